"""Correspondences from pairs that are already rectified, and from disparity maps of any origin.

Not differentiable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.retina import Retina, fovea, interpolate
from torchfovea.setting import require
from torchfovea.stereo.confidence import read_clues
from torchfovea.stereo.costs import left_eye
from torchfovea.stereo.exposure import alike
from torchfovea.stereo.matching import (
    check_range,
    correspondences,
    dense_disparity,
    grey_pair,
    in_range,
    read_disparity,
)
from torchfovea.stereo.readings import refine_reading
from torchfovea.stereo.rig import StereoRig
from torchfovea.stereo.sgbm import SGBM

__all__ = ["RectifiedMatch", "match_disparity", "match_rectified"]


class RectifiedMatch(NamedTuple):
    """Correspondences of a rectified pair and the cameras in whose pixels they are."""

    correspondences: Correspondences
    camera_left: Pinhole
    camera_right: Pinhole
    disparity: Disparity


def match_rectified(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    retina: Retina | None = None,
    gaze_px: tuple[float, float] | None = None,
    params: SGBM | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> RectifiedMatch:
    """Match a pair that is already rectified, through retinas that look at the same pixel of both images.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8.
        right: the same size.
        camera_left: the left camera, in image pixels.
        camera_right: the right camera; the same focal length and cy, cx_right − cx_left is `doffs`.
        baseline_m: distance between the cameras.
        retina: the layout, which spans the images' shorter side; None takes every pixel for an RF.
        gaze_px: (column, row) the retinas look at; None for the images' middle.
        params: the matcher's parameters.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that can be matched; it sets the search range.
        farthest_range_m: correspondences that triangulate to a greater depth are invalid.

    Returns:
        Correspondences (N, ...), the cameras in whose pixels they are (retinal pixels about the gaze; image pixels
        without a retina), and the disparity of the image.

    Raises:
        SettingError: as `match_sgbm`, and for cameras that are not rectified.
    """
    params = params or SGBM()
    pair = alike(grey_pair(left, right))
    check_range(nearest_range_m, farthest_range_m)
    height, width = pair.shape[-2:]
    doffs = _doffs(camera_left, camera_right, baseline_m)
    reach = camera_left.focal_px * baseline_m
    # no pixel of the left image can find its like further off than the image is wide
    nearest_px = min(reach / nearest_range_m - doffs, width - 1)
    search = params.search(max(reach / farthest_range_m - doffs, 1 - width), nearest_px)
    views, looks = list(pair[:, 0]), None
    if retina is not None:
        middle, scale = _gaze(gaze_px, height, width, retina)
        values = fovea(pair, pair.new_tensor([middle, middle]), retina, scale)  # (2, 1, N)
        x = (torch.arange(width, device=pair.device, dtype=pair.dtype) - middle[0]) / scale
        y = (torch.arange(height, device=pair.device, dtype=pair.dtype) - middle[1]) / scale
        place = columns(*torch.broadcast_tensors(x, y[:, None]))
        views, looks = (
            list(interpolate(values, retina, place)[:, 0]),
            retina.inside(place * (1 - 2 / min(height, width))),
        )
    disparity = dense_disparity(views, search, params, camera_left, doffs, baseline_m, True, looks)
    found = match_disparity(
        disparity.disparity,
        camera_left,
        camera_right,
        baseline_m,
        retina,
        gaze_px,
        valid=disparity.valid,
        budget=budget,
        nearest_range_m=nearest_range_m,
        farthest_range_m=farthest_range_m,
        edge_px=params.edge_px,
        pair=pair,
        rival_px=disparity.rival_px,
    )
    return found._replace(disparity=disparity._replace(clues=found.disparity.clues))


def match_disparity(
    disparity: Tensor | np.ndarray,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    retina: Retina | None = None,
    gaze_px: tuple[float, float] | None = None,
    valid: Tensor | np.ndarray | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
    edge_px: float = 1.0,
    pair: Tensor | None = None,
    move: bool = True,
    rival_px: Tensor | None = None,
) -> RectifiedMatch:
    """Correspondences from a disparity map of any origin: a file, a learned matcher, the truth.

    Args:
        disparity: (H, W) [image px], x_left − x_right; NaN and infinite values are invalid.
        camera_left: as in `match_rectified`, like the arguments that follow.
        camera_right: the right camera.
        baseline_m: distance between the cameras.
        retina: the layout; None takes every pixel for an RF.
        gaze_px: (column, row) the retinas look at; None for the map's middle.
        valid: bool (H, W), where the disparity can be trusted; None: wherever it is finite.
        budget: the error budget; its `source_px` is replaced by the map's own size unless it is None.
        nearest_range_m: nearest depth that is believed.
        farthest_range_m: farthest depth that is believed.
        edge_px: neighbouring disparities further apart than this are different surfaces, never averaged.
        pair: (2, 1, H, W), both images in grey, to refine the readings of a retina on; None: read only.
        move: whether the images may move a reading, or only say how well they bear it out.
        rival_px: (H, W), see `Disparity`.

    Returns:
        As `match_rectified`; the image of the returned disparity is black.

    Raises:
        SettingError: for a map without two axes, a mask of another shape, or cameras that are not rectified.
    """
    budget = budget or Budget()
    check_range(nearest_range_m, farthest_range_m)
    values = torch.as_tensor(disparity).detach()
    values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
    require(values.dim() == 2 and values.numel() > 0, "disparity.shape", tuple(values.shape), "(H, W)")
    trusted = torch.isfinite(values)
    if valid is not None:
        mask = torch.as_tensor(valid, device=values.device)
        fits = mask.shape == values.shape and mask.dtype == torch.bool
        require(fits, "valid", (tuple(mask.shape), mask.dtype), f"a bool mask {tuple(values.shape)}")
        trusted = trusted & mask
    values = torch.where(trusted, values, torch.zeros_like(values))
    doffs = _doffs(camera_left, camera_right, baseline_m)
    height, width = values.shape
    (u0, v0), scale = _gaze(gaze_px, height, width, retina)
    if retina is None:
        x, y = (torch.arange(n, device=values.device, dtype=values.dtype) for n in (width, height))
        left_px = columns(*torch.broadcast_tensors(x, y[:, None])).reshape(-1, 2)
        u0, v0, scale = 0.0, 0.0, 1.0
    else:
        left_px = retina.centers_px(values.device, values.dtype)
        budget = budget if budget.source_px is None else replace(budget, source_px=min(height, width))
    place = left_px * scale + left_px.new_tensor([u0, v0])
    field = Disparity(torch.zeros_like(values), values, trusted, camera_left, doffs, baseline_m, rival_px)

    def read(px: Tensor) -> tuple[Tensor, Tensor]:
        shift, found = read_disparity(field, px * scale + px.new_tensor([u0, v0]), edge_px)
        return shift + doffs, found

    cameras = [
        Pinhole(camera.focal_px / scale, (camera.cx_px - u0) / scale, (camera.cy_px - v0) / scale)
        for camera in (camera_left, camera_right)
    ]
    reach = camera_left.focal_px * baseline_m
    shift, found = read(left_px)
    reading = None
    if retina is not None and pair is not None:
        same = torch.eye(3, dtype=torch.float64)
        eye = left_eye(pair, StereoRig(same, same, baseline_m), cameras[0], cameras[1], retina, (u0, v0))
        reading = refine_reading(eye, read, shift, found, reach, edge_px, move)
        shift = reading.shift_px
    found &= in_range(shift, reach, nearest_range_m, farthest_range_m)
    shift = shift - doffs
    right_x = place[:, 0] - shift
    found &= (right_x >= -0.5) & (right_x <= width - 0.5)
    right_px = columns(left_px[:, 0] - shift / scale, left_px[:, 1])
    if retina is not None:
        found &= retina.inside(right_px)
    width_px = torch.ones_like(shift) if retina is None else retina.width_px(left_px) * scale
    clues = read_clues(field, place, shift, width_px)
    if reading is not None:
        clues = clues._replace(noise_px=reading.noise_px, mismatch=reading.mismatch)
    matches = correspondences(left_px, right_px, found, retina, budget, clues)
    return RectifiedMatch(matches, cameras[0], cameras[1], field._replace(clues=clues))


def _doffs(camera_left: Pinhole, camera_right: Pinhole, baseline_m: float) -> float:
    require(0 < baseline_m < math.inf, "baseline_m", baseline_m, "a positive distance in metres")
    rectified = (camera_left.focal_px, camera_left.cy_px) == (camera_right.focal_px, camera_right.cy_px)
    require(rectified, "camera_right", camera_right, f"focal_px and cy_px of the left camera, {camera_left}")
    return camera_right.cx_px - camera_left.cx_px


def _gaze(
    gaze_px: tuple[float, float] | None, height: int, width: int, retina: Retina | None
) -> tuple[tuple[float, float], float]:
    """The pixel looked at, and image pixels per retinal pixel."""
    u, v = ((width - 1) / 2, (height - 1) / 2) if gaze_px is None else gaze_px
    require(math.isfinite(u) and math.isfinite(v), "gaze_px", gaze_px, "finite pixels")
    return (float(u), float(v)), 1.0 if retina is None else min(height, width) / (2 * retina.radius_px)
