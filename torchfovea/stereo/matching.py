"""Semi-global block matching through retinas: where each receptive field (RF) of the left eye is seen by the right eye.

The paper's way (Sec. 7.2): each eye's image goes through its retina and back, both are warped to rectified views that
are parallel to the cyclopean frame, and a dense matcher finds disparities, which are then read at the RFs. Here the way
back and the warp are one interpolation. Nothing in this module is differentiable.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.rounding import unrounded
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.retina import Retina
from torchfovea.stereo.exposure import alike
from torchfovea.stereo.maps import checked_range, read_map
from torchfovea.stereo.rectification import RectifiedPair, frame_to_match, image_frame
from torchfovea.stereo.sgbm import SGBM, check_room, disparity_sgbm
from torchfovea.stereo.views import Views
from torchfovea.stereo.visibility import undisputed

__all__ = ["match_sgbm"]


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
    search = _search(views, params, span)
    if views.rectified:
        frame = image_frame(views, retina)
    else:
        frame = frame_to_match(views, retina, nearest_range_m, params.rectified_fov_deg, search)
    check_room(frame.size, search, params, most_bytes)
    pair = alike(views.grey().detach())
    left_px, right_px, ahead = frame.seen(pair)
    shown = frame.kept(pair, left_px, right_px)[:, 0]
    near = frame.looked_at(left_px, ahead, 1.0)  # a pixel beyond the rim, whose fields are read there, too
    field = _dense(shown, search, params, frame, near)
    if not views.rectified:
        frame = frame._replace(looks=frame.looked_at(left_px, ahead))
    return read_map(field, frame, budget, span, params.edge_px, pair)


def _search(views: Views, params: SGBM, range_m: tuple[float, float]) -> tuple[int, int]:
    """The first disparity searched and one past the last."""
    reach = views.camera_left.focal_px * views.rig.baseline_m
    high, low = (reach / depth - views.doffs_px for depth in range_m)
    if views.rectified:  # no pixel of the left image can find its like further off than the image is wide
        width = views.left.shape[-1]
        low, high = max(low, 1 - width), min(high, width - 1)
    return params.search(low, high)


def _dense(
    shown: Tensor, search: tuple[int, int], params: SGBM, frame: RectifiedPair, near: Tensor | None
) -> Disparity:
    """Match both rectified views (2, H, W); `near`, bool (H, W), says where the left eye looks."""
    left, right = (view.float().cpu().numpy() for view in shown)
    # two eyes' views have a margin that is searched, images have none
    disparity, found = disparity_sgbm(left, right, search, params, pad=frame.views.rectified)
    values, valid = torch.as_tensor(disparity).to(shown), torch.as_tensor(found).to(shown.device)
    valid = valid if near is None else valid & near
    valid, rival_px = undisputed(shown[0], shown[1], values, valid)
    views = frame.views
    return Disparity(shown[0], values, valid, frame.camera, views.doffs_px, views.rig.baseline_m, rival_px)
