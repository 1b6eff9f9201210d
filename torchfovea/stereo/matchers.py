"""One door to every matcher: block matching, the foveated plane sweep, and any other that a user brings."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require
from torchfovea.stereo.external import External, match_external, match_external_rectified
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.rectified import RectifiedMatch, match_rectified
from torchfovea.stereo.rig import StereoRig
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep, SweepRange, match_sweep, match_sweep_rectified

__all__ = ["Matcher", "match_eyes", "match_pair"]


class Matcher(NamedTuple):
    """A matcher with its parameters.

    Attributes:
        params: their type says which matcher it is.
        nearest_m: nearest range that is searched or believed [m].
        source: of an external matcher: ``package.module:function``, or for a pair a disparity file.
    """

    params: SGBM | Sweep | External
    nearest_m: float = 0.3
    source: str | None = None


def match_eyes(
    matcher: Matcher, left: Tensor, right: Tensor, rig: StereoRig, camera: Camera, retina: Retina, budget: Budget
) -> tuple[Correspondences, Disparity | SweepRange]:
    """Match two verged eyes; the arguments are those of `torchfovea.stereo.matching.match_sgbm`.

    Raises:
        SettingError: as the matchers do, and for an external matcher without a function.
    """
    params = matcher.params
    if isinstance(params, SGBM):
        return match_sgbm(left, right, rig, camera, retina, params, budget, matcher.nearest_m)
    if isinstance(params, Sweep):
        return match_sweep(left, right, rig, camera, retina, params, budget, matcher.nearest_m)
    return match_external(_named(matcher), left, right, rig, camera, retina, params, budget, matcher.nearest_m)


def match_pair(
    matcher: Matcher,
    left: Tensor,
    right: Tensor,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    retina: Retina | None,
    gaze_px: tuple[float, float] | None,
    budget: Budget,
) -> RectifiedMatch:
    """Match a rectified pair; the arguments are those of `torchfovea.stereo.rectified.match_rectified`.

    Raises:
        SettingError: as the matchers do, for a sweep without a retina and an external matcher without a source.
    """
    params, nearest_m = matcher.params, matcher.nearest_m
    cameras = (camera_left, camera_right)
    if isinstance(params, SGBM):
        return match_rectified(left, right, *cameras, baseline_m, retina, gaze_px, params, budget, nearest_m)
    if isinstance(params, Sweep):
        require(retina is not None, "sensor.layout", "every_pixel", "a retina, log_polar or uniform, for matcher=sweep")
        assert retina is not None
        return match_sweep_rectified(left, right, *cameras, baseline_m, retina, gaze_px, params, budget, nearest_m)
    source = _named(matcher)
    return match_external_rectified(
        source, left, right, *cameras, baseline_m, retina, gaze_px, params, budget, nearest_m
    )


def _named(matcher: Matcher) -> str:
    expected = "package.module:function, or a disparity file for a pair"
    require(matcher.source is not None, "matcher.source", None, expected)
    return str(matcher.source)
