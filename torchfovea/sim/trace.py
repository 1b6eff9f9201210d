"""Rays through many scenes at once, as tensor operations on any device: the same surfaces that MuJoCo's rays meet.

The scenes are closed rooms with upright boxes, upright cylinders and spheres in them. Every ray leaves the room through
the floor, a wall or the ceiling; the other solids are tried only for the rays that pass near them, as one flat list of
(ray, solid) pairs. `torchfovea.sim.rays` is the reference: with float64 the two agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require
from torchfovea.sim.model import Scene
from torchfovea.sim.room import FLOOR, ROOM, Solid

__all__ = ["Solids", "occluded", "ranges", "solids_of", "take", "trace"]


def _tiny(dtype: torch.dtype) -> float:
    """A step that stands for none: its inverse times any length in a scene is finite."""
    return torch.finfo(dtype).tiny * 1e8


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
        middle: of the room, (3, B, 1).
        half: its half lengths, (3, B, 1).
        faces: geoms that close it toward −x, x, −y, y, −z and z, (6, B).
        boxes: turned boxes.
        cylinders: upright.
        spheres: of any size.
        rotation: yaw of E as cosine and sine, (2, B, 1).
        translation: of E, (3, B, 1).
    """

    middle: Tensor
    half: Tensor
    faces: Tensor
    boxes: _Group
    cylinders: _Group
    spheres: _Group
    rotation: Tensor
    translation: Tensor


def solids_of(
    scenes: Sequence[Scene], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
) -> Solids:
    """Scenes as tensors.

    Raises:
        SettingError: for a scene that is not a room closed by one floor, four walls and a ceiling.
    """
    chosen: dict[str, list[list[tuple[int, Solid]]]] = {"boxes": [], "cylinders": [], "spheres": []}
    rooms, faces, yaw, place = [], [], [], []
    for scene in scenes:
        parts: dict[str, list[tuple[int, Solid]]] = {name: [] for name in chosen}
        shell = []
        for geom, solid in enumerate(scene.solids):
            if solid.kind in (FLOOR, ROOM):
                shell.append((geom, solid))
            else:
                parts["boxes" if solid.shape == "box" else f"{solid.shape}s"].append((geom, solid))
        ends, geoms = _closed(shell)
        rooms.append(ends)
        faces.append(geoms)
        rotation, translation = scene.world_from_ego
        yaw.append((float(rotation[0, 0]), float(rotation[1, 0])))
        place.append(tuple(float(t) for t in translation))
        for name, found in parts.items():
            chosen[name].append(found)

    def tensor(values: object) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device)

    low, high = tensor(rooms).permute(2, 1, 0).contiguous()
    return Solids(
        ((low + high) / 2)[..., None],
        ((high - low) / 2)[..., None],
        torch.tensor(faces, device=device).T.contiguous(),
        boxes=_group(chosen["boxes"], tensor),
        cylinders=_group(chosen["cylinders"], tensor),
        spheres=_group(chosen["spheres"], tensor),
        rotation=tensor(yaw).T[..., None].contiguous(),
        translation=tensor(place).T[..., None].contiguous(),
    )


def take(solids: Solids, index: Tensor) -> Solids:
    """Some of the scenes, each as often as an index (K,) names it."""

    def some(part: Any) -> Any:
        if isinstance(part, _Group):
            return _Group(*(p.index_select(max(p.dim() - 3, 0), index) for p in part))
        return part.index_select(1, index)

    return Solids(*map(some, solids))


def _closed(shell: list[tuple[int, Solid]]) -> tuple[list[list[float]], list[int]]:
    """Where the room ends toward −x and x, −y and y, −z and z, and the geoms there, in that order."""
    ends, faces = [[-math.inf, math.inf] for _ in range(3)], [-1] * 6
    for geom, solid in shell:
        axis = 2 if solid.shape == "plane" else min(range(3), key=lambda k: solid.size_m[k])
        side = 0 if solid.shape == "plane" else int(solid.position_m[axis] > 0)
        thick = 0.0 if solid.shape == "plane" else solid.size_m[axis]
        require(faces[2 * axis + side] < 0 and solid.yaw_rad == 0, "scene", solid.name, "one wall on each side")
        ends[axis][side] = solid.position_m[axis] + (thick, -thick)[side]
        faces[2 * axis + side] = geom
    require(min(faces) >= 0, "scene", f"{len(shell)} parts of a room", "a floor, four walls and a ceiling")
    return ends, faces


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
    tiny = _tiny(step.dtype)
    return 1 / torch.where(step.abs() > tiny, step, torch.full_like(step, tiny))


def _slab(middle: Tensor, half: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave |x − middle| ≤ half; x advances by 1/inverse a unit of range."""
    centre, reach = middle * inverse, half * inverse.abs()
    return centre - reach, centre + reach


def _near(group: _Group, rays: _Rays, unit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
    for group, kind in ((solids.boxes, "box"), (solids.cylinders, "cylinder"), (solids.spheres, "sphere")):
        if group.geom.shape[1] == 0:
            continue
        b, which, flat = _near(group, rays, unit)
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
            a = dx * dx + dy * dy
            upright = a <= _tiny(a.dtype)  # along the axis: inside all the way, or nowhere
            a, cross = torch.where(upright, torch.ones_like(a), a), dx * ry - dy * rx
            middle = torch.where(upright, torch.zeros_like(a), (dx * rx + dy * ry) / a)
            inside = torch.where(upright, sx * sx - rx * rx - ry * ry, sx * sx * a - cross * cross)
            half = torch.where(upright, torch.full_like(a, torch.inf), inside.clamp(min=0).sqrt() / a)
            ends = [(torch.where(inside >= 0, middle - half, torch.inf), middle + half), _slab(rz, sy, _inverse(dz))]
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
    range_m, leave, rays, met = _ranges(solids, origin_e, directions_e)
    # by which face the room is left
    geom = torch.zeros_like(range_m, dtype=torch.int64)
    for axis, (face, ahead) in enumerate(zip(solids.faces.view(3, 2, -1, 1), rays.direction, strict=True)):
        geom = torch.where(leave[axis] <= range_m, torch.where(ahead > 0, face[1], face[0]), geom)
    geom = geom.reshape(-1)
    for pairs in met:
        first = _first(pairs.entry, pairs.exit) == range_m.reshape(-1).index_select(0, pairs.ray)
        geom[pairs.ray[first]] = pairs.geom[first]
    return range_m, geom.reshape(range_m.shape)


def ranges(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> Tensor:
    """The ranges of `trace` alone."""
    return _ranges(solids, origin_e, directions_e)[0]


def _ranges(solids: Solids, origin_e: Tensor, directions_e: Tensor) -> tuple[Tensor, list[Tensor], _Rays, list[_Pairs]]:
    """Ranges (B, N), where each pair of faces is left, and what led there."""
    directions_e = directions_e.to(solids.rotation)
    length = (directions_e * directions_e).sum(-1).sqrt()  # vector_norm takes forty times as long over strided axes
    whole = bool(((length > 0) & (length < torch.inf)).all())
    require(whole, "directions_e", "zero or not finite", "directions")
    rays = _world(solids, origin_e, directions_e / length[..., None])
    offset = [middle - o for middle, o in zip(solids.middle, rays.origin, strict=True)]
    inside = bool(torch.stack([h - o.abs() for h, o in zip(solids.half, offset, strict=True)]).amin() > 0)
    require(inside, "origin", "an eye outside of the room", "eyes inside")
    leave = [_slab(o, h, _inverse(d))[1] for o, h, d in zip(offset, solids.half, rays.direction, strict=True)]
    best = torch.minimum(torch.minimum(leave[0], leave[1]), leave[2])
    met = _pairs(solids, rays)
    for pairs in met:
        best.view(-1).scatter_reduce_(0, pairs.ray, _first(pairs.entry, pairs.exit), "amin")
    return best, leave, rays, met


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
    rays = _world(solids, origin_e, line / away.clamp(min=_tiny(dtype))[..., None])
    hidden = torch.zeros(away.numel(), dtype=torch.bool, device=away.device)
    # a point's own surface is met at the point itself, but for rounding at grazing incidence
    limit = (away - (1e-5 + 1e-5 * away)).reshape(-1)
    for ray, _, entry, leave in _pairs(solids, rays):
        hidden[ray[_first(entry, leave) < limit.index_select(0, ray)]] = True
    return hidden.reshape(away.shape)
