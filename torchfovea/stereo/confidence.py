"""What a disparity map, or a field of inverse depths, itself tells of how far its readings can be trusted.

Matchers err most at depth edges: a block that straddles one reports the nearer surface (foreground fattening), and
beside a nearer surface lies what the right eye cannot see. Both show in the map: as a neighbourhood that is no plane,
and as holes. `Budget.bend` and `Budget.gap` say how much of it is error; `torchfovea.studies.calibration` fits them.
Not differentiable.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.correspondence import Clues, Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.stereo.sheets import nearest_rf

__all__ = ["BLOCK_PX", "field_clues", "read_clues"]

BLOCK_PX = 5.0
"""A neighbourhood reaches at least this far [px]: a matcher's block smears a depth edge over about its side."""

REACH_PX = 5.0  # for each standard deviation of misfit: about a block
FARTHEST_PX = 35.0  # as far as SGBM was seen to extend a rim over a plain wall
DIRECTIONS = 8  # places around a reading, in opposite pairs
REACH_WIDTHS = 3.0  # just past the window of five RFs that the sweep refines with


def read_clues(
    disparity: Disparity, place: Tensor, shift: Tensor, width_px: Tensor, misfit: Tensor | None = None
) -> Clues:
    """Clues at places of a disparity map.

    Args:
        disparity: the map.
        place: (N, 2), where it was read [px of the map].
        shift: (N,), what was read there [px].
        width_px: (N,), the receptive field's width there [px of the map].
        misfit: (N,), how far the images' difference there stands out from their noise, in standard deviations
            (`torchfovea.stereo.readings.standing_out`); None: not asked.

    Returns:
        Clues (N,): the bend is the largest difference of the reading from the mean of two opposite places, both with a
        disparity, on a circle of radius √(width² + BLOCK_PX² + reach²); the fringe is the largest by which it is
        nearer than that; the gap is that radius times the share of places without. What is hidden is the map's rivals.
        The reach is REACH_PX for each standard deviation of misfit, FARTHEST_PX at most: where there is little texture,
        matchers extend a near thing far beyond its rim, and what it covers there differs by more than noise.
    """
    height, width = disparity.disparity.shape
    # NaN where there is no disparity, and around the map
    told = F.pad(torch.where(disparity.valid, disparity.disparity, math.nan), (1, 1, 1, 1), value=math.nan).flatten()
    square = width_px.square() + BLOCK_PX**2
    if misfit is not None:
        square = square + (REACH_PX * misfit).clamp(max=FARTHEST_PX).square()
    radius = square.sqrt()
    x, y = place.unbind(-1)
    angle = math.tau * torch.arange(DIRECTIONS, device=radius.device, dtype=radius.dtype)[:, None] / DIRECTIONS
    column = torch.addcmul(x, radius, angle.cos()).round_().clamp_(-1, width).int()
    row = torch.addcmul(y, radius, angle.sin()).round_().clamp_(-1, height).int()
    around = told.index_select(0, ((row + 1) * (width + 2) + (column + 1)).flatten()).view(DIRECTIONS, -1)
    one, other = around.chunk(2)
    departs = (shift - (one + other) / 2).nan_to_num_(0.0)
    nearer, farther = departs.amax(0).clamp(min=0), departs.amin(0).neg().clamp(min=0)
    holes = around.isnan().sum(0)
    clues = Clues(torch.maximum(nearer, farther), radius * holes / DIRECTIONS, nearer)
    if disparity.rival_px is None:
        return clues
    column, row = x.round().clamp(0, width - 1).long(), y.round().clamp(0, height - 1).long()
    return clues._replace(hidden_px=disparity.rival_px[row, column])


@torch.no_grad()
def field_clues(values: Tensor, valid: Tensor, px_per_value: Tensor, retina: Retina, source_pitch_px: float) -> Clues:
    """The same clues for readings that live on the RFs themselves.

    Args:
        values: (B, N), linear over the field on a plane, such as inverse depth.
        valid: bool (B, N).
        px_per_value: (B, N), the disparity that a unit of it makes [source px].
        retina: the layout.
        source_pitch_px: a source pixel in retinal pixels.

    Returns:
        Clues (B, N) as `read_clues`', on a circle of three widths (of the RF, or of a source pixel where that is
        wider). What lies beyond the retina is no hole.
    """
    around, radius_px, on = _surroundings(retina, source_pitch_px, values.device)
    told = torch.where(valid, values, math.nan).index_select(1, around.flatten()).view(-1, *around.shape)
    one, other = told.chunk(2, 1)
    departs = (values[:, None] - (one + other) / 2).nan_to_num_(0.0)
    nearer, farther = departs.amax(1).clamp(min=0), departs.amin(1).neg().clamp(min=0)
    holes = (on & told.isnan()).sum(1).to(values)
    gap_px = radius_px.to(holes) * holes / DIRECTIONS
    return Clues(torch.maximum(nearer, farther) * px_per_value, gap_px, nearer * px_per_value)


@lru_cache(maxsize=16)
def _surroundings(retina: Retina, source_pitch_px: float, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The RFs around every RF, (8, N) int64; at which distance (N,) [source px]; which are on the retina, (8, N).

    The second four mirror the first four, so that a slant cancels.
    """
    with torch.inference_mode(False), torch.no_grad():
        centers = retina.centers_px(device, torch.float64)
        radius = REACH_WIDTHS * retina.width_px(centers).clamp(min=source_pitch_px)
        near, on = [], []
        for k in range(DIRECTIONS // 2):
            angle = math.tau * k / DIRECTIONS
            place = centers + columns(radius * math.cos(angle), radius * math.sin(angle))
            near.append(nearest_rf(retina, source_pitch_px, place))
            on.append(retina.inside(place))
        for k in range(DIRECTIONS // 2):
            place = 2 * centers - centers[near[k]]
            near.append(nearest_rf(retina, source_pitch_px, place))
            on.append(retina.inside(place))
        return torch.stack(near), radius / source_pitch_px, torch.stack(on)
