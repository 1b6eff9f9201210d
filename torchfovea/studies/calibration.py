"""Is the claimed uncertainty true? Judging it on observations whose truth is known, and fitting the error budget.

The truth lies on the left receptive field's own ray, which leaves one degree of freedom to err in, the inverse range ρ
from the left eye: z = (ρ̂ − ρ)/σ_ρ. To first order (nearly exact in inverse range)

    σ_ρ² = |∂ρ/∂l|² σ_l² + |∂ρ/∂r|² σ_r²

with the budget's variances σ_l², σ_r² of the places l, r in both retinas, so that the budget's few numbers can be
fitted by gradient. Matching errs with heavy tails; the likelihood is a mixture, (1 − ε) N(0, σ²) + ε N(0, (κσ)²), whose
wide part takes the outliers, so that they do not blow up the σ of all others. σ is what the budget reports.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.metrics import ause, coverage, gaussian_nll, nees_mean, outlier_share
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, eye_sigma_px
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require

__all__ = [
    "LEVELS", "BudgetFit", "Judged", "Likelihood", "concatenate", "fit_budget", "judge", "judged", "mixture_nll",
    "select", "sigma_of",
]  # fmt: skip

LEVELS = (0.5, 0.9, 0.95, 0.99)
PARAMETERS = ("sigma_over_width", "match_px", "bend", "gap", "claim")


class Judged(NamedTuple):
    """Observations with truth, (N,) each.

    Attributes:
        error: estimated less true inverse range from the left eye [1/m].
        left_gain: |∂ρ/∂l| of the left place [1/m per retinal px].
        right_gain: |∂ρ/∂r| of the right place.
        left_width_px: width of the receptive field there [retinal px].
        right_width_px: width where the right eye sees the point.
        pixel_px: size of a source pixel on the retina [retinal px].
        bend_px: see `Clues` [source px].
        gap_px: see `Clues` [source px].
        claim_px: standard deviation that the matcher itself claims, in the right eye [retinal px].
        range_m: true distance from the left eye.
        eccentricity_rad: of the left receptive field.
    """

    error: Tensor
    left_gain: Tensor
    right_gain: Tensor
    left_width_px: Tensor
    right_width_px: Tensor
    pixel_px: Tensor
    bend_px: Tensor
    gap_px: Tensor
    claim_px: Tensor
    range_m: Tensor
    eccentricity_rad: Tensor


@dataclass(frozen=True)
class Likelihood:
    """How errors are taken to fall.

    Attributes:
        outlier_share: ε, where the fit starts; fixed where `fit_outliers` is false.
        inflation: κ, how many times wider outliers fall.
        fit_outliers: fit ε too. A free ε lets the fit call more of the tail outliers, which narrows σ.
    """

    outlier_share: float = 0.02
    inflation: float = 10.0
    fit_outliers: bool = False

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        require(0 < self.outlier_share < 0.5, "fit.outlier_share", self.outlier_share, "between 0 and 0.5")
        require(1 < self.inflation < math.inf, "fit.inflation", self.inflation, "more than 1")


class BudgetFit(NamedTuple):
    """What a fit found.

    Attributes:
        budget: the fitted one.
        outlier_share: ε.
        loss: mean negative log-likelihood of the sets, at the end [nats].
        first_loss: where the fit began.
    """

    budget: Budget
    outlier_share: float
    loss: float
    first_loss: float


def judged(
    matches: Correspondences,
    eyes: Eyes,
    camera: Camera,
    retina: Retina,
    budget: Budget,
    inverse_range: Tensor,
    clues: Clues | None = None,
    right_camera: Camera | None = None,
    points: SigmaPoints | None = None,
) -> tuple[Judged, Tensor]:
    """Compare correspondences with the truth along the left receptive fields' rays.

    Args:
        matches: (N, ...).
        eyes: the cameras' poses, in any frame.
        camera: of both eyes or the left one, in retinal pixels.
        retina: of both eyes.
        budget: which the matches were made with.
        inverse_range: the truth, (N,), from the left eye [1/m]; not finite, or 0, where unknown.
        clues: (N,), where there are any.
        right_camera: where the right eye has another.
        points: sigma points.

    Returns:
        Those that are valid and whose truth is known, perhaps none; and which they are, bool (N,).
    """
    dtype = matches.left_px.dtype
    shift = (eyes.t_right - eyes.t_left).to(dtype)
    pose = Eyes(eyes.R_left.to(dtype), torch.zeros_like(shift), eyes.R_right.to(dtype), shift)
    left, right = (px.detach().clone().requires_grad_() for px in (matches.left_px, matches.right_px))
    width = retina.width_px(matches.left_px)
    with torch.enable_grad():
        observed = observe(
            matches._replace(left_px=left, right_px=right), pose, camera, width / 2, points, right_camera=right_camera
        )
        rho = observed.mean[..., 2]
        slopes = torch.autograd.grad(rho.sum(), (left, right))
    truth = inverse_range.to(rho)
    known = observed.valid & torch.isfinite(truth) & (truth > 0)
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    own = matches.right_sigma_px.square() - eye_sigma_px(budget, retina, matches.right_px, clues).square()
    none = torch.zeros_like(width)
    ray = camera.rays(matches.left_px)
    axis = camera.rays(torch.zeros_like(matches.left_px[:1])).expand_as(ray)
    # rounding leaves crumbs of the difference of squares
    claim = torch.where(own > 1e-4 * matches.right_sigma_px.square(), own, none).sqrt() / max(budget.claim, 1e-6)
    everything = Judged(
        rho.detach() - truth,
        torch.linalg.vector_norm(slopes[0], dim=-1),
        torch.linalg.vector_norm(slopes[1], dim=-1),
        width,
        retina.width_px(matches.right_px),
        torch.full_like(width, source),
        none if clues is None else clues.bend_px.to(width),
        none if clues is None else clues.gap_px.to(width),
        claim,
        1 / torch.where(known, truth, torch.ones_like(truth)),
        torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(ray, axis), dim=-1), (ray * axis).sum(-1)),
    )
    return select(everything, known), known


def select(data: Judged, mask: Tensor) -> Judged:
    """Some of the observations, by a mask or by indices."""
    return Judged(*(column[mask] for column in data))


def concatenate(parts: Sequence[Judged]) -> Judged:
    """Several sets as one."""
    return Judged(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def sigma_of(data: Judged, budget: Budget) -> Tensor:
    """Standard deviation of inverse range that a budget claims, (N,) [1/m].

    A budget without `source_px` leaves out the source's and the matcher's terms; otherwise the size of a source pixel
    is the data's own. Differentiable in the observations.
    """
    square = data.left_width_px.new_tensor([getattr(budget, name) for name in PARAMETERS]).square()
    return _variance(data, square, budget.source_px is not None).sqrt()


def _variance(data: Judged, square: Tensor, source: bool) -> Tensor:
    """From the parameters' squares, in the order of PARAMETERS."""
    width, match, bend, gap, claim = square.unbind(-1)
    both = torch.zeros_like(data.error)
    if source:
        both = width + match + bend * data.bend_px.square() + gap * data.gap_px.square()
        both = both * data.pixel_px.square()
    left = width * data.left_width_px.square() + both
    right = width * data.right_width_px.square() + both + claim * data.claim_px.square()
    return data.left_gain.square() * left + data.right_gain.square() * right


def mixture_nll(error: Tensor, variance: Tensor, outlier_share: Tensor, inflation: float) -> Tensor:
    """Negative log-likelihood of (1 − ε) N(0, σ²) + ε N(0, κ²σ²) [nats], elementwise. Differentiable."""
    inlier = torch.log1p(-outlier_share) - gaussian_nll(error, variance)
    outlier = torch.log(outlier_share) - gaussian_nll(error, inflation**2 * variance)
    return -torch.logaddexp(inlier, outlier)


def fit_budget(
    sets: Sequence[Judged], start: Budget | None = None, likelihood: Likelihood | None = None, steps: int = 80
) -> BudgetFit:
    """Fit the budget's numbers to observations with truth, by gradient (L-BFGS on their logarithms).

    Args:
        sets: observations; each set weighs the same however large it is.
        start: whose `source_px` is kept. Numbers of terms that no observation has (clues, a claim) stay as they are.
        likelihood: how errors fall.
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
    sets = [Judged(*(column.detach().double() for column in data)) for data in sets]
    present = [True, True] + [
        any(bool((getattr(data, name) > 0).any()) for data in sets) for name in ("bend_px", "gap_px", "claim_px")
    ]
    # not from `start`: a share of 0 has no logarithm, and from small ones every edge may end up an outlier
    guess = torch.tensor([0.15, 0.15, 0.4, 0.4, 1.0], dtype=torch.float64).log()
    kept = torch.tensor([getattr(start, name) for name in PARAMETERS], dtype=torch.float64).clamp(min=1e-12).log()
    free = torch.tensor(present)
    raw = torch.cat([guess, torch.tensor([_logit(likelihood.outlier_share)], dtype=torch.float64)]).requires_grad_()
    optimizer = torch.optim.LBFGS([raw], max_iter=steps, line_search_fn="strong_wolfe", tolerance_change=1e-9)
    losses: list[float] = []

    def loss() -> Tensor:
        square = (2 * torch.where(free, raw[:-1], kept)).exp()
        share = torch.sigmoid(raw[-1] if likelihood.fit_outliers else raw[-1].detach())
        terms = [
            mixture_nll(data.error, _variance(data, square, True), share, likelihood.inflation).mean() for data in sets
        ]
        # a parameter that the data leave open stays near its guess
        return torch.stack(terms).mean() + 1e-4 * (raw[:-1] - guess).square().sum()

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss()
        value.backward()
        losses.append(value.item())
        return value

    optimizer.step(closure)
    with torch.no_grad():
        last = loss().item()
        numbers = torch.where(free, raw[:-1], kept).exp().tolist()
        share = torch.sigmoid(raw[-1]).item()
    fitted = {name: v for name, v, there in zip(PARAMETERS, numbers, present, strict=True) if there}
    return BudgetFit(replace(start, **fitted), share, last, losses[0])


def _logit(share: float) -> float:
    return math.log(share / (1 - share))


def judge(data: Judged, sigma: Tensor) -> dict[str, float]:
    """How honest standard deviations are, in inverse range, and how sharp.

    Args:
        data: observations with truth.
        sigma: claimed, (N,) [1/m].

    Returns:
        nees_mean (of |z| ≤ 5), outlier_share (of |z| > 5), coverage_50, _90, _95, _99, nll (of N(0, σ²), outliers
        included) [nats], ause, and interval_over_error: the median 1.96 σ over the median |error|, both as ranges; a
        Gaussian's is 2.9. Observations at or beyond infinity have no range, and count in the others.

    Raises:
        SettingError: for no observations.
    """
    require(data.error.numel() > 0, "observations with truth", 0, "at least one that is valid")
    error, sigma = data.error.double(), sigma.double()
    z = error / sigma
    shares = coverage(z, LEVELS)
    true = 1 / data.range_m.double()
    estimate = true + error
    near = estimate > 0
    estimate = torch.where(near, estimate, torch.ones_like(estimate))
    miss, width = (error / (estimate * true)).abs()[near], (1.96 * sigma / estimate.square())[near]
    return {
        "nees_mean": float(nees_mean(z)),
        **{f"coverage_{round(100 * level)}": float(share) for level, share in zip(LEVELS, shares, strict=True)},
        "nll": float(gaussian_nll(error, sigma.square()).mean()),
        "outlier_share": float(outlier_share(z)),
        "ause": float(ause(error, sigma)),
        "interval_over_error": float(width.median() / miss.median()) if bool(near.any()) else math.nan,
    }
