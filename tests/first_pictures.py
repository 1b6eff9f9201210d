"""Pictures as they were first drawn, pixel by pixel: MuJoCo's rays, double precision, the texture in NumPy.

An oracle for `torchfovea.sim.drawing`; slow.
"""

import math
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F

from torchfovea.sim.rays import cast

_SIZE = 64  # voxels a side of the noise volume
_WAVELENGTHS = (5.0, 10.0, 20.0)  # of its octaves [voxels]
_VOXELS_M = (0.0006, 0.0048, 0.0384)  # the three scales: wavelengths 3 mm to 0.77 m
_AMPLITUDES = (0.12, 0.14, 0.16, 0.17, 0.17, 0.15, 0.13, 0.12, 0.10)  # log albedo, fine to coarse
_PIXEL_SIGMA = 0.45  # of a pixel's Gaussian footprint, in pixels
_AMBIENT = 0.5
_LIGHTS = ((0.35, 0.45, 0.82, 0.42), (-0.75, -0.35, 0.56, 0.16))  # direction and strength, in the world
_WHITE = np.array([0.93, 0.91, 0.87], np.float32)
_SILVER = np.array([0.62, 0.63, 0.66], np.float32)


@lru_cache(maxsize=1)
def _volume():
    """The noise, (1, 4, S+1, S+1, S+1): three unit-variance octaves and a fourth, independent coarse one for colour."""
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
    # one voxel more on each far side closes the period for linear interpolation
    volume = np.pad(np.stack(bands), ((0, 0), (0, 1), (0, 1), (0, 1)), mode="wrap")
    # a voxel's channels side by side: one cache line instead of four
    return torch.from_numpy(volume.astype(np.float32))[None].to(memory_format=torch.channels_last_3d)


@lru_cache(maxsize=1)
def _turns():
    """A fixed rotation for each scale, (3, 3, 3)."""
    return np.linalg.qr(np.random.default_rng(7).standard_normal((3, 3, 3)))[0].astype(np.float32)


def _noise(points, scale, channels):
    """Noise at points (N, 3) [m], (C, N)."""
    place = points @ (_turns()[scale] / np.float32(_VOXELS_M[scale] * _SIZE))
    place -= np.floor(place)
    place *= 2
    place -= 1
    grid = torch.from_numpy(place)[None, None, None]
    return F.grid_sample(_volume()[:, :channels], grid, align_corners=True)[0, :, 0, 0].numpy()


def _fading(scale):
    """Amplitude of a scale's octaves, and their decay with the variance of the Gaussian footprint."""
    octaves = zip(_AMPLITUDES[3 * scale :], _WAVELENGTHS, strict=False)
    return [(a, -2 * math.pi**2 / (w * _VOXELS_M[scale]) ** 2) for a, w in octaves]


def _widest(scale):
    """The footprint's variance at which a scale's coarsest octave has all but vanished."""
    amplitude, decay = _fading(scale)[-1]
    return math.log(0.004 / amplitude) / decay


def _octaves(noise, spread, scale):
    """Sum (N,) of a scale's faded octaves, and its variance (N,)."""
    value, power = np.zeros_like(spread), np.zeros_like(spread)
    for wave, (amplitude, decay) in zip(noise, _fading(scale), strict=False):
        fade = np.exp(np.float32(decay) * spread) * np.float32(amplitude)
        value += wave * fade
        power += fade * fade
    return value, power


def _label(local, size, footprint, base):
    """A can's albedo (N, 3): its own colour with a white wave around it, metal at both ends."""
    half = size[:, 1]
    x, y, z = local.T
    angle = np.arctan2(y, x)
    height = z / half
    blur = np.maximum(footprint / half, 1e-3)

    def inside(distance):  # 1 well inside, 0 well outside, a step as wide as the footprint
        s = np.clip(0.5 + distance / (2 * blur), 0, 1)
        step = s * s * (3 - 2 * s)
        return step[:, None]

    wave = 0.34 * np.sin(angle + 0.9 * np.sin(2 * angle))
    ribbon = np.maximum(inside(0.13 - np.abs(height - wave)), inside(0.02 - np.abs(height - wave - 0.24)))
    metal = inside(np.abs(height) - 0.9)
    albedo = base + ribbon * (_WHITE - base)
    plated = albedo + metal * (_SILVER - albedo)
    return plated


def _colour(paint, geom, point_w, normal_w, footprint_m):
    look, offset, centre, can = (part.T.numpy() for part in paint[:4])
    solid = point_w + offset[geom]
    spread = (np.float32(_PIXEL_SIGMA) * footprint_m) ** 2
    look = look[geom]
    last = len(_VOXELS_M) - 1
    coarse = _noise(solid, last, 4)
    log_albedo, power = _octaves(coarse, spread, last)
    for scale in range(last):
        # most pixels are too wide for the finest octaves: look up only those that are not
        rows = np.flatnonzero(spread < _widest(scale))
        if len(rows) == 0:
            continue
        part = spread[rows]
        value, own_power = _octaves(_noise(solid[rows], scale, 3), part, scale)
        log_albedo[rows] += value
        power[rows] += own_power
    base = look[:, :3]
    mix = np.float32(0.65) / (1 + np.exp(-3 * coarse[3]))
    albedo = base + mix[:, None] * (look[:, 3:6] - base)
    rows = np.flatnonzero(can[geom, 0] > 0)
    if len(rows) > 0:
        own = geom[rows]
        albedo[rows] = _label(point_w[rows] - centre[own], can[own], footprint_m[rows], albedo[rows])
    contrast = look[:, 6]
    # the mean of exp(noise) shrinks as octaves fade; put it back, or far walls would darken
    gain = np.exp(contrast * log_albedo - contrast * contrast * power / 2)
    light = np.full_like(gain, _AMBIENT)
    for x, y, z, strength in _LIGHTS:
        facing = normal_w @ np.array([x, y, z], np.float32)
        light += np.float32(strength) * np.maximum(facing, 0)
    albedo *= (gain * light)[:, None]
    np.clip(albedo, 0, 1, out=albedo)
    return albedo


_SKY = (0.62, 0.72, 0.82)
_STEEPEST = 0.12  # cosine of the slant at which the footprint stops growing


def picture(scene, R, t, camera, size):
    """The picture (3, H, W) and what its rays hit."""
    index = torch.arange(size, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    px = torch.stack([u, v], -1)

    def unit(shift=(0.0, 0.0)):
        return F.normalize(camera.rays(px + torch.tensor(shift, dtype=torch.float64)), dim=-1).reshape(-1, 3)

    span = np.maximum(*((unit((a, b)) - unit((-a, -b))).norm(dim=-1).numpy() for a, b in ((0.5, 0), (0, 0.5))))
    direction = unit() @ R.double().T
    hits = cast(scene, t.double(), direction)
    rotation, translation = scene.world_from_ego
    distance, geom = hits.range_m.numpy(), hits.geom.numpy()
    point = (t.double().numpy() + distance[:, None] * direction.numpy()) @ rotation.T + translation
    normal = hits.normal.numpy() @ rotation.T
    slant = np.maximum(np.abs((direction.numpy() * hits.normal.numpy()).sum(-1)), _STEEPEST)
    parts = (point, normal, distance * span / slant)
    rgb = _colour(scene.paint, np.maximum(geom, 0), *(part.astype(np.float32) for part in parts))
    rgb[geom < 0] = _SKY
    return torch.from_numpy(rgb).T.reshape(3, size, size), hits
