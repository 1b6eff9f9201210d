"""From a composed configuration to the library's dataclasses, each value checked under the name the user knows."""

from __future__ import annotations

import dataclasses
from typing import Literal, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.experiments.budgets import build_budget
from torchfovea.experiments.settings import choice, construct, number, typed, whole
from torchfovea.memory import sphere
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.perception import Eligibility, Observer
from torchfovea.sensing.camera import Camera, Fisheye, Pinhole
from torchfovea.sensing.head import Head, fixate
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError, require
from torchfovea.sim.arena import Arena
from torchfovea.sim.scene import AttentionWorld, Cans, Room, Scene, build_scene
from torchfovea.sim.world import World
from torchfovea.stereo.external import External
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep

__all__ = [
    "build_arena",
    "build_cells",
    "build_observer",
    "build_scene_of",
    "build_sensor",
    "choice",
    "construct",
    "number",
    "whole",
]

# A direction counts as reachable if its point at this range is: the neck turns about E, the eyes sit beside it.
REACH_RANGE_M = 1.0


def build_sensor(cfg: DictConfig) -> tuple[Camera, Retina]:
    """The eyes' camera, in retinal pixels, and their retina."""
    layout = choice(cfg, "sensor.layout", ("log_polar", "uniform"))
    kind = choice(cfg, "sensor.camera", ("pinhole", "fisheye"))
    fov_deg = typed(cfg.sensor.fov_deg, "float", "sensor.fov_deg")
    widest = 180 if kind == "pinhole" else 360
    require(0 < fov_deg < widest, "sensor.fov_deg", fov_deg, f"more than 0 and less than {widest} for a {kind} camera")
    require(fov_deg >= 1e-3, "sensor.fov_deg", fov_deg, "at least 0.001 degrees")
    retina: Retina = (
        construct(LogPolar, cfg.sensor, "sensor") if layout == "log_polar" else construct(Uniform, cfg.sensor, "sensor")
    )
    return (Pinhole if kind == "pinhole" else Fisheye).from_fov(fov_deg, retina.radius_px), retina


def build_observer(cfg: DictConfig) -> Observer:
    """The observer that a configuration describes; its strategy is `torchfovea.experiments.strategy`'s to build."""
    camera, retina = build_sensor(cfg)
    printed = choice(cfg, "budget.sigma_points", ("ours", "paper")) == "paper"
    return Observer(
        head=construct(Head, cfg.head, "head"),
        camera=camera,
        retina=retina,
        budget=build_budget(cfg),
        points=SigmaPoints.paper() if printed else None,
        rotated=not printed,
        fusion=construct(Fusion, cfg.fusion, "fusion"),
        prior=construct(Prior, cfg.prior, "prior"),
        reward=choice(cfg, "reward.name", ("inverse_range", "range")),
        eligibility=construct(Eligibility, cfg.eligibility, "eligibility"),
    )


def build_cells(cfg: DictConfig, head: Head, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Tensor:
    """The memory's directions, restricted to what the head can fixate, (cells, 3).

    Raises:
        SettingError: for no cells, a bad mixture or one that never falls within reach.
    """
    count = whole(cfg, "memory.cells")
    memory = OmegaConf.to_container(cfg.memory, resolve=True)
    assert isinstance(memory, dict)

    def reachable(directions: Tensor) -> Tensor:
        return fixate(head, REACH_RANGE_M * directions)[1]

    if memory.get("topology"):
        topologies = {
            "latitude_longitude": sphere.latitude_longitude_directions,
            "geodesic": sphere.geodesic_directions,
            "truncated_icosahedron": sphere.truncated_icosahedron_directions,
            "fibonacci": sphere.fibonacci_directions,
        }
        name = memory["topology"]
        require(name in topologies, "memory.topology", name, "one of " + ", ".join(topologies))
        return sphere.reachable_directions(topologies[name], count, reachable).to(dtype)
    missing = [key for key in ("weights", "means", "covariances") if key not in memory]
    if missing:
        raise SettingError(f"memory.{missing[0]} = missing: expected a mixture's weights, means and covariances")
    mixture = sphere.direction_mixture(memory["weights"], memory["means"], memory["covariances"], dtype=torch.float64)
    return sphere.sample(mixture, count, generator, reachable).to(dtype)


def build_scene_of(cfg: DictConfig, head: Head, seed: int) -> Scene:
    """The scene of a configuration's group `scene`."""
    name = choice(cfg, "scene.name", ("attention_world", "cans"))
    room = construct(Room, cfg.scene.room, "scene.room") if "room" in cfg.scene else Room()
    fields = {key: value for key, value in cfg.scene.items() if key not in ("name", "room")}
    params = (
        construct(AttentionWorld, fields, "scene") if name == "attention_world" else construct(Cans, fields, "scene")
    )
    return build_scene(dataclasses.replace(params, room=room), seed, head)


def build_arena(cfg: DictConfig, observer: Observer, seed: int) -> Arena:
    """The simulated world of an episode."""
    scene = build_scene_of(cfg, observer.head, seed)
    fidelity = choice(cfg, "fidelity", ("photometric", "geometric"))
    world = World(
        scene,
        renderer=cast(Literal["rays", "gl"], choice(cfg, "renderer.name", ("rays", "gl"))),
        motor=cast(Literal["instant", "physics"], choice(cfg, "motor", ("instant", "physics"))),
        camera=observer.camera,
        source_px=whole(cfg, "sensor.source_px", 16),
        radius_px=observer.retina.radius_px,
    )
    matcher = build_matcher(cfg)  # checked even where it is not used
    sample = None if OmegaConf.select(cfg, "sensor.sample") is None else whole(cfg, "sensor.sample", 16)
    return Arena(world, observer, None if fidelity == "geometric" else matcher, sample, seed)


def build_matcher(cfg: DictConfig) -> Matcher:
    """The stereo matcher."""
    kinds: dict[str, type[SGBM | Sweep | External]] = {"sgbm": SGBM, "sweep": Sweep, "external": External}
    params = construct(kinds[choice(cfg, "matcher.name", tuple(kinds))], cfg.matcher, "matcher")
    return Matcher(params, number(cfg, "matcher.nearest_range_m"), cfg.matcher.get("source"))
