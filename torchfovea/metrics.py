"""What an episode achieved, and how honest its uncertainties were (Sec. 7.2.1, Eq. 44-55).

Rewards here are true ones: r_t = −‖x_t‖ of the first surface on the executed line of sight, never a belief. Time is the
last axis, T long, and t = 1 is the initial gaze, which counts. A quantity "per saccade" is the mean of its series over
T (Eq. 49, 51, 53, 55). The judgement of uncertainty works on z = error/σ with one degree of freedom, or on error and
variance. The scene is the unit of statistics: average over seeds within a scene first, then compare paired over scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "Interval",
    "ause",
    "bootstrap_interval",
    "coverage",
    "degrees_travelled",
    "found",
    "gap",
    "gap_per_saccade",
    "gaussian_nll",
    "global_information",
    "holm",
    "information",
    "local_information",
    "near_target",
    "nees",
    "nees_mean",
    "outlier_share",
    "regret",
    "regret_per_saccade",
    "saccades_to_target",
    "sign_flip_p_value",
]


# --- of the search ---------------------------------------------------------------------------------------------------


def gap(rewards: Tensor, best: Tensor) -> Tensor:
    """Gap reduction g_t = (max_{k≤t} r_k − r_1)/(r* − r_1) (Eq. 46, 48; Huang et al. 2006).

    Args:
        rewards: r_t (..., T).
        best: r* (...), of the whole scene (Eq. 47).

    Returns:
        (..., T), clamped to [0, 1] (a ray may pass the best by a rounding), never falling; 1 where the first fixation
        is already the best.
    """
    first = rewards[..., :1]
    room = best[..., None] - first
    gained = rewards.cummax(-1).values - first
    return torch.where(room > 0, (gained / torch.where(room > 0, room, 1.0)).clamp(0, 1), 1.0)


def gap_per_saccade(rewards: Tensor, best: Tensor) -> Tensor:
    """Mean of `gap` over time (Eq. 49): rewards (..., T), best (...), to (...)."""
    return gap(rewards, best).mean(-1)


def regret(rewards: Tensor, best: Tensor) -> Tensor:
    """R_t = r* − mean_{k≤t} r_k (Eq. 50 as printed, a running mean): rewards (..., T), best (...), to (..., T)."""
    steps = torch.arange(1, rewards.shape[-1] + 1, dtype=rewards.dtype, device=rewards.device)
    return best[..., None] - rewards.cumsum(-1) / steps


def regret_per_saccade(rewards: Tensor, best: Tensor) -> Tensor:
    """Mean of `regret` over time (Eq. 51): rewards (..., T), best (...), to (...)."""
    return regret(rewards, best).mean(-1)


def found(hit: Tensor) -> Tensor:
    """Whether a fixation landed on the target itself: bool (..., T) to bool (...)."""
    return hit.any(-1)


def saccades_to_target(hit: Tensor) -> Tensor:
    """Moves after t = 1 until the first hit.

    Args:
        hit: whether the fixation at t is on the target, bool (..., T).

    Returns:
        (...) int64: 0 where the initial gaze hits, T where none does.
    """
    first = hit.to(torch.uint8).argmax(-1)
    return torch.where(hit.any(-1), first, hit.shape[-1])


def degrees_travelled(directions: Tensor) -> Tensor:
    """Sum of the angles between successive lines of sight [degrees]: (..., T, 3), any positive length, to (...)."""
    now, then = directions[..., :-1, :], directions[..., 1:, :]
    sine = torch.linalg.vector_norm(torch.linalg.cross(now, then), dim=-1)
    return torch.rad2deg(torch.atan2(sine, (now * then).sum(-1))).sum(-1)


# --- of the map ------------------------------------------------------------------------------------------------------


def information(cov: Tensor) -> Tensor:
    """I(Σ) = −log|Σ| (Eq. 44), with Σ in m² [nats].

    In float64 inside, through the pivots of Σ: a thin covariance has a determinant below what float32 can resolve. A
    pivot is taken as at least the rounding error of its diagonal entry, so that a covariance which is singular in its
    own dtype has finite information.

    Args:
        cov: packed covariances (xx, xy, xz, yy, yz, zz), (..., 6).

    Returns:
        (...), in the dtype of `cov`. Differentiable.

    Raises:
        SettingError: a diagonal entry that is not positive and finite.
    """
    xx, xy, xz, yy, yz, zz = cov.to(torch.float64).unbind(-1)
    for name, entry in (("xx", xx), ("yy", yy), ("zz", zz)):
        good = (entry > 0) & torch.isfinite(entry)
        if not bool(good.all()):
            bad = entry[~good].flatten()[0].item()
            require(False, f"covariance {name}", bad, "a positive, finite variance")
    rounding = torch.finfo(cov.dtype).eps
    second = torch.maximum(yy - xy * xy / xx, rounding * yy)
    lower = yz - xy * xz / xx
    third = torch.maximum(zz - xz * xz / xx - lower * lower / second, rounding * zz)
    return -(torch.log(xx) + torch.log(second) + torch.log(third)).to(cov.dtype)


def global_information(cov: Tensor) -> Tensor:
    """GI: mean information over all cells (Eq. 52), packed covariances (..., N, 6) to (...)."""
    return information(cov).mean(-1)


def near_target(points: Tensor, target: Tensor, radius_m: float = 0.1) -> Tensor:
    """The cells of LI (Eq. 54): true points (..., N, 3) closer than radius_m to the target (..., 3), bool (..., N).

    A NaN point (a cell whose ray meets nothing) is not near.
    """
    return torch.linalg.vector_norm(points - target[..., None, :], dim=-1) < radius_m


def local_information(cov: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """LI: mean information over the cells near the target (Eq. 54).

    Args:
        cov: packed covariances (..., N, 6).
        near: bool (..., N), from `near_target`, fixed for the episode.

    Returns:
        The mean (...), 0 where there are no cells, and whether there are, bool (...).
    """
    count = near.sum(-1)
    total = torch.where(near, information(cov), 0.0).sum(-1)
    return total / count.clamp_min(1), (count > 0).expand(total.shape)


# --- of honesty ------------------------------------------------------------------------------------------------------


def nees(error: Tensor, variance: Tensor) -> Tensor:
    """Normalized estimation error squared of one degree of freedom, error²/variance = z²; ideally 1 on average."""
    return error.square() / variance


def nees_mean(z: Tensor, limit: float = 5.0, valid: Tensor | None = None) -> Tensor:
    """Mean z² over |z| ≤ limit, to be read beside `outlier_share`; ideally 1.

    Args:
        z: error/σ, any shape.
        limit: beyond it, an error is an outlier.
        valid: bool like z; None takes all.

    Returns:
        A scalar.

    Raises:
        SettingError: nothing valid within the limit.
    """
    z = _flat(z, valid)
    inside = z[z.abs() <= limit]
    require(inside.numel() > 0, "errors within the limit", 0, "at least one")
    return inside.square().mean()


def outlier_share(z: Tensor, limit: float = 5.0, valid: Tensor | None = None) -> Tensor:
    """Share of |z| > limit (a NaN counts): z of any shape, bool `valid` like it, to a scalar.

    Raises:
        SettingError: nothing valid.
    """
    return (~(_flat(z, valid).abs() <= limit)).double().mean()


def coverage(z: Tensor, levels: Sequence[float] = (0.5, 0.9, 0.95, 0.99), valid: Tensor | None = None) -> Tensor:
    """Share of errors inside the central Gaussian interval of each level; ideally the level itself.

    Args:
        z: error/σ, any shape; NaN is outside.
        levels: each in (0, 1).
        valid: bool like z; None takes all.

    Returns:
        (len(levels),) float64.

    Raises:
        SettingError: a level out of range, or nothing valid.
    """
    for level in levels:
        require(0 < level < 1, "level", level, "a probability between 0 and 1")
    size = _flat(z, valid).abs()
    half = torch.special.ndtri((1 + torch.tensor(levels, dtype=torch.float64, device=z.device)) / 2)
    return (size[:, None] <= half).double().mean(0)


def gaussian_nll(error: Tensor, variance: Tensor) -> Tensor:
    """Negative log likelihood ½(error²/variance + log 2π variance) [nats], elementwise. Differentiable."""
    return 0.5 * (error.square() / variance + torch.log(2 * math.pi * variance))


def ause(error: Tensor, uncertainty: Tensor, valid: Tensor | None = None) -> Tensor:
    """Area under the sparsification error (Ilg et al. 2018): whether uncertainty ranks the errors.

    The mean |error| of what is left when the most uncertain share f is removed, less the same when the worst errors are
    removed, integrated over f in [0, 1) at every single removal and divided by the mean |error|. 0 is a perfect
    ranking; only the order of `uncertainty` matters.

    Args:
        error: any shape.
        uncertainty: σ or any increasing function of it, like error.
        valid: bool like error; None takes all.

    Returns:
        A scalar, 0 where all errors are 0.

    Raises:
        SettingError: nothing valid.
    """
    size = _flat(error, valid).abs().double()
    ranked = size[_flat(uncertainty, valid).argsort(stable=True)]
    left = torch.arange(1, size.numel() + 1, dtype=torch.float64, device=size.device)
    mean = size.mean()
    curve = (ranked.cumsum(0) - size.sort().values.cumsum(0)) / left
    return torch.where(mean > 0, curve.mean() / torch.where(mean > 0, mean, 1.0), 0.0)


def _flat(x: Tensor, valid: Tensor | None) -> Tensor:
    x = x.flatten() if valid is None else x[valid]
    require(x.numel() > 0, "valid values", 0, "at least one")
    return x


# --- of significance -------------------------------------------------------------------------------------------------


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
