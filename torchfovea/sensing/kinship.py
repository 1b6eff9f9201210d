"""What the errors of receptive fields have in common, in one look and from look to look."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, edge_doubt, inlier_share
from torchfovea.sensing.retina import Retina

__all__ = ["Kinship", "kinship", "lasting_share", "once_a_pixel"]


class Kinship(NamedTuple):
    """What the errors of one look's receptive fields have in common; `kinship` makes it from a budget.

    Attributes:
        patch: share of a patch of common error that each receptive field covers, (..., N).
        shared: share of the variance that fields of one patch have in common.
        lasting: share of the variance that other looks at the same surface have in common with this one, (..., N).
    """

    patch: Tensor
    shared: float
    lasting: Tensor


def kinship(budget: Budget, retina: Retina, matches: Correspondences) -> Kinship | None:
    """What the errors of one look's correspondences share, by a budget; None: nothing.

    Correlation falls off as exp(−distance/ℓ), ℓ = max(`shared_px` source pixels, `shared_widths` widths), so that a
    patch of common error has the area 2πℓ².

    Args:
        budget: its terms `shared` and `lasting`.
        retina: the layout.
        matches: (..., N); the more a field stands for, the more of a patch it covers.
    """
    if budget.shared == 0:
        return None
    width = retina.width_px(matches.left_px)
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    length = (budget.shared_widths * width).clamp(min=max(budget.shared_px * source, 1e-6))
    covered = width if matches.support_px is None else 2 * matches.support_px
    patch = (covered.square() / (2 * math.pi * length.square())).clamp(max=1)
    lasting = torch.full_like(width, budget.lasting) if matches.lasting is None else matches.lasting
    return Kinship(patch, budget.shared, lasting)


def lasting_share(budget: Budget, clues: Clues, variance_px2: Tensor) -> Tensor:
    """The share of a disparity's variance that another look at the same surface repeats.

    Args:
        budget: its terms.
        clues: of each correspondence (...).
        variance_px2: of the disparity, both eyes' together (...) [source px²].

    Returns:
        (...). What the clues of edges add lasts wholly, for the edges stay, and so does what makes a correspondence
        doubtful; of the rest, `Budget.lasting`. Differentiable.
    """
    smooth = 1 - (2 * edge_doubt(budget, clues) / variance_px2.clamp(min=1e-12)).clamp(max=1)
    return 1 - (1 - budget.lasting) * smooth * inlier_share(budget, clues)


def once_a_pixel(px: Tensor, pixel_px: float, valid: Tensor) -> Tensor:
    """Receptive fields that do not copy another's pixel: of those on one source pixel, the one nearest to its middle.

    Fields narrower than a source pixel read the same few pixels; taken for as many observations, they would count one
    error dozens of times.

    Args:
        px: (N, 2), the fields' centres [retinal px].
        pixel_px: side of a source pixel [retinal px].
        valid: bool (N,), which fields to choose from.

    Returns:
        bool (N,), those chosen.
    """
    at = px.detach().double() / pixel_px
    cell = at.round()
    _, group = torch.unique(cell, dim=0, return_inverse=True)
    away = torch.where(valid, (at - cell).square().sum(-1), math.inf)
    count = int(group.max()) + 1 if len(group) else 0
    nearest = away.new_full((count,), math.inf).scatter_reduce(0, group, away, "amin")
    order = torch.arange(len(px), device=px.device)
    best = torch.where(valid & (away == nearest[group]), order, len(px))
    first = order.new_full((count,), len(px)).scatter_reduce(0, group, best, "amin")
    return valid & (order == first[group])
