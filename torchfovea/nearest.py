"""The nearest cell of a direction and the nearest observation of a cell: exact, for any set of directions.

Eq. 23 assigns an observation to the cell of the largest inner product (printed: the smallest). A lookup in the table of
`torchfovea.cell_index` leaves four cells to compare, whatever the number of cells.
"""

from __future__ import annotations

import math

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.cell_index import SLOTS, CellIndex, arange, build_index, unit_cells
from torchfovea.setting import require

__all__ = ["CellIndex", "build_index", "nearest_cell", "nearest_observation", "neighbour_spacing_rad"]

_FIRST_BUCKET, _WIDEST_BUCKET = (0.004, 0.02), 0.1  # rad; range of the first, and beyond which there are none


def nearest_cell(index: CellIndex, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The cell of the largest inner product with each direction (Eq. 23 with argmax), exactly.

    No other cell's cosine is larger than the returned one's by more than rounding in the index's dtype. Between cells
    that are equally near any one may be returned, always the same for the same input.

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
    kind = index.vectors.dtype
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

    table = index.vectors
    best = torch.zeros_like(x)
    slot = torch.zeros_like(row)
    for k in range(1, SLOTS):
        score = x * table[3 * k].index_select(0, row)
        score.addcmul_(y, table[3 * k + 1].index_select(0, row)).addcmul_(z, table[3 * k + 2].index_select(0, row))
        slot = torch.maximum(slot, (score > best).int().mul_(k))
        best = torch.maximum(best, score)
    cell = index.cells.view(-1).index_select(0, slot.add_(row, alpha=SLOTS))
    active = (link < 0).nonzero().squeeze(1)
    follows = link.index_select(0, active)
    while len(active):  # chains are rare
        link_row = -follows
        q = torch.stack((x[active], y[active], z[active]), -1)
        vectors = table.index_select(1, link_row).view(SLOTS, 3, -1)
        score, where = (vectors * q.mT).sum(1).max(0)
        better = score > best[active]
        changed = active[better]
        best[changed] = score[better]
        cell[changed] = index.cells[link_row[better], where[better]]
        follows = index.link.index_select(0, link_row)
        active, follows = active[follows < 0], follows[follows < 0]
    cosine = (x * table[0].index_select(0, row)).addcmul_(y, table[1].index_select(0, row))
    cosine = cosine.addcmul_(z, table[2].index_select(0, row)).add_(best)
    cosine = cosine.mul_((x * x).addcmul_(y, y).addcmul_(z, z).rsqrt_()).clamp_(-1, 1)
    cosine = torch.where(valid, cosine, -1)
    return torch.where(valid, cell, 0).long().view(shape[:-1]), cosine.view(shape[:-1])


def nearest_observation(
    directions: Tensor, cells: Tensor, gate_rad: Tensor | float = math.pi, wanted: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The observation nearest in direction to each cell, within a gate, exactly.

    What `nearest_cell` is with the roles swapped, for observations that change with every saccade: they are sorted into
    the buckets of a cube map as wide as the gate, and a cell looks into nine. Cells with wider gates than the narrowest
    look again in wider buckets where they found nothing. The narrower the gate and the fewer cells are `wanted`, the
    faster: cells with wide gates and no observation near cost as much as indexing the observations.

    Args:
        directions: of the observations, any positive length, (..., N, 3). Those that are zero or not finite do not
            count.
        cells: unit vectors, (..., K, 3).
        gate_rad: largest angle, one for all or (..., K).
        wanted: cells that look, bool (..., K); all by default.

    Returns:
        The observation's number, int64 (..., K), and the cosine between the two, (..., K). Where there is no
        observation within the gate, the number 0 and the cosine -1. Of equally near observations the first. Not
        differentiable.

    Raises:
        SettingError: where the shapes do not fit or a gate is not positive.
    """
    sets, count = directions.shape[:-2], directions.shape[-2] if directions.ndim > 1 else 0
    good = directions.ndim > 1 and directions.shape[-1] == 3 and cells.shape[:-2] == sets and cells.shape[-1:] == (3,)
    require(good, "cells", tuple(cells.shape), f"the shape {(*sets, 'K', 3)} for directions {tuple(directions.shape)}")
    gate = torch.as_tensor(gate_rad, dtype=cells.dtype, device=cells.device)
    require(bool((gate > 0).all()), "gate_rad", gate_rad, "positive angles")
    gate = gate.broadcast_to(cells.shape[:-1]).reshape(-1).clamp(max=math.pi)
    looking = arange(len(gate), gate) if wanted is None else wanted.reshape(-1).nonzero().squeeze(1)

    o = directions.detach().to(cells.dtype).reshape(-1, 3)
    largest = o.abs().amax(-1)
    seen = ((largest > 0) & (largest < math.inf)).nonzero().squeeze(1)
    o = torch.nn.functional.normalize(o.index_select(0, seen) / largest.index_select(0, seen)[:, None], dim=-1)
    number = torch.zeros(len(gate), dtype=torch.int64, device=gate.device)
    cosine = gate.new_full((len(gate),), -1)
    if len(seen) == 0 or len(looking) == 0:
        return number.view(cells.shape[:-1]), cosine.view(cells.shape[:-1])
    c = cells.detach().reshape(-1, 3)
    o_set = seen // count
    reach = min(max(float(gate.index_select(0, looking).min()), _FIRST_BUCKET[0]), _FIRST_BUCKET[1])
    while len(looking):
        limit = gate.index_select(0, looking)
        asking = (o, o_set, c.index_select(0, looking), looking // cells.shape[-2], limit)
        found = _in_buckets(*asking, reach) if reach <= _WIDEST_BUCKET else _in_all(*asking)
        hit = found >= 0
        mine, nearest = looking[hit], found[hit]
        number[mine] = seen.index_select(0, nearest) % count
        cosine[mine] = 1 - 0.5 * (o.index_select(0, nearest) - c.index_select(0, mine)).square().sum(-1)
        looking = looking[~hit & (limit > reach) & (reach <= _WIDEST_BUCKET)]
        reach *= 4
    return number.view(cells.shape[:-1]), cosine.view(cells.shape[:-1])


def _chord(angle: Tensor) -> Tensor:
    """Chord of an angle, with room for rounding."""
    return 2 * torch.sin(0.5 * angle) * (1 + 4 * torch.finfo(angle.dtype).eps)


def _in_all(o: Tensor, o_set: Tensor, c: Tensor, c_set: Tensor, gate: Tensor) -> Tensor:
    """Nearest observation of each cell among all of its set; -1 where none is within the gate."""
    found = torch.full((len(c),), -1, device=c.device)
    fine_c, fine_o = (torch.nn.functional.normalize(t.double(), dim=-1) for t in (c, o))
    for number in c_set.unique().tolist():
        mine, theirs = (c_set == number).nonzero().squeeze(1), (o_set == number).nonzero().squeeze(1)
        if len(theirs) == 0:
            continue
        if len(mine) * len(theirs) > 1 << 23:
            best, _ = nearest_cell(build_index(fine_o.index_select(0, theirs)), fine_c.index_select(0, mine))
        else:
            best = (fine_c.index_select(0, mine) @ fine_o.index_select(0, theirs).T).argmax(-1)
        nearest = theirs.index_select(0, best)
        chord = (c.index_select(0, mine) - o.index_select(0, nearest)).norm(dim=-1)
        found[mine] = torch.where(chord <= _chord(gate.index_select(0, mine)), nearest, -1)
    return found


def _face_angles(direction: Tensor, face: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Equal-angle coordinates on a face 0...5 (axis, then sign) of the cube, and the component along its axis."""
    axis = face // 2
    major = direction.gather(-1, axis[:, None]).squeeze(-1) * (1 - 2 * (face % 2))
    a, b = (direction.gather(-1, ((axis + k) % 3)[:, None]).squeeze(-1) for k in (1, 2))
    return torch.atan2(a, major), torch.atan2(b, major), major


def _own_face(direction: Tensor) -> Tensor:
    axis = direction.abs().argmax(-1)
    return 2 * axis + (direction.gather(-1, axis[:, None]).squeeze(-1) < 0)


def _in_buckets(o: Tensor, o_set: Tensor, c: Tensor, c_set: Tensor, gate: Tensor, reach: float) -> Tensor:
    """Nearest observation of each cell within min(gate, reach); -1 where there is none.

    An angle changes an equal-angle coordinate by at most sqrt(1 + tan²) of the largest coordinate times itself.
    """
    width = reach * math.sqrt(2)
    for _ in range(8):
        width = 1.001 * reach * math.hypot(1, math.tan(math.pi / 4 + width))
    edge = math.pi / 4 + width
    buckets = math.ceil(2 * edge / width) + 1

    # Each observation lies on its face and, near an edge, also in the margin of the face beyond.
    own = _own_face(o)
    a, b, _ = _face_angles(o, own)
    entries = [(arange(len(o), o), own, a, b)]
    margin = (torch.maximum(a.abs(), b.abs()) >= math.pi / 4 - 1.01 * width).nonzero().squeeze(1)
    for beyond in range(6) if len(margin) else ():
        other = torch.full_like(margin, beyond)
        a, b, major = _face_angles(o.index_select(0, margin), other)
        inside = (major > 0) & (a.abs() < edge) & (b.abs() < edge) & (own.index_select(0, margin) != beyond)
        entries.append((margin[inside], other[inside], a[inside], b[inside]))
    number, face, a, b = (torch.cat(t) for t in zip(*entries, strict=True))

    def bucket(sets: Tensor, faces: Tensor, a: Tensor, b: Tensor) -> Tensor:
        i, j = (((t + edge) / width).long().clamp_(0, buckets - 1) for t in (a, b))
        return ((6 * sets + faces) * buckets + i) * buckets + j

    key, order = bucket(o_set.index_select(0, number), face, a, b).sort(stable=True)
    number = number.index_select(0, order)
    total = (int(torch.maximum(o_set.max(), c_set.max())) + 1) * 6 * buckets**2
    starts = torch.cat((key.new_zeros(1), torch.bincount(key, minlength=total).cumsum(0)))

    own = _own_face(c)
    a, b, _ = _face_angles(c, own)
    home = bucket(c_set, own, a, b)[:, None] + buckets * torch.tensor([-1, 0, 1], device=c.device)
    low, high = (starts[(home + k).clamp_(0, total)] for k in (-1, 2))  # three runs of three buckets each
    found = torch.full((len(c),), -1, device=c.device)
    pairs = (high - low).sum(-1).cumsum(0)
    cuts = torch.searchsorted(pairs, torch.arange(0, int(pairs[-1]) + 1, 1 << 22, device=c.device), right=True).tolist()
    for begin, end in zip(cuts, [*cuts[1:], len(c)], strict=True):
        run = (high[begin:end] - low[begin:end]).reshape(-1)
        which = arange(len(run), run).repeat_interleave(run)
        shift = low[begin:end].reshape(-1) - (run.cumsum(0) - run)
        candidate = number.index_select(0, arange(len(which), which) + shift.index_select(0, which))
        asking = which // 3
        offset = o.index_select(0, candidate) - c[begin:end].index_select(0, asking)
        distance = offset.square_().sum(-1)
        limit = _chord(gate[begin:end].clamp(max=reach)).square()
        nearest = limit.scatter_reduce(0, asking, distance, "amin")
        best = (distance == nearest.index_select(0, asking)).nonzero().squeeze(1)
        first = torch.full((end - begin,), len(o), device=c.device)
        first.scatter_reduce_(0, asking.index_select(0, best), candidate.index_select(0, best), "amin")
        found[begin:end] = torch.where(first < len(o), first, -1)
    return found


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
