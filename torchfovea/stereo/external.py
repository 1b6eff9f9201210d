"""Correspondences from somebody else's matcher: a disparity map in a file, or a function of two images.

A confidence c from 0 to 1, where there is one, becomes a standard deviation of the disparity,

    σ(c) = sure_px + (unsure_px − sure_px)(1 − c)^power,

which adds to the right eye's budget; without a confidence c = 1. Nothing here is differentiable.
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
from torchfovea.setting import require
from torchfovea.stereo.disparity_files import check_maps, load_disparity
from torchfovea.stereo.maps import checked_range, read_map
from torchfovea.stereo.rectification import frame_to_show, image_frame
from torchfovea.stereo.views import Views, grey_of
from torchfovea.stereo.visibility import undisputed

__all__ = ["DisparityFunction", "External", "load_matcher", "match_external"]

DisparityFunction = Callable[[np.ndarray, np.ndarray], Any]
"""From the left and right images, float32 (H, W, 3) in [0, 1], to disparity (H, W) [px] or (disparity, confidence)."""


@dataclass(frozen=True)
class External:
    """What is made of a foreign matcher's answer.

    Attributes:
        sure_px: standard deviation of a disparity of confidence 1, beside the budget [image px].
        unsure_px: that of confidence 0.
        power: of the law between them.
        least_confidence: less is invalid.
        edge_px: neighbouring disparities further apart than this are different surfaces, never averaged.
        rectified_fov_deg: widest rectified view of verged eyes; what lies beyond is masked.
        refine: let the images move what is read at the RFs by the last part of a pixel, as the other matchers do; for
            matchers that prefer whole pixels. Either way they tell its noise.
    """

    sure_px: float = 0.0
    unsure_px: float = 1.0
    power: float = 1.0
    least_confidence: float = 0.0
    edge_px: float = 1.0
    rectified_fov_deg: float = 140.0
    refine: bool = False

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        require(0 <= self.sure_px < math.inf, "matcher.sure_px", self.sure_px, "0 or more pixels")
        require(
            self.sure_px <= self.unsure_px < math.inf,
            "matcher.unsure_px",
            self.unsure_px,
            f"at least sure_px = {self.sure_px}",
        )
        require(0 < self.power < math.inf, "matcher.power", self.power, "a positive number")
        require(0 <= self.least_confidence <= 1, "matcher.least_confidence", self.least_confidence, "0 to 1")
        require(self.edge_px > 0, "matcher.edge_px", self.edge_px, "a positive number of pixels")
        fov = self.rectified_fov_deg
        require(0 < fov <= 160, "matcher.rectified_fov_deg", fov, "more than 0 and at most 160 degrees")

    def sigma_px(self, confidence: Tensor) -> Tensor:
        """The law, (...) to (...) [image px]."""
        return self.sure_px + (self.unsure_px - self.sure_px) * (1 - confidence.clamp(0, 1)) ** self.power


def load_matcher(source: str, setting: str = "matcher.source") -> DisparityFunction:
    """A function by its name, ``package.module:function``.

    Raises:
        SettingError: for another form, a module that does not import, or a name that is no function.
    """
    found: DisparityFunction = load_function(source, setting, "an existing file or package.module:function")
    return found


def _ask(matcher: DisparityFunction, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor | None]:
    """Call a user's function on images (3, H, W)."""
    name = getattr(matcher, "__name__", type(matcher).__name__)
    views = [np.ascontiguousarray(view.detach().cpu().float().movedim(0, -1).numpy()) for view in (left, right)]
    answer = matcher(*views)
    pair = answer if isinstance(answer, tuple) else (answer, None)
    require(
        len(pair) == 2, f"{name}(left, right)", f"{len(pair)} values", "a disparity, or a disparity and a confidence"
    )
    return check_maps(pair[0], pair[1], (left.shape[-2], left.shape[-1]), f"{name}(left, right)")


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
            It sees a rectified pair's images, and of two eyes the rectified views that the retinas keep.
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
        SettingError: for what cannot be read, called or fitted to the images.
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
    disparity, confidence = _answer(source, shown, views.rectified)
    disparity = disparity.to(shown)
    trusted = torch.isfinite(disparity)
    trusted = trusted if frame.looks is None else trusted & frame.looks
    if confidence is not None:
        confidence = confidence.to(shown)
        trusted &= confidence >= params.least_confidence
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    left, right = grey_of(shown)[:, 0]
    trusted, rival_px = undisputed(left, right, disparity, trusted)
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    field = Disparity(
        shown[0].mean(0), disparity, trusted, frame.camera, views.doffs_px, views.rig.baseline_m, rival_px
    )
    matches, found = read_map(field, frame, budget, span, params.edge_px, views.grey().detach(), params.refine)
    place, scale = frame.place(matches.left_px)[0], views.scale(retina)
    return _doubt(matches, confidence, place, scale, params, budget.claim), found


def _answer(source: str | Path | DisparityFunction, shown: Tensor, files: bool) -> tuple[Tensor, Tensor | None]:
    """The disparity and the confidence (H, W) of views (2, 3, H, W), from a file where it may be one, or a function."""
    if isinstance(source, str | Path) and (isinstance(source, Path) or ":" not in source or Path(source).exists()):
        require(
            files, "matcher.source", source, "package.module:function; a file has the disparity of a rectified pair"
        )
        maps = load_disparity(source)
        return check_maps(*maps, (shown.shape[-2], shown.shape[-1]), f"matcher.source = {source}")
    matcher = load_matcher(source) if isinstance(source, str) else source
    assert not isinstance(matcher, Path)
    require(callable(matcher), "matcher.source", matcher, "a file or a function")
    return _ask(matcher, *shown)


def _doubt(
    matches: Correspondences, confidence: Tensor | None, place: Tensor, scale: float, params: External, claim: float
) -> Correspondences:
    """Add the confidences' share to the right eye's standard deviations; `place` (N, 2) in the map's pixels."""
    if confidence is None:
        sigma = torch.full_like(matches.right_sigma_px, params.sure_px)
    else:
        height, width = confidence.shape
        near = place.round().long()
        column, row = near[..., 0].clamp(0, width - 1), near[..., 1].clamp(0, height - 1)
        sigma = params.sigma_px(confidence.to(place)[row, column])
    return matches._replace(right_sigma_px=torch.hypot(matches.right_sigma_px, claim * sigma / scale))
