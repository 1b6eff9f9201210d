"""Deciding where to look: pure functions from a reward belief to a score for every cell, and one choice among scores.

Everything is batched over leading axes `...` (episodes); N is the number of cells, always the last axis. Scores are to
be maximised, and only their order matters, except where a docstring says otherwise. `incumbent` is the best reward so
far, (...) or a number. Where randomness enters, `generator` is one `torch.Generator` for the whole batch, or a sequence
with one for each batch row; then a batch of episodes makes the same choices as the episodes one by one.

References:
    Auer et al. (2002), Finite-time analysis of the multiarmed bandit problem. Cox and John (1992), SDO.
    Kushner (1964); Mockus (1974); Jones et al. (1998), Efficient global optimization.
    Ament et al. (2023), Unexpected improvements to expected improvement: the need of log EI.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "Generators",
    "choose",
    "draw",
    "expected_improvement",
    "known_well_enough",
    "log_expected_improvement",
    "log_probability_of_improvement",
    "probability_of_improvement",
    "thompson",
    "upper_confidence_bound",
]

Generators = torch.Generator | Sequence[torch.Generator]

_TAIL = -4.0  # below it, formulas with Φ cancel and the continued fraction takes over
_TERMS = 20  # of the continued fraction: 1e-12 at the switch, better beyond
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def upper_confidence_bound(mean: Tensor, std: Tensor, alpha: float | Tensor) -> Tensor:
    """μ + α σ (Eq. 41); with α = inf, σ alone.

    Args:
        mean: mean of the reward, (..., N).
        std: its standard deviation, (..., N).
        alpha: weight of exploration ≥ 0, a number or one for each row, (...).

    Returns:
        (..., N). Differentiable in all three; the gradient with respect to an infinite alpha is 0.

    Raises:
        SettingError: a number alpha that is negative or NaN, and shapes that do not belong together.
    """
    _of_one_shape(mean, std, alpha, "acquisition.alpha")
    if not isinstance(alpha, Tensor):
        require(alpha >= 0, "acquisition.alpha", alpha, "a number of at least 0, or inf")
        return torch.broadcast_tensors(std, mean)[0] if math.isinf(alpha) else mean + alpha * std
    alpha = alpha.to(mean)[..., None]
    infinite = torch.isinf(alpha)
    return torch.where(infinite, std, mean + torch.where(infinite, torch.zeros_like(alpha), alpha) * std)


def probability_of_improvement(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> Tensor:
    """P(r > incumbent) = Φ(z), z = (μ − incumbent)/σ (Eq. 42). It rounds to 0 far below; see the log form.

    Args:
        mean: (..., N).
        std: (..., N), 0 allowed.
        incumbent: the best reward so far, (...) or a number.

    Returns:
        (..., N) in [0, 1]. Differentiable; gradients are finite at σ = 0.
    """
    return _normal_cdf(_standardised(mean, std, incumbent)[0])


def log_probability_of_improvement(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> Tensor:
    """Logarithm of Φ(z) (Eq. 42), with values and gradients accurate at any z, also where the probability underflows.

    The gradient of `torch.special.log_ndtr` is not: at z = −1e5 in float32 it is 0.4 in place of 1e5.

    Args:
        mean: (..., N).
        std: (..., N), 0 allowed.
        incumbent: the best reward so far, (...) or a number.

    Returns:
        (..., N), at most 0, finite. Differentiable; gradients are finite at σ = 0.
    """
    z, _, _ = _standardised(mean, std, incumbent)
    far = z < _TAIL
    near = torch.special.log_ndtr(torch.where(far, 0.0, z))
    x = torch.where(far, -z, 1.0)
    return torch.where(far, -0.5 * x * x - _LOG_SQRT_2PI - torch.log(x + _ratio(x)), near)


def expected_improvement(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> Tensor:
    """E[max(r − incumbent, 0)] = (μ − incumbent) Φ(z) + σ φ(z).

    Eq. 43 prints E[r − r*], which is greedy; this is what its text means. It rounds to 0 far below; see the log form.

    Args:
        mean: (..., N).
        std: (..., N), 0 allowed.
        incumbent: the best reward so far, (...) or a number.

    Returns:
        (..., N), at least 0, in the units of the reward. Differentiable; gradients are finite at σ = 0.
    """
    near, far, log_far = _improvement(mean, std, incumbent)
    return torch.where(far, torch.exp(log_far), near)


def log_expected_improvement(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> Tensor:
    """The logarithm of `expected_improvement`, with values and gradients accurate at any z (after Ament et al. 2023).

    Below z = −4 it is log σ + log φ(z) + log(H₁/φ), the last ratio a continued fraction of positive terms, in which
    nothing cancels.

    Args:
        mean: (..., N).
        std: (..., N), 0 allowed.
        incumbent: the best reward so far, (...) or a number.

    Returns:
        (..., N), finite. Differentiable; gradients are finite at σ = 0.
    """
    near, far, log_far = _improvement(mean, std, incumbent)
    return torch.where(far, log_far, torch.log(torch.where(far, 1.0, near)))


def thompson(mean: Tensor, std: Tensor, generator: Generators) -> Tensor:
    """One draw of every cell's reward, independent between cells (Thompson sampling).

    Args:
        mean: (..., N).
        std: (..., N).
        generator: one, or one for each row.

    Returns:
        (..., N). Differentiable in mean and std (reparametrized).

    Raises:
        SettingError: the number of generators is not the number of rows, and shapes that do not belong together.
    """
    _of_one_shape(mean, std)
    return mean + std * draw(torch.randn, mean.shape, mean, generator)


def _normal_cdf(z: Tensor) -> Tensor:
    """Φ(z). `torch.special.ndtr` goes through 1 + erf and has no digit left at z = −8, nor in float32 at z = −5."""
    return 0.5 * torch.erfc(-math.sqrt(0.5) * z)


def _of_one_shape(mean: Tensor, std: Tensor, row: float | Tensor = 0.0, name: str = "incumbent") -> None:
    """Refuse what would broadcast to another shape than the mean's: (4, 1) with (4,) makes 16 numbers of 4."""
    require(mean.is_floating_point(), "mean.dtype", mean.dtype, "a floating-point type")
    shapes = tuple(std.shape), tuple(mean.shape)
    require(std.dim() in (0, mean.dim()) and _fits(std, mean), "std.shape", shapes[0], f"{shapes[1]}, as the mean")
    if isinstance(row, Tensor):
        rows = shapes[1][:-1]
        fits = row.dim() < max(1, mean.dim()) and _fits(row[..., None], mean)
        require(fits, f"{name}.shape", tuple(row.shape), f"{rows}, one for each row, or a number")


def _fits(part: Tensor, whole: Tensor) -> bool:
    pairs = zip(part.shape[::-1], whole.shape[::-1], strict=False)
    return all(a == b or 1 in (a, b) for a, b in pairs)


def _standardised(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return z = difference/σ, the difference and σ; σ is floored only so far that z² and gradients stay finite.

    The steepest is the logarithm's gradient in σ, difference²/σ³.
    """
    _of_one_shape(mean, std, incumbent)
    if isinstance(incumbent, Tensor):
        incumbent = incumbent.to(mean)[..., None]
    difference, kind = mean - incumbent, torch.finfo(mean.dtype)
    least = difference.detach().abs().pow(2 / 3) * (1000 / kind.max) ** (1 / 3)
    std = torch.maximum(std, least.clamp_min(kind.tiny**0.5))
    return difference / std, difference, std


def _improvement(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Expected improvement for z ≥ −4, whether z is below, and the log of the improvement where it is."""
    z, difference, std = _standardised(mean, std, incumbent)
    far = z < _TAIL
    z_near = torch.where(far, 0.0, z)
    # Written so, and not σ(z Φ + φ), the gradient with respect to σ is φ with no cancellation at large z.
    density = torch.exp(-0.5 * z_near * z_near - _LOG_SQRT_2PI)
    near = torch.where(far, 0.0, difference) * _normal_cdf(z_near) + std * density
    x = torch.where(far, -z, 1.0)
    ratio = _ratio(x)
    return near, far, torch.log(std) - 0.5 * x * x - _LOG_SQRT_2PI + torch.log(ratio / (x + ratio))


def _ratio(x: Tensor) -> Tensor:
    """H₁(x)/H₀(x) for x > 0, with Hₙ(x) = ∫ₓ^∞ (t−x)ⁿ/n! φ(t) dt: H₀ = Φ(−x), H₁ = φ(x) − x Φ(−x).

    rₙ₋₁ = 1/(x + n rₙ) (Gautschi 1961), started at the fixed point of its tail. Mills' ratio is r₀ = 1/(x + r₁).
    """
    ratio = 2 / (torch.sqrt(x * x + 4 * (_TERMS + 1)) + x)
    for n in range(_TERMS, 1, -1):
        ratio = 1 / (x + n * ratio)
    return ratio


def known_well_enough(mean: Tensor, std: Tensor, eligible: Tensor, tolerance: float, probability: float) -> Tensor:
    """Whether the search may stop: hardly any chance that another eligible cell beats the best one.

    With b the eligible cell of the highest mean, it bounds P(some rⱼ > r_b + tolerance) by the union bound
    Σⱼ Φ((μⱼ − μ_b − tolerance)/√(σⱼ² + σ_b²)), in which cells are taken as independent of b. The bound is pessimistic:
    it never stops earlier than the probability itself would.

    Args:
        mean: (..., N).
        std: (..., N).
        eligible: bool (..., N).
        tolerance: how much better another may be without mattering, ≥ 0, in the units of the reward.
        probability: the largest acceptable probability of such a cell, in (0, 1).

    Returns:
        Bool (...); False where no cell is eligible.

    Raises:
        SettingError: a setting out of its range.
    """
    require(tolerance >= 0, "stop.tolerance", tolerance, "a number of at least 0, in the units of the reward")
    require(0 < probability < 1, "stop.probability", probability, "a probability between 0 and 1")
    valid = eligible & ~mean.isnan()
    best = torch.where(valid, mean, -torch.inf).argmax(-1, keepdim=True)
    others = valid & (torch.arange(mean.shape[-1], device=mean.device) != best)
    spread = torch.hypot(std, std.gather(-1, best)).clamp_min(torch.finfo(mean.dtype).tiny)
    beaten = _normal_cdf((mean - mean.gather(-1, best) - tolerance) / spread)
    return (torch.where(others, beaten, 0.0).sum(-1) < probability) & valid.any(-1)


def choose(score: Tensor, eligible: Tensor, generator: Generators | None = None) -> Tensor:
    """The eligible cell of the highest score; exact ties are broken uniformly.

    N numbers a row are drawn, ties or not, so that a generator's stream does not depend on the data.

    Args:
        score: (..., N); NaN is never chosen, ±inf may be.
        eligible: bool, broadcastable to (..., N).
        generator: one, or one for each row; None takes the first among ties.

    Returns:
        (...) int64; −1 where no cell can be chosen. Not differentiable.

    Raises:
        SettingError: no cell at all, or a number of generators that is not the number of rows.
    """
    require(score.dim() > 0 and score.shape[-1] > 0, "score", tuple(score.shape), "at least one cell, (..., N)")
    score = score.detach()
    valid = eligible & ~score.isnan()
    score = score.expand(valid.shape)
    best = torch.where(valid, score, -torch.inf).amax(-1, keepdim=True)
    tied = valid & (score == best)
    if generator is None:
        winner = tied.to(torch.uint8).argmax(-1)
    else:  # float64, for among thousands of float32 draws some would themselves tie
        like = torch.empty((), dtype=torch.float64, device=score.device)
        winner = torch.where(tied, draw(torch.rand, valid.shape, like, generator), -1.0).argmax(-1)
    return torch.where(valid.any(-1), winner, -1)


def draw(kind: Callable[..., Tensor], shape: Sequence[int], like: Tensor, generator: Generators) -> Tensor:
    """Random numbers in the dtype and on the device of `like`, drawn in float64 where the generators live.

    Args:
        kind: `torch.rand` or `torch.randn`.
        shape: of the result, its last axis filled row by row.
        like: gives dtype and device.
        generator: one, or one for each row.

    Returns:
        A tensor of that shape.

    Raises:
        SettingError: the number of generators is not the number of rows.
    """
    if isinstance(generator, torch.Generator):
        drawn = kind(*shape, generator=generator, device=generator.device, dtype=torch.float64)
    else:
        listed = isinstance(generator, Sequence) and all(isinstance(one, torch.Generator) for one in generator)
        require(listed, "generator", generator, "a torch.Generator, or one for each row")
        rows = math.prod(shape[:-1])
        require(len(generator) == rows, "generators", len(generator), f"one, or one for each of the {rows} rows")
        drawn = torch.stack([kind(shape[-1], generator=g, device=g.device, dtype=torch.float64) for g in generator])
    return drawn.reshape(tuple(shape)).to(like)
