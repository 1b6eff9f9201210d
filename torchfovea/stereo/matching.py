"""Semi-global block matching through retinas: where each receptive field (RF) of the left eye is seen by the right eye.

The paper's way (Sec. 7.2): each eye's image goes through its retina and back, both are warped to rectified views that
are parallel to the cyclopean frame, and a dense matcher finds disparities, which are then read at the RFs. Here the way
back and the warp are one interpolation. Where RFs are wide the views hold nothing fine: they are matched at half the
size there, for an eighth of the work (`SGBM.half_from_px`), and as they are only around what narrow RFs see. Nothing in
this module is differentiable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.rounding import unrounded
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.retina import Retina
from torchfovea.stereo.exposure import alike
from torchfovea.stereo.maps import checked_range, read_map
from torchfovea.stereo.rectification import Part, RectifiedPair, frame_to_match, image_frame
from torchfovea.stereo.sgbm import SGBM, check_room, disparity_sgbm
from torchfovea.stereo.views import Views
from torchfovea.stereo.visibility import undisputed

__all__ = ["match_sgbm"]

SLACK_PX = 4.0  # what is searched beyond rough disparities
RUN_IN = 12  # pixels around a part after which its matches no longer depend on where it was cut


class _Scale(NamedTuple):
    """The matcher on views whose pixels are `step` times as wide, and the disparities that it searches there."""

    params: SGBM
    search: tuple[int, int]
    step: int


class _Maps(NamedTuple):
    """What was found on a part of the views, (H, W) each; disparities in the views' pixels."""

    image: Tensor
    disparity: Tensor
    valid: Tensor
    rival_px: Tensor
    looks: Tensor


@unrounded
def match_sgbm(
    views: Views,
    retina: Retina | None,
    params: SGBM | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
    most_bytes: float = math.inf,
) -> tuple[Correspondences, Disparity]:
    """Match two images through retinas.

    Args:
        views: the images with their cameras.
        retina: of both; None, for a rectified pair, takes every pixel for an RF.
        params: the matcher's parameters.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that can be matched; it sets the search range.
        farthest_range_m: correspondences that triangulate to a greater depth are invalid.
        most_bytes: that the matcher may need for its costs; its mode and the search range decide.

    Returns:
        Correspondences (N, ...) in the pixels of `Views.cameras`, one per RF of the left eye, and the disparity they
        come from. Invalid: RFs outside either rectified view or whose counterpart is off the right retina or image, RFs
        without a disparity (occluded, ambiguous, textureless), and depths out of range.

    Raises:
        SettingError: for a batch of images, impossible ranges, views that need a retina without one, more costs than
            the machine or `most_bytes` has room for, and without OpenCV.
    """
    params, budget = params or SGBM(), views.told(budget)
    span = checked_range(nearest_range_m, farthest_range_m)
    scales = [_Scale(params, _search(views, params, span), 1)]
    if retina is not None and params.half_from_px is not None:
        scales.append(_Scale(params.halved(), _search(views, params.halved(), span, 2), 2))
    if views.rectified:
        frame = image_frame(views, retina)
    else:
        ends = [scale.step * end for scale in scales for end in scale.search]
        frame = frame_to_match(views, retina, nearest_range_m, params.rectified_fov_deg, (min(ends), max(ends)))
    pair = alike(views.grey().detach())
    maps = _matched(pair, frame, scales, most_bytes)
    if not views.rectified:
        frame = frame._replace(looks=maps.looks)
    baseline = views.rig.baseline_m
    field = Disparity(*maps[:3], frame.camera, views.doffs_px, baseline, maps.rival_px)
    return read_map(field, frame, budget, span, params.edge_px, pair)


def _search(views: Views, params: SGBM, range_m: tuple[float, float], step: int = 1) -> tuple[int, int]:
    """The first disparity searched and one past the last, in steps of so many pixels."""
    reach = views.camera_left.focal_px * views.rig.baseline_m
    high, low = (reach / depth - views.doffs_px for depth in range_m)
    if views.rectified:  # no pixel of the left image can find its like further off than the image is wide
        width = views.left.shape[-1]
        low, high = max(low, 1 - width), min(high, width - 1)
    return params.search(low / step, high / step)


def _matched(pair: Tensor, frame: RectifiedPair, scales: list[_Scale], most_bytes: float) -> _Maps:
    """Match the views: where RFs are wide at half the size, which tells the rest where to search."""
    full, *half = scales
    whole = Part(0, 0, frame.size)
    fine = _fine_part(frame, full.params.half_from_px) if half else whole
    if fine == whole:
        return _match(pair, frame, full, whole, most_bytes)
    height, width = frame.size
    coarse = _match(pair, frame, half[0], Part(0, 0, (-(-height // 2), -(-width // 2)), 2), most_bytes)
    maps = _Maps(*(m.repeat_interleave(2, 0).repeat_interleave(2, 1)[:height, :width].contiguous() for m in coarse))
    if fine is not None:
        own = slice(fine.top, fine.top + fine.size[0]), slice(fine.left, fine.left + fine.size[1])
        found = _match(pair, frame, _narrowed(full, maps.disparity[own][maps.valid[own]]), fine, most_bytes)
        for below, above in zip(maps, found, strict=True):
            below[own] = above
    return maps


def _narrowed(scale: _Scale, rough: Tensor) -> _Scale:
    """Search no further than around rough disparities (M,)."""
    if len(rough) == 0:
        return scale
    low, high = (float(end) for end in rough.aminmax())
    own = replace(scale.params, first_disparity_px=None, disparities=None)
    first, end = own.search(low - SLACK_PX, high + SLACK_PX)
    (least, most), count = scale.search, end - first
    if count >= most - least:
        return scale
    first = min(max(first, least), most - count)
    return scale._replace(search=(first, first + count))


def _fine_part(frame: RectifiedPair, half_from_px: float | None) -> Part | None:
    """What narrow RFs see of the views; all of them where no RF is wide."""
    retina, like = frame.retina, frame.views.left
    assert retina is not None and half_from_px is not None
    narrow = _narrow(retina, half_from_px / frame.views.scale(retina), like.device, like.dtype)
    if len(narrow) == retina.count:
        return Part(0, 0, frame.size)
    place, shown = frame.place(narrow)
    if not bool(shown.any()):
        return None
    low, high = (end.tolist() for end in place[shown].aminmax(dim=0))
    left, top = (max(math.floor(end) - 1, 0) for end in low)
    right, bottom = (min(math.ceil(end) + 2, side) for end, side in zip(high, frame.size[::-1], strict=True))
    return Part(left, top, (bottom - top, right - left)) if left < right and top < bottom else None


@lru_cache(maxsize=16)
def _narrow(retina: Retina, width_px: float, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Centres (N, 2) of the RFs that are narrower [retinal px]."""
    with torch.inference_mode(False), torch.no_grad():
        centers = retina.centers_px(device, dtype)
        return centers[retina.width_px(centers) < width_px]


def _match(pair: Tensor, frame: RectifiedPair, scale: _Scale, part: Part, most_bytes: float) -> _Maps:
    """Match a part of both rectified views, with as much around it as its matches depend on.

    What hides it from the right eye is nearer and to its right, by less than the disparities differ.
    """
    params, (first, end), step = scale
    above, below, before, after = frame.room(part, RUN_IN, RUN_IN + max(end, 0), RUN_IN + end - first)
    height, width = part.size
    around = Part(
        part.left - before * step, part.top - above * step, (above + height + below, before + width + after), step
    )
    check_room(around.size, scale.search, params, most_bytes)
    left_px, right_px, ahead = frame.seen(pair, around)
    shown = frame.kept(pair, left_px, right_px)[:, 0]
    left, right = (view.float().cpu().numpy() for view in shown)
    # two eyes' views have a margin that is searched, images have none
    pad = (max(end - max(before - RUN_IN, 0), 0), max(-first - after, 0)) if frame.views.rectified else (0, 0)
    disparity, found = disparity_sgbm(left, right, scale.search, params, pad)
    values, valid = torch.as_tensor(disparity).to(shown), torch.as_tensor(found).to(shown.device)
    near = frame.looked_at(left_px, ahead, 1.0)  # a pixel beyond the rim, whose fields are read there, too
    valid = valid if near is None else valid & near
    valid, rival = undisputed(shown[0], shown[1], values, valid, step)
    looks = frame.looked_at(left_px, ahead)
    looks = torch.ones_like(valid) if looks is None else looks
    own = slice(above, above + height), slice(before, before + width)
    return _Maps(*(values[own] for values in (shown[0], step * values, valid, step * rival, looks)))
