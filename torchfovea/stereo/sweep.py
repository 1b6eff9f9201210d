"""Foveated plane sweep: stereo matching in the cortical domain, from images to correspondences with their variance.

For every receptive field (RF) of the left eye hypotheses of inverse depth are tried, each as far from the next as the
two retinas can tell apart there: an RF on the periphery is wide and needs few. A hypothesis takes the RF's
neighbourhood into the right image, which is read as wide as the wider of the two RFs that would see it, and is judged
by the correlation (ZNCC) of the neighbourhoods on the cortical grid. Penalties for steps between neighbours, passed
along rings and sectors (`torchfovea.stereo.semiglobal`), settle what single neighbourhoods cannot. The winner is then
refined on neighbourhoods that follow its surface, which also tells its variance (`torchfovea.stereo.subpixel`).

Nothing is rectified: the eyes may be verged, and pinholes or fisheyes. The choice of the winner is piecewise constant
in the images; everything after it is differentiable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, Disparity, eye_sigma_px, inlier_share
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require
from torchfovea.stereo.confidence import field_clues
from torchfovea.stereo.costs import left_eye, project, sheet_rays
from torchfovea.stereo.rectified import RectifiedMatch
from torchfovea.stereo.rig import StereoRig
from torchfovea.stereo.sheets import nearest_rf, sheets
from torchfovea.stereo.surfaces import Sweep, match_sheet
from torchfovea.stereo.visibility import unrivalled

__all__ = ["Sweep", "SweepRange", "Volume", "match_sweep", "match_sweep_rectified"]


class SweepRange(NamedTuple):
    """What was found along the left eye's rays.

    Attributes:
        inverse_range: (..., N) [1/m] from the left eye; 0 where invalid.
        sigma: (..., N), its standard deviation by the images alone, without the RFs' own width; 0 where
            invalid.
        correlation: (..., N) of the neighbourhoods, up to 1; 0 where invalid.
        valid: bool (..., N).
        clues: of how far each can be trusted (..., N).
    """

    inverse_range: Tensor
    sigma: Tensor
    correlation: Tensor
    valid: Tensor
    clues: Clues


class Volume(NamedTuple):
    """Where to look: a volume of interest, such as a memory gives (paper Sec. 8).

    It limits the search and is no prior: fused with the memory it came from, the result does not count twice.

    Attributes:
        inverse_range: (N,) or (B, N), expected along each left RF's ray, from the left eye [1/m].
        sigma: the same shape, its standard deviation; infinite: anywhere.
    """

    inverse_range: Tensor
    sigma: Tensor


def match_sweep(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    rig: StereoRig,
    camera: Camera,
    retina: Retina,
    params: Sweep | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
    volume: Volume | None = None,
    camera_right: Camera | None = None,
    gaze_px: tuple[float, float] | None = None,
) -> tuple[Correspondences, SweepRange]:
    """Match the two eyes' images on the retinas themselves.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8; or a batch (B, 1 or 3, H, W). The retina spans the shorter side.
        right: the same size.
        rig: the eyes' poses (`torchfovea.stereo.rig`); a batch may have (B, 3, 3) rotations.
        camera: the left eye's, or both eyes', in retinal pixels.
        retina: of both eyes.
        params: the sweep's parameters.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that is tried (beyond 60 degrees from the axis: half the range).
        farthest_range_m: farthest depth; infinite by default.
        volume: where to look, for every left RF; None: everywhere between these.
        camera_right: the right eye's, if it differs.
        gaze_px: image pixel (column, row) of both optical axes; None for the images' middle.

    Returns:
        Correspondences (..., N), one per RF of the left eye, batched as the images; right_sigma_px has the variance of
        the match beside the budget's. And the inverse ranges they come from. Invalid: RFs whose counterpart is off the
        right retina or image, textureless or ambiguous neighbourhoods, RFs that others contradict, and depths out of
        range.

    Raises:
        SettingError: for images that are not finite, not of one size or out of [0, 1], for impossible ranges, and a
            volume that does not fit the retina.

    Differentiable in the images where valid; zero gradient elsewhere.
    """
    params, budget = params or Sweep(), budget or Budget()
    pair, single = _pair(left, right)
    batch, (height, width) = len(pair) // 2, pair.shape[-2:]
    require(0 < nearest_range_m < math.inf, "nearest_range_m", nearest_range_m, "a positive distance in metres")
    require(farthest_range_m > nearest_range_m, "farthest_range_m", farthest_range_m, f"more than {nearest_range_m}")
    size = min(height, width)
    budget = budget if budget.source_px is None else replace(budget, source_px=size)
    middle = ((width - 1) / 2, (height - 1) / 2) if gaze_px is None else gaze_px
    eye = left_eye(pair, rig, camera, camera_right or camera, retina, middle)
    left_px = retina.centers_px(pair.device, pair.dtype)
    ray = sheet_rays(eye, left_px)
    length = ray.detach().square().sum(-1).sqrt()
    widest = 1 / farthest_range_m, 1 / nearest_range_m
    low, high = (length.new_full((batch, retina.count), bound) for bound in widest)
    if volume is not None:
        low, high = (
            b.clamp(*widest) for b in _interval(volume, retina, length.expand(batch, -1), params.volume_sigmas)
        )
    parts = [
        match_sheet(eye, sheet, params, low, high) for sheet in sheets(retina, 1 / eye.scale, pair.device, pair.dtype)
    ]
    order = torch.cat([rf for rf, _, _ in parts]).argsort()
    rho, variance, correlation, unit, misfit = torch.cat([values for _, values, _ in parts], -1)[..., order].unbind(1)
    valid = torch.cat([found for _, _, found in parts], -1)[..., order]

    sigma = torch.where(valid, variance, torch.ones_like(variance)).sqrt()
    u, v, seen = project(eye, ray, torch.stack([rho - sigma, rho, rho + sigma], 1))
    right_px = columns(u[:, 1], v[:, 1])
    place = right_px.detach() * eye.scale + right_px.new_tensor(middle)
    valid = valid & seen[:, 1] & ((place >= -0.5) & (place <= place.new_tensor([width - 0.5, height - 0.5]))).all(-1)
    slack = unit.detach()  # noise may carry a match past the last hypothesis
    valid = valid & (rho.detach() >= low - slack) & (rho.detach() <= high + slack)
    square = ((u[:, 2] - u[:, 0]).square() + (v[:, 2] - v[:, 0]).square()) / 4
    motion = square.detach().sqrt()
    hidden_px = None
    if params.left_right:
        apart = rho.detach() * motion / sigma.detach()
        valid, hidden_px = unrivalled(retina, eye.scale, right_px.detach(), apart, misfit, valid)
    right_px = torch.where(valid[..., None], right_px, left_px)
    zero = torch.zeros_like(rho)
    match_px = torch.where(valid, square, zero)
    noise_px = torch.where(valid, motion, zero) * eye.scale
    slope = torch.where(valid, noise_px / sigma.detach(), zero)
    clues = field_clues(torch.where(valid, rho.detach(), zero), valid, slope, retina, 1 / eye.scale)
    clues = clues._replace(
        noise_px=noise_px, mismatch=torch.where(valid, 1 - correlation.detach(), zero), hidden_px=hidden_px
    )
    matches = Correspondences(
        left_px.expand(batch, -1, -1),
        right_px,
        eye_sigma_px(budget, retina, left_px, clues).expand(batch, -1),
        (eye_sigma_px(budget, retina, right_px, clues).square() + budget.claim**2 * match_px).sqrt(),
        valid,
        valid * inlier_share(budget, clues),
        (retina.width_px(left_px) / 2).expand(batch, -1),
    )
    inverse_range, sigma, correlation = (
        torch.where(valid, x, zero) for x in (rho / length, sigma / length, correlation)
    )
    if single:
        found = SweepRange(inverse_range[0], sigma[0], correlation[0], valid[0], clues.take(0))
        return matches.take(0), found
    return matches, SweepRange(inverse_range, sigma, correlation, valid, clues)


def match_sweep_rectified(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    retina: Retina,
    gaze_px: tuple[float, float] | None = None,
    params: Sweep | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
) -> RectifiedMatch:
    """Match a pair that is already rectified, with retinas that look at the same pixel of both images.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8.
        right: the same size.
        camera_left: the left camera, in image pixels.
        camera_right: the right camera; the same focal length and cy.
        baseline_m: distance between the cameras.
        retina: the layout, which spans the images' shorter side.
        gaze_px: (column, row) the retinas look at; None for the images' middle.
        params: the sweep's parameters.
        budget: as in `match_sweep`.
        nearest_range_m: nearest depth that is tried.
        farthest_range_m: farthest depth.

    Returns:
        As `torchfovea.stereo.rectified.match_rectified`; every pixel of the disparity map shows its nearest RF.

    Raises:
        SettingError: as `match_sweep`, and for cameras that are not rectified.
    """
    rectified = (camera_left.focal_px, camera_left.cy_px) == (camera_right.focal_px, camera_right.cy_px)
    require(rectified, "camera_right", camera_right, f"focal_px and cy_px of the left camera, {camera_left}")
    require(0 < baseline_m < math.inf, "baseline_m", baseline_m, "a positive distance in metres")
    height, width = left.shape[-2:]
    u, v = ((width - 1) / 2, (height - 1) / 2) if gaze_px is None else gaze_px
    scale = min(height, width) / (2 * retina.radius_px)
    mine, theirs = (
        Pinhole(camera.focal_px / scale, (camera.cx_px - u) / scale, (camera.cy_px - v) / scale)
        for camera in (camera_left, camera_right)
    )
    eye = torch.eye(3, dtype=torch.float64)
    matches, found = match_sweep(
        left,
        right,
        StereoRig(eye, eye, baseline_m),
        mine,
        retina,
        params,
        budget,
        nearest_range_m,
        farthest_range_m,
        camera_right=theirs,
        gaze_px=(u, v),
    )
    grey = _pair(left, right)[0][0, 0].detach()
    x = (torch.arange(width, device=grey.device, dtype=grey.dtype) - u) / scale
    y = (torch.arange(height, device=grey.device, dtype=grey.dtype) - v) / scale
    place = columns(x, y[:, None])
    rf = nearest_rf(retina, 1 / scale, place)
    shift = (matches.left_px - matches.right_px)[..., 0].detach() * scale
    seen = matches.valid[rf] & retina.inside(place)
    disparity = torch.where(seen, shift[rf], torch.zeros_like(place[..., 0]))
    doffs = camera_right.cx_px - camera_left.cx_px
    field = Disparity(grey, disparity, seen, camera_left, doffs, baseline_m, clues=found.clues)
    return RectifiedMatch(matches, mine, theirs, field)


def _pair(left: Tensor | np.ndarray, right: Tensor | np.ndarray) -> tuple[Tensor, bool]:
    """Both images in grey, (2B, 1, H, W), all left ones first, checked; and whether they came alone."""
    greys: list[Tensor] = []
    for name, image in (("left", left), ("right", right)):
        pixels = torch.as_tensor(image)
        shape = tuple(pixels.shape)
        fits = len(shape) in (3, 4) and shape[-3] in (1, 3) and min(shape) >= 1
        require(fits, f"{name}.shape", shape, "(3, H, W) or (1, H, W), or a batch of such")
        if pixels.dtype == torch.uint8:
            pixels = pixels.to(torch.get_default_dtype()) / 255
        require(pixels.is_floating_point(), f"{name}.dtype", pixels.dtype, "floating point in [0, 1], or uint8")
        values = pixels.detach()
        require(bool(values.isfinite().all()), name, "NaN or infinite values", "finite values")
        lowest, highest = float(values.min()), float(values.max())
        require(lowest >= -1e-3 and highest <= 1 + 1e-3, name, f"{lowest:g} to {highest:g}", "values in [0, 1]")
        weights = pixels.new_tensor([0.299, 0.587, 0.114] if shape[-3] == 3 else [1.0])  # ITU-R BT.601, as OpenCV's
        greys.append((weights[:, None, None] * pixels).sum(-3, keepdim=True))
    shapes = [tuple(grey.shape) for grey in greys]
    require(shapes[0] == shapes[1], "right.shape", shapes[1], f"{shapes[0]}, as the left image")
    require(min(shapes[0][-2:]) >= 8, "left.shape", shapes[0], "at least 8 pixels on either side")
    single = greys[0].dim() == 3
    return torch.cat([grey[None] if single else grey for grey in (greys[0], greys[1].to(greys[0]))]), single


def _interval(volume: Volume, retina: Retina, length: Tensor, sigmas: float) -> tuple[Tensor, Tensor]:
    """A volume's least and greatest inverse depth, (B, N)."""
    for name, value in zip(Volume._fields, volume, strict=True):
        fits = value.shape in ((retina.count,), tuple(length.shape))
        require(fits, f"volume.{name}.shape", tuple(value.shape), f"({retina.count},) or {tuple(length.shape)}")
        require(not bool(value.isnan().any()), f"volume.{name}", "NaN", "numbers")
    require(bool((volume.sigma > 0).all()), "volume.sigma", float(volume.sigma.min()), "more than 0")
    mean, half = (v.detach().to(length) for v in (volume.inverse_range, volume.sigma * sigmas))
    return (mean - half) * length, (mean + half) * length
