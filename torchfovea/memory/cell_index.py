"""Which cells can be the nearest where: a cube map of short candidate lists, for any set of cells.

The sphere is cut into the texels of a cube map. A table holds for each texel the few cells that are nearest somewhere
in it: at most four a row. Texels in which more cells meet are cut into quarters until four are enough, and where still
more meet at one point (the poles of a grid of latitude and longitude) their rows are chained.

Why nothing is missed: on a face of the cube a cell's inner product with the ray (1, u, v) is linear in (u, v). If one
cell is at least as good as another at the four corners of a texel, it is at least as good in all of it, and the other
can be dropped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = ["SLOTS", "CellIndex", "arange", "build_index", "unit_cells"]

SLOTS = 4  # cells a row
_ROOTS = 4  # texels along an edge of the cube at the start of a build
_FINEST = 1 << 21  # texels along an edge beyond which none is cut: the resolution of float32 directions
_SHORT_LIST = 16  # cells that meet at one point are listed rather than separated, two cuts below the table
_PAIRS_CPU, _PAIRS_GPU = 1 << 14, 1 << 20


class CellIndex(NamedTuple):
    """Lookup table of the nearest cell; build it with `build_index`.

    Attributes:
        vectors: the cells' unit vectors, (3, B Nx), in float64 whatever the cells are: what tells close cells apart is
            their difference.
        cells: cell numbers, counted through all sets, (rows, 4) int32. Unused slots of a texel's first row repeat its
            first cell, those of a chained one too.
        link: (rows,) int32. 0: nothing follows; positive: the first of four rows of the texel's quarters; negative:
            minus the next row of the chain.
        resolution: texels along an edge of the cube; the first B * 6 * resolution² rows are the table.
        size: cells of one set.
        batch: number of sets B, or None for one set without a batch axis.
    """

    vectors: Tensor
    cells: Tensor
    link: Tensor
    resolution: int
    size: int
    batch: int | None


class _Frontier(NamedTuple):
    """Texels of one size and the cells that may be nearest in each, sorted by texel.

    Attributes:
        face: of the cube, with that of the batch's set: 6 * set + face, (T,).
        i: texel column, (T,).
        j: texel row, (T,).
        row: of the table, (T,).
        texel: pairs' texel, non-decreasing, (P,).
        cell: pairs' cell, (P,).
        score: inner product of the cell with (1, u, v) at the texel's centre, (P,).
        du: its slope along u, (P,).
        dv: its slope along v, (P,).
    """

    face: Tensor
    i: Tensor
    j: Tensor
    row: Tensor
    texel: Tensor
    cell: Tensor
    score: Tensor
    du: Tensor
    dv: Tensor


def build_index(cells: Tensor) -> CellIndex:
    """Index sets of cells for `nearest_cell`.

    Args:
        cells: directions of any positive length, (Nx, 3), or a batch of sets (B, Nx, 3). Any distribution: clusters,
            lattices, duplicates, a single cell.

    Returns:
        The index, on the device of the cells; not differentiable.

    Raises:
        SettingError: for another shape, no cells, or cells that are zero or not finite.
    """
    good = cells.ndim in (2, 3) and cells.shape[-1] == 3 and cells.numel() > 0
    require(good, "cells", tuple(cells.shape), "the shape (Nx, 3) or (B, Nx, 3) with at least one cell")
    count, batch = cells.shape[-2], cells.shape[0] if cells.ndim == 3 else None
    p = unit_cells(cells).reshape(-1, 3)
    resolution = 1
    while 4 * resolution**2 < count:
        resolution *= 2

    rows = 6 * (batch or 1) * resolution**2
    filled: list[_Rows] = []
    size = min(_ROOTS, resolution)
    front = _roots(p, count, size)
    while len(front.face):
        if size >= resolution:
            if size == resolution:
                front = front._replace(row=(front.face * resolution + front.i) * resolution + front.j)
            simple = _simple(front, separate=size < _FINEST, table=size < 4 * resolution, budget=8 * len(p))
            done, rows = _fill(_choose(front, simple), rows)
            front, cut, rows = _cut(_choose(front, ~simple), rows)
            filled += [done, cut]
        size *= 2
        front = _join([_quarters(piece, size, 4 * size > resolution) for piece in _pieces(front)])
    return _assemble(filled, rows, p, cells, resolution)


def _simple(front: _Frontier, separate: bool, table: bool, budget: int) -> Tensor:
    """The texels (T,) to be written as they are; the others are cut further.

    Those with few cells, few being more where the remaining pairs would outgrow the budget: cells on a circle all meet
    at its pole, and cutting the texels around it would go on for ever.
    """
    count = torch.bincount(front.texel, minlength=len(front.face))
    few = (SLOTS if table else _SHORT_LIST) if separate else len(front.cell)
    while int(count[count > few].sum()) > budget + 65536:
        few *= 2
    return count <= few


def unit_cells(cells: Tensor) -> Tensor:
    """Directions as unit vectors in float64, the same bits for any memory layout."""
    cells = cells.detach().contiguous()
    largest = cells.abs().amax(-1, keepdim=True)
    require(bool(((largest > 0) & (largest < math.inf)).all()), "cells", "zero or not finite", "non-zero directions")
    p = cells.double() / largest
    length: Tensor = p.norm(dim=-1, keepdim=True)
    return p / length


def arange(n: int, like: Tensor) -> Tensor:
    """0 ... n-1 on the device of another tensor."""
    return torch.arange(n, device=like.device)


def _limit(like: Tensor) -> int:
    """Pairs treated at once: on the CPU so few that they fit its cache and no operation waits for other threads."""
    return _PAIRS_CPU if like.device.type == "cpu" else _PAIRS_GPU


def _roots(p: Tensor, count: int, size: int) -> _Frontier:
    """The cells that may be nearest in each of size² texels of a face: all pairs are tried."""
    width, sets = 1 / size, len(p) // count
    step = max(1, _limit(p) // count)
    parts = []
    for begin in range(0, sets, step):
        x, y, z = (t.contiguous() for t in p.view(sets, count, 3)[begin : begin + step].unbind(-1))
        kept: list[tuple[Tensor, ...]] = []
        for face, (major, du, dv) in enumerate(((x, y, z), (-x, y, z), (y, z, x), (-y, z, x), (z, x, y), (-z, x, y))):
            for place in range(size * size):
                u, v = ((2 * k + 1) * width - 1 for k in divmod(place, size))
                score = (major + u * du).add_(dv, alpha=v)
                winner = score.argmax(-1, keepdim=True)
                slope = (du.gather(-1, winner) - du).abs_().add_((dv.gather(-1, winner) - dv).abs_())
                keep = score.gather(-1, winner) - score < slope.mul_(width)
                cell = keep.scatter_(-1, winner, True).view(-1).nonzero().squeeze(1)
                texel = (6 * (cell // count) + face) * size**2 + place
                kept.append((texel, cell + begin * count, *(t.view(-1).index_select(0, cell) for t in (score, du, dv))))
        texel, *pairs = (torch.cat(t) for t in zip(*kept, strict=True))
        texel, order = texel.sort(stable=True)
        number = arange(6 * len(x) * size * size, p)
        texels = (number // size**2 + 6 * begin, number // size % size, number % size, number)
        parts.append(_Frontier._make((*texels, texel, *(t.index_select(0, order) for t in pairs))))
    return _join(parts)


def _quarters(front: _Frontier, size: int, corners: bool) -> _Frontier:
    """Cut every texel in four, each with those of its cells that it needs.

    Args:
        front: texels of twice the edge.
        size: of the new texels: how many along an edge of the cube.
        corners: compare with the best cells at the corners too, not at the centre alone.
    """
    width, texels = 1 / size, len(front.face)
    pieces = []
    for quarter, (a, b) in enumerate(((-width, -width), (-width, width), (width, -width), (width, width))):
        texel, cell, du, dv = front.texel, front.cell, front.du, front.dv
        score = (front.score + a * du).add_(dv, alpha=b)
        for centre in (True, False)[: 1 + corners]:
            kept = _needed(texel, texels, score, du, dv, width, centre)
            texel, cell, score, du, dv = (t.index_select(0, kept) for t in (texel, cell, score, du, dv))
        place = (2 * front.i + quarter // 2, 2 * front.j + quarter % 2, front.row + quarter)
        pieces.append((*place, texel + quarter * texels, cell, score, du, dv))
    return _Frontier(front.face.repeat(4), *(torch.cat(t) for t in zip(*pieces, strict=True)))


def _needed(texel: Tensor, texels: int, score: Tensor, du: Tensor, dv: Tensor, width: float, centre: bool) -> Tensor:
    """The pairs not dominated, at all four corners of their texel, by its best one at the centre or at the corners."""
    points = ((0.0, 0.0),) if centre else ((-width, -width), (-width, width), (width, -width), (width, width))
    keep, winners = torch.ones_like(texel, dtype=torch.bool), []
    for a, b in points:
        judged = score if centre else (score + a * du).add_(dv, alpha=b)
        best = judged.new_full((texels,), -math.inf).scatter_reduce_(0, texel, judged, "amax")
        top = (judged == best.index_select(0, texel)).nonzero().squeeze(1)
        winner = torch.full((texels,), len(texel), device=texel.device)
        winner.scatter_reduce_(0, texel.index_select(0, top), top, "amin")
        lead, slope, other = (t.index_select(0, winner).index_select(0, texel).sub_(t) for t in (score, du, dv))
        good = lead < slope.abs_().add_(other.abs_()).mul_(width)
        keep &= good
        winners.append(winner)
    return keep.index_fill_(0, torch.cat(winners), True).nonzero().squeeze(1)


def _pieces(front: _Frontier) -> list[_Frontier]:
    """Cut a frontier between texels: on the CPU into pieces that fit its cache."""
    limit = _limit(front.cell)
    if len(front.cell) <= limit:
        return [front]
    bounds = [*front.texel[::limit].unique().tolist(), len(front.face)]
    cuts = torch.searchsorted(front.texel, torch.tensor(bounds, device=front.texel.device)).tolist()
    return [
        _Frontier._make((*(t[m:n] for t in front[:4]), front.texel[a:b] - m, *(t[a:b] for t in front[5:])))
        for m, n, a, b in zip(bounds[:-1], bounds[1:], cuts[:-1], cuts[1:], strict=True)
    ]


def _join(pieces: list[_Frontier]) -> _Frontier:
    """One frontier of many, which share no texel."""
    if len(pieces) == 1:
        return pieces[0]
    first, texels = 0, []
    for piece in pieces:
        texels.append(piece.texel + first)
        first += len(piece.face)
    joined = _Frontier(*(torch.cat(t) for t in zip(*pieces, strict=True)))
    return joined._replace(texel=torch.cat(texels))


def _choose(front: _Frontier, mask: Tensor) -> _Frontier:
    """The texels of a mask (T,) and their pairs."""
    number = mask.cumsum(0) - 1
    kept = mask.index_select(0, front.texel).nonzero().squeeze(1)
    texel = number.index_select(0, front.texel.index_select(0, kept))
    return _Frontier._make((*(t[mask] for t in front[:4]), texel, *(t.index_select(0, kept) for t in front[5:])))


class _Rows(NamedTuple):
    """Entries of the table: a cell in a slot of a row, beside the texel's first cell; and links between rows."""

    row: Tensor
    slot: Tensor
    cell: Tensor
    first: Tensor
    link_from: Tensor
    link: Tensor


def _fill(front: _Frontier, rows: int) -> tuple[_Rows, int]:
    """Write texels into their rows, and into chained new ones where they have more cells than slots."""
    count = torch.bincount(front.texel, minlength=len(front.face))
    begin = count.cumsum(0) - count
    rank = arange(len(front.cell), count) - begin.index_select(0, front.texel)
    extra = (count - 1) // SLOTS
    chained = rows + (extra.cumsum(0) - extra).index_select(0, front.texel) + rank // SLOTS - 1
    row = torch.where(rank < SLOTS, front.row.index_select(0, front.texel), chained)
    turn = ((rank > 0) & (rank % SLOTS == 0)).nonzero().squeeze(1)
    first = front.cell.index_select(0, begin.index_select(0, front.texel))
    return _Rows(row, rank % SLOTS, front.cell, first, row[turn - 1], -row[turn]), rows + int(extra.sum())


def _cut(front: _Frontier, rows: int) -> tuple[_Frontier, _Rows, int]:
    """Give texels four new rows each for their quarters."""
    new = rows + 4 * arange(len(front.face), front.face)
    none = new[:0]
    return front._replace(row=new), _Rows(none, none, none, none, front.row, new), rows + 4 * len(front.face)


def _assemble(filled: list[_Rows], rows: int, p: Tensor, cells: Tensor, resolution: int) -> CellIndex:
    row, slot, cell, first, link_from, link_to = (torch.cat(parts) for parts in zip(*filled, strict=True))
    numbers = torch.zeros(rows, dtype=torch.int32, device=p.device)
    numbers = numbers.index_copy_(0, row, first.int())[:, None].repeat(1, SLOTS)
    numbers.view(-1).index_copy_(0, row * SLOTS + slot, cell.int())
    link = torch.zeros(rows, dtype=torch.int32, device=p.device)
    link.index_copy_(0, link_from, link_to.int())
    batch = cells.shape[0] if cells.ndim == 3 else None
    return CellIndex(p.T.contiguous(), numbers, link, resolution, cells.shape[-2], batch)
