"""From a composed configuration to the library's dataclasses, each value checked under the name the user knows."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, TypeVar, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.memory import sphere
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.perception import Eligibility, Observer
from torchfovea.sensing.camera import Camera, Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget
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

T = TypeVar("T")

# A direction counts as reachable if its point at this range is: the neck turns about E, the eyes sit beside it.
REACH_RANGE_M = 1.0


def construct(kind: type[T], node: DictConfig | dict[str, Any], where: str) -> T:
    """Build a dataclass from the settings of the same names; others are ignored.

    Args:
        kind: a frozen dataclass whose fields are floats, ints, bools and strings.
        node: the settings.
        where: their group's name, for errors.

    Raises:
        SettingError: for a value of another type, and whatever the dataclass itself refuses.
    """
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.name in node:
            values[field.name] = _typed(node[field.name], str(field.type), f"{where}.{field.name}")
    return kind(**values)


def _typed(value: Any, kind: str, setting: str) -> Any:
    """A value of a dataclass field's type, told by its name; `Range` is a pair of numbers."""
    if kind.endswith("| None"):
        return None if value is None else _typed(value, kind.removesuffix("| None").strip(), setting)
    if kind == "Range":
        pair = not isinstance(value, str) and hasattr(value, "__len__") and len(value) == 2
        require(pair, setting, value, "two numbers, [least, most]")
        return tuple(_typed(v, "float", setting) for v in value)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind == "float":
        require(number, setting, value, "a number")
        return float(value)
    if kind == "int":
        require(number and float(value).is_integer(), setting, value, "a whole number")
        return int(value)
    require(
        kind not in ("bool", "str") or type(value).__name__ == kind,
        setting,
        value,
        {"bool": "true or false"}.get(kind, "a word"),
    )
    return value


def choice(cfg: DictConfig, setting: str, options: tuple[str, ...]) -> str:
    """One of several words, read at a dotted name."""
    value = OmegaConf.select(cfg, setting)
    require(value in options, setting, value, "one of " + ", ".join(options))
    return str(value)


def whole(cfg: DictConfig, setting: str, least: int = 1) -> int:
    """A whole number no smaller than `least`, read at a dotted name."""
    value = _typed(OmegaConf.select(cfg, setting), "int", setting)
    require(value >= least, setting, value, f"at least {least}")
    return int(value)


def number(cfg: DictConfig, setting: str) -> float:
    """A positive number, read at a dotted name."""
    given = OmegaConf.select(cfg, setting)
    value = float(_typed(given, "float", setting))
    require(value > 0, setting, given, "a positive number")
    return value


def build_sensor(cfg: DictConfig) -> tuple[Camera, Retina]:
    """The eyes' camera, in retinal pixels, and their retina."""
    layout = choice(cfg, "sensor.layout", ("log_polar", "uniform"))
    kind = choice(cfg, "sensor.camera", ("pinhole", "fisheye"))
    fov_deg = _typed(cfg.sensor.fov_deg, "float", "sensor.fov_deg")
    widest = 180 if kind == "pinhole" else 360
    require(0 < fov_deg < widest, "sensor.fov_deg", fov_deg, f"more than 0 and less than {widest} for a {kind} camera")
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
        budget=construct(
            Budget,
            {**cfg.budget, "source_px": whole(cfg, "sensor.source_px", 16) if cfg.budget.source else None},
            "budget",
        ),
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
