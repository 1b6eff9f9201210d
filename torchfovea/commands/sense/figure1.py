"""The paper's Fig. 1 of a pair: its surfaces in colour, and what either retina makes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from omegaconf import DictConfig

from torchfovea.commands.sense.points import Sensed
from torchfovea.commands.shared.budgets import build_budget
from torchfovea.commands.shared.build import build_sensor
from torchfovea.commands.shared.pairs import Pair
from torchfovea.commands.shared.precision import CAMERA, Dots, bearings_deg, both_sensors, headline, measured
from torchfovea.gaussian import columns
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina

__all__ = ["draw_pair", "retinas_of"]

SHOWN_PX = 250  # columns and rows of the cloud in colour
AT_HOME = Eyes(torch.eye(3), torch.zeros(3), torch.eye(3), torch.zeros(3))  # points are in the left camera's frame


def retinas_of(cfg: DictConfig, retina: Retina | None, budget: Budget) -> dict[str, tuple[Retina, Budget]]:
    """Retina and error budget of each layout; empty without ``figure1=true``.

    Args:
        cfg: of `sense`.
        retina: that it describes.
        budget: that it describes.

    Raises:
        SettingError: see `torchfovea.commands.shared.precision.both_sensors`.
    """
    return {
        name: (retina, budget)
        if retina is not None and name == cfg.sensor.layout
        else (build_sensor(node)[1], build_budget(node, pair=True))
        for name, node in both_sensors(cfg, retina).items()
    }


def draw_pair(
    path: Path,
    pair: Pair,
    retinas: Mapping[str, tuple[Retina, Budget]],
    look: Callable[[Retina, Budget], Sensed],
) -> None:
    """Look at a pair with each retina.

    Args:
        path: the PNG to write.
        pair: without a truth, the points that the last retina measured stand in for it.
        retinas: from `retinas_of`.
        look: matches the pair.
    """
    from torchfovea.commands.shared.pictures import draw_precision

    clouds, true = [], _true(pair)
    for name, (retina, budget) in retinas.items():
        sensed = look(retina, budget)
        clouds.append(measured(headline(name, retina), AT_HOME, sensed.points, sensed.chosen, sensed.observed.inlier))
    if true is None:
        points, colour = sensed.points.mean[sensed.chosen], sensed.colour[sensed.chosen]
        true = Dots("measured, in the picture's colours", points, bearings_deg(AT_HOME, points), colour)
    draw_precision(path, true, clouds, CAMERA)


def _true(pair: Pair) -> Dots | None:
    """The true surfaces of a rectified pair, in the left image's colours."""
    if pair.disparity is None:
        return None
    height, width = pair.disparity.shape
    step = max(1, max(height, width) // SHOWN_PX)
    row, column = (torch.arange(0, size, step, dtype=torch.float64) for size in (height, width))
    px = columns(*torch.broadcast_tensors(column, row[:, None]))
    depth = pair.depth_m(pair.disparity[::step, ::step].double())
    points = pair.camera_left.rays(px) * depth[..., None]
    known = torch.isfinite(depth) & (depth > 0)
    points, colour = points[known], pair.left[:, ::step, ::step].movedim(0, -1)[known]
    return Dots("truth, in the picture's colours", points, bearings_deg(AT_HOME, points), colour)
