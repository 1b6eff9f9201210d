"""What a part of a picture is to a stereo matcher, from its truth: smooth, at a depth edge, hidden, without texture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["REGIONS", "at_places", "hidden_places", "regions", "truth_step_px"]

REGIONS = ("smooth", "edge", "hidden", "weak_texture")
"""Every place is one of these: hidden before edge before weak texture before smooth."""

EDGE_STEP_PX = 1.5  # of disparity between neighbouring pixels
EDGE_REACH_PX = 7
WEAK_CONTRAST = 0.02  # standard deviation of grey within 7 x 7 pixels, of a range of 1


def regions(disparity: Tensor, image: Tensor, hidden: Tensor | None = None) -> Tensor:
    """The region of every pixel.

    Args:
        disparity: the truth (H, W) [px]; not finite where unknown.
        image: the left image (3, H, W) in [0, 1].
        hidden: bool (H, W), what the right eye cannot see; None: read off the truth.

    Returns:
        (H, W) int64, an index of REGIONS.
    """
    grey = image.mean(0)
    side = 2 * EDGE_REACH_PX + 1
    mean, square = (_pooled(torch.nn.functional.avg_pool2d, v, 7) for v in (grey, grey.square()))
    weak = (square - mean.square()).clamp(min=0).sqrt() < WEAK_CONTRAST
    jump = torch.zeros_like(disparity)
    for axis in (0, 1):
        step = disparity.diff(dim=axis).abs()
        step = (torch.isfinite(step) & (step > EDGE_STEP_PX)).to(jump)
        nothing = torch.zeros_like(jump.narrow(axis, 0, 1))
        jump = torch.maximum(jump, torch.maximum(torch.cat([step, nothing], axis), torch.cat([nothing, step], axis)))
    edge = _pooled(torch.nn.functional.max_pool2d, jump, side) > 0
    region = torch.where(weak, 3, torch.zeros_like(weak, dtype=torch.int64))
    region = torch.where(edge, 1, region)
    return torch.where(hidden_places(disparity) if hidden is None else hidden, 2, region)


def hidden_places(disparity: Tensor) -> Tensor:
    """Where a nearer surface of the truth (H, W) stands between the point and the right eye, bool (H, W)."""
    height, width = disparity.shape
    known = torch.isfinite(disparity)
    shift = torch.where(known, disparity, torch.zeros_like(disparity))
    reach = int(shift.abs().max().ceil()) + 2
    column = torch.arange(width, device=disparity.device) - shift.round().long() + reach
    nearest = shift.new_full((height, width + 2 * reach), -math.inf)
    told = torch.where(known, shift, torch.full_like(shift, -math.inf))
    for beside in (-1, 0, 1):  # a surface that slants is stretched in the right image
        nearest.scatter_reduce_(1, column + beside, told, "amax")
    return known & (nearest.gather(1, column) > shift + EDGE_STEP_PX)


def at_places(values: Tensor, places: Tensor) -> Tensor:
    """A map (H, W) at the pixels nearest to places (N, 2), columns and rows; the border's beyond it."""
    height, width = values.shape
    column, row = places.round().long().unbind(-1)
    return values[row.clamp(0, height - 1), column.clamp(0, width - 1)]


def truth_step_px(disparity: Tensor) -> float:
    """The step in which a truth comes: the median distance of neighbouring values [px]; near 0 for a continuous one."""
    values = disparity[torch.isfinite(disparity)].double().unique()
    return float(values.diff().median()) if len(values) > 1 else 0.0


def _pooled(pool: Callable[..., Any], values: Tensor, side: int) -> Tensor:
    padded = torch.nn.functional.pad(values[None, None], [side // 2] * 4, mode="replicate")
    return torch.as_tensor(pool(padded, side, 1)[0, 0])
