"""The last part of a pixel: how far surfaces that a matcher found have to move for the two images to agree best.

In a neighbourhood let l be what the left eye sees, r the right eye at the surface's places, both about their means, l'
and r' their derivatives for an offset δ of inverse depth, γ = √(⟨l, l⟩/⟨r, r⟩) the exposure's gain, and e = l − γ r.
One Gauss-Newton step with the gradients of both eyes, q = l' + γ r', and only the gradient energy that both share
beneath it is

    δ = ⟨q, e⟩/(2 ⟨l', γ r'⟩),    var δ = ⟨e', e'⟩ ⟨q, q⟩/(4 n ⟨l', γ r'⟩²)

with e' = e − δ q/2 and n independent samples: noise gives gradients too, but the two eyes' noise has nothing in common,
so that it neither pulls δ towards zero nor passes for texture. Without noise the variance is Cramér and Rao's bound for
the difference of the images. δ is symmetric in the eyes, and does not depend on exposure.

A neighbourhood's offset is believed beside its surroundings': that of windows three times as wide, known to their own
variance and to how far one surface's offsets differ. Where the surroundings have no texture either, nothing is known
but that the matcher was right to about a width.

References: S. Benhimane, E. Malis, "Real-time image-based tracking of planes using efficient second-order
minimization", IROS 2004 (both gradients). L. Matthies, T. Kanade, R. Szeliski, "Kalman filter-based algorithms for
estimating depth from image sequences", IJCV 3, 1989 (the variance).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.machine import loops
from torchfovea.stereo.costs import Eye, project, read_other, read_own, sheet_rays
from torchfovea.stereo.sheets import Sheet, average

__all__ = ["Neighbourhood", "Offset", "smoothed", "steps_per_width", "subpixel"]

WIDE = 3  # surroundings are nine neighbourhoods, so many cells apart
STEP = 0.5  # of the derivatives, in units


class Neighbourhood(NamedTuple):
    """What the cells about a place are believed to be.

    Attributes:
        radius: half their square's side, in cells.
        noise: standard deviation of each image's noise, at least.
        smooth: standard deviation of one surface's offsets about their surroundings', in units.
    """

    radius: int = 2
    noise: float = 0.004  # a grey level of 255
    smooth: float = 0.2


class Offset(NamedTuple):
    """What a refinement says; (B, R, S) each.

    Attributes:
        value: δ in units.
        variance: of it, units².
        correlation: of the neighbourhoods there, up to 1; what cannot be trusted correlates with nothing.
        misfit: mean square difference of the images over the 3 × 3 cells about each, whatever their exposures.
        rest: mean square difference that the step leaves in the neighbourhood.
    """

    value: Tensor
    variance: Tensor
    correlation: Tensor
    misfit: Tensor
    rest: Tensor


def subpixel(eye: Eye, sheet: Sheet, surface: Tensor, unit: Tensor, trusted: Tensor, about: Neighbourhood) -> Offset:
    """Refine surfaces on a sheet by both eyes' images.

    Args:
        eye: whose sheet it is.
        sheet: R × S cells.
        surface: (B, R, S), inverse depths to within about a unit [1/m].
        unit: (B, R, S), the inverse depth that moves the match by an RF's width [1/m].
        trusted: bool (B, R, S), which of them a neighbourhood may count on.
        about: each cell's neighbourhood.

    Differentiable in the images.
    """
    closed, (radius, noise, smooth) = sheet.closed, about
    ray = sheet_rays(eye, sheet.px)
    places = torch.stack([surface - STEP * unit, surface, surface + STEP * unit], 1)
    other, own = read_other(eye, sheet, ray, places), read_own(eye, sheet, ray, STEP * unit)
    library = loops(other, own)
    if library is not None:
        told = other.new_empty(5, *surface.shape)
        seen = (*surface.shape, closed, other.contiguous(), own.contiguous(), trusted.contiguous())
        samples = (_samples(radius, 1), _samples(radius, WIDE))
        library("refine", (*seen, radius, WIDE, STEP, noise, smooth, *samples), told)
        return Offset(*told.unbind(0))
    before, right, after = other.unbind(1)
    back, left, ahead = own.unbind(1)
    rx, lx = (after - before) / (2 * STEP), (ahead - back) / (2 * STEP)

    signals = torch.stack([left, right, lx, rx], 1)
    pairs = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3), (2, 2), (3, 3))
    products = torch.stack([signals[:, i] * signals[:, j] for i, j in pairs], 1)
    weight = trusted.to(left)[:, None]
    moments = average(torch.cat([signals * weight, products * weight, weight], 1), radius, closed)
    weight = moments[:, 14:]
    moments = moments[:, :14] / weight.clamp(min=1e-3)
    mean = moments[:, :4]
    ll, rr, lr, lx_l, lx_r, rx_l, rx_r, xy, xx, yy = (
        moments[:, 4 + k] - mean[:, i] * mean[:, j] for k, (i, j) in enumerate(pairs)
    )
    floor = noise * noise
    ll, rr = ll.clamp(min=0) + floor, rr.clamp(min=0) + floor
    gain = (ll / rr).sqrt()
    pull = lx_l - gain * (lx_r - rx_l) - gain * gain * rx_r  # ⟨q, e⟩
    shared = gain * xy
    energy = (xx + gain * (2 * xy + gain * yy)).clamp(min=0)  # ⟨q, q⟩
    error = 2 * (ll - gain * lr).clamp(min=floor)  # ⟨e, e⟩

    sums = torch.stack([pull, shared, energy, error], 1)
    near, near_weight = _solve(sums, _samples(radius, 1) * weight[:, 0], 2 * floor)
    wide = _spaced(torch.cat([sums * weight, weight], 1), closed)
    far, far_weight = _solve(wide[:, :4] / wide[:, 4:].clamp(min=1e-3), _samples(radius, WIDE) * wide[:, 4], 2 * floor)
    # the matcher's word is good to a width; then the surroundings'; then the neighbourhood's own
    expected, doubt = far * far_weight / (1 + far_weight), 1 / (1 + far_weight) + smooth * smooth
    precision = near_weight + 1 / doubt
    value = (near * near_weight + expected / doubt) / precision
    rest = (error - value * pull + value.square() * energy / 4).clamp(min=0)
    correlation = weight[:, 0] * (1 - rest / (2 * ll))
    differs = left - mean[:, 0] - gain * (right - mean[:, 1])
    return Offset(value, 1 / precision, correlation, average(differs.detach().square(), 1, closed), rest.detach())


@torch.no_grad()
def steps_per_width(eye: Eye, sheet: Sheet, ray: Tensor, surface: Tensor, step: Tensor) -> Tensor:
    """How many steps of inverse depth move the match by an RF's width, at most 10, (B, R, S).

    The wider of the two RFs that see the point counts.
    """
    u, v, _ = project(eye, ray, torch.stack([surface, surface + step], 1))
    width = torch.maximum(eye.retina.width_px(columns(u[:, 0], v[:, 0])), sheet.width_px)
    motion = torch.hypot(u[:, 1] - u[:, 0], v[:, 1] - v[:, 0])
    return (width / motion.clamp(min=1e-6)).clamp(max=10)


def smoothed(surface: Tensor, edge: Tensor, trusted: Tensor | None = None) -> Tensor:
    """Surfaces (B, R, S) averaged with those of their eight neighbours, trusted ones, that are within `edge`."""
    total, weight = surface.clone(), torch.ones_like(surface)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            if i or j:
                other = surface.roll((i, j), (-2, -1))
                near = (other - surface).abs() <= edge
                near = (near if trusted is None else near & trusted.roll((i, j), (-2, -1))).to(other.dtype)
                total, weight = total + near * other, weight + near
    return total / weight


def _solve(sums: Tensor, samples: Tensor, floor: float) -> tuple[Tensor, Tensor]:
    """δ and the inverse of its variance from ⟨q, e⟩, ⟨l', γr'⟩, ⟨q, q⟩ and ⟨e, e⟩, (B, 4, R, S).

    Gradients that agree no better than those of noise would by chance tell nothing. What is left of e after the step is
    noise, of a variance of at least `floor`.
    """
    pull, shared, energy, error = sums.unbind(1)
    chance = (energy / 2 - shared).square() / samples.clamp(min=1e-3)
    clear = (shared.clamp(min=0).square() - chance).clamp(min=0)
    told = clear > 0
    value = torch.where(told, pull / (2 * torch.where(told, shared, torch.ones_like(shared))), torch.zeros_like(pull))
    rest = torch.maximum(error - value * pull + value.square() * energy / 4, floor * torch.ones_like(error))
    return value, 4 * samples * clear / (rest * energy.clamp(min=1e-3 * floor))


def _spaced(values: Tensor, closed: bool) -> Tensor:
    """Means over 3 × 3 cells that are `WIDE` cells apart."""
    for dim, around in ((-2, False), (-1, closed)):
        size = values.shape[dim]
        if around:
            first, last = values.narrow(dim, 0, WIDE), values.narrow(dim, size - WIDE, WIDE)
            wide = torch.cat([last, values, first], dim)
        else:
            first, last = values.narrow(dim, 0, 1), values.narrow(dim, size - 1, 1)
            wide = torch.cat([*(first,) * WIDE, values, *(last,) * WIDE], dim)
        values = (values + wide.narrow(dim, 0, size) + wide.narrow(dim, 2 * WIDE, size)) / 3
    return values


@lru_cache
def _samples(radius: int, spacing: int) -> float:
    """Independent samples of a neighbourhood, (Σw)²/Σw² of its weights; RFs overlap, so that about half of them are."""
    row = np.ones(1)
    for _ in range(radius):
        row = np.convolve(row, np.ones(3))
    if spacing > 1:
        apart = np.zeros(2 * spacing + 1)
        apart[::spacing] = 1
        row = np.convolve(row, apart)
    return float(row.sum() ** 2 / (row**2).sum()) ** 2 / 2
