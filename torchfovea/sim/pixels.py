"""What the pixels of cameras see of rooms and of the solids in them: the first surfaces on their rays.

A picture is cut into square tiles. A solid is tried only in the tiles whose cone of rays reaches into the azimuths and
elevations that it spans, which every camera has; every ray leaves the room through the floor, a wall or the ceiling.
Walls and normals are in single precision, which puts surfaces a few metres away within microns; the rest is in double.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.machine import Loops, loops
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.chart import Components
from torchfovea.setting import require
from torchfovea.sim.solids import Solids, chord, extent, first, outward, tiny, way_out

__all__ = ["FACES", "TILE", "Pixels", "Surfaces", "pixels_of", "surfaces_seen"]

TILE = 8
"""A tile's side [px]."""

FACES = 6
"""A room's, the first surfaces of each scene."""

_AREA = TILE * TILE
_MARGIN_RAD = 1e-4  # of cones and spans, for rounding
_STEEPEST = 0.12  # cosine of the slant at which the footprint stops growing


class Pixels(NamedTuple):
    """What a camera's pixels see, tile by tile.

    Attributes:
        ray: unit, by component, float64 (3, T, 64).
        single: the same in float32.
        span: the angle that a pixel spans [rad], (T, 64).
        axis: of the cone around a tile's rays, float64 (T, 3).
        cone: half its angle [rad], float64 (T,).
    """

    ray: Tensor
    single: Tensor
    span: Tensor
    axis: Tensor
    cone: Tensor


class Surfaces(NamedTuple):
    """The first surfaces of B cameras' pixels, (B · T, 64) each.

    Attributes:
        range_m: along each pixel's ray.
        surface: int32, which of the scene's they are: the faces of its room, then its solids.
        place: in the worlds [m], by component.
        normal: into the room, or out of what stands in it, by component.
        footprint_m: how wide a pixel is there.
    """

    range_m: Tensor
    surface: Tensor
    place: Components
    normal: Components
    footprint_m: Tensor


@lru_cache(maxsize=8)
def pixels_of(camera: Camera, size_px: int, device: torch.device) -> Pixels:
    """The pixels of square pictures."""
    side = -(-size_px // TILE)
    # past the edge, the edge's pixels again
    index = torch.arange(side * TILE, dtype=torch.float64).clamp(max=size_px - 1)
    v, u = torch.meshgrid(index, index, indexing="ij")

    def tiled(part: Tensor) -> Tensor:
        return part.reshape(side, TILE, side, TILE).transpose(1, 2).reshape(-1, _AREA)

    px = torch.stack([tiled(u), tiled(v)], -1)
    ray = torch.nn.functional.normalize(camera.rays(px), dim=-1)
    spans = []
    for step in ((0.5, 0.0), (0.0, 0.5)):
        shift = torch.tensor(step, dtype=torch.float64)
        ends = [torch.nn.functional.normalize(camera.rays(px + s * shift), dim=-1) for s in (-1, 1)]
        spans.append((ends[1] - ends[0]).norm(dim=-1))
    axis = torch.nn.functional.normalize(ray.mean(1), dim=-1)
    cone = 2 * torch.asin(((ray - axis[:, None]).norm(dim=-1).amax(1) / 2).clamp(max=1)) + _MARGIN_RAD
    ray = ray.permute(2, 0, 1).contiguous()
    parts = (ray, ray.float(), torch.maximum(*spans).float(), axis, cone)
    return Pixels(*(part.to(device) for part in parts))


def _reached(solids: Solids, eye: Tensor, axis: Tensor, cone: Tensor) -> Tensor:
    """Whether tiles may see solids, bool (K, B, T): of all shapes, one after the other.

    Args:
        solids: of the scenes.
        eye: in the worlds, (B, 3).
        axis: of the tiles' cones, (B, T, 3).
        cone: half their angles [rad], (T,).
    """
    extents = [extent(shape, group.size[..., 0]) for shape, group in solids.groups]
    radius, half = (torch.cat(parts, -1) for parts in zip(*extents, strict=True))
    x, y, z = torch.cat([group.centre[..., 0] for _, group in solids.groups], -1) - eye.T[:, :, None]
    away = torch.hypot(x, y)
    # how far a solid and a tile reach to either side; all around where they are above, below or around
    wide = torch.asin((radius / away).clamp(max=1)) + torch.where(away <= radius, math.pi, _MARGIN_RAD)
    up = torch.asin(axis[..., 2].clamp(-1, 1))
    side = torch.where(up.abs() + cone < math.pi / 2, cone.sin() / up.cos(), 2.0)
    side = torch.where(side < 1, torch.asin(side.clamp(max=1)), math.pi)
    near, far = (away - radius).clamp(min=0), away + radius
    top, bottom = z + half, z - half
    highest = torch.atan2(top, torch.where(top > 0, near, far)) + _MARGIN_RAD
    lowest = torch.atan2(bottom, torch.where(bottom > 0, far, near)) - _MARGIN_RAD
    # (K, B, 1) beside (B, T)
    turn, wide, highest, lowest = (p.T.float()[..., None] for p in (torch.atan2(y, x), wide, highest, lowest))
    turn = turn - torch.atan2(axis[..., 1], axis[..., 0]).float()
    # an angle between directions, whichever way round
    beside = math.pi - (turn.abs() - math.pi).abs() <= wide + side.float()
    return beside & ((up - cone).float() <= highest) & ((up + cone).float() >= lowest)


class _Met(NamedTuple):
    """First surfaces on the rays of rows of pixels, (R, 64): range [m], and int32 which of the scene's they are."""

    range_m: Tensor
    surface: Tensor


def _walls(solids: Solids, eye: Tensor, direction: Components) -> _Met:
    """Where rays (B · T, 64) leave their room."""
    offset = solids.middle[..., 0] - eye.T
    rows = len(direction[0]) // len(eye)
    out = [
        way_out(o.repeat_interleave(rows)[:, None], h.repeat_interleave(rows)[:, None], d)
        for o, h, d in zip(offset.float(), solids.half[..., 0].float(), direction, strict=True)
    ]
    best = torch.minimum(torch.minimum(out[0], out[1]), out[2])
    face = (direction[2] > 0).int().add_(4)
    for axis in (1, 0):  # arithmetic: torch.where is slow here
        own = (direction[axis] > 0).int().add_(2 * axis)
        face.add_((out[axis] <= best).int().mul_(own.sub_(face)))
    return _Met(best, face)


def _stand_before(met: _Met, solids: Solids, eye: Tensor, rotation: Tensor, pixels: Pixels, near: Tensor) -> None:
    """Put what stands in the rooms before their walls, in place.

    Args:
        met: the walls, (B · T, 64).
        solids: of the scenes.
        eye: in the worlds, float64 (B, 3).
        rotation: of the cameras, float64 (B, 3, 3).
        pixels: what they see.
        near: see `_reached`.
    """
    which, batch, tile = near.nonzero().unbind(1)
    row = batch * near.shape[2] + tile
    counts = [group.geom.shape[1] for _, group in solids.groups]
    parts = [part.count_nonzero() for part in near.split(counts)]
    ends = torch.stack(parts).tolist()
    found, place = [], 0
    for (shape, group), number, b, t, count in zip(
        solids.groups, which.split(ends), batch.split(ends), tile.split(ends), counts, strict=True
    ):
        own = b * count + number - place
        # in double precision: a ray that grazes a cylinder magnifies rounding a thousandfold
        x, y, z = (part.index_select(0, t) for part in pixels.ray)
        dx, dy, dz = ((x * a).addcmul_(y, b).addcmul_(z, c) for a, b, c in rotation[b].permute(1, 2, 0)[..., None])
        rx, ry, rz = (part.reshape(-1)[own, None] for part in group.centre[..., 0] - eye.T[:, :, None])
        (sx, sy, sz), (c, s) = (part.flatten(1)[:, own, None].unbind(0) for part in (group.size, group.turn))
        found.append(first(*chord(shape, (rx, ry, rz), (sx, sy, sz), (c, s), (dx, dy, dz))).float())
        place += count
    range_m, which = torch.cat(found), which.int().add_(FACES)
    # the first solids of all tiles, the second ones, ...: no tile comes twice at once
    layer = near.cumsum(0)[near] - 1
    for pairs in layer.argsort(stable=True).split(layer.bincount().tolist()):
        rows, here = row[pairs], range_m.index_select(0, pairs)
        before, surface = met.range_m.index_select(0, rows), met.surface.index_select(0, rows)
        surface.add_((here < before).int().mul_(which[pairs, None] - surface))
        met.surface.index_copy_(0, rows, surface)
        met.range_m.index_copy_(0, rows, torch.minimum(here, before))


def _normals(met: _Met, solids: Solids, eye: Tensor, direction: Components, near: Tensor) -> list[Tensor]:
    """Of the first surfaces, by component (B · T, 64): into the room, or out of what stands in it.

    Args:
        met: the first surfaces.
        solids: of the scenes.
        eye: in the worlds, (B, 3).
        direction: of the rays, (B · T, 64).
        near: see `_reached`.
    """
    inward = torch.zeros(3, FACES + len(near)).to(met.range_m)
    for axis in range(3):
        inward[axis, 2 * axis], inward[axis, 2 * axis + 1] = 1, -1
    which = met.surface.view(-1)
    normal = [part.index_select(0, which).view_as(met.range_m) for part in inward]
    place = FACES
    for shape, group in solids.groups:
        count, tiles = group.geom.shape[1], near.shape[2]
        rows = near[place - FACES :][:count].any(0).view(-1).nonzero()[:, 0]
        if len(rows) > 0:
            number = met.surface.index_select(0, rows).sub_(place)
            mine = (number >= 0) & (number < count)
            own = number.clamp_(0, count - 1).add_((rows // tiles * count).int()[:, None]).view(-1)
            offset = group.centre[..., 0] - eye.T[:, :, None]
            # of each pixel, what its solid is like
            px, py, pz, sx, sy, sz, c, s = (
                table.float().reshape(-1).index_select(0, own).view_as(mine)
                for table in (*offset, *group.size, *group.turn)
            )
            away = met.range_m.index_select(0, rows)
            dx, dy, dz = (d.index_select(0, rows).mul_(away) for d in direction)
            out = outward(shape, (dx - px, dy - py, dz - pz), (sx, sy, sz), (c, s))
            for part, found in zip(normal, out, strict=True):
                part.index_copy_(0, rows, torch.where(mine, found, part.index_select(0, rows)))
        place += count
    return normal


def surfaces_seen(solids: Solids, eye: Tensor, rotation: Tensor, pixels: Pixels) -> Surfaces:
    """The first surfaces that cameras see, one in each scene. Not differentiable.

    Args:
        solids: of B scenes.
        eye: where the cameras are in the worlds, float64 (B, 3).
        rotation: columns are their axes in the worlds, float64 (B, 3, 3).
        pixels: of each.

    Raises:
        SettingError: for an eye outside of its room.
    """
    inside = bool((solids.half[..., 0] > (solids.middle[..., 0] - eye.T).abs()).all())
    require(inside, "origin", "an eye outside of the room", "eyes inside")
    near = _reached(solids, eye, pixels.axis @ rotation.mT, pixels.cone)
    library = loops(eye)
    if library is not None:
        return _by_loop(library, solids, eye, rotation, pixels, near)
    count, tiles = len(eye), len(pixels.axis)
    turned = rotation.float().transpose(0, 1).reshape(-1, 3) @ pixels.single.view(3, -1)
    dx, dy, dz = turned.view(3, count * tiles, _AREA)
    direction = (dx, dy, dz)
    met = _walls(solids, eye, direction)
    _stand_before(met, solids, eye, rotation, pixels, near)
    nx, ny, nz = _normals(met, solids, eye, direction, near)
    slant = (dx * nx).addcmul_(dy, ny).addcmul_(dz, nz).abs_().clamp_(min=_STEEPEST)
    span = pixels.span.repeat(count, 1) if count > 1 else pixels.span
    at = eye.float().repeat_interleave(tiles, 0)
    x, y, z = (torch.addcmul(at[:, k, None], d, met.range_m) for k, d in enumerate(direction))
    return Surfaces(*met, (x, y, z), (nx, ny, nz), met.range_m * span / slant)


def _by_loop(library: Loops, solids: Solids, eye: Tensor, rotation: Tensor, pixels: Pixels, near: Tensor) -> Surfaces:
    """`surfaces_seen` by the loop of trace.c."""
    rows, origin = len(eye) * len(pixels.axis), eye.T.contiguous()
    tables = (rotation, origin, solids.middle, solids.half, near)
    view = (len(eye), len(pixels.axis), pixels.ray, pixels.span, *(part.contiguous() for part in tables), _STEEPEST)
    groups = [
        (len(eye), group.geom.shape[1], 0, origin, None, *(p.contiguous() for p in group[:3]), tiny(eye.dtype))
        for _, group in solids.groups
    ]
    seen, which = pixels.span.new_empty(8, rows, _AREA), torch.empty(rows, _AREA, dtype=torch.int32)
    library("see", view, *groups, seen, which)
    range_m, x, y, z, nx, ny, nz, footprint_m = seen.unbind(0)
    return Surfaces(range_m, which, (x, y, z), (nx, ny, nz), footprint_m)
