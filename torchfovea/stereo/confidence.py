"""What a disparity map itself tells of how far its readings can be trusted.

Matchers err most at depth edges: a block that straddles one reports the nearer surface (foreground fattening), and
beside a nearer surface lies what the right eye cannot see. Both show in the map: as a neighbourhood that is no plane,
and as holes. `Budget.bend` and `Budget.gap` say how much of it is error; `torchfovea.studies.calibration` fits them.
Not differentiable.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Clues, Disparity

__all__ = ["BLOCK_PX", "read_clues"]

BLOCK_PX = 5.0
"""A neighbourhood reaches at least this far [px]: a matcher's block smears a depth edge over about its side."""

DIRECTIONS = 8  # places around a reading, in opposite pairs


def read_clues(disparity: Disparity, place: Tensor, shift: Tensor, width_px: Tensor) -> Clues:
    """Clues at places of a disparity map.

    Args:
        disparity: the map.
        place: (N, 2), where it was read [px of the map].
        shift: (N,), what was read there [px].
        width_px: (N,), the receptive field's width there [px of the map].

    Returns:
        Clues (N,): the bend is the largest difference of the reading from the mean of two opposite places, both with a
        disparity, on a circle of radius √(width² + BLOCK_PX²); the gap is that radius times the share of
        places without.
    """
    height, width = disparity.disparity.shape
    values, valid = disparity.disparity.flatten(), disparity.valid.flatten()
    radius = (width_px.square() + BLOCK_PX**2).sqrt()
    x, y = place.unbind(-1)

    def at(angle: float) -> tuple[Tensor, Tensor]:
        column, row = (x + radius * math.cos(angle)).round(), (y + radius * math.sin(angle)).round()
        on = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        index = row.clamp(0, height - 1).long() * width + column.clamp(0, width - 1).long()
        return values[index], valid[index] & on

    bend, holes = torch.zeros_like(shift), torch.zeros_like(shift)
    for k in range(DIRECTIONS // 2):
        (one, one_there), (other, other_there) = (at(math.tau * (k / DIRECTIONS + half)) for half in (0.0, 0.5))
        departs = ((one + other) / 2 - shift).abs()
        bend = torch.maximum(bend, torch.where(one_there & other_there, departs, torch.zeros_like(departs)))
        holes = holes + (~one_there).to(holes) + (~other_there).to(holes)
    return Clues(bend, radius * holes / DIRECTIONS)
