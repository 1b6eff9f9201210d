"""Looks at simulated scenes whose truth is cast, for `torchfovea calibrate`: a scene a piece of work."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from omegaconf import DictConfig

from torchfovea.commands.calibrate.truths import Truths, look_at_world
from torchfovea.commands.shared.build import (
    build_head,
    build_matcher,
    build_noise,
    build_renderer,
    build_scene_of,
    build_sensor,
)
from torchfovea.commands.shared.parallel import spread, workers_of
from torchfovea.commands.shared.screen import progress_bar
from torchfovea.commands.shared.settings import changed
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Gaze, fixate
from torchfovea.setting import SettingError
from torchfovea.sim.scene import Scene
from torchfovea.sim.world import World

__all__ = ["SceneTask", "looks_at", "looks_at_scenes", "random_gazes", "viewed"]


class SceneTask(NamedTuple):
    """A scene to look at.

    Attributes:
        cfg: the command's configuration.
        budget: the error budget that the matcher is told, with the pictures' side.
        seed: of the scene, and of where to look.
        fov_deg: field of view.
        looks: random fixations.
    """

    cfg: DictConfig
    budget: Budget
    seed: int
    fov_deg: float
    looks: int


def looks_at_scenes(tasks: list[SceneTask]) -> list[list[Truths]]:
    """What the looks at each scene tell, by the settings `workers` and `backend`; the same for any number of them.

    Raises:
        SettingError: for a scene without surfaces within reach, and whatever a scene, a matcher or a renderer refuses.
    """
    found: dict[int, list[Truths]] = {}
    with progress_bar() as p:
        bar = p.add_task("scenes", total=len(tasks))
        for k, outcome in spread(looks_at, tasks, *workers_of(tasks[0].cfg)) if tasks else ():
            if isinstance(outcome, Exception):
                raise outcome
            found[k] = outcome
            p.update(bar, advance=1)
    return [found[k] for k in range(len(tasks))]


def looks_at(task: SceneTask) -> list[Truths]:
    """Random looks at one scene."""
    sized = viewed(task.cfg, task.fov_deg)
    camera, retina = build_sensor(sized)
    scene = build_scene_of(sized, build_head(sized), task.seed)
    world = World(
        scene,
        renderer=build_renderer(sized),
        camera=camera,
        source_px=task.budget.source_px or sized.sensor.source_px,
        radius_px=retina.radius_px,
        noise=build_noise(sized),
        seed=task.seed,
    )
    gazes = random_gazes(scene, world, task.looks, torch.Generator().manual_seed(task.seed))
    matcher = build_matcher(sized)
    return [look_at_world(world, gaze, retina, task.budget, matcher) for gaze in gazes]


def viewed(cfg: DictConfig, fov_deg: float) -> DictConfig:
    """The same settings with another field of view."""
    return changed(cfg, {"sensor": {"fov_deg": fov_deg}})


def random_gazes(scene: Scene, world: World, count: int, generator: torch.Generator) -> list[Gaze]:
    """Gazes that fixate surfaces in random directions within reach."""
    head, found = world.head, []
    for _ in range(1000 * count):
        pan = math.radians(head.pan_limit_deg) * (2 * torch.rand((), generator=generator, dtype=torch.float64) - 1)
        span = math.radians(head.tilt_up_deg + head.tilt_down_deg)
        tilt = span * torch.rand((), generator=generator, dtype=torch.float64) - math.radians(head.tilt_up_deg)
        forward = torch.cos(tilt)
        direction = torch.stack([forward * torch.cos(pan), forward * torch.sin(pan), -torch.sin(tilt)])
        hit = world.panorama(direction[None])
        gaze, reachable = fixate(head, direction * hit.range_m[0])
        if bool(reachable) and int(hit.geom[0]) >= 0:
            found.append(gaze)
        if len(found) == count:
            return found
    raise SettingError(f"scene = {type(scene.params).__name__}: expected a scene with surfaces within reach")
