"""Strategies of looking: from what the observer knows at a moment, a `View`, to a score for every cell.

A strategy is any function of a `View`. It returns scores (..., N), of which the highest eligible one is fixated, or a
pair of scores and a state of its own that it finds in the next `View`. Nothing is kept elsewhere, so that episodes can
be batched, interrupted and repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding import acquisition, infomax, policies
from torchfovea.deciding.acquisition import Generators
from torchfovea.deciding.reward import RewardBelief, inverse_range_from_range
from torchfovea.deciding.weighted import Terms, Weighting, saccades_left, weighted_score
from torchfovea.memory.classes import class_moments
from torchfovea.memory.egosphere import Memory
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, eye_sigma_px
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require

__all__ = [
    "Strategy",
    "View",
    "evaluate",
    "expected_improvement",
    "expected_improvement_per_cost",
    "first_glance",
    "hedge",
    "information_gain",
    "inverse_range_acuity",
    "log_expected_improvement",
    "oracle",
    "probability_of_improvement",
    "random",
    "raster",
    "thompson",
    "upper_confidence_bound",
    "upper_confidence_bound_less_cost",
    "weighted",
]


class View(NamedTuple):
    """What a strategy may know.

    Attributes:
        mean: of each cell's reward, (..., N).
        std: its standard deviation, (..., N).
        incumbent: the best mean among the seen eligible cells, (...).
        eligible: which cells may be fixated, bool (..., N).
        directions: the cells' unit directions in E, (..., N, 3).
        line_of_sight: where the head looks now, unit, (..., 3).
        last: the cell chosen last, (...) int64; −1 at the start.
        generator: the source of chance, one or one for each row; None where there shall be none.
        state: what the strategy returned beside its scores the last time; None at the start.
        memory: all that is known, (..., N), for strategies that read more than rewards; None where there is none.
    """

    mean: Tensor
    std: Tensor
    incumbent: Tensor
    eligible: Tensor
    directions: Tensor
    line_of_sight: Tensor
    last: Tensor
    generator: Generators | None = None
    state: Any = None
    memory: Memory | None = None


Strategy = Callable[[View], Tensor | tuple[Tensor, Any]]


def upper_confidence_bound(view: View, alpha: float | Tensor = 2.0) -> Tensor:
    """μ + α σ (Eq. 41); `alpha` a number, inf allowed, or one for each row (...)."""
    return acquisition.upper_confidence_bound(view.mean, view.std, alpha)


def probability_of_improvement(view: View) -> Tensor:
    """Eq. 42, as its logarithm: the same choice, also where the probability underflows."""
    return acquisition.log_probability_of_improvement(view.mean, view.std, view.incumbent)


def expected_improvement(view: View) -> Tensor:
    """Eq. 43, as its text means it."""
    return acquisition.expected_improvement(view.mean, view.std, view.incumbent)


def log_expected_improvement(view: View) -> Tensor:
    """The logarithm of the expected improvement: the same choice, also where the improvement underflows."""
    return acquisition.log_expected_improvement(view.mean, view.std, view.incumbent)


def thompson(view: View) -> Tensor:
    """One draw of every cell's reward."""
    return acquisition.thompson(view.mean, view.std, _source(view))


def random(view: View) -> Tensor:
    """Any eligible cell."""
    return policies.random_scores(view.mean, _source(view))


def _cost(view: View, unit: str) -> Tensor:
    require(unit in ("degrees", "seconds"), "acquisition.unit", unit, "degrees or seconds")
    degrees = infomax.saccade_degrees(view.line_of_sight, view.directions)
    return degrees if unit == "degrees" else infomax.saccade_seconds(degrees)


def upper_confidence_bound_less_cost(view: View, alpha: float, weight: float, unit: str = "degrees") -> Tensor:
    """μ + α σ less `weight` for every degree or second that the saccade takes."""
    return infomax.minus_cost(upper_confidence_bound(view, alpha), _cost(view, unit), weight)


def expected_improvement_per_cost(view: View, overhead: float, unit: str = "degrees") -> Tensor:
    """Log of the expected improvement for every degree or second, `overhead` being what each look costs besides."""
    require(overhead > 0, "acquisition.overhead", overhead, "a positive number of its unit")
    return log_expected_improvement(view) - torch.log(overhead + _cost(view, unit))


def raster(view: View, spacing_deg: float) -> tuple[Tensor, Tensor]:
    """A serpentine scan with neighbouring fixations `spacing_deg` apart; its state is the cells' places on it."""
    ranks = view.state
    if ranks is None:
        rows = view.directions.reshape(-1, *view.directions.shape[-2:])
        ranks = torch.stack([policies.raster_ranks(row, spacing_deg) for row in rows])
        ranks = ranks.reshape(view.directions.shape[:-1])
    lead = view.mean.shape[:-1]
    scores = [
        policies.raster_scores(row, last)
        for row, last in zip(ranks.reshape(-1, ranks.shape[-1]), view.last.reshape(-1), strict=True)
    ]
    return torch.stack(scores).reshape(*lead, -1), ranks


def first_glance(view: View) -> tuple[Tensor, Tensor]:
    """The best cell of the first glance, for ever; its state is that cell."""
    state = view.state
    if state is None:
        floor = torch.where(view.eligible, view.mean, -torch.inf)
        state = torch.where(view.eligible.any(-1), floor.argmax(-1), -1)
    return policies.first_glance_scores(view.mean, state), state


def oracle(view: View, best: Tensor) -> Tensor:
    """The cell nearest to the true best direction (..., 3), which no observer knows: a bound for every policy."""
    return policies.oracle_scores(view.directions, best.to(view.mean))


def inverse_range_acuity(
    camera: Camera, retina: Retina, budget: Budget, baseline_m: float
) -> Callable[[Tensor], Tensor]:
    """The noise in inverse range of one receptive field at an eccentricity [rad], from the sensor model.

    Both eyes are taken to see the point at the same eccentricity e, and to err by σ(e) pixels each: the disparity errs
    by √2 σ, an angle by √2 σ dθ/dpx, and an inverse range by that over the baseline.
    """

    def law(angle: Tensor) -> Tensor:
        direction = torch.stack([torch.sin(angle), torch.zeros_like(angle), torch.cos(angle)], -1)
        px = camera.project(direction)
        ray = camera.rays(px)
        step = torch.tensor([1e-2, 0.0], dtype=px.dtype, device=px.device)
        other = camera.rays(px + step)
        ray, other = (r / torch.linalg.vector_norm(r, dim=-1, keepdim=True) for r in (ray, other))
        per_px: Tensor = torch.linalg.vector_norm(other - ray, dim=-1) / 1e-2
        return math.sqrt(2) * eye_sigma_px(budget, retina, px) * per_px / baseline_m

    return law


def information_gain(
    view: View,
    law: Callable[[Tensor], Tensor],
    half_view_rad: float,
    in_range: bool = False,
    overhead: float | None = None,
    unit: str = "degrees",
) -> tuple[Tensor, Tensor]:
    """Expected information of a fixation under the sensor model, one step ahead (Najemnik and Geisler 2005).

    Its state is the precision that each fixation would bring each cell, (..., N, N).

    Args:
        view: what is known.
        law: σ of inverse range by eccentricity, see `inverse_range_acuity`.
        half_view_rad: eccentricity of the retina's border.
        in_range: whether the view's reward is −range rather than inverse range.
        overhead: None for the gain itself; else the gain per (overhead + cost of the saccade).
        unit: of the cost, degrees or seconds.
    """
    belief = RewardBelief(view.mean, view.std)
    if in_range:
        belief = inverse_range_from_range(belief)
    precision = view.state
    if precision is None:
        angles = torch.linspace(0, half_view_rad, 512, dtype=view.mean.dtype, device=view.mean.device)
        table = 1 / law(angles).square()

        def sigma(angle: Tensor) -> Tensor:
            place = (angle / half_view_rad * 511).clamp(0, 511)
            return table[place.round().long()].rsqrt()

        precision = infomax.precision_by_eccentricity(view.directions, view.directions, sigma, half_view_rad)
    gain = infomax.information_gain(belief.std.square(), precision, view.eligible)
    if overhead is not None:
        gain = infomax.per_cost(gain, _cost(view, unit), overhead)
    return gain, precision


class _Course(NamedTuple):
    """State of `weighted`: how many decisions are made, and the foresight's own state."""

    made: int
    foresight: Any


def weighted(
    view: View, weights: Weighting, saccades: int, foresight: Strategy | None = None, sought: int | None = None
) -> tuple[Tensor, _Course]:
    """The family of `torchfovea.deciding.weighted`: a weighted sum of mean, spread, improvement, information and cost.

    Args:
        view: what is known; with its memory where what is unseen or of a class has a weight.
        weights: of the terms.
        saccades: of the whole search, the initial gaze included.
        foresight: what tells the information of a fixation, such as `information_gain` with its sensor's law.
        sought: the class that is sought.

    Raises:
        SettingError: a weight on what is not known.
    """
    made, ahead = (0, None) if view.state is None else view.state
    unseen = information = doubt = None
    if view.memory is not None and weights.counts("by_unseen"):
        fresh = view.eligible & (view.memory.looks == 0)
        unseen = fresh.sum(-1) / view.eligible.sum(-1).clamp(min=1)
    if foresight is not None and weights.counts("information"):
        gain, ahead = evaluate(foresight, view._replace(state=ahead))
        information = gain / gain.shape[-1]
    if view.memory is not None and view.memory.classes is not None and sought is not None:
        doubt = class_moments(view.memory.classes, sought)[1].sqrt()
    degrees = _cost(view, "degrees") if weights.counts("cost_per_deg") else None
    left = saccades_left(made, saccades)
    terms = Terms(view.mean, view.std, view.incumbent, left, unseen, degrees, information, doubt)
    return weighted_score(weights, terms), _Course(made + 1, ahead)


class _Portfolio(NamedTuple):
    """State of `hedge`: gains so far, the last nominees, and the members' own states."""

    gains: policies.Hedge
    nominees: Tensor
    members: tuple[Any, ...]


def hedge(view: View, members: Sequence[Strategy], eta: float) -> tuple[Tensor, _Portfolio]:
    """A portfolio that follows the members in proportion to what their nominees turned out to be worth.

    Args:
        view: what is known.
        members: strategies, each with its own state.
        eta: learning rate, see `torchfovea.deciding.policies.hedge_choose`.
    """
    state = view.state
    lead = view.mean.shape[:-1]
    if state is None:
        start = policies.hedge_start(lead, len(members), view.mean)
        state = _Portfolio(start, torch.full((*lead, len(members)), -1), (None,) * len(members))
    gains = policies.hedge_update(state.gains, state.nominees.to(view.mean.device), view.mean)
    nominees, states = [], []
    for member, own in zip(members, state.members, strict=True):
        scores, after = evaluate(member, view._replace(state=own))
        nominees.append(acquisition.choose(scores, view.eligible, view.generator))
        states.append(after)
    stacked = torch.stack(nominees, -1)
    cell, _ = policies.hedge_choose(gains, stacked, eta, _source(view))
    scores = (torch.arange(view.mean.shape[-1], device=cell.device) == cell[..., None]).to(view.mean)
    return scores, _Portfolio(gains, stacked, tuple(states))


def evaluate(strategy: Strategy, view: View) -> tuple[Tensor, Any]:
    """Scores and state of any strategy; None for the state of those without.

    Raises:
        SettingError: for what is no function, or does not score every cell.
    """
    require(callable(strategy), "strategy", strategy, "a function of a torchfovea.deciding.strategies.View")
    result = strategy(view)
    score, state = result if isinstance(result, tuple) else (result, None)
    fits = isinstance(score, Tensor) and 0 < score.dim() and score.shape == view.mean.shape[-score.dim() :]
    shape = tuple(score.shape) if isinstance(score, Tensor) else type(score).__name__
    require(fits, "strategy's scores", shape, f"{tuple(view.mean.shape)}, one for each cell")
    return score, state


def _source(view: View) -> Generators:
    require(view.generator is not None, "generator", None, "a torch.Generator, for this strategy draws lots")
    assert view.generator is not None
    return view.generator
