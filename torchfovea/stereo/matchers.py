"""One door to every matcher: block matching, the foveated plane sweep, and any other that a user brings."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

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

__all__ = ["Match", "Matcher", "checked_matches", "match_eyes", "match_pair"]


class Match(Protocol):
    """What matches the pictures of two verged eyes: a `Matcher`, or any function like it."""

    def __call__(
        self, left: Tensor, right: Tensor, rig: StereoRig, camera: Camera, retina: Retina, budget: Budget, /
    ) -> tuple[Correspondences, Any]:
        """Match two pictures.

        Args:
            left: (3, H, W) in [0, 1].
            right: of the same shape.
            rig: how the eyes stand.
            camera: both eyes', in retinal pixels; the pictures span the retina's disc.
            retina: both eyes'.
            budget: where a correspondence's standard deviation comes from; a matcher may know better.

        Returns:
            A correspondence for each receptive field of the left eye, in order, and what was found, to be drawn: a
            `Disparity`, a `SweepRange` or None.
        """
        ...


class Matcher(NamedTuple):
    """A built-in matcher with its parameters; it is a `Match`.

    Attributes:
        params: their type says which matcher it is.
        nearest_m: nearest range that is searched or believed [m].
        source: of an external matcher: ``package.module:function``, or for a pair a disparity file.
    """

    params: SGBM | Sweep | External
    nearest_m: float = 0.3
    source: str | None = None

    def __call__(
        self, left: Tensor, right: Tensor, rig: StereoRig, camera: Camera, retina: Retina, budget: Budget, /
    ) -> tuple[Correspondences, Disparity | SweepRange]:
        """Match two verged eyes; see `Match` and `match_eyes`."""
        return match_eyes(self, left, right, rig, camera, retina, budget)


def checked_matches(answer: object, retina: Retina) -> tuple[Correspondences, Any]:
    """What a `Match` returned, or an error under the setting `matcher`.

    Raises:
        SettingError: for anything but correspondences of the retina's receptive fields and what was found.
    """
    expected = "(Correspondences, found)"
    pair = isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], Correspondences)
    require(pair, "matcher", f"{type(answer).__name__} from (left, right, ...)", expected)
    assert isinstance(answer, tuple)
    matches = answer[0]
    for name, lead in (("left_px", 2), ("right_px", 2), ("left_sigma_px", 1), ("right_sigma_px", 1), ("valid", 1)):
        part = getattr(matches, name)
        shape = (retina.count, 2)[:lead]
        fits = isinstance(part, Tensor) and tuple(part.shape) == shape
        require(fits, f"matcher's {name}", getattr(part, "shape", part), f"{shape}, one for each receptive field")
    return matches, answer[1]


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
