"""What a look is worth: the belief about a task's reward that follows from the belief about a 3-D point (Sec. 6.1).

The paper's task is the nearest object: r(x) = −‖x‖ from the ego frame's origin (Eq. 36), Gaussian by first order
(Eq. 37-40). Nearness can as well be measured in inverse range, in which noise does not grow with range; and any
function r(x) can be a reward. Whether a cell *may* be looked at (eligibility) is decided elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.finite import require_finite
from torchfovea.gaussian import Gaussian, columns, quadratic3
from torchfovea.sensing.unscented import SigmaPoints, unscented_transform
from torchfovea.setting import require

__all__ = [
    "RewardBelief",
    "inverse_range_from_range",
    "nearest_to",
    "of_class",
    "range_from_inverse_range",
    "range_reward",
    "user_reward",
]


class RewardBelief(NamedTuple):
    """A Gaussian belief about each cell's reward.

    Attributes:
        mean: (..., N).
        std: standard deviation, (..., N), in the units of the mean.
    """

    mean: Tensor
    std: Tensor


def range_reward(gaussian: Gaussian) -> RewardBelief:
    """Nearness in range, r = −‖x‖, to first order: mean −‖μ‖, std √(JᵀΣJ), J = −μ/‖μ‖ (Eq. 36-40).

    Eq. 39 calls the variance σ_r; here it is its root. At μ = 0, where J is not defined, the variance is the mean over
    all directions, tr(Σ)/3.

    Args:
        gaussian: points in the ego frame [m], mean (..., 3), packed cov (..., 6).

    Returns:
        Mean and std (...) [m]. Differentiable, with finite gradients at μ = 0.
    """
    mean, cov = gaussian
    square = mean.square().sum(-1)
    defined = square > _tiny(square)
    norm = torch.sqrt(torch.where(defined, square, 1.0))
    along = quadratic3(cov, mean / norm[..., None])
    everywhere = (cov[..., 0] + cov[..., 3] + cov[..., 5]) / 3
    return RewardBelief(-torch.where(defined, norm, 0.0), _root(torch.where(defined, along, everywhere)))


def range_from_inverse_range(belief: RewardBelief, far_m: float = 1000.0) -> RewardBelief:
    """The reward r = −1/ρ from the reward ρ, to first order: mean −1/ρ, std σ_ρ/ρ².

    Args:
        belief: mean ρ and std (...) [1/m]; ρ is negative beyond infinity.
        far_m: a ρ below 1/far_m is taken as 1/far_m: mean −far_m, std σ_ρ far_m².

    Returns:
        Mean and std (...) [m]. Differentiable; the mean's gradient is 0 beyond far_m.

    Raises:
        SettingError: a far_m that is not positive.
    """
    require(far_m > 0, "far_m", far_m, "a positive range in metres")
    range_m = 1 / belief.mean.clamp_min(1 / far_m)
    return RewardBelief(-range_m, belief.std * range_m * range_m)


def inverse_range_from_range(belief: RewardBelief, near_m: float = 0.01) -> RewardBelief:
    """The reward ρ = 1/range from the reward −range, to first order: mean 1/range, std σ/range².

    Args:
        belief: mean −range and std (...) [m].
        near_m: a range below it is taken as near_m.

    Returns:
        Mean and std (...) [1/m]. Differentiable; the mean's gradient is 0 nearer than near_m.

    Raises:
        SettingError: a near_m that is not positive.
    """
    require(near_m > 0, "near_m", near_m, "a positive range in metres")
    inverse = 1 / (-belief.mean).clamp_min(near_m)
    return RewardBelief(inverse, belief.std * inverse * inverse)


def of_class(belief: RewardBelief, share: Tensor, variance: Tensor) -> RewardBelief:
    """The reward θ r of a surface whose reward is r and which is of the class that is sought with share θ.

    Args:
        belief: mean and std of r, (...).
        share: mean of θ, 0 to 1, (...).
        variance: of θ, which is independent of r, (...).

    Returns:
        Mean and std (...), exact: E[θr] = E[θ] E[r], E[(θr)²] = E[θ²] E[r²]. Differentiable.
    """
    mean = share * belief.mean
    square = (share.square() + variance) * (belief.mean.square() + belief.std.square())
    return RewardBelief(mean, _root(square - mean.square()))


def user_reward(function: Callable[[Tensor], Tensor], gaussian: Gaussian, method: str = "first_order") -> RewardBelief:
    """Moments of any reward r(x) of a Gaussian point.

    Args:
        function: maps points (..., 3) [m] to rewards (...), each from its own point; with the unscented transform it
            is called once on (7, ..., 3). It may use its own tensors that broadcast to (...).
        gaussian: mean (..., 3), packed cov (..., 6), positive semi-definite.
        method: `first_order` (mean r(μ), std √(JᵀΣJ), J by automatic differentiation) or `unscented` (sigma points at
            ±√3 standard deviations, exact in the mean for cubic rewards).

    Returns:
        Mean and std (...). Differentiable where the function is (twice, for first order).

    Raises:
        SettingError: an unknown method, or a function whose result does not have the shape (...) or is not finite
            (`torchfovea.finite.require_finite`).
    """
    require(method in ("first_order", "unscented"), "reward.method", method, "first_order or unscented")
    mean, cov = gaussian
    if method == "unscented":

        def column(points: Tensor) -> Tensor:
            return _checked(function(points), points)[..., None]

        moments = unscented_transform(column, mean, _cholesky3(cov), SigmaPoints(3, alpha=1.0, beta=0.0, kappa=0.0))
        require_finite(moments[0], "the user's reward", "a finite number for every point")
        return RewardBelief(moments[0][..., 0], _root(moments[1][..., 0]))

    def total(points: Tensor) -> tuple[Tensor, Tensor]:
        reward = _checked(function(points), points)
        return reward.sum(), reward

    jacobian, reward = torch.func.grad(total, has_aux=True)(mean)
    require_finite(reward, "the user's reward", "a finite number for every point")
    require_finite(jacobian, "the user's reward's derivative", "a finite number for every point")
    return RewardBelief(reward, _root(quadratic3(cov, jacobian)))


def nearest_to(point: Tensor) -> Callable[[Tensor], Tensor]:
    """The reward r(x) = −‖x − point‖ [m], such as the nearest to a hand; for `user_reward`.

    Args:
        point: (3,), or anything that broadcasts against points (..., 3), in their frame.

    Returns:
        The function, with gradient 0 at the point itself.
    """
    return lambda x: -_norm(x - point)


def _checked(reward: Tensor, points: Tensor) -> Tensor:
    shape, expected = tuple(reward.shape), tuple(points.shape[:-1])
    require(shape == expected, "shape of the user's reward", shape, f"{expected}, one number a point")
    return reward


def _tiny(x: Tensor) -> float:
    return math.sqrt(torch.finfo(x.dtype).tiny)


def _norm(x: Tensor) -> Tensor:
    """Length (..., C) to (...), with gradient 0 at 0."""
    return _root(x.square().sum(-1))


def _root(variance: Tensor) -> Tensor:
    """Square root, 0 with gradient 0 where the variance is 0, or negative by rounding."""
    positive = variance > _tiny(variance)
    return torch.where(positive, torch.sqrt(torch.where(positive, variance, 1.0)), 0.0)


def _cholesky3(cov: Tensor) -> Tensor:
    """Lower Cholesky factor (..., 3, 3) of packed covariances, zero where a pivot is; Σ = L Lᵀ."""
    xx, xy, xz, yy, yz, zz = cov.unbind(-1)

    def over(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b > 0, a / torch.where(b > 0, b, 1.0), 0.0)

    a = _root(xx)
    b, c = over(xy, a), over(xz, a)
    d = _root(yy - b * b)
    e = over(yz - b * c, d)
    f = _root(zz - c * c - e * e)
    zero = torch.zeros_like(a)
    lower: Tensor = columns(a, zero, zero, b, d, zero, c, e, f).unflatten(-1, (3, 3))
    return lower
