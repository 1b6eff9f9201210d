"""The long paths: a picture, a photometric saccade, geometric and tuning episodes, each as an entry of the bench.

Every function takes the command's configuration and the observer it describes, and gives a `Path`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig

from torchfovea.commands.bench.timing import Path, Peer, compiled_peer, in_mode, same
from torchfovea.commands.shared.build import build_arena, build_cells, build_scene_of
from torchfovea.commands.shared.rollout import roll_out
from torchfovea.commands.shared.settings import changed, number, whole
from torchfovea.compiling import compiling
from torchfovea.deciding.weighted import Weighting
from torchfovea.perception import Observer, Step, compiled, decide, new_memory, perceive
from torchfovea.sensing.camera import image_camera
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sim import gl, rays
from torchfovea.stereo.matchers import match_all
from torchfovea.tuning.baselines import table_1
from torchfovea.tuning.bias import Shape
from torchfovea.tuning.estimators import Gradient, covered
from torchfovea.tuning.problem import Problem, play
from torchfovea.tuning.scenes import Distribution, draw_scenes, stream
from torchfovea.tuning.simulator import simulate
from torchfovea.tuning.worlds import Task, Worlds, world_of

__all__ = ["episode", "photometric_saccade", "picture", "sweeps", "tuning_episode", "tuning_gradient"]


def picture(cfg: DictConfig, observer: Observer, size: int) -> Path:
    """One picture by rays, and by OpenGL where there is any."""
    scene = build_scene_of(cfg, observer.head, int(cfg.seed))
    zero = torch.zeros(())
    pose = eyes(observer.head, Gaze(zero, zero + 0.3, zero + 0.1))
    camera = image_camera(observer.camera, observer.retina.radius_px, size)
    by_rays, by_gl = (partial(module.render, scene, pose.R_left, pose.t_left, camera, size) for module in (rays, gl))
    backend = gl.available_gl()

    def check() -> None:
        ours = by_rays()
        hits = ours.geom >= 0
        if not bool(hits.float().mean() > 0.5):
            raise RuntimeError("render: rays that hit nothing")
        if backend is not None:
            same("render", ours.range_m[hits], by_gl().range_m[hits], 0.02, 0.97)

    def quick() -> object:
        with compiling(cfg.compile):
            return by_rays()

    shown = by_rays()
    peers = () if backend is None else (Peer(f"OpenGL, {backend}", by_gl),)
    return Path(
        "render",
        f"a picture of {size} x {size} by rays",
        "cpu",
        by_rays,
        peers if cfg.compile == "off" else (*peers, Peer("ours, compiled", quick)),
        check,
        sum(part.numel() * part.element_size() for part in shown),
    )


def photometric_saccade(cfg: DictConfig, observer: Observer) -> Path:
    """All of a photometric saccade: both eyes' pictures by rays, matching, triangulation, memory, decision."""
    settings = changed(cfg, {"fidelity": "photometric", "sensor": {"sample": None}})
    generator = torch.Generator().manual_seed(int(cfg.seed))
    memory = new_memory(observer, build_cells(cfg, observer.head, generator))
    zero = torch.zeros(())
    gaze = Gaze(zero, zero + 0.3, zero + 0.1)

    def of(observer: Observer) -> Callable[[], Step]:
        arena = build_arena(settings, observer, int(cfg.seed))

        def saccade() -> Step:
            look = arena.look(gaze, generator)
            return decide(observer, perceive(observer, memory, look.matches, eyes(observer.head, gaze)), generator)

        return saccade

    ours = of(observer)

    def check() -> None:
        if int(ours().cell) < 0:
            raise RuntimeError("saccade: nothing to fixate")

    quick = compiled_peer(cfg.compile, lambda mode: of(compiled(observer, mode)))
    work = f"two pictures of {int(cfg.sensor.source_px)} px by rays, {cfg.matcher.name}, to the next fixation"
    return Path("saccade", work, "cpu", ours, quick, check)


def sweeps(cfg: DictConfig, observer: Observer, batch: int) -> Path:
    """Sweeps of several pairs of pictures together, as environments ask for them, and one by one."""
    settings = changed(cfg, {"fidelity": "photometric", "sensor": {"sample": None}})
    zero, tasks = torch.zeros(()), []
    gaze = Gaze(zero, zero + 0.3, zero + 0.1)
    for seed in range(int(cfg.seed), int(cfg.seed) + batch):
        arena = build_arena(settings, observer, seed)
        left, right = arena.world.images(gaze)
        tasks.append(arena.task(left.image, right.image, gaze))
    views, matchers = [view for view, _ in tasks], [matcher for _, matcher in tasks]

    def together(mode: str = "off") -> list[Any]:
        with compiling(mode):
            return match_all(matchers, views, observer.retina, observer.budget)

    def alone() -> list[Any]:
        return [matcher(view, observer.retina, observer.budget) for view, matcher in tasks]

    def check() -> None:
        for (ours, _), (theirs, _) in zip(together(), alone(), strict=True):
            both = ours.valid & theirs.valid
            same("saccade", ours.right_px[both], theirs.right_px[both], 1e-3, 0.99)

    work = f"the sweep alone, {observer.retina.count} RFs; {batch} pairs together"
    peers = Peer("one by one", alone), *compiled_peer(cfg.compile, lambda mode: partial(together, mode))
    return Path("saccade", work, "cpu", together, peers, check, units=batch)


def episode(cfg: DictConfig, observer: Observer, batch: int, device: str, compile: str = "off") -> Path:
    """Geometric episodes that advance together, the same one by one, and, unless `compile` is off, compiled."""
    cfg = cfg.copy()
    cfg.device = device
    cfg.sensor.sample = None
    seeds = [int(cfg.seed) + number for number in range(batch)]

    def together() -> list[Any]:
        return roll_out(cfg, observer, seeds)

    def alone() -> list[Any]:
        return [roll_out(cfg, observer, [seed])[0] for seed in seeds]

    def check() -> None:
        for ours, theirs in zip(together(), alone(), strict=True):
            same("episode", ours.direction[:2], theirs.direction[:2], 1e-3)
            same("episode", ours.global_information[0], theirs.global_information[0], 1e-3)

    looks = whole(cfg, "saccades")
    fast = compiled_peer(compile, lambda mode: partial(roll_out, cfg, compiled(observer, mode), seeds))
    return Path(
        "episode",
        f"of {looks} saccades, {observer.retina.count} RFs, {cfg.memory.cells} cells; {batch} together",
        device,
        together,
        (Peer("one by one", alone), *fast),
        check,
        units=batch,
    )


def tuning_episode(cfg: DictConfig, observer: Observer) -> Path:
    """Tuning's simulated episodes together, and the same one by one."""
    episodes, cells = whole(cfg, "tuning.episodes", 8), whole(cfg, "tuning.cells", 2)
    task = Task(observer, whole(cfg, "saccades", 2), number(cfg, "far_m"))
    generator = torch.Generator().manual_seed(int(cfg.seed))
    scenes = draw_scenes(Distribution(), observer.head, episodes, generator)
    few = changed(cfg, {"memory": {"cells": episodes * cells}})
    directions = build_cells(few, observer.head, generator).reshape(episodes, cells, 3)
    noise = torch.randn(task.saccades, episodes, cells, generator=generator)
    world = world_of(task, scenes, directions, noise)
    weights = Weighting(torch.ones(()))
    part = [torch.tensor([b]) for b in range(min(8, episodes))]
    singles: list[tuple[Any, Worlds]] = [(scenes.take(one), world.take(one)) for one in part]

    def alone() -> torch.Tensor:
        return torch.cat([simulate(task, *single, weights).value for single in singles])

    def together() -> torch.Tensor:
        return simulate(task, scenes, world, weights).value

    def check() -> None:
        same("tune", together()[: len(part)], alone(), 1e-4, 0.99)

    return Path(
        "tune",
        f"an episode of {task.saccades} saccades and {cells} cells; {episodes} together",
        "cpu",
        together,
        (
            Peer(f"one by one, {len(part)} of them scaled", alone, episodes / len(part)),
            *compiled_peer(cfg.compile, lambda mode: partial(in_mode, mode, together)),
        ),
        check,
        units=episodes,
    )


def tuning_gradient(cfg: DictConfig, observer: Observer) -> Path:
    """Tuning's gradient of a bias, with all episodes that it plays, a scene of the minibatch."""
    scenes, cells = whole(cfg, "tuning.episodes", 8), whole(cfg, "tuning.cells", 2)
    task = Task(observer, whole(cfg, "saccades", 2), number(cfg, "far_m"))
    problem = Problem(task, Distribution(), Shape(), cells)
    batch, vector = problem.batch(scenes, stream("training", int(cfg.seed))), table_1(problem.shape, "target")

    def ours() -> Gradient:
        with torch.enable_grad():
            return covered(problem, vector, batch)

    def check() -> None:
        same("tune", [ours().value], [float(play(problem, vector, batch).value.mean())], 1e-6)

    return Path(
        "tune",
        f"a gradient's episodes, {task.saccades} saccades and {cells} cells, for each of {scenes} scenes",
        "cpu",
        ours,
        compiled_peer(cfg.compile, lambda mode: partial(in_mode, mode, ours)),
        check,
        units=scenes,
    )
