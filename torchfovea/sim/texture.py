"""Procedural solid texture: the colour of a point of an object, filtered to the pixel that sees it.

Each geom carries its own place in one periodic volume of band-limited noise (three octaves a volume, the volume looked up at
three scales a factor 8 apart, each turned so that no period lines up with a wall). An octave fades as its wavelength nears
the pixel's footprint, hence far surfaces are smooth instead of aliased and two eyes see one colour.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["Paint", "colour"]

_SIZE = 96  # voxels a side of the noise volume
_WAVELENGTHS = (5.0, 10.0, 20.0)  # of its octaves [voxels]
_VOXELS_M = (0.0006, 0.0048, 0.0384)  # the three scales: wavelengths 3 mm to 0.77 m
_AMPLITUDES = (0.12, 0.14, 0.16, 0.17, 0.17, 0.15, 0.13, 0.12, 0.10)  # log albedo, fine to coarse
_PIXEL_SIGMA = 0.45  # of a pixel's Gaussian footprint, in pixels
_CELLS = 2  # grid_sample runs one thread a batch entry
_LIGHTS = ((0.35, 0.45, 0.82, 0.42), (-0.75, -0.35, 0.56, 0.16))  # direction and strength, in the world


class Paint(NamedTuple):
    """What each of G geoms looks like.

    Attributes:
        rotation: (G, 3, 3), world to the geom's texture frame.
        centre: (G, 3), the geom's centre in the world [m].
        offset: (G, 3), its place in the noise [m].
        base: (G, 3), RGB.
        accent: (G, 3), RGB mixed in at large scale.
        contrast: (G,), strength of the noise.
        axes: (G, 3, 3), world to the geom's own frame.
        can: (G, 2), radius and half height of a can's label [m]; 0 for everything else.
    """

    rotation: Tensor
    centre: Tensor
    offset: Tensor
    base: Tensor
    accent: Tensor
    contrast: Tensor
    axes: Tensor
    can: Tensor


@lru_cache(maxsize=1)
def _volume() -> Tensor:
    """The noise, (1, 4, S+1, S+1, S+1): three unit-variance octaves and a fourth, independent coarse one for colour."""
    generator = torch.Generator().manual_seed(20180)
    frequency = torch.fft.fftfreq(_SIZE)
    radius = (
        frequency[:, None, None] ** 2 + frequency[None, :, None] ** 2 + torch.fft.rfftfreq(_SIZE)[None, None, :] ** 2
    ).sqrt()
    octave = torch.log2(radius.clamp(min=1e-6))
    bands = []
    for wavelength in (*_WAVELENGTHS, 24.0):
        noise = torch.fft.rfftn(torch.randn(_SIZE, _SIZE, _SIZE, generator=generator))
        window = torch.cos(math.pi / 2 * (octave + math.log2(wavelength)).clamp(-1, 1))
        band = torch.fft.irfftn(noise * window, s=(_SIZE,) * 3)
        bands.append(band / band.std())
    volume = torch.stack(bands)[None]
    # one voxel more on each far side closes the period for linear interpolation
    for axis in (2, 3, 4):
        volume = torch.cat([volume, volume.narrow(axis, 0, 1)], axis)
    return volume.contiguous()


@lru_cache(maxsize=1)
def _turns() -> Tensor:
    """A fixed rotation for each scale, (3, 3, 3)."""
    generator = torch.Generator().manual_seed(7)
    return torch.linalg.qr(torch.randn(3, 3, 3, generator=generator))[0]


def _noise(points: Tensor, scale: int, channels: slice) -> Tensor:
    """Noise at points (N, 3) [m] in the texture frame, (N, C)."""
    n = points.shape[0]
    place = points @ (_turns()[scale] / (_VOXELS_M[scale] * _SIZE))
    place = (place - place.floor()) * 2 - 1
    pad = -n % _CELLS
    grid = F.pad(place, (0, 0, 0, pad)).reshape(_CELLS, 1, 1, -1, 3)
    volume = _volume()[:, channels].expand(_CELLS, -1, -1, -1, -1)
    sampled = F.grid_sample(volume, grid, align_corners=True)  # (cells, C, 1, 1, n/cells)
    return sampled.permute(0, 2, 3, 4, 1).reshape(-1, sampled.shape[1])[:n]


def _smoothstep(x: Tensor) -> Tensor:
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def _label(local: Tensor, size: Tensor, footprint: Tensor, base: Tensor) -> Tensor:
    """A can's albedo (N, 3): its own colour with a white wave around it, metal at both ends."""
    radius, half = size.unbind(-1)
    x, y, z = local.unbind(-1)
    angle = torch.atan2(y, x)
    height = z / half
    blur = (footprint / half).clamp(min=1e-3)

    def inside(distance: Tensor) -> Tensor:  # 1 well inside, 0 well outside, as wide a step as the footprint
        return _smoothstep(0.5 + distance / (2 * blur))

    wave = 0.34 * torch.sin(angle + 0.9 * torch.sin(2 * angle))
    ribbon = inside(0.13 - (height - wave).abs())
    ribbon = torch.maximum(ribbon, inside(0.02 - (height - wave - 0.24).abs()))
    metal = inside(height.abs() - 0.9)
    white = base.new_tensor([0.93, 0.91, 0.87])
    silver = base.new_tensor([0.62, 0.63, 0.66])
    albedo = base + ribbon[:, None] * (white - base)
    return albedo + metal[:, None] * (silver - albedo)


def colour(paint: Paint, geom: Tensor, point_w: Tensor, normal_w: Tensor, footprint_m: Tensor) -> Tensor:
    """Colour of surface points, without any term that depends on the viewpoint but the pixel's own blur.

    Args:
        paint: of the scene.
        geom: (N,) which geom each point lies on, >= 0.
        point_w: (N, 3) in the world [m].
        normal_w: (N, 3), outward.
        footprint_m: (N,) width of the pixel on the surface [m].

    Returns:
        (N, 3) RGB in [0, 1], float32.
    """
    relative = (point_w - paint.centre[geom])[:, None, :]
    solid = (relative @ paint.rotation[geom].mT)[:, 0] + paint.offset[geom]
    spread = (_PIXEL_SIGMA * footprint_m) ** 2
    log_albedo = torch.zeros_like(footprint_m)
    kept = torch.zeros_like(footprint_m)
    mix = torch.zeros_like(footprint_m)
    for scale, voxel in enumerate(_VOXELS_M):
        waves = [w * voxel for w in _WAVELENGTHS]
        fades = torch.stack([torch.exp(-2 * math.pi**2 / (w * w) * spread) for w in waves], -1)
        fades = fades * fades.new_tensor(_AMPLITUDES[3 * scale : 3 * scale + 3])
        coarse = scale == len(_VOXELS_M) - 1
        # most pixels are too wide for the finest octaves: look up only those that are not
        rows = None if coarse else (fades[:, 2] > 0.004).nonzero()[:, 0]
        if rows is not None and rows.numel() == 0:
            continue
        if rows is None or rows.numel() > 0.8 * footprint_m.numel():
            noise = _noise(solid, scale, slice(0, 4) if coarse else slice(0, 3))
            log_albedo = log_albedo + (noise[:, :3] * fades).sum(-1)
            kept = kept + (fades * fades).sum(-1)
            if coarse:
                mix = torch.sigmoid(3 * noise[:, 3])
        else:
            part = fades[rows]
            log_albedo = log_albedo.index_add(0, rows, (_noise(solid[rows], scale, slice(0, 3)) * part).sum(-1))
            kept = kept.index_add(0, rows, (part * part).sum(-1))
    base = paint.base[geom]
    albedo = base + 0.65 * mix[:, None] * (paint.accent[geom] - base)
    labelled = paint.can[geom, 0] > 0
    if bool(labelled.any()):
        rows = labelled.nonzero()[:, 0]
        own = geom[rows]
        local = (relative[rows] @ paint.axes[own].mT)[:, 0]
        albedo = albedo.index_copy(0, rows, _label(local, paint.can[own], footprint_m[rows], albedo[rows]))
    contrast = paint.contrast[geom]
    # the mean of exp(noise) shrinks as octaves fade; put it back, or far walls would darken
    gain = torch.exp(contrast * log_albedo - contrast * contrast * kept / 2)
    light = torch.full_like(gain, 0.5)
    for *direction, strength in _LIGHTS:
        light = light + strength * (normal_w @ normal_w.new_tensor(direction)).clamp(min=0)
    return (albedo * (gain * light)[:, None]).clamp(0, 1)
