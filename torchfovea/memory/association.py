"""Which observation belongs to which cell of the memory (Sec. 5.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns, positive_definite, rounding_of_minors
from torchfovea.machine import Loops, columns_of, loops
from torchfovea.memory.nearest import CellIndex, nearest_cell, nearest_observation
from torchfovea.sensing.triangulation import Observations

__all__ = ["Pairs", "associate", "gather_columns", "in_front"]


class Pairs(NamedTuple):
    """Observations and the cells that take them; both count through all batches, (B N) and (B Nx).

    Attributes:
        observation: (M,) int64.
        cell: (M,) int64.
    """

    observation: Tensor
    cell: Tensor


def gather_columns(values: Tensor, index: Tensor) -> Tensor:
    """Rows `index` (M,) of values (..., k), counted through all leading axes, as columns (M, k)."""
    return columns(*(value.reshape(-1).index_select(0, index) for value in values.unbind(-1)))


def usable(observed: Observations) -> Tensor:
    """Observations that can be fused: valid, finite, positive definite, with unit directions; bool (..., N)."""
    square = (observed.direction * observed.direction).sum(-1)
    good = observed.valid & ((square - 1).abs() < 1e-3) & torch.isfinite(observed.mean.sum(-1))
    return good & positive_definite(observed.cov)


def associate(
    cells: Tensor,
    index: CellIndex,
    spacing_rad: Tensor,
    observed: Observations,
    gate_rad: float,
    gate_spacing: float,
    fill: bool,
) -> Pairs:
    """Pair observations with cells (Eq. 23): each with its nearest, then each empty covered cell with its nearest.

    Args:
        cells: unit directions (..., Nx, 3).
        index: of the cells, from `torchfovea.memory.nearest.build_index`.
        spacing_rad: distance of each cell to its neighbours (..., Nx).
        observed: (..., N). What is not valid, not finite, not positive definite or has no unit direction is left out.
        gate_rad: pairs farther apart are dropped, unless the receptive field covers the cell
        gate_spacing: or the cell is within this many spacings.
        fill: whether a cell without observation takes the nearest one, within the gate.

    Returns:
        The pairs. Not differentiable.
    """
    library = loops(cells, observed.mean, observed.cov, observed.direction, observed.support_rad, spacing_rad)
    if library is not None:
        return _by_loops(library, cells, index, spacing_rad, observed, (gate_rad, gate_spacing, fill))
    good = usable(observed)
    cell, cosine = nearest_cell(index, observed.direction)
    angle = torch.acos(cosine.clamp(-1, 1))
    gate = torch.maximum(
        (gate_spacing * spacing_rad.gather(-1, cell)).clamp(min=gate_rad), observed.support_rad.expand_as(angle)
    )
    batch, count, size = good.shape[:-1].numel(), cells.shape[-2], good.shape[-1]
    offset = torch.arange(batch, device=cells.device)[:, None]
    flat = cell.reshape(batch, size) + offset * count
    pair = (good & (angle <= gate)).reshape(-1).nonzero().squeeze(1)
    cell = flat.reshape(-1).index_select(0, pair)
    if not fill or size == 0:
        return Pairs(pair, cell)
    empty = torch.ones(batch * count, dtype=torch.bool, device=cells.device)
    empty[cell] = False
    support = observed.support_rad.expand(good.shape)
    widest = max(gate_rad, float(torch.where(good, support, torch.zeros_like(support)).max()))
    if widest == 0:
        return Pairs(pair, cell)
    counted = torch.where(good[..., None], observed.direction.detach(), torch.zeros_like(observed.direction))
    nearest, cosine = nearest_observation(counted, cells, gate_rad=widest, wanted=empty.view(cells.shape[:-1]))
    extra = (empty & (cosine.reshape(-1) > -1)).nonzero().squeeze(1)
    source = (nearest.reshape(batch, count) + offset * size).reshape(-1).index_select(0, extra)
    # the observation's own gate, not the widest one's
    apart = gather_columns(observed.direction, source) - gather_columns(cells, extra)
    chord = 2 * torch.sin(support.reshape(-1).index_select(0, source).clamp(gate_rad, math.pi) / 2)
    within = ((apart * apart).sum(-1) <= chord * chord).nonzero().squeeze(1)
    source, extra = source.index_select(0, within), extra.index_select(0, within)
    return Pairs(torch.cat([pair, source]), torch.cat([cell, extra]))


def _by_loops(
    library: Loops,
    cells: Tensor,
    index: CellIndex,
    spacing_rad: Tensor,
    observed: Observations,
    gates: tuple[float, float, bool],
) -> Pairs:
    """`associate` by the loops of associate.c."""
    valid = observed.valid.contiguous()
    sets, count, size = valid.shape[:-1].numel(), valid.shape[-1], cells.shape[-2]
    vectors = (columns_of(part) for part in (observed.direction, observed.mean, observed.cov))
    support = observed.support_rad.expand(valid.shape).contiguous()
    given = (sets, count, size, *vectors, support, valid, columns_of(cells), spacing_rad.contiguous())
    given = (*given, rounding_of_minors(cells.dtype))
    table = (index.vectors.contiguous(), index.cells.contiguous(), index.link.contiguous(), index.resolution)
    kinds = torch.empty(2, sets * (count + size) + 1, dtype=torch.int64)
    found = library("associate", given, table, *map(float, gates[:2]), int(gates[2]), kinds[0], kinds[1])
    return Pairs(kinds[0, :found], kinds[1, :found])


def in_front(near: Tensor, std: Tensor, cell: Tensor, cells: int, limit: float, hides: Tensor | None = None) -> Tensor:
    """A z-buffer that knows its noise: drop what lies behind another observation of the same cell.

    The eyes are beside and above the ego frame's origin and see past the edge of a near thing; from that origin what
    they see there is hidden.

    Args:
        near: inverse ranges (M,).
        std: their standard deviations (M,).
        cell: (M,) int64.
        cells: how many there are.
        limit: how many standard deviations apart, counted on either side, two surfaces are two.
        hides: which of them can hide others, bool (M,); None: all.

    Returns:
        Whether each is kept, bool (M,).
    """
    margin = limit * std
    surface = torch.full((cells,), -torch.inf, dtype=near.dtype, device=near.device)
    edge = near - margin if hides is None else torch.where(hides, near - margin, -torch.inf)
    surface = surface.scatter_reduce(0, cell, edge, "amax")
    return near + margin >= surface.index_select(0, cell)
