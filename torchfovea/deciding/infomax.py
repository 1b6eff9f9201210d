"""One-step infomax: the expected information of a look at each candidate, and what a saccade to it costs.

M is the number of cells remembered, N that of candidate fixations; leading axes `...` are episodes.

References:
    Najemnik and Geisler (2005), Optimal eye movement strategies in visual search.
    Butko and Movellan (2010), Infomax control of eye movements.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "information_gain",
    "minus_cost",
    "per_cost",
    "precision_by_eccentricity",
    "saccade_degrees",
    "saccade_seconds",
]

_BLOCK = 1 << 22  # elements of one block of candidates x cells


def information_gain(variance: Tensor, precision: Tensor, eligible: Tensor | None = None) -> Tensor:
    """Expected reduction of the memory's total entropy by one look at each candidate [nats].

    Σⱼ ½ log(1 + vⱼ pᵢⱼ), vⱼ the variance that cell j has now, pᵢⱼ the precision (1/variance) of what a fixation of
    candidate i would observe of it, 0 where it would not see it. Assumes that cells are independent and Gaussian, and
    that the precision does not depend on the value found; the gain then is exact and needs no expectation. Occlusion
    is not foreseen. Evaluated in blocks of candidates: 2,000 x 2,000 takes tens of milliseconds on a CPU.

    Args:
        variance: of the quantity kept for each cell, finite, (..., M).
        precision: (..., N, M), or (N, M) for all rows.
        eligible: the cells whose entropy counts, (..., M); None counts all.

    Returns:
        (..., N), at least 0. Differentiable.
    """
    if eligible is not None:
        variance = torch.where(eligible, variance, 0.0)
    count = precision.shape[-2]
    step = max(1, _BLOCK // max(1, variance.numel()))
    blocks = (precision[..., start : start + step, :] for start in range(0, count, step))
    return torch.cat([0.5 * torch.log1p(variance[..., None, :] * block).sum(-1) for block in blocks], -1)


def precision_by_eccentricity(
    directions: Tensor, cells: Tensor, law: Callable[[Tensor], Tensor], half_view_rad: float = math.pi
) -> Tensor:
    """Predicted precision of every cell under every candidate fixation, from the angle between them alone.

    The sensor's noise in inverse range depends on eccentricity and hardly on range, so that this fits a memory kept in
    inverse range; for one kept in range, σ grows as range²: divide `variance` by range⁴ before asking for the gain. The
    angle is taken at the ego centre, and each fixation is taken to converge on its candidate.

    Args:
        directions: the candidates' unit vectors, (..., N, 3).
        cells: the cells' unit vectors, (..., M, 3).
        law: standard deviation as a function of the eccentricity [rad], finite and positive.
        half_view_rad: eccentricity beyond which nothing is seen.

    Returns:
        (..., N, M), 0 out of view.
    """
    chord = torch.cdist(directions, cells, compute_mode="donot_use_mm_for_euclid_dist")
    angle = 2 * torch.asin((chord / 2).clamp(max=1 - torch.finfo(chord.dtype).eps))
    seen = angle <= half_view_rad
    sigma = law(torch.where(seen, angle, 0.0))
    return torch.where(seen, 1 / (sigma * sigma), 0.0)


def saccade_degrees(direction: Tensor, directions: Tensor) -> Tensor:
    """Angle between the present line of sight and every candidate [degrees].

    Args:
        direction: (..., 3), any positive length.
        directions: (..., N, 3) or (N, 3), any positive length.

    Returns:
        (..., N). Differentiable, with gradient 0 at an angle of exactly 0 or 180.
    """
    now, directions = torch.broadcast_tensors(direction[..., None, :], directions)
    cross2 = torch.linalg.cross(now, directions).square().sum(-1)
    turned = cross2 > 0
    sine = torch.where(turned, torch.sqrt(torch.where(turned, cross2, 1.0)), 0.0)
    return torch.rad2deg(torch.atan2(sine, (now * directions).sum(-1)))


def saccade_seconds(degrees: Tensor, seconds_per_degree: float = 0.0022, onset_s: float = 0.021) -> Tensor:
    """Duration [s] by the human main sequence, 21 ms and 2.2 ms a degree (Carpenter 1988); 0 if the gaze stays."""
    return torch.where(degrees > 0, onset_s + seconds_per_degree * degrees, 0.0)


def per_cost(score: Tensor, cost: Tensor, overhead: float = 1.0) -> Tensor:
    """Score per unit of cost: score / (overhead + cost).

    For positive scores such as PI, EI or an information gain; a negative score would prefer the dearer candidate. From
    a logarithmic score subtract log(overhead + cost) instead.

    Args:
        score: (..., N), at least 0.
        cost: of going there, at least 0, (..., N).
        overhead: what every look costs, > 0, in the units of `cost`; without it, staying would be free.

    Returns:
        (..., N). Differentiable.

    Raises:
        SettingError: an overhead that is not positive.
    """
    require(overhead > 0, "overhead", overhead, "a positive number, in the units of the cost")
    return score / (overhead + cost)


def minus_cost(score: Tensor, cost: Tensor, weight: float | Tensor) -> Tensor:
    """Score less weighted cost, for scores of any sign; `weight` is score per unit of cost, a number or (...)."""
    if isinstance(weight, Tensor):
        weight = weight.to(score)[..., None]
    return score - weight * cost
