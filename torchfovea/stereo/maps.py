"""Disparity maps of any origin, read at receptive fields (RFs): correspondences with their standard deviations.

Nothing in this module is differentiable.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.correspondence import (
    Budget,
    Clues,
    Correspondences,
    Disparity,
    doubt,
    eye_sigma_px,
    inlier_share,
)
from torchfovea.sensing.kinship import lasting_share
from torchfovea.sensing.retina import Retina
from torchfovea.setting import require
from torchfovea.stereo.confidence import read_clues
from torchfovea.stereo.costs import left_eye
from torchfovea.stereo.readings import refine_reading, standing_out
from torchfovea.stereo.rectification import RectifiedPair, image_frame
from torchfovea.stereo.views import Views

__all__ = ["checked_range", "correspondences", "match_disparity", "read_map", "read_values"]


def match_disparity(
    disparity: Tensor | np.ndarray,
    views: Views,
    retina: Retina | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
    valid: Tensor | np.ndarray | None = None,
) -> tuple[Correspondences, Disparity]:
    """Correspondences from a disparity map as it is: a file, a learned matcher, the truth.

    Args:
        disparity: (H, W) [image px], x_left − x_right; NaN and infinite values are invalid.
        views: the rectified pair that it belongs to.
        retina: the layout; None takes every pixel for an RF.
        budget: the error budget; its `source_px` is replaced by the map's own size unless it is None.
        nearest_range_m: nearest depth that is believed.
        farthest_range_m: farthest depth that is believed.
        valid: bool (H, W), where the disparity can be trusted; None: wherever it is finite.

    Returns:
        Correspondences (N, ...) in the pixels of `Views.cameras`, one per RF of the left eye, and the map with what it
        tells of them; its image is black.

    Raises:
        SettingError: for a map or a mask of another shape than the images, and views that are not rectified.
    """
    frame, span = image_frame(views, retina), checked_range(nearest_range_m, farthest_range_m)
    values = torch.as_tensor(disparity).detach()
    values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
    require(tuple(values.shape) == frame.size, "disparity.shape", tuple(values.shape), f"{frame.size}, as the images")
    trusted = torch.isfinite(values)
    if valid is not None:
        mask = torch.as_tensor(valid, device=values.device)
        fits = mask.shape == values.shape and mask.dtype == torch.bool
        require(fits, "valid", (tuple(mask.shape), mask.dtype), f"a bool mask {tuple(values.shape)}")
        trusted = trusted & mask
    values = torch.where(trusted, values, torch.zeros_like(values))
    black = torch.zeros_like(values)
    field = Disparity(black, values, trusted, frame.camera, views.doffs_px, views.rig.baseline_m)
    return read_map(field, frame, views.told(budget), span)


def read_map(
    field: Disparity,
    frame: RectifiedPair,
    budget: Budget,
    range_m: tuple[float, float],
    edge_px: float = 1.0,
    pair: Tensor | None = None,
    move: bool = True,
) -> tuple[Correspondences, Disparity]:
    """Read a disparity map of rectified views at the RFs.

    Args:
        field: the map.
        frame: its views.
        budget: which knows the images' size.
        range_m: nearest and farthest depth that are believed.
        edge_px: neighbouring disparities further apart than this are different surfaces, never averaged.
        pair: (2, 1, H, W), both images in grey, to refine the readings of a retina on; None: read only.
        move: whether the images may move a reading, or only say how well they bear it out.

    Returns:
        Correspondences (N, ...), and the map where the left eye looks, with the RFs' clues.
    """
    views, retina, doffs = frame.views, frame.retina, field.doffs_px
    scale, reach = views.scale(retina), field.camera.focal_px * field.baseline_m

    def read(px: Tensor) -> tuple[Tensor, Tensor]:
        place, shown = frame.place(px)
        shift, found = read_values(field.disparity, field.valid, place, edge_px)
        return shift + doffs, found & shown

    left_px = _fields(field, retina)
    place, shown = frame.place(left_px)
    shift, found = read_values(field.disparity, field.valid, place, edge_px)
    shift, found = shift + doffs, found & shown
    reading = None
    if retina is not None and pair is not None:
        reading = refine_reading(left_eye(pair, views, retina), read, shift, found, reach, edge_px, move)
        shift = reading.shift_px
    lowest = reach / range_m[1] if math.isfinite(range_m[1]) else -1.0  # noise may carry infinity to −1 px
    found &= (shift >= lowest) & (shift <= reach / range_m[0])
    shift = shift - doffs
    right_px, seen = frame.there(left_px, place, shift)
    found &= seen
    if frame.looks is not None:
        field = field._replace(image=field.image * frame.looks, valid=field.valid & frame.looks)
    width_px = torch.ones_like(shift) if retina is None else retina.width_px(left_px) * scale
    misfit = None if reading is None else standing_out(reading.rest, width_px, found)
    clues = read_clues(field, place, shift, width_px, misfit)
    if reading is not None:
        clues = clues._replace(noise_px=reading.noise_px, mismatch=reading.mismatch)
    return correspondences(left_px, right_px, found, retina, budget, clues), field._replace(clues=clues)


def read_values(values: Tensor, valid: Tensor, place: Tensor, edge_px: float) -> tuple[Tensor, Tensor]:
    """A disparity map (H, W) at places (N, 2) of its view, and where there is one.

    Bilinear among the four pixels around the place that are valid and on the same surface as the nearest of them, which
    must be valid itself: nothing is averaged over a depth edge.
    """
    height, width = values.shape
    # NaN, which is on no surface, where there is none and around the map
    told = F.pad(torch.where(valid, values, math.nan), (1, 2, 1, 2), value=math.nan).flatten()
    x, y = place[..., 0].clamp(-1, width), place[..., 1].clamp(-1, height)
    left, top = x.floor(), y.floor()
    first = (top.int() + 1) * (width + 3) + (left.int() + 1)
    reference = told.index_select(0, first + (y.round() - top).int() * (width + 3) + (x.round() - left).int())
    across, down = x - left, y - top
    total, weighted = torch.zeros_like(x), torch.zeros_like(x)
    for over, column in ((1 - across, 0), (across, 1)):
        for under, row in ((1 - down, 0), (down, width + 3)):
            value = told.index_select(0, first + (column + row))
            near = (value - reference).abs_() <= edge_px
            weight = over * under * near
            total += weight
            weighted.addcmul_(weight, torch.where(near, value, 0))
    found = total > 0
    return weighted / torch.where(found, total, 1), found


def correspondences(
    left_px: Tensor,
    right_px: Tensor,
    valid: Tensor,
    retina: Retina | None,
    budget: Budget,
    clues: Clues | None = None,
) -> Correspondences:
    """Places (N, 2) in both eyes with their σ from the budget; without a retina in image pixels."""
    right_px = torch.where(valid[:, None], right_px, left_px)
    inlier = valid.to(left_px) if clues is None else valid * inlier_share(budget, clues)
    if retina is None:  # the RFs are the source's pixels
        square = torch.full_like(left_px[:, 0], budget.sigma_over_width**2 + budget.match_px**2)
        left_sigma = right_sigma = (square if clues is None else square + doubt(budget, clues)).sqrt()
        support, source = torch.full_like(left_sigma, 0.5), 1.0
    else:
        left_sigma, right_sigma = (eye_sigma_px(budget, retina, px, clues) for px in (left_px, right_px))
        support, source = retina.width_px(left_px) / 2, 2 * retina.radius_px / (budget.source_px or math.inf)
    lasting = None
    if clues is not None and source > 0:
        lasting = lasting_share(budget, clues, (left_sigma.square() + right_sigma.square()) / source**2)
    return Correspondences(left_px, right_px, left_sigma, right_sigma, valid, inlier, support, lasting)


def checked_range(nearest_range_m: float, farthest_range_m: float) -> tuple[float, float]:
    """Both depths, or SettingError for an impossible range."""
    require(0 < nearest_range_m < math.inf, "nearest_range_m", nearest_range_m, "a positive distance in metres")
    require(farthest_range_m > nearest_range_m, "farthest_range_m", farthest_range_m, f"more than {nearest_range_m}")
    return nearest_range_m, farthest_range_m


def _fields(field: Disparity, retina: Retina | None) -> Tensor:
    """The left eye's RFs, (N, 2); without a retina every pixel, row by row."""
    values = field.disparity
    if retina is not None:
        return retina.centers_px(values.device, values.dtype)
    row, column = (torch.arange(n, device=values.device, dtype=values.dtype) for n in values.shape)
    return columns(*torch.broadcast_tensors(column, row[:, None])).reshape(-1, 2)
