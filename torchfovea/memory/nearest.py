"""The nearest cell of a direction and the nearest observation of a cell: exact, for any set of directions.

Eq. 23 assigns an observation to the cell of the largest inner product (printed: the smallest). A lookup in the table of
`torchfovea.memory.cell_index` leaves four cells to compare, whatever the number of cells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.memory.cell_index import SLOTS, CellIndex, build_index, unit_cells
from torchfovea.setting import require

__all__ = [
    "CellIndex",
    "build_index",
    "index_of_set",
    "join_indices",
    "nearest_cell",
    "nearest_observation",
    "neighbour_spacing_rad",
]


def join_indices(indices: Sequence[CellIndex]) -> CellIndex:
    """What `build_index` gives for the stacked sets of one-set indices, without building them again.

    Args:
        indices: of one set each, with the same number of cells, on one device.

    Raises:
        SettingError: for none, an index of several sets, or sets of different sizes.
    """
    alike = len(indices) > 0 and all(one.batch is None and one.size == indices[0].size for one in indices)
    require(alike, "indices", [(one.batch, one.size) for one in indices], "one or more of one set and size each")
    table = 6 * indices[0].resolution ** 2  # rows of a set that come first; what they link to follows after all sets'
    shift, links, after = (len(indices) - 1) * table, [], []
    for one in indices:
        moved = one.link + shift * one.link.sign()
        links.append(moved[:table])
        after.append(moved[table:])
        shift += len(one.link) - table
    parts = [slice(None, table), slice(table, None)]
    numbers = [one.cells + b * one.size for b, one in enumerate(indices)]
    return CellIndex(
        torch.cat([one.vectors for one in indices], 1),
        torch.cat([number[part] for part in parts for number in numbers]),
        torch.cat(links + after),
        indices[0].resolution,
        indices[0].size,
        len(indices),
    )


def index_of_set(index: CellIndex, b: int) -> CellIndex:
    """The index of one of several sets, without building it again; what is of one set already is returned as it is."""
    if index.batch is None:
        return index
    require(0 <= b < index.batch, "b", b, f"a set's number, 0 to {index.batch - 1}")
    if index.batch == 1:
        return index._replace(batch=None)
    table = 6 * index.resolution**2
    rows = torch.arange(b * table, (b + 1) * table, device=index.link.device)
    found = [rows]
    while len(rows):  # what rows link to, then what that links to
        link = index.link.index_select(0, rows).long()
        quarters = link[link > 0][:, None] + torch.arange(4, device=link.device)
        rows = torch.cat([quarters.flatten(), -link[link < 0]])
        found.append(rows)
    kept = torch.cat(found)
    place = torch.zeros(len(index.link), dtype=index.link.dtype, device=kept.device)
    place[kept] = torch.arange(len(kept), dtype=place.dtype, device=kept.device)
    link = index.link.index_select(0, kept)
    link = link.sign() * place.index_select(0, link.abs())
    numbers = index.cells.index_select(0, kept) - b * index.size
    vectors = index.vectors[:, b * index.size : (b + 1) * index.size]
    return CellIndex(vectors, numbers, link, index.resolution, index.size, None)


def nearest_cell(index: CellIndex, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The cell of the largest inner product with each direction (Eq. 23 with argmax), exactly.

    No other cell's cosine is larger than the returned one's by more than rounding in the directions' dtype. Between
    cells that are equally near any one may be returned, always the same for the same input.

    Args:
        index: from `build_index`.
        directions: of any positive length, (..., 3), or (B, ..., 3) for an index of B sets.

    Returns:
        The cell number, int64 (...), and its cosine with the direction (...). A direction that is zero or not finite
        gets cell 0 and the cosine -1, which no gate lets pass. Not differentiable.

    Raises:
        SettingError: where the shapes do not fit.
    """
    shape = directions.shape
    fits = shape[-1:] == (3,) and (index.batch is None or (len(shape) > 1 and shape[0] == index.batch))
    wanted = "(..., 3)" if index.batch is None else f"({index.batch}, ..., 3)"
    require(fits, "directions", tuple(shape), f"the shape {wanted}")
    # Selection by arithmetic: `torch.where` on an unpredictable mask is twenty times slower than a product on the CPU.
    kind = torch.promote_types(directions.dtype, torch.float32)
    x, y, z = (t.reshape(-1) for t in directions.detach().to(kind).unbind(-1))
    ax, ay, az = x.abs(), y.abs(), z.abs()
    largest = torch.maximum(torch.maximum(ax, ay), az)
    valid = (largest >= torch.finfo(kind).tiny) & (largest < math.inf)
    scale = 1 / largest
    x, y, z = x * scale, y * scale, z * scale
    on_x = (ax == largest).to(kind)
    on_y = (ay == largest).to(kind) * (1 - on_x)
    on_z = 1 - on_x - on_y
    half = 0.5 * index.resolution
    u = (on_x * y).addcmul_(on_y, z).addcmul_(on_z, x).mul_(half).add_(half)  # in texels
    v = (on_x * z).addcmul_(on_y, x).addcmul_(on_z, y).mul_(half).add_(half)
    major = (on_x * x).addcmul_(on_y, y).addcmul_(on_z, z)
    face = (4.75 - 4 * on_x - 2 * on_y).sub_(major, alpha=0.5).int()
    if index.batch is not None:
        sets = torch.arange(index.batch, dtype=torch.int32, device=face.device)
        face = (face.view(index.batch, -1) + 6 * sets[:, None]).view(-1)
    i, j = (t.int().clamp_(0, index.resolution - 1) for t in (u, v))
    row = face.mul_(index.resolution).add_(i).mul_(index.resolution).add_(j)
    row = torch.where(valid, row, 0)
    link = index.link.index_select(0, row)
    active = (link > 0).nonzero().squeeze(1)
    size = index.resolution
    while len(active):
        size *= 2
        bits = []
        for t in (u, v):
            bits.append((t.index_select(0, active) * (size / index.resolution)).int().clamp_(0, size - 1) & 1)
        child = link.index_select(0, active) + 2 * bits[0] + bits[1]
        row[active] = child
        link[active] = follows = index.link.index_select(0, child)
        active = active[follows > 0]

    # rows of numbers and the cells' own vectors stay in the cache, where a table of vectors for every row does not
    numbers = index.cells.unbind(-1)
    cell = numbers[0].index_select(0, row)
    first = [t.index_select(0, cell) for t in index.vectors]
    best = torch.zeros_like(x)
    slot = torch.zeros_like(row)
    for k in range(1, SLOTS):
        cell = numbers[k].index_select(0, row)
        # the difference is as good as the vectors are, where that of two products would round what is close
        dx, dy, dz = (t.index_select(0, cell).sub_(f).to(kind) for t, f in zip(index.vectors, first, strict=True))
        score = (x * dx).addcmul_(y, dy).addcmul_(z, dz)
        slot = torch.maximum(slot, (score > best).int().mul_(k))
        best = torch.maximum(best, score)
    cell = index.cells.view(-1).index_select(0, slot.add_(row, alpha=SLOTS))
    active = (link < 0).nonzero().squeeze(1)
    follows = link.index_select(0, active)
    while len(active):  # chains are rare
        others = index.cells.index_select(0, -follows)
        q, own = (torch.stack([t[active] for t in parts]) for parts in ((x, y, z), first))
        score = ((index.vectors[:, others] - own[..., None]).to(kind) * q[..., None]).sum(0)
        score, where = score.max(-1)
        better = score > best[active]
        changed = active[better]
        best[changed] = score[better]
        cell[changed] = others[better, where[better]]
        follows = index.link.index_select(0, -follows)
        active, follows = active[follows < 0], follows[follows < 0]
    hx, hy, hz = (t.to(kind) for t in first)
    cosine = (x * hx).addcmul_(y, hy).addcmul_(z, hz).add_(best)
    cosine = cosine.mul_((x * x).addcmul_(y, y).addcmul_(z, z).rsqrt_()).clamp_(-1, 1)
    cosine = torch.where(valid, cosine, -1)
    if index.batch is not None:
        cell = (cell.view(index.batch, -1) - index.size * sets[:, None]).view(-1)
    return torch.where(valid, cell, 0).long().view(shape[:-1]), cosine.view(shape[:-1])


def nearest_observation(
    directions: Tensor, cells: Tensor, gate_rad: Tensor | float = math.pi, wanted: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The observation nearest in direction to each cell, within a gate, exactly.

    What `nearest_cell` is with the roles swapped, for observations that change with every saccade: SciPy's k-d tree on
    the CPU, all pairs elsewhere. The fewer cells are `wanted`, the faster.

    Args:
        directions: of the observations, any positive length, (..., N, 3). Those that are zero or not finite do not
            count.
        cells: unit vectors, (..., K, 3).
        gate_rad: largest angle, one for all or (..., K).
        wanted: cells that look, bool (..., K); all by default.

    Returns:
        The observation's number, int64 (..., K), and the cosine between the two, (..., K). Where there is no
        observation within the gate, the number 0 and the cosine -1. Of equally near observations any one, always the
        same for the same input. Not differentiable.

    Raises:
        SettingError: where the shapes do not fit or a gate is not positive.
    """
    sets, count = directions.shape[:-2], directions.shape[-2] if directions.ndim > 1 else 0
    good = directions.ndim > 1 and directions.shape[-1] == 3 and cells.shape[:-2] == sets and cells.shape[-1:] == (3,)
    require(good, "cells", tuple(cells.shape), f"the shape {(*sets, 'K', 3)} for directions {tuple(directions.shape)}")
    gate = torch.as_tensor(gate_rad, dtype=torch.float64, device=cells.device)
    require(bool((gate > 0).all()), "gate_rad", gate_rad, "positive angles")
    shape = cells.shape[:-1]
    number, chord = torch.zeros(shape, dtype=torch.int64, device=cells.device), torch.full(shape, math.inf).to(gate)
    asks = torch.ones_like(number, dtype=torch.bool) if wanted is None else wanted.expand(shape)
    if count and bool(asks.any()):
        x, y, z = directions.detach().unbind(-1)
        largest = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())
        seen = (largest > 0) & (largest < math.inf)
        x, y, z = x / largest, y / largest, z / largest
        length = (x * x + y * y + z * z).sqrt()
        # those that do not count lie farther off than any that do
        o = columns(*(torch.where(seen, t / length, 9.0) for t in (x, y, z)))
        sets_of = o.reshape(-1, count, 3), cells.detach().reshape(-1, *cells.shape[-2:]), asks
        found = _by_tree(*sets_of, gate) if o.device.type == "cpu" else _by_all_pairs(*sets_of)
        number, chord = (part.view(shape) for part in found)
    within = asks & (chord <= _chord(gate))
    cosine = torch.where(within, 1 - 0.5 * chord * chord, -1.0).to(cells.dtype)
    return torch.where(within, number, 0), cosine


def _chord(angle: Tensor) -> Tensor:
    """Chord of an angle, with room for rounding."""
    return 2 * torch.sin(0.5 * angle.clamp(max=math.pi)) * (1 + 4 * torch.finfo(angle.dtype).eps)


def _by_tree(o: Tensor, c: Tensor, asks: Tensor, gate: Tensor) -> tuple[Tensor, Tensor]:
    """Number of the nearest observation and its chord, infinite where none lies within the widest gate."""
    number = torch.zeros(c.shape[:-1], dtype=torch.int64)
    chord = torch.full(c.shape[:-1], math.inf, dtype=torch.float64)
    reach = float(_chord(gate).max()) * (1 + 1e-6)
    for k, mask in enumerate(asks.view(chord.shape)):
        # quick to build: it serves once
        tree = cKDTree(o[k].numpy(), leafsize=32, balanced_tree=False, compact_nodes=False)
        far, nearest = tree.query(c[k][mask].numpy(), distance_upper_bound=reach)
        chord[k, mask] = torch.from_numpy(far)
        number[k, mask] = torch.from_numpy(nearest)
    return number, chord


def _by_all_pairs(o: Tensor, c: Tensor, asks: Tensor) -> tuple[Tensor, Tensor]:
    """Number of the nearest observation and its chord, however far."""
    asks = asks.view(c.shape[:-1])
    most = int(asks.sum(-1).max())
    asking = asks.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, :most]
    number, chord = torch.zeros_like(asks, dtype=torch.int64), torch.full_like(c[..., 0], math.inf).double()
    block = max(1, (1 << 26) // (len(o) * o.shape[1]))
    for row in asking.split(block, dim=-1):
        ask = c.gather(1, row[..., None].expand(-1, -1, 3)).to(o)
        # by differences: products would round what lies close together
        far, nearest = torch.cdist(ask, o, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
        number.scatter_(1, row, nearest)
        chord.scatter_(1, row, far.double())
    return number, chord


def neighbour_spacing_rad(cells: Tensor, neighbours: int = 6) -> Tensor:
    """Median angle from each cell to its nearest neighbours, the local grain of a memory.

    Args:
        cells: unit vectors, (..., Nx, 3).
        neighbours: how many (six surround a cell of an even topology); fewer where there are fewer other cells.

    Returns:
        (..., Nx) [rad]; pi for a cell that has no other. Not differentiable; computed on the CPU.

    Raises:
        SettingError: for another shape, or cells that are zero or not finite.
    """
    require(cells.ndim >= 2 and cells.shape[-1] == 3, "cells", tuple(cells.shape), "the shape (..., Nx, 3)")
    require(neighbours >= 1, "neighbours", neighbours, "at least 1")
    sets = unit_cells(cells).cpu().reshape(-1, *cells.shape[-2:])
    k = min(neighbours, cells.shape[-2] - 1)
    if k == 0:
        return torch.full_like(cells[..., 0], math.pi)
    angle = []
    for p in sets.numpy():
        chord = torch.from_numpy(cKDTree(p).query(p, k=k + 1)[0][:, 1:])
        angle.append((2 * torch.asin((0.5 * chord).clamp(max=1))).quantile(0.5, dim=-1))
    return torch.stack(angle).reshape(cells.shape[:-1]).to(cells)
