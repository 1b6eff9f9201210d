"""Rays through many scenes at once, as tensor operations on any device: the same surfaces that MuJoCo's rays meet.

The scenes are closed rooms with upright boxes, upright cylinders and spheres in them. Every ray leaves the room through
the floor, a wall or the ceiling; the other solids are tried only for the rays that pass near them, as one flat list of
(ray, solid) pairs. `torchfovea.sim.rays` is the reference: with float64 the two agree to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.machine import loops
from torchfovea.setting import require
from torchfovea.sim.solids import Group, Solids, chord, first, tiny, way_out

__all__ = ["occluded", "ranges", "trace"]


class _Rays(NamedTuple):
    """Rays in the worlds: origins (B, 1) and directions (B, N) by component."""

    origin: tuple[Tensor, Tensor, Tensor]
    direction: tuple[Tensor, Tensor, Tensor]


def _world(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> _Rays:
    c, s = solids.rotation
    origin = origin_e.to(c)[:, None].unbind(-1)
    x, y, z = directions_e.to(c).unbind(-1)
    ox, oy, oz = c * origin[0] - s * origin[1], s * origin[0] + c * origin[1], origin[2]
    shift = solids.translation
    return _Rays((ox + shift[0], oy + shift[1], oz + shift[2]), (c * x - s * y, s * x + c * y, z))


class _Pairs(NamedTuple):
    """Rays that may meet a solid: flat ray number, geom, entry and exit along the ray (exit < entry: missed), (P,)."""

    ray: Tensor
    geom: Tensor
    entry: Tensor
    exit: Tensor


def _near(group: Group, rays: _Rays, unit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs of rays and solids worth an exact test: batch, flat solid and flat ray numbers, (P,) each.

    Near is a ray that passes a solid's bounding sphere, ahead. Single precision, with a margin, is enough for that.
    """
    x, y, z = (c[..., 0] - o for c, o in zip(group.centre, rays.origin, strict=True))  # (B, K)
    square = x * x + y * y + z * z
    beside2 = square - group.size.square().sum(0)[..., 0]
    # the cosine's numerator that the sphere's rim has, less what rounding to float32 may take
    least = torch.where(beside2 > 0, beside2.clamp(min=0).sqrt(), -torch.inf) - 1e-5 * (1 + square.sqrt())
    mask = torch.stack([x, y, z], -1).float() @ unit >= least.float()[..., None]
    flat = mask.reshape(-1).nonzero()[:, 0]
    n = unit.shape[-1]
    which = flat // n
    batch = which // group.geom.shape[1]
    return batch, which, flat + (batch - which) * n


def _pairs(solids: Solids, rays: _Rays) -> list[_Pairs]:
    found = []
    unit = torch.stack([d.float() for d in rays.direction], -2)
    for kind, group in solids.groups:
        if group.geom.shape[1] == 0:
            continue
        b, which, flat = _near(group, rays, unit)
        dx, dy, dz = (d.reshape(-1).index_select(0, flat) for d in rays.direction)
        cx, cy, cz, sx, sy, sz, c, s = (
            part.reshape(-1).index_select(0, which) for part in (*group.centre, *group.size, *group.turn)
        )
        ox, oy, oz = (o[:, 0].index_select(0, b) for o in rays.origin)
        offset = (cx - ox, cy - oy, cz - oz)
        entry, leave = chord(kind, offset, (sx, sy, sz), (c, s), (dx, dy, dz))
        found.append(_Pairs(flat, group.geom.reshape(-1).index_select(0, which), entry, leave))
    return found


def trace(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> tuple[Tensor, Tensor]:
    """First surfaces on rays from inside the room.

    Args:
        solids: B scenes.
        origin_e: (B, 3) in E [m].
        directions_e: (B, N, 3) in E, of any positive length.

    Returns:
        Ranges (B, N) [m] and geoms (B, N); in the solids' dtype.

    Raises:
        SettingError: for an origin outside of its room, and directions that are zero or not finite.
    """
    rays, leave, range_m = _shell(solids, origin_e, directions_e)
    met = _pairs(solids, rays)
    for pairs in met:
        range_m.view(-1).scatter_reduce_(0, pairs.ray, first(pairs.entry, pairs.exit), "amin")
    # by which face the room is left
    geom = torch.zeros_like(range_m, dtype=torch.int64)
    for axis, (face, ahead) in enumerate(zip(solids.faces.view(3, 2, -1, 1), rays.direction, strict=True)):
        geom = torch.where(leave[axis] <= range_m, torch.where(ahead > 0, face[1], face[0]), geom)
    geom = geom.reshape(-1)
    for pairs in met:
        met_first = first(pairs.entry, pairs.exit) == range_m.reshape(-1).index_select(0, pairs.ray)
        geom[pairs.ray[met_first]] = pairs.geom[met_first]
    return range_m, geom.reshape(range_m.shape)


def ranges(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> Tensor:
    """The ranges of `trace` alone."""
    rays, _, range_m = _shell(solids, origin_e, directions_e)
    return _meet(solids, rays, range_m)


def _shell(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> tuple[_Rays, list[Tensor], Tensor]:
    """Rays, where they leave each pair of the room's faces, and the room, (B, N)."""
    directions_e = directions_e.to(solids.rotation)
    length = (directions_e * directions_e).sum(-1).sqrt()  # vector_norm takes forty times as long over strided axes
    whole = bool(((length > 0) & (length < torch.inf)).all())
    require(whole, "directions_e", "zero or not finite", "directions")
    rays = _world(solids, origin_e, directions_e / length[..., None])
    offset = [middle - o for middle, o in zip(solids.middle, rays.origin, strict=True)]
    inside = bool(torch.stack([h - o.abs() for h, o in zip(solids.half, offset, strict=True)]).amin() > 0)
    require(inside, "origin", "an eye outside of the room", "eyes inside")
    leave = [way_out(o, h, d) for o, h, d in zip(offset, solids.half, rays.direction, strict=True)]
    return rays, leave, torch.minimum(torch.minimum(leave[0], leave[1]), leave[2])


def _meet(solids: Solids, rays: _Rays, range_m: Tensor) -> Tensor:
    """Ranges (B, N), lowered to where rays meet something that stands in the room."""
    library = loops(range_m)
    if library is None:
        for pairs in _pairs(solids, rays):
            range_m.view(-1).scatter_reduce_(0, pairs.ray, first(pairs.entry, pairs.exit), "amin")
        return range_m
    origin, direction = torch.stack(rays.origin), torch.stack(rays.direction)
    for shape, (_, group) in enumerate(solids.groups):
        parts = (part.contiguous() for part in (group.centre, group.size, group.turn))
        given = (*group.geom.shape, range_m.shape[-1], origin, direction, *parts, tiny(range_m.dtype))
        library("meet", given, shape, range_m)
    return range_m


def occluded(solids: Solids, origin_e: Tensor, points_e: Tensor) -> Tensor:
    """Whether something that stands in the room hides points from an eye; bool (B, N).

    The walls and the floor, around a convex room, hide nothing inside it from an eye inside it.

    Args:
        solids: B scenes.
        origin_e: the eye, (B, 3) in E [m].
        points_e: on surfaces, (B, N, 3) in E [m].
    """
    dtype = solids.rotation.dtype
    line = points_e.to(dtype) - origin_e.to(dtype)[:, None]
    away = (line * line).sum(-1).sqrt()
    rays = _world(solids, origin_e, line / away.clamp(min=tiny(dtype))[..., None])
    # a point's own surface is met at the point itself, but for rounding at grazing incidence
    return _meet(solids, rays, torch.full_like(away, torch.inf)) < away - (1e-5 + 1e-5 * away)
