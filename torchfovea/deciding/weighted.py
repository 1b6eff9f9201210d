"""A small family of acquisitions, told apart by a few weights: a score that is a weighted sum of what may count.

With μ and σ a cell's mean and standard deviation of the reward,

    score = μ + α(τ, u) σ + improvement EI + information I + doubt s − cost_per_deg c,
    α(τ, u) = alpha exp(by_time (τ − ½) + by_unseen (u − ½)),

τ being the share of the saccades that are left, u the share of the eligible cells that no look has reached, EI the
expected improvement, I the expected information of the fixation [nats a cell], s the standard deviation of the belief
that the cell is of the class that is sought, and c the saccade [degrees]. Nothing here is a network: weights are set by
hand, by search, or by gradient (`torchfovea tune acquisition=weighted`). With all but alpha at 0 it is the upper
confidence bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import expected_improvement, upper_confidence_bound
from torchfovea.setting import require, typed

__all__ = ["Terms", "Weighting", "joined", "saccades_left", "weighted_alpha", "weighted_score"]

_MOST = 20.0  # of the exponent


@dataclass(frozen=True)
class Weighting:
    """Weighting of the terms; each a number, or one for each row (...).

    Attributes:
        alpha: of the standard deviation, at the middle of the search with half of the cells seen; ≥ 0, inf allowed.
        by_time: how much log α falls from the first decision to the last.
        by_unseen: how much more log α is where nothing is seen than where all is.
        improvement: of the expected improvement over the incumbent.
        information: reward per nat a cell.
        doubt: reward per standard deviation of the sought class's share.
        cost_per_deg: reward that a degree of the saccade costs [1/°].
    """

    alpha: float | Tensor = 1.0
    by_time: float | Tensor = 0.0
    by_unseen: float | Tensor = 0.0
    improvement: float | Tensor = 0.0
    information: float | Tensor = 0.0
    doubt: float | Tensor = 0.0
    cost_per_deg: float | Tensor = 0.0

    def __post_init__(self) -> None:
        """Raise SettingError for numbers that are none, and a negative alpha."""
        for name, value in self.numbers.items():
            value = typed(value, "float", f"acquisition.{name}")
            if name == "alpha":
                require(value >= 0, "acquisition.alpha", value, "a number of at least 0, or inf")
            else:
                require(math.isfinite(value), f"acquisition.{name}", value, "a finite number")

    @property
    def numbers(self) -> dict[str, float]:
        """Those that are the same for all rows."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in named.items() if not isinstance(value, Tensor)}

    def counts(self, name: str) -> bool:
        """Whether a term has to be worked out: its weight is not 0 for all."""
        return isinstance(getattr(self, name), Tensor) or getattr(self, name) != 0

    def each(self, change: Callable[[Tensor], Tensor]) -> Weighting:
        """The same with every tensor changed, such as to the rows of an index."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: change(value) for name, value in named.items() if isinstance(value, Tensor)})


def joined(parts: Sequence[Weighting]) -> Weighting:
    """Weighting of several batches, alike in what is one number for all, as those of one batch."""
    first = parts[0]
    rows = [name for name in (field.name for field in fields(first)) if name not in first.numbers]
    return replace(first, **{name: torch.cat([getattr(part, name) for part in parts]) for name in rows})


class Terms(NamedTuple):
    """What a decision weighs; what has no weight may be None.

    Attributes:
        mean: of each cell's reward, (..., N).
        std: its standard deviation, (..., N).
        incumbent: the best mean among the seen eligible cells, (...).
        left: share of the saccades that are left, 1 at the first decision and 0 at the last: a number or (...).
        unseen: share of the eligible cells that no look has reached, (...).
        degrees: of the saccade to each cell, (..., N).
        information: expected of a fixation of each cell, averaged over the cells [nats], (..., N).
        doubt: standard deviation of the share of the class that is sought, (..., N).
    """

    mean: Tensor
    std: Tensor
    incumbent: Tensor
    left: float | Tensor = 0.5
    unseen: Tensor | None = None
    degrees: Tensor | None = None
    information: Tensor | None = None
    doubt: Tensor | None = None


def saccades_left(made: int, saccades: int) -> float:
    """Share of a search's decisions that are left after so many: 1 before the first, 0 at the last and beyond.

    Args:
        made: decisions so far.
        saccades: of the search, the initial gaze included.
    """
    return min(max(1 - made / max(saccades - 2, 1), 0.0), 1.0)


def weighted_alpha(weights: Weighting, left: float | Tensor, unseen: Tensor | None) -> float | Tensor:
    """α of a moment, see above; a number, or (...). Differentiable in what is a tensor."""
    exponent: float | Tensor = 0.0
    if weights.counts("by_time"):
        exponent = exponent + weights.by_time * (left - 0.5)
    if weights.counts("by_unseen"):
        require(unseen is not None, "unseen", None, "the share of the cells that is not seen, which by_unseen weighs")
        assert unseen is not None
        exponent = exponent + weights.by_unseen * (unseen - 0.5)
    if not isinstance(exponent, Tensor):
        return weights.alpha * math.exp(min(max(exponent, -_MOST), _MOST)) if exponent else weights.alpha
    return weights.alpha * exponent.clamp(-_MOST, _MOST).exp()


def weighted_score(weights: Weighting, terms: Terms) -> Tensor:
    """The score of every cell.

    Args:
        weights: of the terms.
        terms: what is weighed.

    Returns:
        (..., N), in the units of the reward. Differentiable in the weights and in all terms.

    Raises:
        SettingError: a weight on a term that is not there.
    """
    alpha = weighted_alpha(weights, terms.left, terms.unseen)
    total = upper_confidence_bound(terms.mean, terms.std, alpha)
    if weights.counts("improvement"):
        gain = expected_improvement(terms.mean, terms.std, terms.incumbent)
        total = total + _row(weights.improvement) * gain
    for name, term, sign in (
        ("information", terms.information, 1.0),
        ("doubt", terms.doubt, 1.0),
        ("cost_per_deg", terms.degrees, -1.0),
    ):
        if weights.counts(name):
            require(term is not None, f"acquisition.{name}", getattr(weights, name), "0, for it is not known here")
            assert term is not None
            total = total + sign * _row(getattr(weights, name)) * term
    return total


def _row(weight: float | Tensor) -> float | Tensor:
    return weight[..., None] if isinstance(weight, Tensor) else weight
