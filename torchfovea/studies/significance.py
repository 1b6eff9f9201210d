"""How sure a comparison is: bootstrap intervals, paired tests and Holm's correction.

The scene is the unit of statistics: average over seeds within a scene first, then compare paired over scenes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "Interval",
    "bootstrap_interval",
    "holm",
    "sign_flip_p_value",
    "studentized_p_value",
]


class Interval(NamedTuple):
    """A mean over scenes with its confidence interval, each (...)."""

    estimate: Tensor
    low: Tensor
    high: Tensor


def bootstrap_interval(
    values: Tensor, generator: torch.Generator, level: float = 0.95, resamples: int = 9999
) -> Interval:
    """Mean over scenes with its bootstrap interval, bias-corrected and accelerated (Efron 1987, BCa).

    For a paired comparison give the differences scene by scene. All columns are resampled alike, so that curves over
    time or settings stay paired. With fewer than about ten scenes any bootstrap interval is somewhat too short.

    Args:
        values: one for each scene, finite, (S, ...); S ≥ 2.
        generator: its device need not be that of `values`.
        level: of confidence, in (0, 1).
        resamples: how many, ≥ 100.

    Returns:
        Estimate, low and high, (...) float64; of no width where all scenes agree.

    Raises:
        SettingError: fewer than 2 scenes, values that are not finite, or a setting out of its range.
    """
    require(values.dim() > 0 and values.shape[0] >= 2, "scenes", tuple(values.shape), "at least 2 along the first axis")
    require(bool(torch.isfinite(values).all()), "values", "NaN or infinite", "finite ones; drop undefined scenes")
    require(0 < level < 1, "level", level, "a probability between 0 and 1")
    require(resamples >= 100, "resamples", resamples, "at least 100")
    scenes = values.shape[0]
    x = values.detach().double().reshape(scenes, -1)
    drawn = torch.randint(scenes, (resamples, scenes), generator=generator, device=generator.device)
    counts = torch.zeros(resamples, scenes, dtype=x.dtype, device=drawn.device)
    counts.scatter_add_(1, drawn, torch.ones_like(drawn, dtype=x.dtype))
    means = (counts.to(x.device) @ x / scenes).sort(0).values
    estimate = x.mean(0)
    centred = x - estimate
    square = centred.square().sum(0)
    # agreement to rounding: there is nothing to resample
    spread = square > scenes * (torch.finfo(values.dtype).eps * x.abs().amax(0)) ** 2
    skew = centred.pow(3).sum(0) / (6 * torch.where(spread, square, 1.0).pow(1.5))
    below = ((means < estimate).double().mean(0) + (means <= estimate).double().mean(0)) / 2
    bias = torch.special.ndtri(below.clamp(0.5 / resamples, 1 - 0.5 / resamples))
    ends = []
    for tail in ((1 - level) / 2, (1 + level) / 2):
        z = bias + torch.special.ndtri(torch.tensor(tail, dtype=x.dtype, device=x.device))
        place = torch.special.ndtr(bias + z / (1 - skew * z)) * (resamples - 1)
        floor = place.floor().long().clamp(0, resamples - 2)
        lower, upper = (means.gather(0, (floor + i)[None])[0] for i in (0, 1))
        end = lower + (place - floor) * (upper - lower)
        ends.append(torch.where(spread, end, estimate).reshape(values.shape[1:]))
    return Interval(estimate.reshape(values.shape[1:]), ends[0], ends[1])


def sign_flip_p_value(differences: Tensor, generator: torch.Generator, flips: int = 9999) -> Tensor:
    """Two-sided p-value of a paired comparison: the mean difference against random signs of the scenes' differences.

    Exact, over all 2^S signs, where these are no more than `flips`; else Monte Carlo, (1 + as extreme)/(1 + flips).

    Args:
        differences: one for each scene, finite, (S, ...).
        generator: its device need not be that of `differences`.
        flips: how many, ≥ 100.

    Returns:
        (...) float64 in (0, 1].

    Raises:
        SettingError: no scene, differences that are not finite, or too few flips.
    """
    require(differences.dim() > 0 and differences.shape[0] >= 1, "scenes", tuple(differences.shape), "at least 1")
    require(bool(torch.isfinite(differences).all()), "differences", "NaN or infinite", "finite ones")
    require(flips >= 100, "flips", flips, "at least 100")
    scenes = differences.shape[0]
    x = differences.detach().double().reshape(scenes, -1)
    exact = scenes < 63 and 2**scenes <= flips
    if exact:
        bits = torch.arange(2**scenes)[:, None] >> torch.arange(scenes) & 1
    else:
        bits = torch.randint(2, (flips, scenes), generator=generator, device=generator.device)
    sums = ((2 * bits - 1).to(x) @ x).abs()
    # the same sum in another order differs by rounding and is still as extreme
    extreme = (sums >= x.sum(0).abs() - 1e-12 * x.abs().sum(0)).double()
    p = extreme.mean(0) if exact else (1 + extreme.sum(0)) / (1 + flips)
    return p.reshape(differences.shape[1:])


def studentized_p_value(differences: Tensor, generator: torch.Generator, resamples: int = 9999) -> Tensor:
    """Two-sided p-value of a paired comparison by the bootstrap of Student's t (Hall and Wilson 1991).

    Twice the smaller share of resamples whose t = (mean* − mean)/standard error* lies beyond mean/standard error. It
    minds that skewed differences move mean and standard error together, where a sign flip rejects too often.

    Args:
        differences: one for each scene, finite, (S,); S ≥ 2.
        generator: random state on the CPU.
        resamples: how many, ≥ 100.

    Returns:
        A scalar, float64 in (0, 1]; 1 where all are 0.

    Raises:
        SettingError: fewer than 2 scenes, differences that are not finite, or too few resamples.
    """
    require(differences.dim() == 1 and len(differences) >= 2, "scenes", tuple(differences.shape), "at least 2, (S,)")
    require(bool(torch.isfinite(differences).all()), "differences", "NaN or infinite", "finite ones")
    require(resamples >= 100, "resamples", resamples, "at least 100")
    x = differences.detach().double().cpu()
    scenes, mean = len(x), x.mean()
    drawn = x[torch.randint(scenes, (resamples, scenes), generator=generator)]
    # samples that agree to rounding have no standard error: as extreme as can be, unless they lie on the mean
    least = 1e-9 * x.abs().max()
    error = x.std().clamp(min=least)
    away, errors = drawn.mean(1) - mean, drawn.std(1).clamp(min=least)
    tie = 1e-9 * mean.abs() * errors
    tails = ((away * error <= mean * errors + tie).sum(), (away * error >= mean * errors - tie).sum())
    return (2.0 * (1 + torch.stack(tails).min()) / (1 + resamples)).double().clamp(max=1)


def holm(p_values: Tensor) -> Tensor:
    """Holm's step-down correction over a family of hypotheses (Holm 1979).

    Args:
        p_values: (K,), each in [0, 1].

    Returns:
        Adjusted p-values (K,) in the same order: reject where at most the level, which bounds the
        family-wise error.

    Raises:
        SettingError: not one axis, or a value outside [0, 1].
    """
    require(p_values.dim() == 1, "shape of p_values", tuple(p_values.shape), "one axis")
    require(bool(((p_values >= 0) & (p_values <= 1)).all()), "p_values", p_values.tolist(), "each between 0 and 1")
    if p_values.numel() == 0:
        return p_values
    ordered, order = p_values.sort()
    factors = torch.arange(len(ordered), 0, -1, dtype=ordered.dtype, device=ordered.device)
    adjusted = (factors * ordered).cummax(0).values.clamp(max=1)
    return torch.empty_like(adjusted).scatter(0, order, adjusted)
