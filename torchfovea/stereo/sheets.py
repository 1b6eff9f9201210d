"""A retina cut into sheets: regular grids of places on which windows and neighbours mean something to a matcher.

A log-polar retina becomes bands of rings by sectors, about an octave of RF widths each (the cortical image, closed
along its sectors), and, where its RFs are narrower than a pixel of the source image, one square lattice of the
source's pitch in their stead: finer places would only repeat each other. A uniform retina becomes one square lattice,
and so does any other layout, at the pitch of its narrowest RF.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.layout import LogPolar, Retina, Uniform

__all__ = ["Sheet", "average", "nearest_rf", "read_sheet", "sheets"]

MARGIN = 4  # cells of context around the RFs that a sheet answers for


class Sheet(NamedTuple):
    """A grid of R × S places on the retina.

    Attributes:
        px: (R, S, 2) [retinal px].
        width_px: (R, S), the larger of the RF's width there and a source pixel.
        closed: whether the last column neighbours the first.
        rf: (n,) int64, the RFs answered for.
        cells: (4, n) int64, the cells around each RF, or (1, n) where every RF is a cell itself; the nearest one first.
        share: (4, n) or (1, n), their bilinear weights.
    """

    px: Tensor
    width_px: Tensor
    closed: bool
    rf: Tensor
    cells: Tensor
    share: Tensor


@lru_cache(maxsize=16)
def sheets(retina: Retina, source_pitch_px: float, device: torch.device, dtype: torch.dtype) -> tuple[Sheet, ...]:
    """Cut a retina into sheets; every RF is answered for by exactly one.

    Args:
        retina: the layout.
        source_pitch_px: a source pixel in retinal pixels.
        device: of the result.
        dtype: of the result.
    """
    centers = retina.centers_px("cpu", torch.float64).numpy()
    if isinstance(retina, Uniform):
        own = retina.pitch_px >= source_pitch_px
        parts = [_lattice(centers, max(retina.pitch_px, source_pitch_px), own)]
    elif isinstance(retina, LogPolar):
        parts = _cut(retina, centers, source_pitch_px)
    else:
        narrowest = float(retina.width_px(torch.from_numpy(centers)).min())
        parts = [_lattice(centers, max(narrowest, source_pitch_px), own=False)]
    out = []
    with torch.inference_mode(False), torch.no_grad():
        for px, closed, rf, place in parts:
            grid = columns(*(torch.from_numpy(np.ascontiguousarray(c)) for c in px))
            width = retina.width_px(grid).clamp(min=source_pitch_px)
            cells, share = _around(place, (grid.shape[0], grid.shape[1]))
            grid, width, share = (a.to(device, dtype) for a in (grid, width, share))
            out.append(Sheet(grid, width, closed, torch.from_numpy(rf).to(device), cells.to(device), share))
    return tuple(out)


def _around(place: np.ndarray, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Cells of a grid, rows and columns, around places (n, 2), columns and rows, and their weights; see `Sheet`."""
    last = np.array(size)[::-1] - 1
    nearest = np.minimum(np.round(place), last)
    steps = np.array([(0, 0), (1, 0), (0, 1), (1, 1)] if (nearest != place).any() else [(0, 0)])
    at = nearest + steps[:, None] * np.where(place < nearest, -1, 1)
    share = np.clip(1 - np.abs(place - at), 0, 1).prod(-1)
    column, row = np.moveaxis(np.clip(at, 0, last), -1, 0)
    return torch.from_numpy((row * size[1] + column).astype(np.int64)), torch.from_numpy(share)


Part = tuple[tuple[np.ndarray, np.ndarray], bool, np.ndarray, np.ndarray]


def _cut(retina: LogPolar, centers: np.ndarray, source_pitch: float) -> list[Part]:
    """A lattice for the RFs that are narrower than the source's pixels, and bands of the other rings."""
    fovea, rings, sectors = retina.fovea_count, retina.rings, retina.sectors
    widths = retina.rho_min_px * retina.base ** np.arange(rings) * (retina.base - 1)
    start = int((widths < source_pitch).sum())
    octave = max(3, round(math.log(2) / math.log(retina.base)))
    start = rings if rings - start < 3 else start  # fewer than three rings make no band
    parts = []
    inner = fovea + start * sectors
    if inner:
        own = start == 0 and retina.fovea_pitch_px >= source_pitch
        parts.append(_lattice(centers[:inner], retina.fovea_pitch_px if own else source_pitch, own))
    cortex = np.moveaxis(centers[fovea:].reshape(rings, sectors, 2), -1, 0)
    bands = max(1, round((rings - start) / octave)) if start < rings else 0
    for k in range(bands):
        low, high = (start + round(j * (rings - start) / bands) for j in (k, k + 1))
        bottom, top = max(low - MARGIN, 0), min(high + MARGIN, rings)
        row, column = np.divmod(np.arange((low - bottom) * sectors, (high - bottom) * sectors), sectors)
        rf = fovea + np.arange(low * sectors, high * sectors)
        parts.append(((cortex[0, bottom:top], cortex[1, bottom:top]), True, rf, np.stack([column, row], -1)))
    return parts


def _lattice(centers: np.ndarray, pitch: float, own: bool) -> Part:
    """A square lattice under the first RFs, through their centres if the pitch is their own."""
    offset = np.mod(centers[0] / pitch + 1e-9, 1.0) if own else np.full(2, 0.5)
    place = centers / pitch - offset
    low, high = np.floor(place.min(0) + 1e-6) - MARGIN, np.ceil(place.max(0) - 1e-6) + MARGIN
    x, y = ((np.arange(low[k], high[k] + 1) + offset[k]) * pitch for k in (0, 1))
    across, down = np.broadcast_arrays(x, y[:, None])
    return (across, down), False, np.arange(len(centers)), np.round(place - low, 6)


def average(values: Tensor, radius: int, closed: bool) -> Tensor:
    """Weighted means over windows of (2 radius + 1)² cells, (..., R, S) to the same; repeated beyond an open border.

    A window of 3 × 3 equal weights, `radius` times over, so that larger windows weigh their middle most.
    Differentiable.
    """
    for _ in range(radius):
        for dim, around in ((-2, False), (-1, closed)):
            size = values.shape[dim]
            first, last = values.narrow(dim, 0, 1), values.narrow(dim, size - 1, 1)
            wide = torch.cat([last, values, first] if around else [first, values, last], dim)
            values = wide.narrow(dim, 0, size) + wide.narrow(dim, 1, size)
            values += wide.narrow(dim, 2, size)
    return values * 9.0**-radius


def read_sheet(sheet: Sheet, values: Tensor, guide: Tensor, valid: Tensor, edge: Tensor) -> tuple[Tensor, Tensor]:
    """Values of a sheet's cells at the RFs that it answers for.

    Bilinear among the cells that are valid and whose guide is within `edge` of the nearest cell's, which must be valid
    itself: nothing is averaged over a depth edge.

    Args:
        sheet: with n RFs.
        values: (B, C, R, S).
        guide: (B, R, S).
        valid: bool (B, R, S).
        edge: (B, R, S), the largest difference of the guide on one surface.

    Returns:
        (B, C, n), 0 where invalid, and bool (B, n). Differentiable in the values.
    """
    values, guide, valid, edge = (part.flatten(-2) for part in (values, guide, valid, edge))
    nearest, *others = sheet.cells
    found, reference, limit = (_at(part, nearest) for part in (valid, guide, edge))
    first = _at(values, nearest)
    if not others:
        return first * found[:, None], found
    total = sheet.share[0] * found
    out = total[:, None] * first
    for cell, share in zip(others, sheet.share[1:], strict=True):
        near = (_at(guide, cell) - reference).abs() <= limit
        weight = share * (found & _at(valid, cell) & near)
        total, out = total + weight, out + weight[:, None] * _at(values, cell)
    return out / torch.where(found, total, torch.ones_like(total))[:, None], found


def _at(values: Tensor, cell: Tensor) -> Tensor:
    """Values (..., R · S) of cells (n,); an index over the last of several axes takes three times as long."""
    return values.gather(-1, cell.expand(*values.shape[:-1], -1))


def nearest_rf(retina: Retina, source_pitch_px: float, px: Tensor) -> Tensor:
    """The RF nearest to any place of the retina, (..., 2) to int64 (...), to within half a source pixel."""
    table, pitch = _table(retina, source_pitch_px, px.device)
    middle = (len(table) - 1) / 2
    place = (px.detach() / pitch + middle).round().clamp(0, len(table) - 1).long()
    return table[place[..., 1], place[..., 0]]


@lru_cache(maxsize=16)
def _table(retina: Retina, source_pitch_px: float, device: torch.device) -> tuple[Tensor, float]:
    with torch.inference_mode(False), torch.no_grad():
        size = min(1025, 2 * math.ceil(retina.radius_px / source_pitch_px) + 1)
        axis = np.linspace(-retina.radius_px, retina.radius_px, size)
        tree = cKDTree(retina.centers_px("cpu", torch.float64).numpy())
        _, index = tree.query(np.stack(np.broadcast_arrays(axis, axis[:, None]), -1))
        return torch.from_numpy(index).to(device), 2 * retina.radius_px / (size - 1)
