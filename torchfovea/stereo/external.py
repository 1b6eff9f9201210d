"""Correspondences from somebody else's matcher: a disparity map in a file, or a function of two images.

A confidence c from 0 to 1, where there is one, becomes a standard deviation of the disparity,

    σ(c) = sure_px + (unsure_px − sure_px)(1 − c)^power,

which adds to the right eye's budget times `Budget.claim`; without a confidence c = 1. A matcher that tells a standard
deviation or a variance is taken at its word. Nothing here is differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.imported import load_function
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.setting import SettingError, check_types, require
from torchfovea.stereo.disparity_files import check_maps, load_disparity
from torchfovea.stereo.maps import checked_range, read_map
from torchfovea.stereo.rectification import frame_to_show, image_frame
from torchfovea.stereo.views import Views, grey_of
from torchfovea.stereo.visibility import undisputed

__all__ = ["DisparityFunction", "External", "load_matcher", "match_external", "resolve_source"]

DisparityFunction = Callable[[np.ndarray, np.ndarray], Any]
"""From the left and right images, float32 (H, W, 3) in [0, 1], to disparity (H, W) [px] or (disparity, confidence)."""

# what the second of a matcher's two maps may tell, and between which values
TELLS = {
    "confidence": (0.0, 1.0), "doubt": (0.0, 1.0), "sigma": (0.0, math.inf), "variance": (0.0, math.inf),
    "log_variance": (-math.inf, math.inf),
}  # fmt: skip


@dataclass(frozen=True)
class External:
    """What is made of a foreign matcher's answer.

    Attributes:
        scale: what a disparity is multiplied by to become x_left − x_right in pixels: −1 for a flow from left to right,
            1/16 for OpenCV's whole numbers.
        invalid: the number that stands for no disparity, before the scale; null: none does. NaN and infinite values
            never are one.
        tells: what the second map is, where there is one: confidence (0 to 1, higher is better), doubt (0 to 1, higher
            is worse), sigma [image px], variance [image px²] or log_variance.
        sure_px: standard deviation of a disparity of confidence 1, beside the budget [image px].
        unsure_px: that of confidence 0.
        power: of the law between them.
        least_confidence: less is invalid; a doubt's is 1 less the doubt.
        edge_px: neighbouring disparities further apart than this are different surfaces, never averaged.
        rectified_fov_deg: widest rectified view of verged eyes; what lies beyond is masked.
        refine: let the images move what is read at the RFs by the last part of a pixel, as the other matchers do; for
            matchers that prefer whole pixels. Either way they tell its noise.
    """

    scale: float = 1.0
    invalid: float | None = None
    tells: str = "confidence"
    sure_px: float = 0.0
    unsure_px: float = 1.0
    power: float = 1.0
    least_confidence: float = 0.0
    edge_px: float = 1.0
    rectified_fov_deg: float = 140.0
    refine: bool = False

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        check_types(self, "matcher.")
        scaled = self.scale != 0 and math.isfinite(self.scale)
        require(scaled, "matcher.scale", self.scale, "a number other than 0, negative to turn the sign round")
        require(self.tells in TELLS, "matcher.tells", self.tells, "one of " + ", ".join(TELLS))
        require(0 <= self.sure_px < math.inf, "matcher.sure_px", self.sure_px, "0 or more pixels")
        require(
            self.sure_px <= self.unsure_px < math.inf,
            "matcher.unsure_px",
            self.unsure_px,
            f"at least sure_px = {self.sure_px}",
        )
        require(0 < self.power < math.inf, "matcher.power", self.power, "a positive number")
        require(0 <= self.least_confidence <= 1, "matcher.least_confidence", self.least_confidence, "0 to 1")
        certain = self.least_confidence == 0 or TELLS[self.tells] == (0.0, 1.0)
        require(certain, "matcher.least_confidence", self.least_confidence, f"0 where the matcher tells a {self.tells}")
        require(self.edge_px > 0, "matcher.edge_px", self.edge_px, "a positive number of pixels")
        fov = self.rectified_fov_deg
        require(0 < fov <= 160, "matcher.rectified_fov_deg", fov, "more than 0 and at most 160 degrees")

    def confidence(self, told: Tensor) -> Tensor:
        """Of a confidence or a doubt, (...) to (...) in [0, 1]."""
        return 1 - told if self.tells == "doubt" else told

    def sigma_px(self, told: Tensor) -> Tensor:
        """The standard deviation of what the second map tells, (...) to (...) [image px]."""
        if self.tells == "sigma":
            return told
        if self.tells == "variance":
            return told.sqrt()
        if self.tells == "log_variance":
            return (told / 2).exp()
        doubt = 1 - self.confidence(told).clamp(0, 1)
        return self.sure_px + (self.unsure_px - self.sure_px) * doubt**self.power


def load_matcher(source: str) -> DisparityFunction:
    """A function by its name, ``package.module:function``.

    Raises:
        SettingError: for another form, a module that does not import, or a name that is no function.
    """
    found: DisparityFunction = load_function(source, "matcher.source", "an existing file or package.module:function")
    return found


def _ask(matcher: DisparityFunction, shown: Tensor, span: tuple[float, float]) -> tuple[Tensor, Tensor | None]:
    """Call a user's function on images (2, 3, H, W)."""
    name = getattr(matcher, "__name__", type(matcher).__name__)
    views = [np.ascontiguousarray(view.detach().cpu().float().movedim(0, -1).numpy()) for view in shown]
    answer = matcher(*views)
    pair = answer if isinstance(answer, tuple) else (answer, None)
    require(
        len(pair) == 2, f"{name}(left, right)", f"{len(pair)} values", "a disparity, or a disparity and a confidence"
    )
    return check_maps(pair[0], pair[1], (shown.shape[-2], shown.shape[-1]), f"{name}(left, right)", span)


def match_external(
    source: str | Path | DisparityFunction,
    views: Views,
    retina: Retina | None = None,
    params: External | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> tuple[Correspondences, Disparity]:
    """A foreign disparity, read at the RFs.

    Args:
        source: a function, or its name ``package.module:function``; of a rectified pair also a file (`load_disparity`).
            A function sees a rectified pair's images, and of two eyes the rectified views that the retinas keep.
        views: the images with their cameras.
        retina: of both; None, for a rectified pair, takes every pixel for an RF.
        params: what is made of the answer.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that is believed.
        farthest_range_m: farthest depth that is believed.

    Returns:
        Correspondences (N, ...) in the pixels of `Views.cameras`, one per RF of the left eye, and the disparity they
        come from.

    Raises:
        SettingError: for what cannot be read, called or fitted to the images, and for disparities of the wrong sign or
            unit: most of them behind the eyes, or further than the image is wide.
    """
    params, budget = params or External(), views.told(budget)
    span = checked_range(nearest_range_m, farthest_range_m)
    if views.rectified:
        frame = image_frame(views, retina)
    else:
        frame = frame_to_show(views, retina, params.rectified_fov_deg)
    shown = views.colour().detach()
    if not views.rectified:
        left_px, right_px, ahead = frame.seen(shown)
        shown, frame = frame.kept(shown, left_px, right_px), frame._replace(looks=frame.looked_at(left_px, ahead))
    disparity, worth = _answer(source, shown, views.rectified, TELLS[params.tells])
    trusted = (
        torch.isfinite(disparity) if params.invalid is None else disparity.isfinite() & (disparity != params.invalid)
    )
    disparity, trusted = (params.scale * disparity).to(shown), trusted.to(shown.device)
    trusted = trusted if frame.looks is None else trusted & frame.looks
    _check_sign(disparity[trusted], views.doffs_px, shown.shape[-1], params.scale)
    if worth is not None:
        worth = worth.to(shown)
        trusted &= worth.isfinite()
        if params.least_confidence > 0:
            trusted &= params.confidence(worth) >= params.least_confidence
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    left, right = grey_of(shown)[:, 0]
    trusted, rival_px = undisputed(left, right, disparity, trusted)
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    field = Disparity(
        shown[0].mean(0), disparity, trusted, frame.camera, views.doffs_px, views.rig.baseline_m, rival_px
    )
    matches, found = read_map(field, frame, budget, span, params.edge_px, views.grey().detach(), params.refine)
    place, scale = frame.place(matches.left_px)[0], views.scale(retina)
    return _doubt(matches, worth, place, scale, params, budget.claim), found


def _check_sign(disparity: Tensor, doffs_px: float, width: int, scale: float) -> None:
    """Refuse disparities (M,) [px] most of which no point has: behind the eyes, or further than the image is wide."""
    if disparity.numel() == 0:
        return
    span = f"{float(disparity.min()):.4g} to {float(disparity.max()):.4g} px"
    # noise may carry infinity to −1 px
    behind, beyond = (float(those.float().mean()) for those in (disparity < -doffs_px - 1, disparity > width))
    form = "x_left - x_right in pixels, of points ahead; {} by matcher.scale={:g}"
    require(behind <= 0.5, "disparities", span, form.format("turn the sign round", -scale))
    require(beyond <= 0.5, "disparities", span, form.format("sixteenths become pixels", scale / 16))


def resolve_source(source: object, files: bool) -> Path | DisparityFunction:
    """What a source stands for: a disparity file, where it may be one, or a function.

    Args:
        source: a function, its name ``package.module:function``, or a file's.
        files: whether a file has an answer: to a rectified pair.

    Raises:
        SettingError: for anything else, nothing included.
    """
    expected = "package.module:function, a function or, for a rectified pair, a disparity file"
    if isinstance(source, Path) or (isinstance(source, str) and (":" not in source or Path(source).exists())):
        require(files, "matcher.source", source, expected)
        return Path(source)
    if isinstance(source, str):
        return load_matcher(source)
    if not callable(source):
        raise SettingError(f"matcher.source = {source}: expected {expected}")
    return source


def _answer(
    source: str | Path | DisparityFunction, shown: Tensor, files: bool, span: tuple[float, float]
) -> tuple[Tensor, Tensor | None]:
    """The disparity and its worth (H, W) of views (2, 3, H, W), from a file where it may be one, or a function."""
    found = resolve_source(source, files)
    if not isinstance(found, Path):
        return _ask(found, shown, span)
    maps = load_disparity(found, span=span)
    return check_maps(*maps, (shown.shape[-2], shown.shape[-1]), f"matcher.source = {source}", span)


def _doubt(
    matches: Correspondences, worth: Tensor | None, place: Tensor, scale: float, params: External, claim: float
) -> Correspondences:
    """Add the second map's share to the right eye's standard deviations; `place` (N, 2) in the map's pixels."""
    if worth is None:
        sigma = torch.full_like(matches.right_sigma_px, params.sure_px)
    else:
        height, width = worth.shape
        near = place.round().long()
        column, row = near[..., 0].clamp(0, width - 1), near[..., 1].clamp(0, height - 1)
        sigma = params.sigma_px(worth.to(place)[row, column])
        sigma = torch.where(sigma.isfinite(), sigma, torch.zeros_like(sigma))
    return matches._replace(right_sigma_px=torch.hypot(matches.right_sigma_px, claim * sigma / scale))
