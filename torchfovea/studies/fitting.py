"""Fitting the error budget to observations with truth: one likelihood for σ and the inlier probability.

An error of inverse range is N(0, σ²) with probability p; with 1 − p the match is anywhere on its line. σ² is the
budget's sum of variances and the odds (1 − p)/p its product of clues (`torchfovea.sensing.correspondence.Budget`); both
are fitted together by maximum likelihood, every observation weighted by the area that it stands for and every scene
alike. A truth that comes in steps cannot show an error below its step: the matcher's own is not fitted below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.stats import spearmanr
from torch import Tensor

from torchfovea.sensing.correspondence import Budget
from torchfovea.setting import check_types, require
from torchfovea.studies.calibration import Judged, mixture_nll, select

__all__ = ["BudgetFit", "Likelihood", "claim_rank", "fit_budget", "least_match_px"]

# where the fit starts, and where what the data leave open stays
SPREAD = {
    "sigma_over_width": 0.15, "match_px": 0.15, "bend": 0.4, "gap": 0.4, "fringe": 0.4, "noise": 0.8, "claim": 1.0,
}  # fmt: skip
POWERS = {"outliers_gap": 0.3, "outliers_hidden": 0.3, "outliers_mismatch": 0.3}
CLUES = {
    "bend": "bend_px", "gap": "gap_px", "fringe": "fringe_px", "noise": "noise_px", "claim": "claim_px",
    "outliers_gap": "gap_px", "outliers_hidden": "hidden_px", "outliers_mismatch": "mismatch",
}  # fmt: skip
DRAWN = 6000  # observations of a scene, drawn by their area
STAY = 1e-4  # pull toward the start, nats for a factor of e


@dataclass(frozen=True)
class Likelihood:
    """How errors are taken to fall.

    Attributes:
        outlier_share: share of outliers where no clue speaks: where the fit starts.
        fit_outliers: fit the shares too; otherwise every outlier is left to σ but the share it starts with.
    """

    outlier_share: float = 0.02
    fit_outliers: bool = True

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        check_types(self, "fit.")
        require(0 < self.outlier_share < 0.5, "fit.outlier_share", self.outlier_share, "between 0 and 0.5")


class BudgetFit(NamedTuple):
    """What a fit found.

    Attributes:
        budget: the fitted one.
        loss: mean negative log-likelihood of the sets, at the end [nats].
        first_loss: where the fit began.
    """

    budget: Budget
    loss: float
    first_loss: float


def least_match_px(step_px: float) -> float:
    """The matcher's error in each eye that a truth in steps [source px] cannot tell from none: step/√12 over both."""
    return step_px / math.sqrt(24)


def claim_rank(sets: Sequence[Judged]) -> tuple[float, float]:
    """Whether errors are large where the matcher claims that they are.

    Args:
        sets: observations; an error is counted in retinal pixels of the right eye.

    Returns:
        Spearman's rank correlation of the claimed standard deviation with the error's size, and the probability of one
        as far from 0 by chance; NaN for claims that are all alike.
    """
    claim, error = (
        torch.cat(parts).double().cpu().numpy()
        for parts in zip(*((data.claim_px, (data.error / data.right_gain).abs()) for data in sets), strict=True)
    )
    if np.ptp(claim) == 0:
        return math.nan, math.nan
    found = spearmanr(claim, error)
    return float(found.statistic), float(found.pvalue)


def fit_budget(
    sets: Sequence[Judged],
    start: Budget | None = None,
    likelihood: Likelihood | None = None,
    least_match: float = 0.0,
    steps: int = 100,
) -> BudgetFit:
    """Fit the budget's numbers to observations with truth, by gradient (L-BFGS on their logarithms).

    Args:
        sets: observations; each set weighs the same however large it is, and in it every area.
        start: whose `source_px`, `shared` and `lasting` are kept. Numbers of terms that no observation has (clues, a
            claim) stay as they are.
        likelihood: how errors fall.
        least_match: the matcher's error that the sets' truths cannot tell from none (`least_match_px`); the fitted
            `match_px` is never below.
        steps: of L-BFGS.

    Raises:
        SettingError: for a set of fewer than 100 observations, or a budget without `source_px`.
    """
    start, likelihood = start or Budget(), likelihood or Likelihood()
    require(start.source_px is not None, "budget.source", False, "true: the printed budget has nothing to fit")
    require(len(sets) > 0, "sets", 0, "at least one set of observations")
    for data in sets:
        count = data.error.numel()
        require(count >= 100, "observations with truth", count, "at least 100 valid ones to fit a budget")
    sets = [_drawn(data) for data in sets]
    names = [*SPREAD, *POWERS]
    free = torch.tensor(
        [n not in CLUES or any(bool((getattr(data, CLUES[n]) > 0).any()) for data in sets) for n in names]
    )
    free[len(SPREAD) :] &= likelihood.fit_outliers
    # not from `start`: a share of 0 has no logarithm, and from small ones every edge may end up an outlier
    guess = torch.tensor([*SPREAD.values(), *POWERS.values()], dtype=torch.float64).log()
    kept = torch.tensor([getattr(start, name) for name in names], dtype=torch.float64)
    odds = torch.tensor([_logit(likelihood.outlier_share)], dtype=torch.float64)
    raw = torch.cat([guess, odds]).requires_grad_()
    optimizer = torch.optim.LBFGS([raw], max_iter=steps, line_search_fn="strong_wolfe", tolerance_change=1e-9)
    losses: list[float] = []

    def loss() -> Tensor:
        numbers = dict(zip(names, torch.where(free, raw[:-1].exp(), kept), strict=True))
        base = raw[-1] if likelihood.fit_outliers else raw[-1].detach()
        terms = [
            mixture_nll(
                data.error, _variance(data, numbers, least_match), torch.sigmoid(-_odds(data, numbers, base)),
                data.line,
            ).mean()
            for data in sets
        ]  # fmt: skip
        return torch.stack(terms).mean() + STAY * (raw - torch.cat([guess, odds])).square().sum()

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss()
        value.backward()
        losses.append(value.item())
        return value

    optimizer.step(closure)
    with torch.no_grad():
        last = loss().item()
        numbers = raw[:-1].exp().tolist()
        share = torch.sigmoid(raw[-1]).item()
    fitted = {name: v for name, v, there in zip(names, numbers, free.tolist(), strict=True) if there}
    fitted["match_px"] = math.hypot(fitted["match_px"], least_match)
    return BudgetFit(replace(start, outliers=share, **fitted), last, losses[0])


def _logit(share: float) -> float:
    return math.log(share / (1 - share))


def _drawn(data: Judged) -> Judged:
    """As many as the fit needs, drawn by area, so that all weigh alike; always the same."""
    generator = torch.Generator(data.error.device).manual_seed(0)
    chosen = torch.multinomial(data.area().double(), DRAWN, replacement=True, generator=generator)
    return Judged(*(c.detach().double() if c.is_floating_point() else c for c in select(data, chosen)))


def _variance(data: Judged, number: dict[str, Tensor], least_match: float) -> Tensor:
    """As `calibration.sigma_of`, of numbers that are being fitted."""
    square = {name: number[name].square() for name in SPREAD}
    both = square["sigma_over_width"] + square["match_px"] + least_match**2
    for name in ("bend", "gap", "fringe", "noise"):
        both = both + square[name] * getattr(data, CLUES[name]).square()
    both = both * data.pixel_px.square()
    left = square["sigma_over_width"] * data.left_width_px.square() + both
    right = square["sigma_over_width"] * data.right_width_px.square() + both
    right = right + square["claim"] * data.claim_px.square()
    return data.left_gain.square() * left + data.right_gain.square() * right


def _odds(data: Judged, number: dict[str, Tensor], base: Tensor) -> Tensor:
    """The logarithm of the odds of an outlier, as `correspondence.inlier_share` has it."""
    odds = base + number["outliers_mismatch"] * data.mismatch
    for name in ("gap", "hidden"):
        odds = odds + number[f"outliers_{name}"] * torch.log1p(getattr(data, CLUES[f"outliers_{name}"]))
    return odds
