"""Pictures of many scenes at once, as tensor operations on any device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.sim.model import Scene
from torchfovea.sim.pixels import FACES, TILE, pixels_of, surfaces_seen
from torchfovea.sim.solids import Solids, solids_of
from torchfovea.sim.texture import Paint, colour

__all__ = ["Drawn", "Painted", "draw_pictures", "paint_scenes"]

_SKY = (0.62, 0.72, 0.82)


class Painted(NamedTuple):
    """B scenes, in double precision, and what they look like, in single.

    Attributes:
        solids: of the scenes.
        geom: of each surface, int64 (B · S,): the faces of the room, the boxes, cylinders and spheres; -1 for none.
        paint: of each surface.
    """

    solids: Solids
    geom: Tensor
    paint: Paint


class Drawn(NamedTuple):
    """B pictures and the truth behind them.

    Attributes:
        image: (B, 3, H, W) RGB in [0, 1].
        range_m: (B, H, W) along each pixel's ray, infinite where it meets nothing.
        geom: (B, H, W) int64, -1 for a miss.
    """

    image: Tensor
    range_m: Tensor
    geom: Tensor


def paint_scenes(scenes: Sequence[Scene], device: torch.device | str = "cpu") -> Painted:
    """Scenes to draw, closed rooms or not."""
    solids = solids_of(scenes, device, closed=False)
    geom = torch.cat([solids.faces.T, *(group.geom for _, group in solids.groups)], 1)
    tables = []
    for scene, own in zip(scenes, geom.cpu().clamp(min=0), strict=True):
        tables.append(Paint(*(part[..., own] for part in scene.paint)))
    paint = Paint(*(torch.cat(parts, -1).to(device) for parts in zip(*tables, strict=True)))
    return Painted(solids, geom.reshape(-1), paint)


@torch.no_grad()
def draw_pictures(scenes: Painted, rotation: Tensor, eye: Tensor, camera: Camera, size_px: int) -> Drawn:
    """Square pictures, one of each scene. Not differentiable.

    Args:
        scenes: B.
        rotation: (B, 3, 3), columns are the cameras' axes in the worlds.
        eye: (B, 3), where they are in the worlds [m].
        camera: of all pictures; pixel centres are integers.
        size_px: side of each.

    Raises:
        SettingError: for an eye outside of its room.
    """
    solids, device = scenes.solids, scenes.geom.device
    rotation, eye = rotation.to(device, torch.float64), eye.to(device, torch.float64)
    count = len(eye)
    range_m, surface, place, normal, footprint_m = surfaces_seen(
        solids, eye, rotation, pixels_of(camera, size_px, device)
    )
    if count > 1:
        own = torch.arange(count, device=device, dtype=torch.int32) * (len(scenes.geom) // count)
        surface.add_(own.repeat_interleave(len(surface) // count)[:, None])
    rgb = colour(scenes.paint, surface, place, normal, footprint_m)
    geom = scenes.geom.index_select(0, surface.view(-1)).view_as(surface)
    if bool((scenes.geom[:FACES] < 0).any()):
        missed = geom < 0
        rgb = torch.where(missed, rgb.new_tensor(_SKY)[:, None, None], rgb)
        range_m.masked_fill_(missed, torch.inf)

    def whole(part: Tensor) -> Tensor:  # (..., B · T, 64) to (B, ..., H, W)
        rows = _rows(count, part.shape[:-2].numel(), -(-size_px // TILE), device)
        picture = part.view(-1, TILE).index_select(0, rows.view(-1)).view(*rows.shape[:-1], -1)
        return picture[..., :size_px, :size_px].contiguous().view(count, *part.shape[:-2], size_px, size_px)

    return Drawn(whole(rgb), whole(range_m), whole(geom))


@lru_cache(maxsize=16)
def _rows(count: int, channels: int, side: int, device: torch.device) -> Tensor:
    """Where the tiles' rows of channels of pictures are in pictures of so many tiles a side, (B, C, H, W / 8)."""
    rows = torch.arange(channels * count * side * side * TILE, dtype=torch.int32, device=device)
    rows = rows.view(channels, count, side, side, TILE).permute(1, 0, 2, 4, 3)
    return rows.reshape(count, channels, side * TILE, side)
