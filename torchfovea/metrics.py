"""What an episode achieved, and how honest its uncertainties were (Sec. 7.2.1, Eq. 44-55).

Rewards here are true ones: r_t = −‖x_t‖ of the first surface on the executed line of sight, never a belief. Time is the
last axis, T long, and t = 1 is the initial gaze, which counts. A quantity "per saccade" is the mean of its series over
T (Eq. 49, 51, 53, 55). The judgement of uncertainty works on z = error/σ with one degree of freedom, or on error and
variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "ause",
    "coverage",
    "degrees_travelled",
    "found",
    "gap",
    "gap_per_saccade",
    "gaussian_nll",
    "global_information",
    "information",
    "local_information",
    "near_target",
    "nees",
    "nees_mean",
    "outlier_share",
    "phantom",
    "regret",
    "regret_per_saccade",
    "saccades_to_target",
    "weighted_mean",
    "weighted_median",
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

    Raises:
        SettingError: without a fixation.
    """
    require(rewards.shape[-1] > 0, "rewards", tuple(rewards.shape), "at least one fixation, (..., T)")
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


def phantom(aimed_m: Tensor, range_m: Tensor, nearer: float = 0.4) -> Tensor:
    """Whether a saccade aimed at nothing: at a point clearly nearer than the first surface on its line of sight.

    Args:
        aimed_m: range of the point that both eyes turned to (...); inf: none.
        range_m: range of the surface (...); inf: none.
        nearer: by how much in inverse range [1/m].

    Returns:
        bool (...).
    """
    return 1 / aimed_m - 1 / range_m > nearer


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
    distance: Tensor = torch.linalg.vector_norm(points - target[..., None, :], dim=-1)
    return distance < radius_m


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
    half: Tensor = torch.special.ndtri((1 + torch.tensor(levels, dtype=torch.float64, device=z.device)) / 2)
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


def weighted_mean(values: Tensor, weight: Tensor) -> float:
    """Of values (N,) of any type, by weights (N,); those without weight may be NaN. NaN for no weight at all."""
    there = weight > 0
    return float((values[there].double() * weight[there]).sum() / weight.sum())


def weighted_median(values: Tensor, weight: Tensor) -> float:
    """The lower of two, of values (N,) by weights (N,), some of which are positive; the others' may be NaN."""
    values, weight = values[weight > 0], weight[weight > 0]
    order = values.argsort()
    total = weight[order].cumsum(0)
    return float(values[order][int((total < total[-1] / 2).sum())])


def _flat(x: Tensor, valid: Tensor | None) -> Tensor:
    x = x.flatten() if valid is None else x[valid]
    require(x.numel() > 0, "valid values", 0, "at least one")
    return x
