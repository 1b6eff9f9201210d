"""Procedural solid texture: the colour of a point of an object, filtered to the pixel that sees it.

Each geom has its own place in one periodic volume of band-limited noise: three octaves, looked up at three scales a
factor 8 apart, each turned so that no period lines up with a wall. An octave fades as its wavelength nears the pixel's
footprint, hence far surfaces are smooth instead of aliased and two eyes see one colour.

Points come in rows of neighbours, and by components: a scale is looked up only for the rows in which it shows.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.machine import Loops, loops
from torchfovea.sensing.chart import Components
from torchfovea.sim.volume import PeriodicVolume

__all__ = ["Paint", "colour"]

_SIZE = 64  # voxels a side of the noise volume
_WAVELENGTHS = (5.0, 10.0, 20.0)  # of its octaves [voxels]
_VOXELS_M = (0.0006, 0.0048, 0.0384)  # the three scales: wavelengths 3 mm to 0.77 m
_AMPLITUDES = (0.12, 0.14, 0.16, 0.17, 0.17, 0.15, 0.13, 0.12, 0.10)  # log albedo, fine to coarse
_FAINTEST = 0.002  # log albedo below which an octave has all but vanished
_PIXEL_SIGMA = 0.45  # of a pixel's Gaussian footprint, in pixels
_AMBIENT = 0.5
_LIGHTS = ((0.35, 0.45, 0.82, 0.42), (-0.75, -0.35, 0.56, 0.16))  # direction and strength, in the world
_WHITE = (0.93, 0.91, 0.87)
_SILVER = (0.62, 0.63, 0.66)


class Paint(NamedTuple):
    """What each of G geoms looks like; float32.

    Attributes:
        look: (7, G), RGB; RGB mixed in at large scale; strength of the noise.
        offset: (3, G), its place in the noise, added to world coordinates [m].
        centre: (3, G), in the world [m].
        can: (2, G), radius and half height of an upright can's label [m]; 0 for everything else.
        stripes: (3, G), a mark on a can in place of its label's wave: periods around it, periods per metre of height,
            and contrast; 0 for none.
        repeat_m: (G,), after which the noise repeats along each axis of the world; inf: never.
    """

    look: Tensor
    offset: Tensor
    centre: Tensor
    can: Tensor
    stripes: Tensor
    repeat_m: Tensor


@lru_cache(maxsize=4)
def _volume(device: torch.device) -> PeriodicVolume:
    """The noise: three octaves of unit variance and a fourth, independent coarse one for colour."""
    rng = np.random.default_rng(20180)
    f = np.fft.fftfreq(_SIZE)
    radius = np.sqrt(f[:, None, None] ** 2 + f[None, :, None] ** 2 + np.fft.rfftfreq(_SIZE)[None, None, :] ** 2)
    octave = np.log2(np.maximum(radius, 1e-6))
    bands = []
    for wavelength in (*_WAVELENGTHS, 24.0):
        noise = np.fft.rfftn(rng.standard_normal((_SIZE,) * 3))
        window = np.cos(math.pi / 2 * np.clip(octave + math.log2(wavelength), -1, 1))
        band = np.fft.irfftn(noise * window, (_SIZE,) * 3, axes=(0, 1, 2))
        bands.append(band / band.std())
    return PeriodicVolume(np.stack(bands), device)


@lru_cache(maxsize=1)
def _turns() -> np.ndarray:
    """A fixed rotation for each scale, (3, 3, 3)."""
    return np.linalg.qr(np.random.default_rng(7).standard_normal((3, 3, 3)))[0]


def _noise(point: Tensor, scale: int, count: int = 3) -> list[Tensor]:
    """Noise at points (3, R, C) [m]: three octaves from fine to coarse, and the fourth number, that of the colour."""
    turn = point.new_tensor(_turns()[scale].T / (_VOXELS_M[scale] * _SIZE))
    return _volume(point.device).at((turn @ point.flatten(1)).view_as(point), count)


def _decay(scale: int) -> float:
    """By which a scale's coarsest octave, e to that times the variance of the Gaussian footprint, fades."""
    return -2 * math.pi**2 / (_WAVELENGTHS[-1] * _VOXELS_M[scale]) ** 2


def _widest(scale: int) -> float:
    """The footprint's variance at which a scale's coarsest octave has all but vanished."""
    return math.log(_FAINTEST / _AMPLITUDES[3 * scale + 2]) / _decay(scale)


def _octaves(noise: list[Tensor], spread: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Sum of a scale's faded octaves, and its variance."""
    value, power = torch.zeros_like(spread), torch.zeros_like(spread)
    fade = (spread * _decay(scale)).exp_()
    for octave in (2, 1, 0):
        amplitude = _AMPLITUDES[3 * scale + octave]
        value.addcmul_(noise[octave], fade, value=amplitude)
        power.addcmul_(fade, fade, value=amplitude**2)
        # half the wavelength, the fourth power
        fade = fade.square_().square_()
    return value, power


def _log_albedo(point: Tensor, spread: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum of the faded octaves, its variance, and the noise of the colour, each (R, C).

    Args:
        point: in the noise [m], (3, R, C).
        spread: variance of the footprint [m²], (R, C).
    """
    last = len(_VOXELS_M) - 1
    coarse = _noise(point, last, 4)
    value, power = _octaves(coarse, spread, last)
    narrowest = spread.amin(1)
    for scale in range(last):
        # most pixels are too wide for the finest octaves: look up only where they are not
        rows = (narrowest < _widest(scale)).nonzero()[:, 0]
        if 0 < len(rows) < 0.9 * len(spread):
            some = torch.stack([part.index_select(0, rows) for part in point])
            own = _octaves(_noise(some, scale), spread.index_select(0, rows), scale)
            value.index_add_(0, rows, own[0])
            power.index_add_(0, rows, own[1])
        elif len(rows) > 0:
            own = _octaves(_noise(point, scale), spread, scale)
            value.add_(own[0])
            power.add_(own[1])
    return value, power, coarse[3]


def _label(local: Components, size: Tensor, stripes: Tensor, footprint: Tensor, base: Tensor) -> Tensor:
    """A can's albedo (3, R, C): its own colour with a white wave around it, or with stripes, and metal at both ends."""
    half = size[1]
    x, y, z = local
    angle = torch.atan2(y, x)
    height = z / half
    blur = (footprint / half).clamp(min=1e-3)

    def inside(distance: Tensor) -> Tensor:  # 1 well inside, 0 well outside, a step as wide as the footprint
        s = (0.5 + distance / (2 * blur)).clamp(0, 1)
        return s * s * (3 - 2 * s)

    wave = 0.34 * torch.sin(angle + 0.9 * torch.sin(2 * angle))
    ribbon = torch.maximum(inside(0.13 - (height - wave).abs()), inside(0.02 - (height - wave - 0.24).abs()))
    around, up, contrast = stripes
    striped = contrast > 0
    if bool(striped.any()):
        ribbon = torch.where(striped, 0, ribbon)
        frequency = (around / (2 * math.pi * size[0])).square() + up.square()
        fade = torch.exp(-2 * (math.pi * _PIXEL_SIGMA * footprint).square() * frequency)
        base = base * (1 + contrast * fade * torch.sin(around * angle + 2 * math.pi * up * z))
    metal = inside(height.abs() - 0.9)
    white, silver = (base.new_tensor(c)[:, None, None] for c in (_WHITE, _SILVER))
    albedo = base + ribbon * (white - base)
    return albedo + metal * (silver - albedo)


def _light(normal: Components) -> Tensor:
    """What falls on surfaces with unit normals (R, C)."""
    light = torch.full_like(normal[0], _AMBIENT)
    for a, b, c, strength in _LIGHTS:
        facing = (normal[0] * a).add_(normal[1], alpha=b).add_(normal[2], alpha=c)
        light.add_(facing.clamp_(min=0), alpha=strength)
    return light


def colour(paint: Paint, geom: Tensor, point: Components, normal: Components, footprint_m: Tensor) -> Tensor:
    """Colour of surface points, without any term that depends on the viewpoint but the pixel's own blur.

    Args:
        paint: of the scene.
        geom: (R, C) which geom each point lies on, >= 0; rows are of points near each other.
        point: in the world [m], (R, C) each, float32 like all that follow.
        normal: outward, (R, C) each.
        footprint_m: (R, C) width of the pixel on the surface [m].

    Returns:
        (3, R, C) RGB in [0, 1].
    """
    library = loops(*point, *normal, footprint_m, paint.look)
    if library is not None:
        return _by_loop(library, paint, geom, point, normal, footprint_m)
    which = geom.reshape(-1)

    def told(table: Tensor) -> Tensor:  # (G,) of each point
        return table.index_select(0, which).view_as(geom)

    places = point
    if bool(paint.repeat_m.isfinite().any()):
        repeat = told(paint.repeat_m)
        x, y, z = (torch.where(repeat.isfinite(), part.remainder(repeat), part) for part in point)
        places = x, y, z
    solid = torch.stack([told(table).add_(part) for table, part in zip(paint.offset, places, strict=True)])
    log_albedo, power, tint = _log_albedo(solid, (_PIXEL_SIGMA * footprint_m).square_())
    mix = tint.mul_(3).sigmoid_().mul_(0.65)
    albedo = torch.stack([torch.lerp(told(paint.look[k]), told(paint.look[3 + k]), mix) for k in range(3)])
    rows = (told(paint.can[0]).amax(1) > 0).nonzero()[:, 0]
    if len(rows) > 0:
        own = geom.index_select(0, rows)
        size, stripes = paint.can[:, own], paint.stripes[:, own]
        local = [part.index_select(0, rows) - c[own] for part, c in zip(point, paint.centre, strict=True)]
        base, canned = albedo.index_select(1, rows), size[0] > 0
        size = torch.where(canned, size, 1)
        label = _label((local[0], local[1], local[2]), size, stripes, footprint_m.index_select(0, rows), base)
        albedo.index_copy_(1, rows, torch.where(canned, label, base))
    contrast = told(paint.look[6])
    # the mean of exp(noise) shrinks as octaves fade; put it back, or far walls would darken
    gain = log_albedo.mul_(contrast).addcmul_(contrast.square_(), power, value=-0.5).exp_()
    return albedo.mul_(gain.mul_(_light(normal))).clamp_(0, 1)


def _by_loop(
    library: Loops, paint: Paint, geom: Tensor, point: Components, normal: Components, footprint_m: Tensor
) -> Tensor:
    """`colour` by the loop of texture.c."""
    rgb = footprint_m.new_empty(3, *geom.shape)
    repeat = paint.repeat_m if bool(paint.repeat_m.isfinite().any()) else None
    tables = [part.contiguous() for part in (paint.look, paint.offset, paint.centre, paint.can, paint.stripes)]
    scales, lights = _scales(), torch.tensor(_LIGHTS)
    painted = (len(paint.repeat_m), *tables, repeat, len(scales), scales, len(lights), lights, _AMBIENT, _PIXEL_SIGMA)
    points = (*geom.shape, *(part.contiguous() for part in (geom.int(), *point, *normal, footprint_m)))
    library("paint", _volume(geom.device).flat, painted, points, rgb)
    return rgb


@lru_cache(maxsize=1)
def _scales() -> Tensor:
    """Of each scale the rotation to periods, how its coarsest octave fades, where, and its amplitudes, (3, 14)."""
    rows = []
    for scale, turn in enumerate(_turns()):
        turn = turn.T / (_VOXELS_M[scale] * _SIZE)
        rows.append((*turn.flat, _decay(scale), _widest(scale), *_AMPLITUDES[3 * scale : 3 * scale + 3]))
    return torch.tensor(rows, dtype=torch.float32)
