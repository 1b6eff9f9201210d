"""Deciding where to look: pure functions from a reward belief to a score for every cell, and one choice among scores.

Everything is batched over leading axes `...` (episodes); N is the number of cells, always the last axis. Scores are to
be maximised, and only their order matters, except where a docstring says otherwise. `incumbent` is the best reward so
far, (...) or a number. Where randomness enters, `generator` is one `torch.Generator` for the whole batch, or a sequence
with one for each batch row; then a batch of episodes makes the same choices as the episodes one by one.

References:
    Auer et al. (2002), Finite-time analysis of the multiarmed bandit problem. Cox and John (1992), SDO.
    Kushner (1964); Mockus (1974); Jones et al. (1998), Efficient global optimization.
    Ament et al. (2023), Unexpected improvements to expected improvement: the need of log EI.
    Hoffman, Brochu and de Freitas (2011), Portfolio allocation for Bayesian optimization.
    Najemnik and Geisler (2005); Butko and Movellan (2010), Infomax control of eye movements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "Generators",
    "Hedge",
    "best_of",
    "choose",
    "eccentricity_law",
    "expected_improvement",
    "first_glance_scores",
    "gaze_information_gain",
    "hedge_choose",
    "hedge_start",
    "hedge_update",
    "information_gain",
    "known_well_enough",
    "log_expected_improvement",
    "log_probability_of_improvement",
    "minus_cost",
    "oracle_scores",
    "per_cost",
    "precision_by_eccentricity",
    "probability_of_improvement",
    "random_scores",
    "raster_ranks",
    "raster_scores",
    "saccade_degrees",
    "saccade_seconds",
    "thompson",
    "upper_confidence_bound",
]

Generators = torch.Generator | Sequence[torch.Generator]

_TAIL = -4.0  # below it, formulas with Φ cancel and the continued fraction takes over
_TERMS = 20  # of the continued fraction: 1e-12 at the switch, better beyond
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_BLOCK = 1 << 22  # elements of one block of candidates x cells


# --- the paper's three, and their stable forms -----------------------------------------------------------------------


def upper_confidence_bound(mean: Tensor, std: Tensor, alpha: float | Tensor) -> Tensor:
    """μ + α σ (Eq. 41); with α = inf, σ alone.

    Args:
        mean: mean of the reward, (..., N).
        std: its standard deviation, (..., N).
        alpha: weight of exploration ≥ 0, a number or one for each row, (...).

    Returns:
        (..., N). Differentiable in all three; the gradient with respect to an infinite alpha is 0.

    Raises:
        SettingError: a number alpha that is negative or NaN.
    """
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
        SettingError: the number of generators is not the number of rows.
    """
    return mean + std * _draw(torch.randn, mean.shape, mean, generator)


def _normal_cdf(z: Tensor) -> Tensor:
    """Φ(z). `torch.special.ndtr` goes through 1 + erf and has no digit left at z = −8, nor in float32 at z = −5."""
    return 0.5 * torch.erfc(-math.sqrt(0.5) * z)


def _standardised(mean: Tensor, std: Tensor, incumbent: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return z = difference/σ, the difference and σ; σ is floored only so far that z² and gradients stay finite."""
    if isinstance(incumbent, Tensor):
        incumbent = incumbent.to(mean)[..., None]
    difference = mean - incumbent
    std = std.clamp_min(torch.finfo(mean.dtype).tiny ** 0.25)
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


# --- one-step infomax ------------------------------------------------------------------------------------------------


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
    blocks = (precision[..., part, :] for part in _parts(precision.shape[-2], variance.numel()))
    return _gain(variance, blocks, eligible)


def gaze_information_gain(
    variance: Tensor,
    directions: Tensor,
    cells: Tensor,
    law: Callable[[Tensor], Tensor],
    half_view_rad: float = math.pi,
    eligible: Tensor | None = None,
) -> Tensor:
    """`information_gain` with the precision of `precision_by_eccentricity`, which is never kept as a whole.

    Args:
        variance: of the quantity kept for each cell, (..., M).
        directions: the candidates' unit vectors, (N, 3).
        cells: the cells' unit vectors, (M, 3).
        law: standard deviation as a function of the eccentricity [rad].
        half_view_rad: eccentricity beyond which nothing is seen.
        eligible: the cells whose entropy counts, (..., M); None counts all.

    Returns:
        (..., N), at least 0 [nats]. Differentiable.
    """
    parts = _parts(directions.shape[-2], variance.numel())
    blocks = (precision_by_eccentricity(directions[part], cells, law, half_view_rad) for part in parts)
    return _gain(variance, blocks, eligible)


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
        law: standard deviation as a function of the eccentricity [rad], such as `eccentricity_law`.
        half_view_rad: eccentricity beyond which nothing is seen.

    Returns:
        (..., N, M), 0 out of view.
    """
    chord = torch.cdist(directions, cells, compute_mode="donot_use_mm_for_euclid_dist")
    angle = 2 * torch.asin((chord / 2).clamp(max=1 - torch.finfo(chord.dtype).eps))
    seen = angle <= half_view_rad
    sigma = law(torch.where(seen, angle, 0.0))
    return torch.where(seen, 1 / (sigma * sigma), 0.0)


def eccentricity_law(sigma_fovea: float, sigma_per_rad: float) -> Callable[[Tensor], Tensor]:
    """σ(e)² = sigma_fovea² + (sigma_per_rad · e)²: acuity that falls linearly, over what the source image allows.

    Args:
        sigma_fovea: standard deviation on the optical axis, > 0.
        sigma_per_rad: its growth with eccentricity, ≥ 0; 0 for a uniform sensor.

    Returns:
        The law, from eccentricity [rad] to σ in the units of `sigma_fovea`.

    Raises:
        SettingError: a value out of its range.
    """
    require(0 < sigma_fovea < math.inf, "sigma_fovea", sigma_fovea, "a positive number")
    require(0 <= sigma_per_rad < math.inf, "sigma_per_rad", sigma_per_rad, "a number of at least 0")
    return lambda angle: torch.sqrt(sigma_fovea**2 + (sigma_per_rad * angle) ** 2)


def _gain(variance: Tensor, blocks: Iterator[Tensor], eligible: Tensor | None) -> Tensor:
    if eligible is not None:
        variance = torch.where(eligible, variance, 0.0)
    return torch.cat([0.5 * torch.log1p(variance[..., None, :] * block).sum(-1) for block in blocks], -1)


def _parts(candidates: int, row: int) -> Iterator[slice]:
    step = max(1, _BLOCK // max(1, row))
    return (slice(start, start + step) for start in range(0, candidates, step))


# --- costs -----------------------------------------------------------------------------------------------------------


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


# --- a portfolio -----------------------------------------------------------------------------------------------------


class Hedge(NamedTuple):
    """State of a GP-Hedge portfolio over K acquisitions.

    Attributes:
        gains: cumulated rewards of what each acquisition has nominated, (..., K).
    """

    gains: Tensor


def hedge_start(batch: Sequence[int], acquisitions: int, like: Tensor) -> Hedge:
    """A portfolio that trusts its acquisitions equally, for each row of `batch`, in the dtype and device of `like`."""
    return Hedge(torch.zeros(*batch, acquisitions, dtype=like.dtype, device=like.device))


def hedge_choose(state: Hedge, nominees: Tensor, eta: float, generator: Generators) -> tuple[Tensor, Tensor]:
    """Follow one acquisition's nominee, drawn with probability ∝ exp(η gain) (Hoffman et al. 2011, Algorithm 2).

    Args:
        state: the portfolio, gains (..., K).
        nominees: the cell that each acquisition would choose, (..., K) int64.
        eta: learning rate ≥ 0 in 1/reward; with rewards in [0, 1] over T choices, sqrt(8 ln K / T) is the theory's.
        generator: one, or one for each row.

    Returns:
        The cell, (...), and the acquisition followed, (...), both int64.

    Raises:
        SettingError: a negative eta; the number of generators is not the number of rows.
    """
    require(eta >= 0, "acquisition.eta", eta, "a number of at least 0")
    cumulated = torch.softmax(eta * state.gains, -1).cumsum(-1)
    draw = _draw(torch.rand, (*state.gains.shape[:-1], 1), cumulated, generator)
    followed = (cumulated < draw).sum(-1, keepdim=True).clamp(max=state.gains.shape[-1] - 1)
    return nominees.gather(-1, followed)[..., 0], followed[..., 0]


def hedge_update(state: Hedge, nominees: Tensor, mean: Tensor) -> Hedge:
    """Reward every acquisition, followed or not, by the updated mean at its nominee.

    Args:
        state: the portfolio, gains (..., K).
        nominees: (..., K) int64; −1 (no eligible cell) gains nothing.
        mean: mean of the rewards *after* the look, (..., N).

    Returns:
        The new state.
    """
    gained = mean.expand(*nominees.shape[:-1], mean.shape[-1]).gather(-1, nominees.clamp_min(0))
    return Hedge(state.gains + torch.where(nominees >= 0, gained, 0.0))


# --- policies that any claim must beat -------------------------------------------------------------------------------


def random_scores(mean: Tensor, generator: Generators) -> Tensor:
    """Uniform scores shaped as `mean` (..., N): every eligible cell is equally likely."""
    return _draw(torch.rand, mean.shape, mean, generator)


def raster_ranks(directions: Tensor, spacing_deg: float) -> Tensor:
    """The place of each cell on a serpentine scan of the cells' extent, from the top row down, rows alternating.

    A grid of pan and tilt with equal spacing on the sphere; at each place the nearest cell, if within the spacing.

    Args:
        directions: the cells' unit vectors in the ego frame (x forward, y left, z up), (N, 3).
        spacing_deg: distance between neighbouring fixations, such as half the field of view.

    Returns:
        (N,) int64: 0, 1, 2, … along the scan, −1 for cells that are not on it. Not differentiable.

    Raises:
        SettingError: a spacing outside (0, 180).
    """
    require(0 < spacing_deg < 180, "spacing_deg", spacing_deg, "an angle between 0 and 180 degrees")
    cells = directions.detach()
    spacing = math.radians(spacing_deg)
    elevation = torch.atan2(cells[:, 2], torch.hypot(cells[:, 0], cells[:, 1]))
    azimuth = torch.atan2(cells[:, 1], cells[:, 0])
    ranks = torch.full((len(cells),), -1, dtype=torch.int64, device=cells.device)
    place = 0
    for row, up in enumerate(_centred(elevation.min().item(), elevation.max().item(), spacing)[::-1]):
        along = _centred(azimuth.min().item(), azimuth.max().item(), spacing / max(math.cos(up), 1e-6))
        for left in along if row % 2 else along[::-1]:
            point = (math.cos(up) * math.cos(left), math.cos(up) * math.sin(left), math.sin(up))
            cosine, cell = (cells @ cells.new_tensor(point)).max(0)
            if cosine >= math.cos(spacing) and ranks[cell] < 0:
                ranks[cell] = place
                place += 1
    return ranks


def raster_scores(ranks: Tensor, last: Tensor) -> Tensor:
    """Scores that follow a scan: highest for the next place after the last choice, cyclically.

    Args:
        ranks: from `raster_ranks`, (N,).
        last: the last cell chosen, (...) int64; −1 at the start.

    Returns:
        (..., N) float64; −inf for cells off the scan, which are chosen only when no cell on it is eligible.
    """
    count = int(ranks.max()) + 1
    position = torch.where(last >= 0, ranks[last.clamp_min(0)], -1)
    ahead = torch.remainder(ranks - position[..., None] - 1, max(count, 1))
    return torch.where(ranks >= 0, -ahead.to(torch.float64), -torch.inf)


def first_glance_scores(mean: Tensor, chosen: Tensor) -> Tensor:
    """Greedy on what the first glance showed, and never moving again while that cell stays eligible.

    Args:
        mean: mean of the reward, (..., N).
        chosen: the cell chosen after the first glance, (...) int64; −1 before there is one.

    Returns:
        (..., N): the mean, with +inf at the chosen cell.
    """
    return torch.where(torch.arange(mean.shape[-1], device=mean.device) == chosen[..., None], torch.inf, mean)


def oracle_scores(directions: Tensor, best: Tensor) -> Tensor:
    """Cosine between each cell (N, 3) or (..., N, 3) and the true best direction (..., 3), as (..., N): look there."""
    return (directions * best[..., None, :]).sum(-1)


def _centred(low: float, high: float, spacing: float) -> list[float]:
    """Evenly spaced places, `spacing` apart, that cover [low, high] symmetrically."""
    count = max(1, math.ceil((high - low) / spacing - 1e-9))
    return [(low + high) / 2 + (i - (count - 1) / 2) * spacing for i in range(count)]


# --- stopping and choosing -------------------------------------------------------------------------------------------


def best_of(mean: Tensor, among: Tensor) -> Tensor:
    """The incumbent: the highest mean (..., N) among a mask (..., N), as (...); where it is empty, the row's lowest."""
    lowest = mean.amin(-1)
    return torch.where(among, mean, lowest[..., None]).amax(-1)


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
    spread = torch.sqrt(std.square() + std.gather(-1, best).square()).clamp_min(torch.finfo(mean.dtype).tiny ** 0.25)
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
        SettingError: the number of generators is not the number of rows.
    """
    score = score.detach()
    valid = eligible & ~score.isnan()
    score = score.expand(valid.shape)
    best = torch.where(valid, score, -torch.inf).amax(-1, keepdim=True)
    lot = torch.arange(0, -score.shape[-1], -1, dtype=torch.float64, device=score.device)
    if generator is not None:  # float64, for among thousands of float32 draws some would themselves tie
        lot = _draw(torch.rand, valid.shape, lot, generator)
    winner = torch.where(valid & (score == best), lot, -torch.inf).argmax(-1)
    return torch.where(valid.any(-1), winner, -1)


def _draw(kind: Callable[..., Tensor], shape: Sequence[int], like: Tensor, generator: Generators) -> Tensor:
    """Random numbers in the dtype and on the device of `like`, drawn in float64 where the generators live."""
    if isinstance(generator, torch.Generator):
        drawn = kind(*shape, generator=generator, device=generator.device, dtype=torch.float64)
    else:
        rows = math.prod(shape[:-1])
        require(len(generator) == rows, "generators", len(generator), f"one, or one for each of the {rows} rows")
        drawn = torch.stack([kind(shape[-1], generator=g, device=g.device, dtype=torch.float64) for g in generator])
    return drawn.reshape(tuple(shape)).to(like)
