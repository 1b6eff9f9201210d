"""The paper's Fig. 1 of a search: the scene at its last fixation, and what either retina measures there."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchfovea.commands.shared.build import build_arena, build_observer
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.precision import EGO, Dots, bearings_deg, both_sensors, headline, measured
from torchfovea.gaussian import Gaussian, columns
from torchfovea.perception import Observer, observed
from torchfovea.sensing.chart import cartesian_from_inverse_range
from torchfovea.sensing.head import Eyes, Gaze, eyes
from torchfovea.setting import require
from torchfovea.sim.world import World

__all__ = ["Sensors", "draw_scene", "sensors_of"]

Sensors = dict[str, tuple[DictConfig, Observer]]

SHOWN_PX = 200  # columns of the cloud in colour


def sensors_of(cfg: DictConfig, observer: Observer) -> Sensors:
    """Configuration and observer of each layout; empty without ``figure1=true``.

    Raises:
        SettingError: for a search whose last fixation cannot be looked at anew.
    """
    found = both_sensors(cfg, observer.retina)
    if found:
        shown = observer.classes is None or cfg.fidelity == "photometric"
        require(shown, "figure1", True, "false with reward=of_class and fidelity=geometric, whose marks no picture has")
        still = name_of(cfg, "motion") == "still"
        require(still, "figure1", True, "false with a base that moves, motion=path")
    ours = cfg.sensor.layout
    return {name: (node, observer if name == ours else build_observer(node)) for name, node in found.items()}


def draw_scene(path: Path, sensors: Sensors, seed: int, gaze: Gaze) -> None:
    """Look once more where the head looked, with each retina.

    Args:
        path: the PNG to write.
        sensors: from `sensors_of`.
        seed: of the episode.
        gaze: one.
    """
    from torchfovea.commands.shared.pictures import draw_precision

    clouds, true = [], None
    for name, (cfg, observer) in sensors.items():
        arena = build_arena(cfg, observer, seed)
        believed = Gaze(*(angle.float() for angle in arena.saccade(gaze).gaze))
        matches = arena.look(believed, torch.Generator().manual_seed(seed)).matches
        pose = eyes(observer.head, believed)
        seen = observed(observer, matches, pose)
        points = Gaussian(seen.mean, seen.cov)
        if observer.fusion.chart == "inverse_range":
            points = cartesian_from_inverse_range(points, seen.direction)
        clouds.append(measured(headline(name, observer.retina), pose, points, seen.valid, seen.inlier))
        true = true or _true(arena.world, pose)
    assert true is not None
    draw_precision(path, true, clouds, EGO)


def _true(world: World, pose: Eyes) -> Dots:
    """The first surfaces of the left eye's picture, in the picture's colours."""
    image = world.images()[0].image
    step = max(1, world.source_px // SHOWN_PX)
    row, column = (torch.arange(0, world.source_px, step, dtype=torch.float64) for _ in "rc")
    px = columns(*torch.broadcast_tensors(column, row[:, None])).reshape(-1, 2)
    seen = world.correspond(None, world.image_camera.rays(px))
    colour = image[:, ::step, ::step].flatten(1).T
    points = seen.points_e[seen.hit]
    return Dots("true surfaces, in the picture's colours", points, bearings_deg(pose, points), colour[seen.hit])
