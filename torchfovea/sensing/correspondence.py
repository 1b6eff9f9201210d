"""Correspondences between the two retinas and how well each is known: the measurement of paper Eq. 6-7."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.retina import Retina
from torchfovea.setting import check_types, require

__all__ = [
    "Budget",
    "Clues",
    "Correspondences",
    "Disparity",
    "check_valid",
    "doubt",
    "edge_doubt",
    "eye_sigma_px",
    "inlier_share",
]


class Correspondences(NamedTuple):
    """Pairs of places that show the same point, one for every RF of the left eye; pixels of each eye's own camera.

    Attributes:
        left_px: (..., N, 2), the RF's centre.
        right_px: (..., N, 2); finite but meaningless where invalid.
        left_sigma_px: (..., N), standard deviation along each axis.
        right_sigma_px: (..., N).
        valid: bool (..., N).
        inlier: (..., N), probability that the two places show one point at all, by what the matcher knows of this pair;
            None: certain.
        support_px: (..., N), half the width that the left RF stands for [px]: its own, and more where only some of the
            RFs were looked through; None: its own, by the retina.
        lasting: (..., N), share of the variance that another look at the same surface repeats; None: the budget's.
        classes: (..., N, K), how likely what the RF shows is for each class of things; None: it tells nothing of that.
    """

    left_px: Tensor
    right_px: Tensor
    left_sigma_px: Tensor
    right_sigma_px: Tensor
    valid: Tensor
    inlier: Tensor | None = None
    support_px: Tensor | None = None
    lasting: Tensor | None = None
    classes: Tensor | None = None

    def take(self, index: int | Tensor) -> Correspondences:
        """Every part at an index of the first axis: some receptive fields (N,), or one row of a batch (B, N)."""
        left_px, right_px, left_sigma, right_sigma, valid = (part[index] for part in self[:5])
        more = (None if part is None else part[index] for part in self[5:])
        return Correspondences(left_px, right_px, left_sigma, right_sigma, valid, *more)

    def supported(self, retina: Retina) -> Tensor:
        """`support_px` (..., N), the RFs' own where it is not told."""
        return retina.width_px(self.left_px) / 2 if self.support_px is None else self.support_px


def check_valid(matches: Correspondences) -> None:
    """Raise SettingError for what are no correspondences, or say by numbers which are valid."""
    kind = type(matches).__name__
    require(isinstance(matches, Correspondences), "matches", kind, "torchfovea.Correspondences")
    require(matches.valid.dtype == torch.bool, "matches.valid.dtype", matches.valid.dtype, "torch.bool")


class Disparity(NamedTuple):
    """What the matcher saw and found, in the pixels of the left rectified view.

    Attributes:
        image: (H, W), the left view in grey, 0 to 1.
        disparity: (H, W) [px], x_left − x_right; 0 where invalid.
        valid: bool (H, W).
        camera: the left view's.
        doffs_px: disparity of a point at infinity, negated (cx_right − cx_left): depth = focal · baseline/(d + doffs).
        baseline_m: distance between the eyes.
        rival_px: (H, W), by how much another surface's disparity differs that claims the same place of the right view;
            0: none does; None: not asked.
        clues: of the readings at the receptive fields, (N,); None for a map that nobody read.
    """

    image: Tensor
    disparity: Tensor
    valid: Tensor
    camera: Pinhole
    doffs_px: float
    baseline_m: float
    rival_px: Tensor | None = None
    clues: Clues | None = None

    def depth_m(self) -> Tensor:
        """Depth along the view's axis (H, W) [m]; inf where invalid or not in front."""
        shift = self.disparity + self.doffs_px
        seen = self.valid & (shift > 0)
        depth = self.camera.focal_px * self.baseline_m / torch.where(seen, shift, torch.ones_like(shift))
        return torch.where(seen, depth, torch.full_like(depth, math.inf))


class Clues(NamedTuple):
    """What a matcher knows of how far each of its readings can be trusted, (..., N) in source px; detached.

    Every matcher tells the first two where it tells any (`torchfovea.stereo.confidence`); None: it does not know. Only
    meaningful where the correspondence is valid, finite everywhere.

    Attributes:
        bend_px: by how much the neighbourhood departs from a plane through the reading: a depth edge, a fine structure,
            noise. A slant does not count.
        gap_px: how far the neighbourhood reaches times the share of it that has no disparity.
        fringe_px: by how much the reading is nearer than its neighbourhood, the one-sided bend: along the rim of a near
            thing matchers report it a little beyond where it ends (foreground fattening).
        noise_px: the Cramér-Rao bound of the pair itself: the standard deviation of a disparity for what the two images
            differ by in its window, over the window's gradient energy. Weak texture widens it.
        mismatch: 1 less the correlation of the two windows, 0 to 2: the share of the contrast that the eyes do not
            share, whatever their exposures.
        hidden_px: by how much another surface's disparity differs that claims the place, or one within half a window of
            it, where the right eye would see the point; 0: none does. One of the two is hidden from the right eye.
    """

    bend_px: Tensor
    gap_px: Tensor
    fringe_px: Tensor | None = None
    noise_px: Tensor | None = None
    mismatch: Tensor | None = None
    hidden_px: Tensor | None = None

    def take(self, index: int | Tensor) -> Clues:
        """Every clue at an index of the first axis."""
        more = (None if clue is None else clue[index] for clue in self[2:])
        return Clues(self.bend_px[index], self.gap_px[index], *more)


@dataclass(frozen=True)
class Budget:
    """What limits a correspondence, as variances that add up, and how probably it is one at all.

    An error is N(0, σ²) with probability p; with 1 − p the match is anywhere on its line. Per eye and axis

        σ² = (s W)² + (s p)² + (m p)²,   m² = match_px² + (bend b)² + (gap g)² + (fringe f)² + (noise n)²,

    with s = `sigma_over_width`, W the RF's width, p the size of a source pixel on the retina (an RF cannot be sharper
    than its source), m the matcher's own error and b, g, f, n its `Clues` where it gives any. The odds of an outlier:

        (1 − p)/p = outliers/(1 − outliers) · (1 + g)^outliers_gap · (1 + h)^outliers_hidden · e^(outliers_mismatch c),

    with the clues h = hidden_px and c = mismatch. The paper has the first term only: `Budget.printed`. `torchfovea
    calibrate` fits the numbers (`torchfovea.studies.fitting`).

    Attributes:
        sigma_over_width: s; 1/6 lets three standard deviations span half a width.
        source_px: side of the source image across the retina [px]; None leaves out the terms with p.
        match_px: the matcher's error in each eye on a smooth surface [source px].
        bend: share of a reading's `Clues.bend_px` that is error; 0: not asked.
        gap: share of `Clues.gap_px`; 0: not asked.
        fringe: share of `Clues.fringe_px`; 0: not asked.
        noise: factor on `Clues.noise_px`, which the pair's own noise and texture bound; 0: not asked.
        claim: factor on the standard deviation that a matcher itself claims (the sweep's curve of costs, a foreign
            matcher's confidence).
        outliers: share of outliers where no clue speaks; 0: every correspondence is certain.
        outliers_gap: exponent of the odds.
        outliers_hidden: likewise.
        outliers_mismatch: rate of the odds' growth.
        shared: share of a match's variance that neighbouring fields of one look have in common, because they see the
            same pixels of the same surface; 0: independent, as in the paper. It fades with the fields' distance d as
            e^(−d/L), L = max(shared_px source pixels, shared_widths widths).
        shared_px: see `shared` [source px].
        shared_widths: see `shared` [widths of the receptive field].
        lasting: share of the variance that another look at the same patch of surface has in common with this one; 0:
            independent, as in the paper. Never more than `shared`. What edges and doubts make of it lasts wholly.
    """

    sigma_over_width: float = 1 / 6
    source_px: int | None = 400
    match_px: float = 0.15
    bend: float = 0.0
    gap: float = 0.0
    fringe: float = 0.0
    noise: float = 0.0
    claim: float = 1.0
    outliers: float = 0.0
    outliers_gap: float = 0.0
    outliers_hidden: float = 0.0
    outliers_mismatch: float = 0.0
    shared: float = 0.0
    shared_px: float = 4.0
    shared_widths: float = 2.0
    lasting: float = 0.0

    printed: ClassVar[Budget]

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        check_types(self, "budget.")
        require(
            1e-9 <= self.sigma_over_width <= 1e6,
            "budget.sigma_over_width",
            self.sigma_over_width,
            "a positive number, 1e-9 to 1e6",
        )
        require(
            self.source_px is None or self.source_px > 0, "sensor.source_px", self.source_px, "a positive number of px"
        )
        for field in fields(self):
            if field.name not in ("sigma_over_width", "source_px"):
                value = getattr(self, field.name)
                require(0 <= value <= 1e6, f"budget.{field.name}", value, "0 to 1e6")
        for name in ("outliers", "shared"):
            require(getattr(self, name) < 1, f"budget.{name}", getattr(self, name), "a share, less than 1")
        least = f"0 or more and not above budget.shared = {self.shared:g}"
        require(self.lasting <= self.shared, "budget.lasting", self.lasting, least)


Budget.printed = Budget(source_px=None, match_px=0.0)


def eye_sigma_px(budget: Budget, retina: Retina, px: Tensor, clues: Clues | None = None) -> Tensor:
    """Standard deviation along each axis of a correspondence at places of one retina.

    Args:
        budget: the terms.
        retina: the layout.
        px: (..., 2), places [retinal px].
        clues: of each correspondence (...); None: none.

    Returns:
        (...) [retinal px]. Differentiable.
    """
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    square = (budget.sigma_over_width * retina.width_px(px)).square()
    square = square + (budget.sigma_over_width**2 + budget.match_px**2) * source**2
    if clues is not None and source > 0:
        square = square + doubt(budget, clues) * source**2
    return square.sqrt()


def doubt(budget: Budget, clues: Clues) -> Tensor:
    """The variance that the clues (...) add in each eye [source px²]. Differentiable."""
    return _square_of(
        (
            (budget.bend, clues.bend_px),
            (budget.gap, clues.gap_px),
            (budget.fringe, clues.fringe_px),
            (budget.noise, clues.noise_px),
        )
    )


def edge_doubt(budget: Budget, clues: Clues) -> Tensor:
    """The part of `doubt` that tells of depth edges: bends, holes and rims (...) [source px²]. Differentiable."""
    return _square_of(((budget.bend, clues.bend_px), (budget.gap, clues.gap_px), (budget.fringe, clues.fringe_px)))


def _square_of(parts: Sequence[tuple[float, Tensor | None]]) -> Tensor:
    """Sum of squares of factors times clues, where there are any; the first is."""
    squares = [(factor * clue).square() for factor, clue in parts if clue is not None]
    return torch.stack(squares).sum(0)


def inlier_share(budget: Budget, clues: Clues) -> Tensor:
    """Probability that a correspondence shows one point at all, by its clues (...); 1 where `outliers` is 0.

    Differentiable.
    """
    odds = budget.outliers / (1 - budget.outliers) * (1 + clues.gap_px) ** budget.outliers_gap
    if clues.hidden_px is not None:
        odds = odds * (1 + clues.hidden_px) ** budget.outliers_hidden
    if clues.mismatch is not None:
        odds = odds * (budget.outliers_mismatch * clues.mismatch).exp()
    return 1 / (1 + odds)
