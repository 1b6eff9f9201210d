"""Is the claimed uncertainty true? Observations whose truth is known, and the judgement of σ and inlier probability.

The truth lies on the left receptive field's own ray, which leaves one degree of freedom to err in, the inverse range ρ
from the left eye: z = (ρ̂ − ρ)/σ_ρ. To first order (nearly exact in inverse range)

    σ_ρ² = |∂ρ/∂l|² σ_l² + |∂ρ/∂r|² σ_r²

with the budget's variances σ_l², σ_r² of the places l, r in both retinas, so that the budget's few numbers can be
fitted by gradient (`torchfovea.studies.fitting`). An error is taken for N(0, σ²) with the budget's inlier probability
p; with 1 − p the right place is anywhere on its line across the right retina. Figures come by field and by area: a
log-polar retina has most of its fields in a disc of a few pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.metrics import ause, gaussian_nll, weighted_mean, weighted_median
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, doubt, eye_sigma_px, inlier_share
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require

__all__ = [
    "LEVELS", "Judged", "concatenate", "inlier_of", "judge", "judged", "mixture_nll", "mixture_std", "reliability",
    "select", "sigma_of",
]  # fmt: skip

LEVELS = (0.5, 0.9, 0.95, 0.99)
OUTLIER = 5.0  # standard deviations


class Judged(NamedTuple):
    """Observations with truth, (N,) each.

    Attributes:
        error: estimated less true inverse range from the left eye [1/m].
        left_gain: |∂ρ/∂l| of the left place [1/m per retinal px].
        right_gain: |∂ρ/∂r| of the right place.
        line: inverse ranges that a line across the right retina spans there, where an outlier may fall [1/m].
        left_width_px: width of the receptive field there [retinal px]; its square is the area it stands for.
        right_width_px: width where the right eye sees the point.
        pixel_px: size of a source pixel on the retina [retinal px].
        bend_px: see `Clues` [source px]; 0 where the matcher does not know, as the clues that follow.
        gap_px: see `Clues` [source px].
        fringe_px: see `Clues` [source px].
        noise_px: see `Clues` [source px].
        mismatch: see `Clues`.
        hidden_px: see `Clues` [source px].
        claim_px: standard deviation that the matcher itself claims, in the right eye [retinal px].
        range_m: true distance from the left eye.
        eccentricity_rad: of the left receptive field.
        place_px: where the left receptive field lies, its two columns: (N, 2) [source px from the axis].
        region: what it looks at, an index of `torchfovea.commands.shared.regions.REGIONS`; 0 where nobody asked.
    """

    error: Tensor
    left_gain: Tensor
    right_gain: Tensor
    line: Tensor
    left_width_px: Tensor
    right_width_px: Tensor
    pixel_px: Tensor
    bend_px: Tensor
    gap_px: Tensor
    fringe_px: Tensor
    noise_px: Tensor
    mismatch: Tensor
    hidden_px: Tensor
    claim_px: Tensor
    range_m: Tensor
    eccentricity_rad: Tensor
    place_px: Tensor
    region: Tensor

    def clues(self) -> Clues:
        """As the budget's formulas take them."""
        return Clues(*(getattr(self, name) for name in Clues._fields))

    def area(self) -> Tensor:
        """What each receptive field stands for on the retina, (N,) [retinal px²]."""
        return self.left_width_px.square()


def judged(
    matches: Correspondences,
    eyes: Eyes,
    camera: Camera | tuple[Camera, Camera],
    retina: Retina,
    budget: Budget,
    inverse_range: Tensor,
    clues: Clues | None = None,
    points: SigmaPoints | None = None,
    region: Tensor | None = None,
) -> tuple[Judged, Tensor]:
    """Compare correspondences with the truth along the left receptive fields' rays.

    Args:
        matches: (N, ...).
        eyes: the cameras' poses, in any frame.
        camera: of both eyes, or the left one's and the right one's, in retinal pixels.
        retina: of both eyes.
        budget: which the matches were made with.
        inverse_range: the truth, (N,), from the left eye [1/m]; not finite, or 0, where unknown.
        clues: (N,), where there are any.
        points: sigma points.
        region: (N,), what each looks at.

    Returns:
        Those that are valid and whose truth is known, perhaps none; and which they are, bool (N,).
    """
    dtype = matches.left_px.dtype
    shift = (eyes.t_right - eyes.t_left).to(dtype)
    pose = Eyes(eyes.R_left.to(dtype), torch.zeros_like(shift), eyes.R_right.to(dtype), shift)
    left, right = (px.detach().clone().requires_grad_() for px in (matches.left_px, matches.right_px))
    width = retina.width_px(matches.left_px)
    with torch.enable_grad():
        observed = observe(matches._replace(left_px=left, right_px=right), pose, camera, width / 2, points)
        rho = observed.mean[..., 2]
        slopes = torch.autograd.grad(rho.sum(), (left, right))
    truth = inverse_range.to(rho)
    known = observed.valid & torch.isfinite(truth) & (truth > 0)
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    own = matches.right_sigma_px.square() - eye_sigma_px(budget, retina, matches.right_px, clues).square()
    none = torch.zeros_like(width)
    eye = camera[0] if isinstance(camera, tuple) else camera
    ray = eye.rays(matches.left_px)
    axis = eye.rays(torch.zeros_like(matches.left_px[:1])).expand_as(ray)
    # rounding leaves crumbs of the difference of squares
    claim = torch.where(own > 1e-4 * matches.right_sigma_px.square(), own, none).sqrt() / max(budget.claim, 1e-6)
    told = [none if clue is None else clue.to(width) for clue in clues or Clues(none, none)]
    right_gain = torch.linalg.vector_norm(slopes[1], dim=-1)
    everything = Judged(
        rho.detach() - truth,
        torch.linalg.vector_norm(slopes[0], dim=-1),
        right_gain,
        2 * retina.radius_px * right_gain,
        width,
        retina.width_px(matches.right_px),
        torch.full_like(width, source),
        told[0],
        told[1],
        told[2],
        told[3],
        told[4],
        told[5],
        claim,
        1 / torch.where(known, truth, torch.ones_like(truth)),
        torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(ray, axis), dim=-1), (ray * axis).sum(-1)),
        matches.left_px / max(source, 1e-12),
        torch.zeros_like(known, dtype=torch.int64) if region is None else region,
    )
    return select(everything, known), known


def select(data: Judged, mask: Tensor) -> Judged:
    """Some of the observations, by a mask or by indices."""
    return Judged(*(column[mask] for column in data))


def concatenate(parts: Sequence[Judged]) -> Judged:
    """Several sets as one."""
    return Judged(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def sigma_of(data: Judged, budget: Budget) -> Tensor:
    """Standard deviation of inverse range that a budget claims for inliers, (N,) [1/m].

    A budget without `source_px` leaves out the source's and the matcher's terms; otherwise the size of a source pixel
    is the data's own. Differentiable in the observations.
    """
    both = torch.zeros_like(data.error)
    if budget.source_px is not None:
        both = budget.sigma_over_width**2 + budget.match_px**2 + doubt(budget, data.clues())
        both = both * data.pixel_px.square()
    left = (budget.sigma_over_width * data.left_width_px).square() + both
    right = (budget.sigma_over_width * data.right_width_px).square() + both + (budget.claim * data.claim_px).square()
    return (data.left_gain.square() * left + data.right_gain.square() * right).sqrt()


def inlier_of(data: Judged, budget: Budget) -> Tensor:
    """Inlier probability that a budget claims, (N,). Differentiable in the observations."""
    return inlier_share(budget, data.clues())


def mixture_nll(error: Tensor, variance: Tensor, inlier: Tensor, line: Tensor) -> Tensor:
    """Negative log-likelihood of p N(0, σ²) + (1 − p)/line [nats], elementwise.

    Args:
        error: of inverse range [1/m].
        variance: σ², positive.
        inlier: p in (0, 1].
        line: the inverse ranges that outliers fall on, see `Judged`.

    Returns:
        Like `error`. Differentiable.
    """
    sure = inlier >= 1
    outlier = torch.log1p(-torch.where(sure, 0.5, inlier)).masked_fill(sure, -math.inf) - torch.log(line)
    return -torch.logaddexp(torch.log(inlier) - gaussian_nll(error, variance), outlier)


def judge(data: Judged, sigma: Tensor, inlier: Tensor | None = None, weight: Tensor | None = None) -> dict[str, float]:
    """How honest standard deviations and inlier probabilities are, in inverse range, and how sharp.

    Args:
        data: observations with truth.
        sigma: claimed, (N,) [1/m].
        inlier: claimed, (N,); None: certain.
        weight: of each, (N,), such as `Judged.area`; None: all alike.

    Returns:
        Of everything: nees_mean (of |z| ≤ 5), outlier_share (of |z| > 5), coverage_50, _90, _95, _99, nll (of N(0, σ²),
        outliers included) [nats], ause (never weighted), and interval_over_error: the median 1.96 σ over the median
        |error|, both as ranges; a Gaussian's is 2.9. Observations at or beyond infinity have no range, and count in the
        others. Of those with an inlier probability above 1/2: inlier_share, how many these are, and
        inlier_coverage_50 and _95. And of the mixture: inlier_mean, the mean probability, and mixture_nll.

    Raises:
        SettingError: for no observations.
    """
    require(data.error.numel() > 0, "observations with truth", 0, "at least one that is valid")
    error, sigma = data.error.double(), sigma.double()
    p = torch.ones_like(error) if inlier is None else inlier.double()
    w = torch.ones_like(error) if weight is None else weight.double()
    z = (error / sigma).abs()
    inside = {level: z <= math.sqrt(2) * float(torch.erfinv(torch.tensor(level).double())) for level in LEVELS}
    true = 1 / data.range_m.double()
    estimate = true + error
    near = estimate > 0
    estimate = torch.where(near, estimate, torch.ones_like(estimate))
    miss, width = (error / (estimate * true)).abs()[near], (1.96 * sigma / estimate.square())[near]
    core, likely = w * (z <= OUTLIER), w * (p > 0.5)
    ratio = weighted_median(width, w[near]) / weighted_median(miss, w[near]) if bool(near.any()) else math.nan
    return {
        "nees_mean": weighted_mean(z.square(), core),
        **{f"coverage_{round(100 * level)}": weighted_mean(hit, w) for level, hit in inside.items()},
        "nll": weighted_mean(gaussian_nll(error, sigma.square()), w),
        "outlier_share": weighted_mean(z > OUTLIER, w),
        "ause": float(ause(error, sigma)),
        "interval_over_error": ratio,
        "inlier_share": weighted_mean(p > 0.5, w),
        "inlier_coverage_50": weighted_mean(inside[0.5], likely),
        "inlier_coverage_95": weighted_mean(inside[0.95], likely),
        "inlier_mean": weighted_mean(p, w),
        "mixture_nll": weighted_mean(mixture_nll(error, sigma.square(), p, data.line.double()), w),
    }


def reliability(
    data: Judged, sigma: Tensor, inlier: Tensor, edges: Sequence[float], weight: Tensor | None = None
) -> list[tuple[float, float, int, float, float]]:
    """Are the inlier probabilities true? A table by claimed probability.

    Which observation is an outlier nobody knows; the share of |z| > 3 tells how many are, for a Gaussian leaves .3%
    there.

    Args:
        data: observations with truth.
        sigma: claimed, (N,).
        inlier: claimed, (N,).
        edges: bounds of the rows, ascending from 0 to 1.
        weight: of each, (N,); None: all alike.

    Returns:
        Rows (from, to, observations, mean claimed probability, share within 3σ), those without observations left out.
    """
    w = torch.ones_like(sigma) if weight is None else weight
    near, rows = (data.error / sigma).abs() <= 3, []
    for low, high in pairwise(edges):
        row = (inlier > low) & (inlier <= high)
        if bool(row.any()):
            some = w * row
            rows.append((low, high, int(row.sum()), weighted_mean(inlier, some), weighted_mean(near, some)))
    return rows


def mixture_std(sigma: Tensor, inlier: Tensor, spread: Tensor) -> Tensor:
    """Standard deviation of the Gaussian that has a mixture's 95% interval: one number for who asks for one.

    Of p N(0, σ²) + (1 − p) N(0, σ² + S²): with probability 1 − p the error is another surface's distance.

    Args:
        sigma: of inliers, (N,).
        inlier: p, (N,).
        spread: S, how far surfaces lie apart, broadcastable to (N,).

    Returns:
        (N,), from σ where p = 1 to √(σ² + S²) where p = 0. Not differentiable.
    """
    wide, root = (sigma.square() + spread.square()).sqrt(), math.sqrt(2)
    end = root * float(torch.erfinv(torch.tensor(0.95, dtype=torch.float64)))
    low, high = sigma.detach().double(), wide.detach().double()
    for _ in range(50):
        middle = (low + high) / 2
        within, beyond = (torch.erf(end * middle / (root * width)) for width in (sigma, wide))
        inside = inlier * within + (1 - inlier) * beyond
        low, high = torch.where(inside < 0.95, middle, low), torch.where(inside < 0.95, high, middle)
    return ((low + high) / 2).to(sigma)
