"""A disparity map, read at the receptive fields (RFs) and refined there on the two images themselves.

Block matching prefers whole pixels, and it matches what the retina left of the pictures after interpolating them twice.
The refinement (`torchfovea.stereo.subpixel`) reads the pictures as wide as each RF sees them. Not differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.stereo.costs import Eye, sheet_depth, sheet_rays
from torchfovea.stereo.sheets import average, read_sheet, sheets
from torchfovea.stereo.subpixel import Neighbourhood, smoothed, steps_per_width, subpixel

__all__ = ["Reading", "refine_reading", "standing_out"]

WIDER = 2  # cells by which windows for the misfit are wider than the refinement's


class Reading(NamedTuple):
    """At N RFs.

    Attributes:
        shift_px: disparity as it was read, (N,) [px], `doffs` included.
        noise_px: standard deviation that the images leave it [px]; infinite nowhere.
        mismatch: 1 less the correlation of the neighbourhoods.
        rest: mean square difference that the refinement leaves in windows about twice as wide, 0 where nothing is read.
    """

    shift_px: Tensor
    noise_px: Tensor
    mismatch: Tensor
    rest: Tensor


@torch.no_grad()
def refine_reading(
    eye: Eye,
    read: Callable[[Tensor], tuple[Tensor, Tensor]],
    shift_px: Tensor,
    found: Tensor,
    reach_px_m: float,
    edge_px: float,
    move: bool = True,
) -> Reading:
    """Refine what was read at the RFs.

    Args:
        eye: the left one, with both images (B = 1).
        read: from places (..., 2) of the left eye [retinal px] to disparities with `doffs` (...) [px of the map], and
            whether there is one.
        shift_px: (N,), what it tells of the RFs.
        found: bool (N,).
        reach_px_m: focal length times baseline: disparity = reach/depth.
        edge_px: neighbouring disparities further apart than this are different surfaces.
        move: whether to take the refined disparities, or only what the images say of those that were read.
    """
    parts = sheets(eye.retina, 1 / eye.scale, shift_px.device, shift_px.dtype)
    cells = [sheet.px.flatten(0, 1) for sheet in parts]
    values = (told.split([len(own) for own in cells]) for told in read(torch.cat(cells)))
    rows = []
    for sheet, there, trusted in zip(parts, *values, strict=True):
        ray = sheet_rays(eye, sheet.px)
        depth = sheet_depth(eye, sheet.px)[0]
        there, trusted = there.reshape(depth.shape), trusted.reshape(depth.shape)[None]
        edge = torch.full_like(depth, edge_px)[None]
        level = smoothed(there[None], edge, trusted)
        step = (depth / reach_px_m)[None].clamp(min=1e-9)  # sheets count inverse depth as their rays do
        width_px = steps_per_width(eye, sheet, ray, level * step, step)
        offset = subpixel(eye, sheet, level * step, width_px * step, trusted, Neighbourhood())
        value = torch.where(offset.value.abs() < 1, offset.value, torch.zeros_like(level))
        by = level - there + value * width_px
        weight = trusted.to(by)[:, None]
        wide = average(torch.cat([offset.rest[:, None] * weight, weight], 1), WIDER, sheet.closed)
        refined = [
            by,
            offset.variance.sqrt() * width_px,
            1 - offset.correlation,
            wide[:, 0] / wide[:, 1].clamp(min=1e-3),
        ]
        own, told = read_sheet(sheet, torch.stack(refined, 1), there[None], trusted, edge)
        rows.append(torch.cat([own[0], told.to(own)]))
    # every RF is of one sheet
    every, rf = torch.cat(rows, 1), torch.cat([sheet.rf for sheet in parts])
    by, sigma, differs, rest, told = torch.empty_like(every).scatter_(1, rf.expand(5, -1), every)
    told = (told > 0) & found
    nothing = torch.zeros_like(by)
    shift = shift_px + torch.where(told, by, nothing) if move else shift_px.clone()
    noise = torch.where(told, sigma, edge_px) * found
    return Reading(shift, noise, torch.where(told, differs, 1) * found, torch.where(told, rest, nothing))


@torch.no_grad()
def standing_out(rest: Tensor, width_px: Tensor, found: Tensor) -> Tensor:
    """How far the images' differences stand out from their noise, in its own standard deviations.

    Most readings are right, and what the images differ by there is noise and what interpolation adds; wider RFs average
    more of it away. So the noise is the median over RFs of about one width, and its spread the median departure of all
    RFs from that, both of logarithms. No level of noise need be known.

    Args:
        rest: mean square differences, (N,) (`Reading.rest`).
        width_px: of the RFs (N,) [source px].
        found: bool (N,), which of them have a reading.

    Returns:
        (N,), standard deviations above the median; 0 below it, and where nothing is read.
    """
    told = found & (rest > 0)
    index = told.nonzero()[:, 0]
    if len(index) == 0:
        return torch.zeros_like(rest)
    level = rest.index_select(0, index).clamp(min=1e-12).log()
    step = (3 * width_px.index_select(0, index).clamp(min=1).log2()).round().long()
    for k in step.bincount().nonzero()[:, 0].tolist():
        alike = (step == k).nonzero()[:, 0]
        own = level.index_select(0, alike)
        level.index_copy_(0, alike, own - own.median())
    spread = 1.4826 * level.abs().median()
    return torch.zeros_like(rest).index_copy_(0, index, level.clamp_(min=0) / spread.clamp(min=1e-3))
