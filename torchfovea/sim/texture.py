"""Procedural solid texture: the colour of a point of an object, filtered to the pixel that sees it.

Each geom has its own place in one periodic volume of band-limited noise: three octaves, looked up at three scales a
factor 8 apart, each turned so that no period lines up with a wall. An octave fades as its wavelength nears the pixel's
footprint, hence far surfaces are smooth instead of aliased and two eyes see one colour.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["Paint", "colour"]

_SIZE = 64  # voxels a side of the noise volume
_WAVELENGTHS = (5.0, 10.0, 20.0)  # of its octaves [voxels]
_VOXELS_M = (0.0006, 0.0048, 0.0384)  # the three scales: wavelengths 3 mm to 0.77 m
_AMPLITUDES = (0.12, 0.14, 0.16, 0.17, 0.17, 0.15, 0.13, 0.12, 0.10)  # log albedo, fine to coarse
_PIXEL_SIGMA = 0.45  # of a pixel's Gaussian footprint, in pixels
_AMBIENT = 0.5
_LIGHTS = ((0.35, 0.45, 0.82, 0.42), (-0.75, -0.35, 0.56, 0.16))  # direction and strength, in the world


class Paint(NamedTuple):
    """What each of G geoms looks like.

    Attributes:
        look: (G, 7), RGB; RGB mixed in at large scale; strength of the noise.
        offset: (G, 3), its place in the noise, added to world coordinates [m].
        centre: (G, 3), in the world [m].
        can: (G, 2), radius and half height of an upright can's label [m]; 0 for everything else.
    """

    look: Tensor
    offset: Tensor
    centre: Tensor
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
    # a voxel's channels side by side: one cache line instead of four
    return volume.to(memory_format=torch.channels_last_3d)


@lru_cache(maxsize=1)
def _turns() -> Tensor:
    """A fixed rotation for each scale, (3, 3, 3)."""
    generator = torch.Generator().manual_seed(7)
    return torch.linalg.qr(torch.randn(3, 3, 3, generator=generator))[0]


def _noise(points: Tensor, scale: int, channels: int) -> Tensor:
    """Noise at points (N, 3) [m], (C, N)."""
    place = points @ (_turns()[scale] / (_VOXELS_M[scale] * _SIZE))
    grid = ((place - place.floor()) * 2 - 1)[None, None, None]
    return F.grid_sample(_volume()[:, :channels], grid, align_corners=True)[0, :, 0, 0]


def _fading(scale: int) -> list[tuple[float, float]]:
    """Amplitude of a scale's octaves, and their decay with the variance of the Gaussian footprint."""
    octaves = zip(_AMPLITUDES[3 * scale :], _WAVELENGTHS, strict=False)
    return [(a, -2 * math.pi**2 / (w * _VOXELS_M[scale]) ** 2) for a, w in octaves]


def _widest(scale: int) -> float:
    """The footprint's variance at which a scale's coarsest octave has all but vanished."""
    amplitude, decay = _fading(scale)[-1]
    return math.log(0.004 / amplitude) / decay


def _octaves(noise: Tensor, spread: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Sum (N,) of a scale's faded octaves, and its variance (N,)."""
    value, power = torch.zeros_like(spread), torch.zeros_like(spread)
    for wave, (amplitude, decay) in zip(noise, _fading(scale), strict=True):
        fade = torch.exp(decay * spread) * amplitude
        value.addcmul_(wave, fade)
        power.addcmul_(fade, fade)
    return value, power


def _smoothstep(x: Tensor) -> Tensor:
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def _label(local: Tensor, size: Tensor, footprint: Tensor, base: Tensor) -> Tensor:
    """A can's albedo (N, 3): its own colour with a white wave around it, metal at both ends."""
    half = size[:, 1]
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
    solid = point_w + paint.offset[geom]
    spread = (_PIXEL_SIGMA * footprint_m) ** 2
    look = paint.look[geom]
    log_albedo, kept = torch.zeros_like(spread), torch.zeros_like(spread)
    for scale in range(len(_VOXELS_M) - 1):
        # most pixels are too wide for the finest octaves: look up only those that are not
        rows = (spread < _widest(scale)).nonzero()[:, 0]
        if rows.numel() == 0:
            continue
        if rows.numel() > 0.8 * spread.numel():
            value, power = _octaves(_noise(solid, scale, 3), spread, scale)
            log_albedo += value
            kept += power
        else:
            value, power = _octaves(_noise(solid[rows], scale, 3), spread[rows], scale)
            log_albedo.index_add_(0, rows, value)
            kept.index_add_(0, rows, power)
    coarse = _noise(solid, len(_VOXELS_M) - 1, 4)
    value, power = _octaves(coarse[:3], spread, len(_VOXELS_M) - 1)
    base = look[:, :3]
    albedo = base + 0.65 * torch.sigmoid(3 * coarse[3])[:, None] * (look[:, 3:6] - base)
    rows = (paint.can[geom, 0] > 0).nonzero()[:, 0]
    if rows.numel() > 0:
        own = geom[rows]
        albedo[rows] = _label(point_w[rows] - paint.centre[own], paint.can[own], footprint_m[rows], albedo[rows])
    contrast = look[:, 6]
    # the mean of exp(noise) shrinks as octaves fade; put it back, or far walls would darken
    gain = torch.exp(contrast * (log_albedo + value) - contrast * contrast * (kept + power) / 2)
    light = torch.full_like(gain, _AMBIENT)
    for *direction, strength in _LIGHTS:
        light += strength * (normal_w @ normal_w.new_tensor(direction)).clamp(min=0)
    return (albedo * (gain * light)[:, None]).clamp(0, 1)
