"""From a pair to points with covariances: what a retina, or every pixel, makes of two images."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, columns
from torchfovea.sensing.chart import cartesian_from_inverse_range
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.kinship import once_a_pixel
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require
from torchfovea.stereo.matchers import Match, Matcher, checked_matches
from torchfovea.stereo.views import Views
from torchfovea.studies.calibration import mixture_std

__all__ = ["Sensed", "match_and_sense", "sense"]


class Sensed(NamedTuple):
    """Points of a pair, in the left camera's optical frame (x right, y down, z forward).

    Attributes:
        matches: the correspondences.
        observed: in the inverse-range chart about the left camera.
        points: Cartesian moments, (N, 3) [m] and (N, 6) [m²].
        colour: what each receptive field sees, (N, 3).
        chosen: bool (N,), the valid fields of which none copies another's source pixel.
    """

    matches: Correspondences
    observed: Observations
    points: Gaussian
    colour: Tensor
    chosen: Tensor


def match_and_sense(
    match: Match, views: Views, printed: bool, retina: Retina | None, budget: Budget
) -> tuple[Sensed, Any]:
    """What a matcher makes of a pair, as points and as its own map.

    Args:
        match: built in or a user's own.
        views: the pair.
        printed: whether the sigma points are the paper's.
        retina: None: every pixel.
        budget: of errors.

    Raises:
        SettingError: for a user's own matcher without a retina, and as matchers do.
    """
    matches, found = _matched(match, views, retina, budget)
    return sense(views, retina, matches, SigmaPoints.paper() if printed else None, not printed), found


def _matched(match: Match, views: Views, retina: Retina | None, budget: Budget) -> tuple[Correspondences, Any]:
    """Match, with a user's own matcher too."""
    if retina is None:
        require(isinstance(match, Matcher), "sensor.layout", "every_pixel", "a retina, for a matcher of your own")
        assert isinstance(match, Matcher)
        return match(views, None, budget)
    return checked_matches(match(views, retina, budget), retina)


def sense(
    views: Views, retina: Retina | None, matches: Correspondences, points: SigmaPoints | None, rotated: bool
) -> Sensed:
    """Correspondences of a pair as points with covariances, in the left camera's frame."""
    rotation, across = views.rig.R_left.mT, views.rig.R_left.new_tensor([views.rig.baseline_m, 0.0, 0.0])
    eye, right = torch.eye(3), ((rotation @ views.rig.R_right).float(), (rotation @ across).float())
    rig = Eyes(eye, torch.zeros(3), *right)
    px, cameras = matches.left_px, views.cameras(retina)
    support = torch.full_like(px[..., 0], 0.5) if retina is None else retina.width_px(px) / 2
    observed = _doubted(observe(matches, rig, cameras, support, points, "inverse_range", rotated))
    moments = cartesian_from_inverse_range(Gaussian(observed.mean, observed.cov), observed.direction)
    if retina is None:
        colour, chosen = views.left.flatten(1).T, observed.valid
    else:
        colour = views.fovea(views.left[None], retina)[0].T
        chosen = once_a_pixel(px, 1 / views.scale(retina), observed.valid)
    return Sensed(matches, observed, moments, colour, chosen)


def _doubted(observed: Observations) -> Observations:
    """Observations whose inverse ranges are as uncertain as they are, a doubtful match taken in (`mixture_std`)."""
    rho, valid = observed.mean[:, 2], observed.valid
    if observed.inlier is None or int(valid.sum()) < 2:
        return observed
    *rest, variance = observed.cov.unbind(-1)
    sigma = variance.sqrt()
    factor = torch.where(valid, mixture_std(sigma, observed.inlier, rho[valid].std()) / sigma, 1.0)
    aa, ab, ar, bb, br = rest
    return observed._replace(cov=columns(aa, ab, factor * ar, bb, factor * br, factor.square() * variance))
