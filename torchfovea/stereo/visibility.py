"""Which matches can be true together: a place of the right eye shows one surface, and is the like of one place.

Beside a near thing lies what the right eye cannot see. Matchers extend the thing over it, by about half a window, or
let it pass into the background; either way its likes on the right belong to somebody else. Of those that claim a place,
or one within the half window, from different depths, the one whose neighbourhood differs least is believed: the
left-right check of semi-global matching, with the small neighbourhoods of a pixel's own difference in place of the
costs that the extension comes from. Not differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.machine import loops
from torchfovea.sensing.retina import Retina
from torchfovea.stereo.sheets import average

__all__ = ["outdone", "undisputed", "unrivalled"]

NEAR = 3  # half a window, in cells: as far as near things are extended
APART = 0.5  # rivals' disparities differ by more, and by more than their places do, in cells
CLEAR = 1.5  # a winner's misfit is less by this factor; else both may stay


@torch.no_grad()
def outdone(
    cell: Tensor, shape: tuple[int, int], disparity: Tensor, misfit: Tensor, valid: Tensor, step: int = 1
) -> tuple[Tensor, Tensor]:
    """Which claims on places of the right eye are outdone by others.

    Args:
        cell: (B, N, 2) int64, the column and row that each claims.
        shape: rows and columns.
        disparity: (B, N), in cells.
        misfit: (B, N), how much the neighbourhoods differ.
        valid: bool (B, N), whether the claim counts.
        step: side of a cell [px]; over larger ones misfits are surer and less apart is apart.

    Returns:
        bool (B, N); and by how much the farthest rival's disparity differs, outdone or not, (B, N) in cells, 0: none.
    """
    rows, across = shape
    library = loops(disparity, misfit)
    if library is not None:
        lost, rivals = torch.empty_like(valid), torch.empty_like(disparity)
        parts = (part.contiguous() for part in (cell.movedim(-1, 0), disparity, misfit, valid))
        library("outdone", (*valid.shape, rows, across, *parts, APART / step, CLEAR ** (1 / step)), lost, rivals)
        return lost, rivals
    column, row = cell.unbind(-1)
    valid = valid & (column >= 0) & (column < across) & (row >= 0) & (row < rows)
    width = across + 2 * NEAR
    none, size = rows * width + NEAR, rows * width + 2 * NEAR + 1
    every = torch.arange(len(valid), device=valid.device)[:, None] * size
    index = (torch.where(valid, row * width + column + NEAR, none) + every).flatten()
    shift, own = disparity.flatten(), torch.where(valid, misfit, torch.inf).flatten()
    least = own.new_full((len(valid) * size,), torch.inf).scatter_reduce_(0, index, own, "amin")
    best = valid.flatten() & (own == least.index_select(0, index))
    # nobody's disparity differs from nothing's
    told = torch.full_like(least, torch.nan).scatter_(0, torch.where(best, index, none), shift)
    told.view(-1, size)[:, none] = torch.nan
    apart = APART / step
    claims = _contested(told, index, shift, apart).nonzero()[:, 0]
    index, shift, own = (part.index_select(0, claims) for part in (index, shift, own))
    out, dispute = torch.zeros_like(claims, dtype=torch.bool), torch.zeros_like(shift)
    for k in range(-NEAR, NEAR + 1):
        there = index + k
        differs = told.index_select(0, there).sub_(shift).abs_()
        rival = differs > apart + abs(k)
        out |= rival & (least.index_select(0, there).mul_(CLEAR ** (1 / step)) < own)
        dispute = torch.where(rival & (differs > dispute), differs, dispute)
    lost, rivals = torch.zeros_like(valid).flatten(), torch.zeros_like(disparity).flatten()
    lost[claims], rivals[claims] = out, dispute
    return lost.view_as(valid), rivals.view_as(disparity)


def _contested(told: Tensor, index: Tensor, disparity: Tensor, apart: float) -> Tensor:
    """Which claims (M,) may have a rival near their cells, bool (M,): few, so that only they need a closer look."""
    high, low = told.nan_to_num(-torch.inf), told.nan_to_num(torch.inf)
    top, bottom = high.clone(), low.clone()
    for k in range(1, NEAR + 1):
        for here, there in ((slice(k, None), slice(None, -k)), (slice(None, -k), slice(k, None))):
            torch.maximum(top[here], high[there] - k, out=top[here])
            torch.minimum(bottom[here], low[there] + k, out=bottom[here])
    slack = 0.9 * apart  # for rounding
    top, bottom = (most.index_select(0, index) for most in (top, bottom))
    return (top - disparity > slack) | (disparity - bottom > slack)


@torch.no_grad()
def undisputed(left: Tensor, right: Tensor, disparity: Tensor, valid: Tensor, step: int = 1) -> tuple[Tensor, Tensor]:
    """Where the disparities of a rectified pair are not outdone by others, bool (H, W); and disputes (H, W) [px].

    Args:
        left: (H, W), grey.
        right: (H, W).
        disparity: (H, W) [px].
        valid: bool (H, W).
        step: see `outdone`.
    """
    height, width = left.shape
    if valid.count_nonzero() < 2:
        return valid, torch.zeros_like(disparity)
    x = torch.arange(width, device=left.device, dtype=left.dtype)
    there = (x - disparity).clamp_(0, width - 1)
    first = there.int().clamp_(max=width - 2)
    row = torch.arange(height, device=left.device)[:, None]
    index, flat = (first + width * row.int()).flatten(), right.flatten()
    one, other = (flat.index_select(0, index + k).view_as(left) for k in (0, 1))
    like = torch.lerp(one, other, there.sub_(first))
    weight = valid.to(left)
    # exposures differ: one gain and offset
    count = weight.sum()
    mine, theirs = ((image - (image * weight).sum() / count) for image in (left, like))
    gain = (mine.square().mul_(weight).sum() / theirs.square().mul_(weight).sum().clamp(min=1e-12)).sqrt()
    square = (mine - gain * theirs).square_()
    misfit = average(torch.stack([square.mul_(weight), weight]), 1, False)
    misfit = misfit[0] / misfit[1].clamp(min=1e-6)
    cell = columns((x - disparity).round().long().view(1, -1), row.expand(-1, width).reshape(1, -1))
    shift, share, claim = (part.view(1, -1) for part in (disparity, misfit, valid))
    lost, rivals = outdone(cell, (height, width), shift, share, claim, step)
    return valid & ~lost.view_as(valid), rivals.view_as(disparity)


@torch.no_grad()
def unrivalled(
    retina: Retina, scale: float, right_px: Tensor, disparity_px: Tensor, misfit: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Which of the RFs' matches are not outdone by others, bool (B, N); and disputes (B, N) [image px].

    Places are cells of a lattice for every octave of RF widths; an RF asks that of its own octave, in which all RFs as
    narrow or narrower have their say.

    Args:
        retina: of both eyes.
        scale: image pixels per retinal pixel.
        right_px: (B, N, 2), where the right eye sees each [retinal px].
        disparity_px: (B, N), along the rectified frame [retinal px].
        misfit: (B, N), how much the neighbourhoods differ.
        valid: bool (B, N).
    """
    own = retina.width_px(retina.centers_px(right_px.device, right_px.dtype))
    width = torch.maximum(retina.width_px(right_px), own)
    octave = torch.where(valid, torch.log2(width * scale).clamp(min=0).ceil(), torch.zeros_like(width)).long()
    out, dispute = valid, torch.zeros_like(disparity_px)
    for k in range(int(octave.max()) + 1):
        pitch = 2.0**k / scale
        reach = int(retina.radius_px / pitch) + 1
        cell = (right_px / pitch).round().long() + reach
        voter = valid & (octave <= k)
        lost, differs = outdone(cell, (2 * reach + 1, 2 * reach + 1), disparity_px / pitch, misfit, voter)
        mine = octave == k
        out, dispute = out & ~(lost & mine), torch.where(mine, differs * 2.0**k, dispute)
    return out, dispute
