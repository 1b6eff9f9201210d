"""What errors have in common: neighbouring fields of one look, and two looks at one patch of surface.

Matches err together. Fields that see the same pixels of the same surface share their error, and what texture and
surface do to a matcher they do again at the next look. Both shares are correlations of z = error/σ, measured where the
truth is known; gross errors are cut off, so that they do not decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Budget
from torchfovea.studies.calibration import Judged, sigma_of

__all__ = ["KnownLook", "lasting_share_of", "shared_share"]

CUT = 5.0  # larger |z| count as this, as in `torchfovea.metrics.nees_mean`
GROSS = 3.0  # and beyond this an error tells nothing of what neighbours share: votes and inlier probabilities see to it
SAME_RANGE = 0.03  # relative difference of two places on one surface
ASKED = 1500  # fields of a look whose neighbours are asked
LEAST_PAIRS = 100  # fewer tell nothing
LENGTHS = 1.0  # correlation lengths of the budget within which fields are neighbours
FACTORS = (0.2, 0.3, 0.45, 0.7, 1.0, 1.5)  # of the budget's correlation lengths, to choose from
GAZES_DEG = (5.0, 40.0)  # looks nearer to each other are one look, farther ones have little in common


class KnownLook(NamedTuple):
    """One look at a scene whose truth is known.

    Attributes:
        data: the observations, (N,).
        point_m: the true points (N, 3), in one frame for all looks at a scene.
        axis: (3,), where the left eye looks.
    """

    data: Judged
    point_m: Tensor
    axis: Tensor


def shared_share(looks: Sequence[Judged], budget: Budget) -> tuple[float, float] | None:
    """How much of the variance neighbouring fields have in common, and how far (`Budget.shared`, `shared_px`).

    Over pairs of fields on one smooth surface, the regression of z z′/⟨(z² + z′²)/2⟩ on e^(−d/(k L)), d their distance
    and L the budget's length, by the one of some factors k that explains most.

    Args:
        looks: observations of one look each.
        budget: whose σ they are measured in, and whose `shared_px` and `shared_widths` make L.

    Returns:
        The share, in [0, 1), and k; None where there are too few neighbours.
    """
    product, kernel = torch.zeros(2, len(FACTORS), dtype=torch.float64)
    power, total, pairs = 0.0, 0.0, 0
    factors = torch.tensor(FACTORS, dtype=torch.float64)[:, None]
    for data in looks:
        z = (data.error / sigma_of(data, budget)).double()
        smooth = (data.region == 0) & (z.abs() <= GROSS)
        z, place, rho = z[smooth], data.place_px[smooth].double(), 1 / data.range_m[smooth]
        width = (data.left_width_px / data.pixel_px)[smooth]
        area = data.area()[smooth].double()
        if len(z) < 2:
            continue
        some = torch.multinomial(
            area, min(ASKED, len(z)), generator=torch.Generator(z.device).manual_seed(0)
        )  # as often as they cover the retina
        length = torch.clamp(budget.shared_widths * width[some], min=budget.shared_px)[:, None]
        away = torch.cdist(place[some], place)
        near = (away > 0) & (away < LENGTHS * length) & ((rho / rho[some, None] - 1).abs() < SAME_RANGE)
        one, other = near.nonzero(as_tuple=True)
        # neighbours of a field count as one
        even = 1 / near.sum(1)[one].double()
        first, second = z[some][one], z[other]
        falls = torch.exp(-(away / length)[one, other] / factors)
        product += (falls * (even * first * second)).sum(1)
        kernel += (falls.square() * even).sum(1)
        power += float((even * (first.square() + second.square()) / 2).sum())
        total += float(even.sum())
        pairs += len(one)
    if pairs < LEAST_PAIRS:
        return None
    best = int((product.clamp(min=0).square() / kernel).argmax())
    share = float(product[best] / kernel[best]) / (power / total)
    return min(max(share, 0.0), 0.99), FACTORS[best]


def lasting_share_of(scenes: Sequence[Sequence[KnownLook]], budget: Budget) -> float | None:
    """The share of the variance that looks at one patch of surface have in common (`Budget.lasting`).

    Over pairs of looks 5 to 40 degrees apart, the correlation of z of the fields that see one point of a smooth
    surface: what edges do lasts wholly (`torchfovea.sensing.kinship.lasting_share`).

    Args:
        scenes: the looks at each scene.
        budget: whose σ they are measured in.

    Returns:
        In [0, 1); None where no looks overlap.
    """
    product, first, second, pairs = 0.0, 0.0, 0.0, 0
    least, most = (math.cos(math.radians(a)) for a in GAZES_DEG)
    for looks in scenes:
        z = [_cut(look.data, budget) for look in looks]
        for i, one in enumerate(looks):
            for j in range(i + 1, len(looks)):
                other, cosine = looks[j], float(one.axis @ looks[j].axis)
                if not most <= cosine <= least or not len(one.point_m) or not len(other.point_m):
                    continue
                away, nearest = torch.cdist(one.point_m, other.point_m).min(1)
                # within half a field, as far as it lies
                field = one.data.left_width_px * _pixel_m(one.data)
                same = (away < field / 2) & (one.data.region == 0)
                weight = one.data.area()[same].double()
                a, b = z[i][same], z[j][nearest[same]]
                product += float((weight * a * b).sum())
                first += float((weight * a * a).sum())
                second += float((weight * b * b).sum())
                pairs += int(same.sum())
    return None if pairs < LEAST_PAIRS else min(max(product / math.sqrt(first * second), 0.0), 0.99)


def _pixel_m(data: Judged) -> Tensor:
    """What a retinal pixel spans at the points' distance, (N,) [m]."""
    # a pinhole's: the tangent of the eccentricity is the distance from the axis over the focal length
    distance = torch.linalg.vector_norm(data.place_px, dim=-1) * data.pixel_px
    focal: Tensor = (distance / torch.tan(data.eccentricity_rad)).nanmedian()
    return data.range_m / focal


def _cut(data: Judged, budget: Budget) -> Tensor:
    return (data.error / sigma_of(data, budget)).clamp(-CUT, CUT).double()
