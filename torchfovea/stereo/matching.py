"""From two retinas to correspondences: where each receptive field (RF) of the left eye is seen by the right eye.

The paper's way (Sec. 7.2): each eye's image goes through its retina and back, both are warped to rectified views that
are parallel to the cyclopean frame, and a dense matcher finds disparities, which are then read at the RFs. Here the way
back and the warp are one interpolation. Nothing in this module is differentiable.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import (
    Budget,
    Clues,
    Correspondences,
    Disparity,
    doubt,
    eye_sigma_px,
    inlier_share,
)
from torchfovea.sensing.retina import Retina, fovea, interpolate
from torchfovea.setting import require
from torchfovea.stereo.confidence import read_clues
from torchfovea.stereo.costs import left_eye
from torchfovea.stereo.exposure import alike
from torchfovea.stereo.readings import refine_reading
from torchfovea.stereo.rig import StereoRig, posed, verged
from torchfovea.stereo.sgbm import SGBM, disparity_sgbm
from torchfovea.stereo.visibility import undisputed

__all__ = [
    "SGBM",
    "Budget",
    "Correspondences",
    "Disparity",
    "StereoRig",
    "eye_sigma_px",
    "match_sgbm",
    "posed",
    "verged",
]


def match_sgbm(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    rig: StereoRig,
    camera: Camera,
    retina: Retina,
    params: SGBM | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> tuple[Correspondences, Disparity]:
    """Match the two eyes' images through their retinas.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8; the retina looks at its middle and spans its shorter side.
        right: the same size.
        rig: the eyes' poses (`verged`, `posed`).
        camera: of both eyes, in retinal pixels.
        retina: of both eyes.
        params: the matcher's parameters.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that can be matched; it sets the search range.
        farthest_range_m: correspondences that triangulate to a greater depth are invalid.

    Returns:
        Correspondences (N, ...) in retinal pixels, one per RF of the left eye, and the disparity they come from.
        Invalid: RFs outside either rectified view or whose counterpart is off the right retina, RFs without a disparity
        (occluded, ambiguous, textureless), and depths out of range.

    Raises:
        SettingError: for images that are not finite, not of one size or out of [0, 1], for impossible ranges, and
            without OpenCV.
    """
    params, budget = params or SGBM(), budget or Budget()
    pair = alike(grey_pair(left, right))
    check_range(nearest_range_m, farthest_range_m)
    size = min(pair.shape[-2:])
    budget = budget if budget.source_px is None else replace(budget, source_px=size)
    values = fovea(pair, None, retina)
    focal = camera.focal_px * size / (2 * retina.radius_px)
    nearest_px = focal * rig.baseline_m / nearest_range_m
    search = params.search(0.0, nearest_px)
    R_left, R_right = rig.R_left.to(pair), rig.R_right.to(pair)
    limit = math.tan(math.radians(params.rectified_fov_deg) / 2)
    (l_low, l_high), (r_low, r_high) = (_extent(camera, retina, R, limit) for R in (R_left, R_right))
    # what both can see of anything between the nearest range and infinity, and the search range to its left
    low = torch.maximum(l_low, r_low)
    high = torch.minimum(l_high, r_high + r_high.new_tensor([rig.baseline_m / nearest_range_m, 0.0]))
    width, height = (((high - low) * focal).ceil().int() + 1).clamp(min=1).tolist()
    before, after = max(search[1], 0), max(-search[0], 0)
    view = Pinhole(focal, before - low[0].item() * focal, -low[1].item() * focal)
    column = torch.arange(before + width + after, device=pair.device, dtype=pair.dtype)
    row = torch.arange(height, device=pair.device, dtype=pair.dtype)
    rays = view.rays(columns(*torch.broadcast_tensors(column, row[:, None])))
    seen = [camera.project(rays @ R) for R in (R_left, R_right)]
    views = [interpolate(values[i : i + 1], retina, px)[0, 0] for i, px in enumerate(seen)]
    ahead = camera.in_view(rays @ R_left)
    near = retina.inside(seen[0] * (1 - 2 / size)) & ahead  # a pixel beyond the rim, whose fields are read there, too
    disparity = dense_disparity(views, search, params, view, 0.0, rig.baseline_m, False, near)

    def read(px: Tensor) -> tuple[Tensor, Tensor]:
        directions = camera.rays(px) @ R_left.mT
        x, y, z = directions.unbind(-1)
        shift, found = read_disparity(disparity, view.project(directions), params.edge_px)
        return shift, found & view.in_view(directions) & (x.abs() <= limit * z) & (y.abs() <= limit * z)

    left_px = retina.centers_px(pair.device, pair.dtype)
    place = view.project(camera.rays(left_px) @ R_left.mT)
    shift, found = read(left_px)
    reach = focal * rig.baseline_m
    middle = ((pair.shape[-1] - 1) / 2, (pair.shape[-2] - 1) / 2)
    eye = left_eye(pair, rig, camera, camera, retina, middle)
    reading = refine_reading(eye, read, shift, found, reach, params.edge_px)
    shift = reading.shift_px
    found &= in_range(shift, reach, nearest_range_m, farthest_range_m)
    there = view.rays(columns(place[..., 0] - shift, place[..., 1])) @ R_right
    right_px = camera.project(there)
    found &= camera.in_view(there) & retina.inside(right_px)
    # nothing where the left eye does not look
    looks = retina.inside(seen[0]) & ahead
    disparity = disparity._replace(image=disparity.image * looks, valid=disparity.valid & looks)
    clues = read_clues(disparity, place, shift, retina.width_px(left_px) * (size / (2 * retina.radius_px)))
    clues = clues._replace(noise_px=reading.noise_px, mismatch=reading.mismatch)
    return correspondences(left_px, right_px, found, retina, budget, clues), disparity._replace(clues=clues)


def grey_pair(left: Tensor | np.ndarray, right: Tensor | np.ndarray) -> Tensor:
    """Both images in grey, (2, 1, H, W); checked."""
    greys = []
    for name, image in (("left", left), ("right", right)):
        pixels = torch.as_tensor(image).detach()
        shape = tuple(pixels.shape)
        require(pixels.dim() == 3 and shape[0] in (1, 3), f"{name}.shape", shape, "(3, H, W) or (1, H, W)")
        require(min(shape) >= 1, f"{name}.shape", shape, "at least one pixel")
        if pixels.dtype == torch.uint8:
            pixels = pixels.to(torch.get_default_dtype()) / 255
        require(pixels.is_floating_point(), f"{name}.dtype", pixels.dtype, "floating point in [0, 1], or uint8")
        require(bool(pixels.isfinite().all()), name, "NaN or infinite values", "finite values")
        low, high = pixels.min().item(), pixels.max().item()
        require(low >= -1e-3 and high <= 1 + 1e-3, name, f"{low:g} to {high:g}", "values in [0, 1]")
        weights = pixels.new_tensor([0.299, 0.587, 0.114] if shape[0] == 3 else [1.0])  # ITU-R BT.601, as OpenCV's
        greys.append((weights[:, None, None] * pixels).sum(0, keepdim=True))
    shapes = [tuple(grey.shape[-2:]) for grey in greys]
    require(shapes[0] == shapes[1], "right.shape", shapes[1], f"{shapes[0]}, the left image's height and width")
    return torch.stack([greys[0], greys[1].to(greys[0])])


def check_range(nearest_range_m: float, farthest_range_m: float) -> None:
    """Raise SettingError for an impossible range of depths."""
    require(0 < nearest_range_m < math.inf, "nearest_range_m", nearest_range_m, "a positive distance in metres")
    require(farthest_range_m > nearest_range_m, "farthest_range_m", farthest_range_m, f"more than {nearest_range_m}")


def _extent(camera: Camera, retina: Retina, rotation: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The box of x/z and y/z that an eye's retina spans in the rectified frame: lowest (2,), highest (2,)."""
    angle = torch.linspace(0, 2 * math.pi, 257, device=rotation.device, dtype=rotation.dtype)
    rim = retina.radius_px * torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    rim = torch.cat([rim, torch.zeros_like(rim[:1])])
    directions = camera.rays(rim) @ rotation.mT
    # what lies behind is beyond the limit on its side
    slope = directions[:, :2] / directions[:, 2:].clamp(min=1e-6)
    slope = slope.clamp(-limit, limit)
    return slope.amin(0), slope.amax(0)


def dense_disparity(
    views: list[Tensor],
    search: tuple[int, int],
    params: SGBM,
    camera: Pinhole,
    doffs_px: float,
    baseline_m: float,
    pad: bool,
    looks: Tensor | None = None,
) -> Disparity:
    """Match two rectified views (H, W); `looks`, bool (H, W), says where the left eye does, everywhere by default."""
    left, right = (view.float().cpu().numpy() for view in views)
    found = disparity_sgbm(left, right, search, params, pad)
    disparity, valid = torch.as_tensor(found[0]).to(views[0]), torch.as_tensor(found[1]).to(views[0].device)
    valid = valid if looks is None else valid & looks
    valid, rival_px = undisputed(views[0], views[1], disparity, valid)
    return Disparity(views[0], disparity, valid, camera, doffs_px, baseline_m, rival_px)


def read_disparity(disparity: Disparity, place: Tensor, edge_px: float) -> tuple[Tensor, Tensor]:
    """The disparity at places (N, 2) of its view, and where there is one.

    Bilinear among the four pixels around the place that are valid and on the same surface as the nearest of them, which
    must be valid itself: nothing is averaged over a depth edge.
    """
    height, width = disparity.disparity.shape
    x, y = place.unbind(-1)
    column, row = x.round(), y.round()
    on = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    zero = torch.zeros_like(x)
    nearest = torch.where(on, row, zero).long() * width + torch.where(on, column, zero).long()
    values, valid = disparity.disparity.flatten(), disparity.valid.flatten()
    reference, found = values[nearest], on & valid[nearest]
    left, top = x.floor(), y.floor()
    total, weighted = zero, zero
    for dx in (0, 1):
        for dy in (0, 1):
            u, v = left + dx, top + dy
            at = v.clamp(0, height - 1).long() * width + u.clamp(0, width - 1).long()
            weight = (1 - (x - u).abs()).clamp(min=0) * (1 - (y - v).abs()).clamp(min=0)
            weight = weight * (valid[at] & ((values[at] - reference).abs() <= edge_px))
            total, weighted = total + weight, weighted + weight * values[at]
    found = found & (total > 0)
    value = weighted / torch.where(found, total, torch.ones_like(total))
    return torch.where(found, value, torch.zeros_like(value)), found


def in_range(shift: Tensor, reach: float, nearest_m: float, farthest_m: float) -> Tensor:
    """Whether disparities (all of it, with doffs) are those of depths in range; noise may carry infinity to −1 px."""
    lowest = reach / farthest_m if math.isfinite(farthest_m) else -1.0
    return (shift >= lowest) & (shift <= reach / nearest_m)


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
        sigma = (square if clues is None else square + doubt(budget, clues)).sqrt()
        half = torch.full_like(left_px[:, 0], 0.5)
        return Correspondences(left_px, right_px, sigma, sigma, valid, inlier, half)
    left_sigma, right_sigma = (eye_sigma_px(budget, retina, px, clues) for px in (left_px, right_px))
    return Correspondences(left_px, right_px, left_sigma, right_sigma, valid, inlier, retina.width_px(left_px) / 2)
