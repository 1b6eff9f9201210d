"""Which surface a cell believes in: every look votes.

Matchers err in two ways: by a little, which a covariance says, and altogether, which none can. So a cell holds one
surface *and* how far the looks so far speak for it, a Beta belief of the share of them that are true (after Vogiatzis
and Hernández 2011). An observation that its surface foretells is a vote for it, as far as it is an inlier; one that it
does not is a vote against it. Where those against are in the majority, the cell takes the surface of the look in place
of its own. A cell that no look has reached judges its first surface by its prior: false matches lie anywhere, true
ones where things are wont to be, so that what seems very near must be seen twice.

Votes are shares of a look, not counts of receptive fields: fields that see one patch of surface err together. What
lasts between looks they share too, so that a doubtful rim stays doubtful however often it is seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Information, columns, quadratic3
from torchfovea.memory.association import Pairs, gather_columns, in_front
from torchfovea.memory.egosphere import FAR_M, Fusion, Memory, belief
from torchfovea.memory.pooling import nearness
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.chart import basis
from torchfovea.sensing.head import Eyes, to_ego
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations

__all__ = ["Ballot", "Sight", "against", "cast", "see", "within_sight"]


TIE = 1.001  # votes that differ by less leave a cell what it has: no rounding decides


class Sight(NamedTuple):
    """One look's observations of patches, in pairs with the cells that they fall on.

    Attributes:
        rho: inverse ranges (M,) [1/m].
        variance: theirs, with what their directions do not tell (M,).
        bearing: precision of their directions (M,) [1/rad²].
        row: their directions in their cells' frames (e₁, e₂, p), (M, 3).
        inlier: probability that each is true at all (M,).
        cell: (M,) int64, counted through all batches.
    """

    rho: Tensor
    variance: Tensor
    bearing: Tensor
    row: Tensor
    inlier: Tensor
    cell: Tensor


class Ballot(NamedTuple):
    """What a look decides.

    Attributes:
        keep: how much each observation counts, its inlier probability or 0, (M,).
        anew: which cells take the look's surface for their own, bool (..., Nx); unseen ones that it reaches too.
        votes: (..., Nx, 2), for and against, after it.
        hits: observations of each cell, (..., Nx).
    """

    keep: Tensor
    anew: Tensor
    votes: Tensor
    hits: Tensor


def see(observed: Observations, pairs: Pairs, cells: Tensor, slope_std: float) -> Sight:
    """A look's observations as rows of a filter of patches.

    Args:
        observed: (..., N), in inverse range.
        pairs: from `torchfovea.memory.association.associate`.
        cells: of the memory (..., Nx, 3).
        slope_std: how steep patches may be [1/m/rad]: seen in a direction that is itself uncertain, the inverse range
            of a slope is so too.

    Differentiable in the observations.
    """
    which = pairs.observation
    aa, _, _, bb, _, rr = (part.reshape(-1).index_select(0, which) for part in observed.cov.unbind(-1))
    across = aa + bb
    target, direction = gather_columns(cells, pairs.cell), gather_columns(observed.direction, which)
    row = columns(*((direction * axis).sum(-1) for axis in (*basis(target), target)))
    rho = observed.mean[..., 2].reshape(-1).index_select(0, which)
    inlier = torch.ones_like(rho) if observed.inlier is None else observed.inlier.reshape(-1).index_select(0, which)
    return Sight(rho, rr + slope_std**2 * across, 2 / across, row, inlier, pairs.cell)


def cast(sight: Sight, memory: Memory, fusion: Fusion) -> Ballot:
    """Count one look's votes.

    Args:
        sight: of the look.
        memory: of patches, before it.
        fusion: how many standard deviations apart two surfaces are two, and what votes go by.

    Differentiable in the inlier probabilities; which observations agree is held fixed.
    """
    prior, seen = memory.prior, memory.looks > 0
    mean, std, slope_std = prior.mean, prior.std, prior.slope_std
    conflict = fusion.conflict
    shape, count = seen.shape, seen.numel()
    has, at = seen.reshape(-1), sight.cell
    with torch.no_grad():
        agrees = has.index_select(0, at)
        ahead = ~agrees
        if conflict < math.inf:
            x, y, z = sight.row.unbind(-1)
            patches = belief(memory)
            a, b, rho = gather_columns(patches.mean, at).unbind(-1)
            variance = sight.variance + quadratic3(gather_columns(patches.cov, at), sight.row)
            off = (sight.rho - (a * x).addcmul_(b, y).addcmul_(rho, z)).square()
            agrees &= off < conflict**2 * variance
            # of what does not agree, the nearest surface hides the rest from E, if it is one
            rest = ~agrees
            spread = (sight.variance + slope_std**2 * (x * x).addcmul_(y, y)).sqrt()
            ahead = rest & in_front(sight.rho, spread, at, count, conflict, rest & (sight.inlier > 0.5))
        # how much more often true surfaces lie there than false matches, which are even in inverse range
        usual = math.log(std * math.sqrt(2 * math.pi) * fusion.nearest_m) + ((sight.rho - mean) / std).square() / 2
        odds = torch.exp(-usual.clamp(min=0))
    inlier = sight.inlier
    believed = torch.where(agrees, inlier, inlier * odds / (inlier * odds + 1 - inlier).clamp(min=1e-12))
    for_it, instead = agrees.to(inlier), ahead.to(inlier)
    sums = torch.zeros(4, count, dtype=inlier.dtype, device=inlier.device)
    rows = torch.stack([for_it, instead, for_it * believed, instead * believed])
    agree, other, pro, contra = sums.scatter_add(1, at.expand(4, -1), rows)
    hits = agree + other
    share = 1 / hits.clamp(min=1)
    pro, contra = (pro * share).clamp(max=1), (contra * share).clamp(max=1)
    yes, no = (part.reshape(-1) for part in memory.votes.unbind(-1))
    reached = hits > 0
    fresh = ~has & reached
    # where nothing agrees the doubt about the look is no vote against the cell
    more_no = no + torch.where(agree > 0, 1 - pro, contra) * reached
    more_yes = yes + pro
    turned = ~fresh & (more_no > TIE * more_yes) & (contra > pro)
    anew = fresh | turned
    kept = torch.where(turned, yes, 0.0)
    more_yes, more_no = torch.where(anew, contra, more_yes), torch.where(anew, kept + 1 - contra, more_no)
    scale = (fusion.window / (more_yes + more_no).clamp(min=fusion.window)).detach()
    new = anew.index_select(0, at)
    keep = inlier * torch.where(new, instead, for_it)
    after = columns(more_yes * scale, more_no * scale).reshape(*shape, 2)
    return Ballot(keep, anew.reshape(shape), after, hits.reshape(shape))


def against(votes: Tensor, missed: Tensor) -> Tensor:
    """Votes (..., Nx, 2) after a look that should have shown some cells' surfaces, bool (..., Nx), and did not."""
    yes, no = votes.unbind(-1)
    return columns(yes, no + missed.to(no))


def within_sight(memory: Memory, among: Tensor, eyes: Eyes, cameras: tuple[Camera, Camera], retina: Retina) -> Tensor:
    """Which of some cells have points that fall on both retinas.

    Args:
        memory: of patches.
        among: the cells that are asked, bool (..., Nx).
        eyes: their poses (...).
        cameras: the left one's and the right one's.
        retina: of both.

    Returns:
        bool (..., Nx); False where not asked. Not differentiable.
    """
    with torch.no_grad():
        lead, which = among.shape[:-1], among.reshape(-1).nonzero().squeeze(1)
        vector, matrix, cells = (gather_columns(part, which) for part in (*memory.information, memory.cells))
        rho = nearness(Information(vector, matrix))[0].to(cells.dtype).clamp(min=1 / FAR_M)[:, None]
        inside = torch.ones_like(rho, dtype=torch.bool)
        poses = ((eyes.R_left, eyes.t_left), (eyes.R_right, eyes.t_right))
        for camera, (rotation, origin) in zip(cameras, poses, strict=True):
            rotation, origin = rotation.expand(*lead, 3, 3).reshape(-1, 3, 3), origin.expand(*lead, 3).reshape(-1, 3)
            if len(rotation) > 1:
                row = which // among.shape[-1]
                rotation, origin = rotation.index_select(0, row), origin.index_select(0, row)
            # directions to points p/ρ, times ρ
            eye = zip(cells[:, None].unbind(-1), origin.unbind(-1), strict=True)
            ray = to_ego(rotation.mT, columns(*(c - rho * o[:, None] for c, o in eye)))
            inside &= camera.in_view(ray) & retina.inside(camera.project(ray))
    return torch.zeros_like(among).view(-1).index_put_((which,), inside[:, 0]).view(among.shape)
