"""How a look enters a memory of patches, by the loops of remember.c in place of a hundred operations on tensors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Information
from torchfovea.machine import Loops, columns_of
from torchfovea.memory.association import Pairs
from torchfovea.memory.egosphere import Fusion, Memory
from torchfovea.memory.pooling import Pooled
from torchfovea.sensing.kinship import Kinship
from torchfovea.sensing.triangulation import Observations

__all__ = ["Counted", "count_look"]


class Counted(NamedTuple):
    """What is known once a look's votes are counted.

    Attributes:
        memory: what is left of the one before, its votes and looks those after the look.
        pooled: what the look tells, from `torchfovea.memory.pooling.pool_patches`; None: it has joined the memory.
        kinship: what `torchfovea.memory.pooling.share_errors` asks for, precision (..., Nx, 3) and patches (..., Nx).
    """

    memory: Memory
    pooled: Pooled | None
    kinship: tuple[Tensor, Tensor] | None


def count_look(
    library: Loops,
    memory: Memory,
    observed: Observations,
    pairs: Pairs,
    fusion: Fusion,
    kin: Kinship | None,
    join: bool,
) -> Counted:
    """What `torchfovea.memory.voting.cast` and `torchfovea.memory.pooling.pool_patches` do with a look.

    Args:
        library: from `torchfovea.machine.loops`, for the dtype of all that follows.
        memory: of patches, before.
        observed: in inverse range.
        pairs: from `torchfovea.memory.association.associate`.
        fusion: how.
        kin: what the observations' errors have in common.
        join: whether what the look tells joins the memory at once; nothing is to be added to it.
    """
    shape, like = memory.looks.shape, memory.cells
    before = (
        *map(columns_of, memory.information),
        memory.bearing.contiguous(),
        memory.looks.contiguous(),
        columns_of(memory.lasting),
        columns_of(memory.votes),
    )
    after = tuple(torch.empty_like(part) for part in before)
    vector, matrix, bearing, looks, lasting, votes = after
    told: tuple[Tensor | None, ...] = (vector, matrix, bearing, None, None)
    sums, rest = (torch.zeros(0 if join else parts, *shape, dtype=t.dtype) for parts, t in ((9, vector), (6, like)))
    if not join:
        told = (sums[:3], sums[3:], rest[0], rest[1], None if kin is None else rest[2:])
    inlier = None if observed.inlier is None else observed.inlier.contiguous()
    shared = (None, None) if kin is None else (kin.patch.to(like).contiguous(), kin.lasting.to(like).contiguous())
    look = (
        len(pairs.cell),
        observed.valid.numel(),
        looks.numel(),
        *pairs,
        *map(columns_of, (observed.mean, observed.cov, observed.direction)),
        inlier,
        *shared,
        columns_of(memory.cells),
    )
    prior = memory.prior
    numbers = (prior.mean, prior.std, prior.bearing_std, prior.slope_std, fusion.conflict, fusion.window)
    settings = tuple(map(float, (*numbers, fusion.nearest_m)))
    library("remember", look, before, after, told, settings)
    known = memory._replace(
        information=Information(vector.movedim(0, -1), matrix.movedim(0, -1)),
        bearing=bearing,
        looks=looks,
        lasting=lasting.movedim(0, -1),
        votes=votes.movedim(0, -1),
    )
    if join:
        return Counted(known, None, None)
    information = Information(sums[:3].movedim(0, -1), sums[3:].movedim(0, -1))
    sought = None if kin is None else (rest[2:5].movedim(0, -1), rest[5])
    return Counted(known, Pooled(information, rest[0], rest[1]), sought)
