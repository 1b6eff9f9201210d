"""Rays through many scenes at once, as tensor operations on any device: the same surfaces that MuJoCo's rays meet.

The scenes are made of a floor, upright boxes, upright cylinders and spheres. The room's walls are tried for every ray;
the other solids only for the rays that pass near them, as one flat list of (ray, solid) pairs. `torchfovea.sim.rays` is
the reference: with float64 the two agree to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require
from torchfovea.sim.model import Scene
from torchfovea.sim.rays import MISS_RANGE_M
from torchfovea.sim.room import FLOOR, ROOM, Solid

__all__ = ["Solids", "occluded", "solids_of", "trace"]

_TINY = 1e-300


class _Group(NamedTuple):
    """Solids of one shape in B scenes, padded to K with solids far below that no ray meets.

    Attributes:
        centre: x, y and z, (3, B, K, 1).
        size: up to three half lengths, or radius and half height, or radius, (3, B, K, 1).
        turn: cosine and sine of the yaw, (2, B, K, 1).
        geom: (B, K).
    """

    centre: Tensor
    size: Tensor
    turn: Tensor
    geom: Tensor


class Solids(NamedTuple):
    """B scenes as tensors, in each scene's world.

    Attributes:
        walls: axis-aligned boxes of the room, tried for every ray.
        boxes: turned boxes.
        cylinders: upright.
        spheres: of any size.
        floor: geom of the plane z = 0, (B,).
        rotation: yaw of E as cosine and sine, (2, B, 1).
        translation: of E, (3, B, 1).
    """

    walls: _Group
    boxes: _Group
    cylinders: _Group
    spheres: _Group
    floor: Tensor
    rotation: Tensor
    translation: Tensor


def solids_of(
    scenes: Sequence[Scene], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
) -> Solids:
    """Scenes as tensors.

    Raises:
        SettingError: for a scene without exactly one floor.
    """
    chosen: dict[str, list[list[tuple[int, Solid]]]] = {"walls": [], "boxes": [], "cylinders": [], "spheres": []}
    floors, yaw, place = [], [], []
    for scene in scenes:
        parts: dict[str, list[tuple[int, Solid]]] = {name: [] for name in chosen}
        planes = []
        for geom, solid in enumerate(scene.solids):
            if solid.shape == "plane":
                planes.append(geom)
            elif solid.shape == "box":
                parts["walls" if solid.kind == ROOM and solid.yaw_rad == 0 else "boxes"].append((geom, solid))
            else:
                parts[f"{solid.shape}s"].append((geom, solid))
        one = len(planes) == 1 and scene.solids[planes[0]].kind == FLOOR
        require(one, "scene", f"{len(planes)} planes", "one floor")
        floors.append(planes[0])
        rotation, translation = scene.world_from_ego
        yaw.append((float(rotation[0, 0]), float(rotation[1, 0])))
        place.append(tuple(float(t) for t in translation))
        for name, found in parts.items():
            chosen[name].append(found)

    def tensor(values: object) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device)

    walls, boxes, cylinders, spheres = (_group(found, tensor) for found in chosen.values())
    return Solids(
        walls,
        boxes,
        cylinders,
        spheres,
        torch.tensor(floors, device=device),
        tensor(yaw).T[..., None].contiguous(),
        tensor(place).T[..., None].contiguous(),
    )


def _group(scenes: list[list[tuple[int, Solid]]], tensor: Callable[[object], Tensor]) -> _Group:
    most = max(len(scene) for scene in scenes)
    rows = []
    for scene in scenes:
        row = []
        for geom, solid in scene:
            size = (*solid.size_m, 0.0, 0.0)[:3]
            yaw = torch.tensor(solid.yaw_rad, dtype=torch.float64)
            row.append((*solid.position_m, *size, float(yaw.cos()), float(yaw.sin()), float(geom)))
        # far below and without size
        row += [(0.0, 0.0, -1e6, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0)] * (most - len(row))
        rows.append(row)
    values = tensor(rows).reshape(len(scenes), most, 9).permute(2, 0, 1).contiguous()
    return _Group(values[:3, ..., None], values[3:6, ..., None], values[6:8, ..., None], values[8].long())


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


def _inverse(step: Tensor) -> Tensor:
    return 1 / torch.where(step.abs() > _TINY, step, torch.full_like(step, _TINY))


def _slab(middle: Tensor, half: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave |x − middle| ≤ half; x advances by 1/inverse a unit of range."""
    centre, reach = middle * inverse, half * inverse.abs()
    return centre - reach, centre + reach


def _near(group: _Group, rays: _Rays, upright: bool) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs of rays and solids worth an exact test: batch, flat solid and flat ray numbers, (P,) each."""
    rx, ry, rz = (c[..., 0] - o for c, o in zip(group.centre, rays.origin, strict=True))  # (B, K)
    dx, dy, dz = rays.direction
    if upright:  # seen from above, the ray's line passes the axis within the radius
        level = torch.rsqrt((dx * dx + dy * dy).clamp(min=_TINY))
        aside = torch.stack([ry, -rx], -1) @ torch.stack([dx * level, dy * level], -2)
        mask = aside.abs_() <= group.size[0] * (1 + 1e-9)
    else:  # it passes the bounding sphere's centre within its radius, ahead
        radius2 = group.size.square().sum(0)[..., 0]
        beside2 = rx * rx + ry * ry + rz * rz - radius2 * (1 + 1e-9)
        least = torch.where(beside2 > 0, beside2.clamp(min=0).sqrt(), -torch.inf)
        mask = torch.stack([rx, ry, rz], -1) @ torch.stack([dx, dy, dz], -2) >= least[..., None]
    flat = mask.reshape(-1).nonzero()[:, 0]
    n = dx.shape[1]
    which = flat // n
    batch = which // group.geom.shape[1]
    return batch, which, flat + (batch - which) * n


def _pairs(solids: Solids, rays: _Rays) -> list[_Pairs]:
    found = []
    for group, kind in ((solids.boxes, "box"), (solids.cylinders, "cylinder"), (solids.spheres, "sphere")):
        if group.geom.shape[1] == 0:
            continue
        b, which, flat = _near(group, rays, kind == "cylinder")
        dx, dy, dz = (d.reshape(-1).index_select(0, flat) for d in rays.direction)
        cx, cy, cz, sx, sy, sz, c, s = (
            part.reshape(-1).index_select(0, which) for part in (*group.centre, *group.size, *group.turn)
        )
        rx, ry, rz = (centre - o[:, 0].index_select(0, b) for centre, o in zip((cx, cy, cz), rays.origin, strict=True))
        if kind == "box":
            ends = [
                _slab(c * rx + s * ry, sx, _inverse(c * dx + s * dy)),
                _slab(c * ry - s * rx, sy, _inverse(c * dy - s * dx)),
                _slab(rz, sz, _inverse(dz)),
            ]
        elif kind == "cylinder":
            a = (dx * dx + dy * dy).clamp(min=_TINY)
            middle, cross = (dx * rx + dy * ry) / a, dx * ry - dy * rx
            half = (sx * sx * a - cross * cross).clamp(min=0).sqrt() / a
            ends = [(middle - half, middle + half), _slab(rz, sy, _inverse(dz))]
        else:
            along = dx * rx + dy * ry + dz * rz
            inside = sx * sx - (rx * rx + ry * ry + rz * rz) + along * along
            half = inside.clamp(min=0).sqrt()
            ends = [(torch.where(inside >= 0, along - half, torch.inf), along + half)]
        entry, leave = ends[0]
        for low, high in ends[1:]:
            entry, leave = torch.maximum(entry, low), torch.minimum(leave, high)
        found.append(_Pairs(flat, group.geom.reshape(-1).index_select(0, which), entry, leave))
    return found


def _first(entry: Tensor, leave: Tensor) -> Tensor:
    """Range of the first surface: the entry, or from inside the exit; infinite where missed or behind."""
    range_m = torch.where(entry > 0, entry, leave)
    return torch.where((entry <= leave) & (leave > 0), range_m, torch.inf)


def trace(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> tuple[Tensor, Tensor]:
    """First surfaces on rays.

    Args:
        solids: B scenes.
        origin_e: (B, 3) in E [m].
        directions_e: unit, (B, N, 3) in E.

    Returns:
        Ranges (B, N) [m], MISS_RANGE_M where nothing is met, and geoms (B, N), -1 there; in the solids' dtype.
    """
    rays = _world(solids, origin_e, directions_e)
    (ox, oy, oz), (dx, _, dz) = rays
    down = torch.where(dz < -_TINY, -oz / torch.where(dz < -_TINY, dz, -1), torch.inf)
    best = torch.where(down > 0, down, torch.inf)
    geom = solids.floor[:, None].expand(best.shape)
    walls, (ix, iy, iz) = solids.walls, (_inverse(d) for d in rays.direction)
    for k in range(walls.geom.shape[1]):
        (cx, cy, cz), (sx, sy, sz) = walls.centre[:, :, k], walls.size[:, :, k]
        (lx, hx), (ly, hy), (lz, hz) = (_slab(cx - ox, sx, ix), _slab(cy - oy, sy, iy), _slab(cz - oz, sz, iz))
        range_m = torch.maximum(torch.maximum(lx, ly), lz)
        # from outside the wall
        nearer = (range_m <= torch.minimum(torch.minimum(hx, hy), hz)) & (range_m > 0) & (range_m < best)
        best = torch.where(nearer, range_m, best)
        geom = torch.where(nearer, walls.geom[:, k, None], geom)
    best, geom = best.reshape(-1), geom.reshape(-1).clone()
    met = _pairs(solids, rays)
    if met:
        ray, which, entry, leave = (torch.cat(parts) for parts in zip(*met, strict=True))
        range_m = _first(entry, leave)
        best = best.scatter_reduce(0, ray, range_m, "amin")
        first = (range_m == best.index_select(0, ray)) & (range_m < torch.inf)
        geom[ray[first]] = which[first]
    missed = torch.isinf(best)
    shape = dx.shape
    range_m = torch.where(missed, torch.full_like(best, MISS_RANGE_M), best).reshape(shape)
    return range_m, torch.where(missed, -1, geom).reshape(shape)


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
    rays = _world(solids, origin_e, line / away[..., None])
    hidden = torch.zeros(away.numel(), dtype=torch.bool, device=away.device)
    # a point's own surface is met at the point itself, but for rounding at grazing incidence
    limit = (away - (1e-5 + 1e-5 * away)).reshape(-1)
    for ray, _, entry, leave in _pairs(solids, rays):
        hidden[ray[_first(entry, leave) < limit.index_select(0, ray)]] = True
    return hidden.reshape(away.shape)
