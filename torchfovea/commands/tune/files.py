"""What a tuning run leaves for `torchfovea search --config-dir RUN`: biases and scenes as files of configuration."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import torch
from omegaconf import OmegaConf
from torch import Tensor

from torchfovea.commands.shared.memories import mixture_yaml
from torchfovea.files import replacing
from torchfovea.tuning.bias import decode, mixture_of
from torchfovea.tuning.problem import Problem
from torchfovea.tuning.scenes import Distribution

__all__ = ["memory_yaml", "scene_yaml", "write_memory", "write_scenes"]

_CORNERS = [(float(a), float(e)) for a in (-1, 0, 1) for e in (-1, 0, 1)]


def memory_yaml(problem: Problem, vector: Tensor, task: Tensor | None, note: str, name: str = "tuned") -> str:
    """A bias in the form of conf/memory/*.yaml."""
    return mixture_yaml(mixture_of(problem.shape, vector.double(), task), note, name)


def write_memory(problem: Problem, vector: Tensor, folder: Path, name: str = "tuned", how: str = "Tuned on") -> None:
    """A vector as files for `search --config-dir FOLDER memory=NAME`; a conditioned one for nine tasks."""
    weights = decode(problem.shape, vector, torch.zeros(1, problem.shape.task_numbers, dtype=torch.float64)).weights
    told = {field.name: float(getattr(weights, field.name)) for field in fields(weights)}
    plain = not any(value for name, value in told.items() if name != "alpha")
    given = [f"acquisition.{name}={value:.4g}" for name, value in told.items() if name == "alpha" or value]
    acquisition = " ".join(given if plain else ["acquisition=weighted", *given])
    own, observer = problem.distribution, problem.at(vector).task.observer
    fov_deg = 2 * math.degrees(math.atan(observer.retina.radius_px / observer.camera.focal_px))
    tasks: dict[str, Tensor | None] = {"": None}
    if problem.shape.conditioned:
        unsure = [0.0] * (problem.shape.task_numbers - 2)  # middling
        tasks = {f"_task_{a:+.0f}_{e:+.0f}": torch.tensor([a, e, *unsure]) for a, e in _CORNERS}
    for suffix, task in tasks.items():
        use = f"search --config-dir THIS_RUNS_FOLDER memory={name}{suffix} scene={own.name}{suffix}"
        note = f"{how} {own.name}: torchfovea {use} {acquisition} sensor.fov_deg={fov_deg:.4g}"
        with replacing(folder / "memory" / f"{name}{suffix}.yaml") as temporary:
            temporary.write_text(memory_yaml(problem, vector, task, note, f"{name}{suffix}"), encoding="utf-8")


def write_scenes(own: Distribution, folder: Path) -> None:
    """A distribution as files for `search --config-dir FOLDER scene=...`: a file for each region or task."""
    regions = {f"_{k}" if len(own.regions) > 1 else "": region for k, region in enumerate(own.regions)}
    if own.conditioned:
        regions = {f"_task_{a:+.0f}_{e:+.0f}": own.region_of(a, e) for a, e in _CORNERS}
    for suffix, region in regions.items():
        with replacing(folder / "scene" / f"{own.name}{suffix}.yaml") as temporary:
            temporary.write_text(scene_yaml(own, region), encoding="utf-8")


def scene_yaml(distribution: Distribution, region: tuple[float, float, float, float]) -> str:
    """A distribution's scenes with the target in one region, in the form of conf/scene/cans.yaml.

    The cans then stand on poles, amid furniture.
    """
    d = distribution
    fields = ("cans", "target_range_m", "azimuth_deg", "elevation_deg", "range_m", "can_radius_m", "can_height_m",
              "margin_m", "tries")  # fmt: skip
    same = {name: getattr(d, name) for name in fields}
    content = {
        "name": "cans",
        "_target_": "torchfovea.sim.scene.Cans",
        "target_azimuth_deg": region[:2],
        "target_elevation_deg": region[2:],
        **same,
    }
    walls = {name: getattr(d, name) for name in ("front_m", "back_m", "side_m", "height_m")}
    content |= {
        "pole_radius_m": 0.012,
        "reach_margin_deg": 1.5,
        "room": {"_target_": "torchfovea.sim.room.Room", **walls, "furniture": True},
    }
    content |= {"outside_first_view": False, "first_view_deg": 90.0}
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in content.items()}
    return f"# The scenes of distribution={d.name}, for search scene=...\n" + OmegaConf.to_yaml(OmegaConf.create(plain))
