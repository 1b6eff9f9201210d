"""Correspondences from somebody else's matcher: a disparity map in a file, or a function of two images.

A confidence c from 0 to 1, where there is one, becomes a standard deviation of the disparity,

    σ(c) = sure_px + (unsure_px − sure_px)(1 − c)^power,

which adds to the right eye's budget; without a confidence c = 1. Nothing here is differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.imported import load_function
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.retina import Retina, fovea, interpolate
from torchfovea.setting import require
from torchfovea.stereo.confidence import read_clues
from torchfovea.stereo.costs import left_eye
from torchfovea.stereo.disparity_files import check_maps, load_disparity
from torchfovea.stereo.matching import check_range, correspondences, in_range, read_disparity
from torchfovea.stereo.readings import refine_reading
from torchfovea.stereo.rectified import RectifiedMatch, match_disparity
from torchfovea.stereo.rig import StereoRig
from torchfovea.stereo.visibility import undisputed

__all__ = ["External", "Matcher", "load_matcher", "match_external", "match_external_rectified"]

Matcher = Callable[[np.ndarray, np.ndarray], Any]
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


def load_matcher(source: str, setting: str = "matcher.source") -> Matcher:
    """A function by its name, ``package.module:function``.

    Raises:
        SettingError: for another form, a module that does not import, or a name that is no function.
    """
    found: Matcher = load_function(source, setting, "an existing file or package.module:function")
    return found


def _ask(matcher: Matcher, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor | None]:
    """Call a user's function on images (3, H, W)."""
    name = getattr(matcher, "__name__", type(matcher).__name__)
    views = [np.ascontiguousarray(view.detach().cpu().float().movedim(0, -1).numpy()) for view in (left, right)]
    answer = matcher(*views)
    pair = answer if isinstance(answer, tuple) else (answer, None)
    require(
        len(pair) == 2, f"{name}(left, right)", f"{len(pair)} values", "a disparity, or a disparity and a confidence"
    )
    return check_maps(pair[0], pair[1], (left.shape[-2], left.shape[-1]), f"{name}(left, right)")


def _colour_pair(left: Tensor | np.ndarray, right: Tensor | np.ndarray) -> Tensor:
    """Both images in colour, (2, 3, H, W); checked."""
    out: list[Tensor] = []
    for name, image in (("left", left), ("right", right)):
        pixels = torch.as_tensor(image).detach()
        fits = pixels.dim() == 3 and pixels.shape[0] in (1, 3) and pixels.numel() > 0
        require(fits, f"{name}.shape", tuple(pixels.shape), "(3, H, W) or (1, H, W)")
        pixels = pixels.to(torch.get_default_dtype()) / 255 if pixels.dtype == torch.uint8 else pixels
        require(pixels.is_floating_point(), f"{name}.dtype", pixels.dtype, "floating point in [0, 1], or uint8")
        require(bool(pixels.isfinite().all()), name, "NaN or infinite values", "finite values")
        out.append(pixels.expand(3, -1, -1))
    require(
        out[0].shape == out[1].shape, "right.shape", tuple(out[1].shape), f"{tuple(out[0].shape)}, as the left image"
    )
    return torch.stack([out[0], out[1].to(out[0])])


def _grey(pair: Tensor) -> Tensor:
    """(2, 3, H, W) to (2, 1, H, W), as `torchfovea.stereo.matching.grey_pair`."""
    return (pair * pair.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1, keepdim=True)


def match_external_rectified(
    source: str | Path | Matcher,
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    retina: Retina | None = None,
    gaze_px: tuple[float, float] | None = None,
    params: External | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> RectifiedMatch:
    """A foreign disparity of a rectified pair, read at the RFs.

    Args:
        source: a file (`load_disparity`), a function, or its name ``package.module:function``.
        left: (1 or 3, H, W) in [0, 1], or uint8.
        right: the same size.
        camera_left: the left camera, in image pixels.
        camera_right: the right camera; the same focal length and cy, cx_right − cx_left is `doffs`.
        baseline_m: distance between the cameras.
        retina: the layout, which spans the images' shorter side; None takes every pixel for an RF.
        gaze_px: (column, row) the retinas look at; None for the images' middle.
        params: what is made of the answer.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that is believed.
        farthest_range_m: farthest depth that is believed.

    Raises:
        SettingError: for what cannot be read, called or fitted to the images.
    """
    params = params or External()
    pair = _colour_pair(left, right)
    height, width = pair.shape[-2:]
    if isinstance(source, str | Path) and (isinstance(source, Path) or ":" not in source or Path(source).exists()):
        disparity, confidence = load_disparity(source)
        check_maps(disparity, confidence, (height, width), f"matcher.source = {source}")
    else:
        matcher = load_matcher(source) if isinstance(source, str) else source
        require(callable(matcher), "matcher.source", matcher, "a file or a function")
        disparity, confidence = _ask(matcher, *pair)
    trusted = torch.isfinite(disparity)
    if confidence is not None:
        trusted &= confidence >= params.least_confidence
    grey = _grey(pair)
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity)).to(grey)
    trusted, rival_px = undisputed(grey[0, 0], grey[1, 0], disparity, trusted)
    match = match_disparity(
        disparity,
        camera_left,
        camera_right,
        baseline_m,
        retina,
        gaze_px,
        valid=trusted,
        budget=budget,
        nearest_range_m=nearest_range_m,
        farthest_range_m=farthest_range_m,
        edge_px=params.edge_px,
        pair=grey,
        move=params.refine,
        rival_px=rival_px,
    )
    scale = camera_left.focal_px / match.camera_left.focal_px
    left_px = match.correspondences.left_px
    origin = left_px.new_tensor([match.camera_left.cx_px, match.camera_left.cy_px])
    place = (left_px - origin) * scale + left_px.new_tensor([camera_left.cx_px, camera_left.cy_px])
    found = _doubt(match.correspondences, confidence, place, scale, params, (budget or Budget()).claim)
    return match._replace(correspondences=found, disparity=match.disparity._replace(image=pair[0].mean(0)))


def match_external(
    matcher: Matcher | str,
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    rig: StereoRig,
    camera: Camera,
    retina: Retina,
    params: External | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> tuple[Correspondences, Disparity]:
    """A foreign matcher on verged eyes: it sees the rectified views that the retinas keep.

    Args:
        matcher: a function, or its name ``package.module:function``.
        left: (1 or 3, H, W) in [0, 1], or uint8; the retina looks at its middle and spans its shorter side.
        right: the same size.
        rig: the eyes' poses (`torchfovea.stereo.rig`).
        camera: of both eyes, in retinal pixels.
        retina: of both eyes.
        params: what is made of the answer.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that is believed.
        farthest_range_m: farthest depth that is believed.

    Returns:
        Correspondences (N, ...) in retinal pixels, one per RF of the left eye, and the disparity they come from.

    Raises:
        SettingError: for images or answers of the wrong form.
    """
    params, budget = params or External(), budget or Budget()
    function = load_matcher(matcher) if isinstance(matcher, str) else matcher
    require(callable(function), "matcher.source", matcher, "a function")
    check_range(nearest_range_m, farthest_range_m)
    pair = _colour_pair(left, right)
    size = min(pair.shape[-2:])
    budget = budget if budget.source_px is None else replace(budget, source_px=size)
    values = fovea(pair, None, retina)
    focal = camera.focal_px * size / (2 * retina.radius_px)
    R_left, R_right = rig.R_left.to(pair), rig.R_right.to(pair)
    left_px = retina.centers_px(pair.device, pair.dtype)
    directions = camera.rays(left_px) @ R_left.mT
    limit = math.tan(math.radians(params.rectified_fov_deg) / 2)
    x, y, z = directions.unbind(-1)
    inside = (z > 0) & (x.abs() <= limit * z) & (y.abs() <= limit * z)
    require(bool(inside.any()), "matcher.rectified_fov_deg", params.rectified_fov_deg, "a view that the left eye sees")
    # the left eye's view in the rectified frame, and as much of it as can be farther to the left in the right eye's
    slope = (directions[..., :2] / z.clamp(min=1e-6)[..., None])[inside]
    low, high = slope.amin(0), slope.amax(0)
    width, height = ((high - low) * focal).ceil().int().add(1).tolist()
    view = Pinhole(focal, -low[0].item() * focal, -low[1].item() * focal)
    column, row = (torch.arange(n, device=pair.device, dtype=pair.dtype) for n in (width, height))
    rays = view.rays(columns(*torch.broadcast_tensors(column, row[:, None])))
    seen = [camera.project(rays @ R) for R in (R_left, R_right)]
    views = [interpolate(values[i : i + 1], retina, px)[0] for i, px in enumerate(seen)]
    disparity, confidence = _ask(function, *views)
    disparity = disparity.to(pair)
    trusted = torch.isfinite(disparity) & retina.inside(seen[0]) & camera.in_view(rays @ R_left)
    if confidence is not None:
        trusted &= (confidence >= params.least_confidence).to(pair.device)
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    grey = [view.mean(0) for view in views]
    trusted, rival_px = undisputed(grey[0], grey[1], disparity, trusted)
    disparity = torch.where(trusted, disparity, torch.zeros_like(disparity))
    field = Disparity(grey[0], disparity, trusted, view, 0.0, rig.baseline_m, rival_px)

    def read(px: Tensor) -> tuple[Tensor, Tensor]:
        directions = camera.rays(px) @ R_left.mT
        x, y, z = directions.unbind(-1)
        shift, found = read_disparity(field, view.project(directions), params.edge_px)
        return shift, found & (z > 0) & (x.abs() <= limit * z) & (y.abs() <= limit * z)

    place = view.project(directions)
    shift, found = read(left_px)
    reach = focal * rig.baseline_m
    eye = left_eye(_grey(pair), rig, camera, camera, retina, ((pair.shape[-1] - 1) / 2, (pair.shape[-2] - 1) / 2))
    reading = refine_reading(eye, read, shift, found, reach, params.edge_px, params.refine)
    shift = reading.shift_px
    found &= in_range(shift, reach, nearest_range_m, farthest_range_m)
    there = view.rays(columns(place[..., 0] - shift, place[..., 1])) @ R_right
    right_px = camera.project(there)
    found &= camera.in_view(there) & retina.inside(right_px)
    scale = size / (2 * retina.radius_px)
    clues = read_clues(field, place, shift, retina.width_px(left_px) * scale)
    clues = clues._replace(noise_px=reading.noise_px, mismatch=reading.mismatch)
    matches = correspondences(left_px, right_px, found, retina, budget, clues)
    return _doubt(matches, confidence, place, scale, params, budget.claim), field._replace(clues=clues)


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
