"""The strategy of looking that a configuration describes: the makers that ``_target_`` names, and a user's own."""

from __future__ import annotations

import inspect
import math
from functools import partial, wraps
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.named import build_named, name_of
from torchfovea.commands.shared.settings import within
from torchfovea.deciding import strategies
from torchfovea.deciding.strategies import Strategy, View
from torchfovea.deciding.weighted import Weighting
from torchfovea.imported import require_takes
from torchfovea.perception import Observer
from torchfovea.search import StopRule
from torchfovea.setting import require, typed

__all__ = [
    "build_stop",
    "build_strategy",
    "ei_cost",
    "hedge",
    "infomax",
    "oracle",
    "raster",
    "ucb",
    "ucb_cost",
    "weighted",
]

FORM = "a function of a View that returns a score for each cell"


def build_strategy(cfg: DictConfig, observer: Observer, best: Tensor | None = None) -> Strategy:
    """The strategy by its name.

    Args:
        cfg: with the group `acquisition`.
        observer: whose sensor the strategies with foresight know.
        best: true direction of the best point (..., 3), for the oracle alone.

    Raises:
        SettingError: for an unknown name or a setting out of range.
    """
    name = name_of(cfg, "acquisition")
    made = build_named(cfg, "acquisition", FORM)
    require(callable(made), "acquisition", type(made).__name__, FORM)
    known = {"observer": observer, "best": best}
    needs = [key for key in known if key in _parameters(made)]
    if needs:  # a maker, of what a configuration cannot say
        made = made(**{key: known[key] for key in needs})
        require(callable(made), "acquisition", f"{type(made).__name__} from {name}", FORM)
    require_takes(made, ("view",), "acquisition", OmegaConf.select(cfg, "acquisition.source") or name)
    target = OmegaConf.select(cfg, "acquisition._target_")
    strategy: Strategy = made if isinstance(target, str) and target.startswith("torchfovea.") else _checked(made, name)
    return strategy


def _parameters(made: Any) -> list[str]:
    """What something takes that a partial has not given it yet."""
    try:
        given = made.keywords if isinstance(made, partial) else {}
        return [key for key in inspect.signature(made).parameters if key not in given]
    except (TypeError, ValueError):
        return []


def _checked(strategy: Strategy, name: str) -> Strategy:
    """A user's strategy, whose scores are looked at."""

    @wraps(strategy)
    def scored(view: View) -> Tensor | tuple[Tensor, Any]:
        answer = strategy(view)
        score = answer[0] if isinstance(answer, tuple) and len(answer) == 2 else answer
        fits = isinstance(score, Tensor) and score.shape == view.mean.shape
        shape = tuple(score.shape) if isinstance(score, Tensor) else type(score).__name__
        require(fits, f"acquisition {name}'s scores", shape, f"{tuple(view.mean.shape)}, one for each cell")
        return answer

    return scored


def _number(value: float, setting: str, expected: str, least: float = 0.0) -> float:
    require(typed(value, "float", f"acquisition.{setting}") >= least, f"acquisition.{setting}", value, expected)
    return float(value)


def _alpha(value: float) -> float:
    return _number(value, "alpha", "a number of at least 0, or inf")


def _unit(value: str) -> str:
    require(value in ("degrees", "seconds"), "acquisition.unit", value, "degrees or seconds")
    return value


def _overhead(value: float) -> float:
    return _number(value, "overhead", "a positive number of degrees or seconds", 1e-9)


def ucb(alpha: float) -> Strategy:
    """The upper confidence bound, Eq. 41."""
    return partial(strategies.upper_confidence_bound, alpha=_alpha(alpha))


def ucb_cost(alpha: float, weight: float, unit: str = "degrees") -> Strategy:
    """The upper confidence bound less `weight` for every degree or second of the saccade."""
    weight = _number(weight, "weight", "reward per degree or second, at least 0")
    least = strategies.upper_confidence_bound_less_cost
    return partial(least, alpha=_alpha(alpha), weight=weight, unit=_unit(unit))


def ei_cost(overhead: float, unit: str = "degrees") -> Strategy:
    """The expected improvement for every degree or second of the saccade and `overhead`."""
    return partial(strategies.expected_improvement_per_cost, overhead=_overhead(overhead), unit=_unit(unit))


def hedge(alpha: float, eta: float) -> Strategy:
    """A portfolio of the upper confidence bound, the probability of improvement and the expected improvement."""
    members = (ucb(alpha), strategies.probability_of_improvement, strategies.expected_improvement)
    return partial(strategies.hedge, members=members, eta=_number(eta, "eta", "a number of at least 0"))


def raster(spacing_deg: float) -> Strategy:
    """A serpentine scan."""
    spacing = _number(spacing_deg, "spacing_deg", "an angle between 0 and 180 degrees")
    return partial(strategies.raster, spacing_deg=spacing)


def oracle(best: Tensor | None) -> Strategy:
    """The cell nearest to the truth; where that is not known yet, straight ahead."""
    return partial(strategies.oracle, best=torch.tensor([1.0, 0.0, 0.0]) if best is None else best)


def infomax(observer: Observer, overhead: float | None = None, unit: str = "degrees") -> Strategy:
    """The expected information of a fixation by an observer's sensor model, or that for every cost of the saccade."""
    known = isinstance(observer.reward, str)
    require(known, "acquisition", "infomax", "reward=inverse_range or range, of which it knows what a look brings")
    edge = torch.tensor([observer.retina.radius_px, 0.0], dtype=torch.float64)
    x, _, z = observer.camera.rays(edge).unbind(-1)
    return partial(
        strategies.information_gain,
        law=strategies.inverse_range_acuity(
            observer.camera, observer.retina, observer.budget, observer.head.baseline_m
        ),
        half_view_rad=float(torch.atan2(x, z)),
        in_range=observer.reward == "range",
        overhead=None if overhead is None else _overhead(overhead),
        unit=_unit(unit),
    )


def weighted(observer: Observer, saccades: int, **weights: float) -> Strategy:
    """The family of acquisitions with weights, over a search of so many saccades."""
    given = Weighting(**weights)
    classes = observer.classes
    require(not given.counts("doubt") or classes is not None, "acquisition.doubt", given.doubt, "0 without classes")
    return partial(
        strategies.weighted,
        weights=given,
        saccades=int(_number(saccades, "saccades", "a whole number of at least 1", 1)),
        foresight=infomax(observer) if given.counts("information") else None,
        sought=None if classes is None else classes.sought,
    )


def build_stop(cfg: DictConfig) -> StopRule | None:
    """When the best is known well enough: (tolerance, probability), or None for never."""
    expected = "a number of at least 0, in the units of the reward"
    tolerance, probability = within(cfg, "stop.tolerance", 0, math.inf, expected), cfg.stop.probability
    if probability is None:
        return None
    require(0 < probability < 1, "stop.probability", probability, "a probability between 0 and 1, or null")
    return tolerance, float(probability)
