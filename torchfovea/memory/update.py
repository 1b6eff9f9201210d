"""How a look enters the memory (Sec. 5.2-5.3).

*Associate*: each observation finds its cell. *Vote* (patches): a cell keeps its surface or takes the look's. *Pool*:
the observations of a cell add up in information form, as the paper fuses all (Eq. 34-35). *Add*: what they share, and
no averaging removes, is added to the pooled covariance. *Fuse*: the result joins the memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchfovea.compiling import kernel
from torchfovea.gaussian import Gaussian, Information, columns
from torchfovea.machine import loops
from torchfovea.memory.association import Pairs, associate, gather_columns
from torchfovea.memory.classes import join_evidence
from torchfovea.memory.counting import count_look
from torchfovea.memory.egosphere import Fusion, Memory, Prior, blend, check_chart, forget
from torchfovea.memory.pooling import Pooled, add_common, found_points, nearness, pool, pool_patches, share_errors
from torchfovea.memory.voting import cast, see
from torchfovea.rounding import unrounded
from torchfovea.sensing.chart import turn_cartesian
from torchfovea.sensing.kinship import Kinship
from torchfovea.sensing.triangulation import Observations
from torchfovea.setting import require

__all__ = ["Common", "fuse", "remember"]

Common = Tensor | Callable[[Tensor], Tensor]
"""Packed covariance (..., Nx, 6) that a saccade's observations share, or a function of their points (..., Nx, 3)."""


def fuse(memory: Memory, pooled: Pooled, lasting: Tensor | None = None) -> Memory:
    """Join one saccade's pooled observations with the memory (Eq. 34-35).

    Args:
        memory: before.
        pooled: what a look tells.
        lasting: what to add to `Memory.lasting`, (..., Nx, 2); None: nothing.

    Differentiable.
    """
    information = Information(*(old + new for old, new in zip(memory.information, pooled.information, strict=True)))
    return memory._replace(
        information=information,
        bearing=memory.bearing + pooled.bearing,
        looks=memory.looks + (pooled.hits > 0),
        lasting=memory.lasting if lasting is None else memory.lasting + lasting,
    )


@unrounded
def remember(
    memory: Memory,
    observed: Observations,
    fusion: Fusion,
    common: Common | None = None,
    kin: Kinship | None = None,
    evidence: Tensor | None = None,
) -> Memory:
    """Enter one saccade's observations: associate (Eq. 22-23), vote, pool, add, fuse (Eq. 34-35).

    Args:
        memory: before.
        observed: in the memory's chart; see `associate` for what is left out.
        fusion: how, in the memory's chart.
        common: see `add_common`; a function of the points that the saccade found, see `torchfovea.memory.encoders`.
        kin: what the observations' errors have in common; None: nothing. Patches only.
        evidence: of each observation for every class, (..., N, K), where the memory asks for it.

    Returns:
        The memory after, in the dtype of the one before. Differentiable in the observations (the association and
        which of them agree are held fixed).

    Raises:
        SettingError: for observations or a fusion of another chart than the memory's, or of another batch.
    """
    check_chart(memory, observed.chart, "observed.chart")
    check_chart(memory, fusion.chart, "fusion.chart")
    batch, mine = tuple(observed.mean.shape[:-2]), tuple(memory.looks.shape[:-1])
    require(batch == mine, "observed.batch", batch, f"{mine}, the memory's")
    cells = memory.cells
    observed = _like(cells, observed)
    if fusion.half_life < math.inf:
        memory = forget(memory, 0.5 ** (1 / fusion.half_life))
    gate_rad = math.radians(fusion.gate_deg)
    pairs = associate(cells, memory.lookup, memory.spacing_rad, observed, gate_rad, fusion.gate_spacing, fusion.fill)
    if evidence is not None and memory.classes is not None:
        memory = memory._replace(classes=join_evidence(memory.classes, evidence, pairs))
    if memory.chart == "cartesian":
        return _remember_points(memory, observed, pairs, fusion, common)
    known = observed.mean, observed.cov, observed.direction, observed.inlier, memory.looks, memory.votes, memory.lasting
    library = loops(*known, None if kin is None else kin.lasting.to(cells.dtype))
    if library is not None:
        join = kin is None and common is None
        counted = count_look(library, memory, observed, pairs, fusion, kin, join)
        return (
            counted.memory
            if counted.pooled is None
            else _join(counted.memory, counted.pooled, counted.kinship, kin, common)
        )
    # where the eye looked last is not asked: what comes with the first look would have to be compiled anew
    after = _remember_patches(memory._replace(axis=None), observed, pairs, fusion, common, kin)
    return after._replace(axis=memory.axis)


def _like(cells: Tensor, observed: Observations) -> Observations:
    """Observations in the cells' dtype."""
    mean, cov, direction, support = (part.to(cells.dtype) for part in observed[:4])
    inlier = None if observed.inlier is None else observed.inlier.to(cells.dtype)
    return Observations(mean, cov, direction, support, observed.valid, inlier, observed.chart)


def _remember_points(
    memory: Memory, observed: Observations, pairs: Pairs, fusion: Fusion, common: Common | None
) -> Memory:
    """The paper's way; every observation is believed."""
    cells = memory.cells
    gaussian = Gaussian(*(gather_columns(part, pairs.observation) for part in (observed.mean, observed.cov)))
    if fusion.name == "aligned":
        direction = gather_columns(observed.direction, pairs.observation)
        gaussian = turn_cartesian(gaussian, direction, gather_columns(cells, pairs.cell))
    pooled = pool(gaussian, pairs.cell, cells.shape[:-1])
    pooled = _add(pooled, memory, common)
    yes, no = memory.votes.unbind(-1)
    return fuse(memory._replace(votes=columns(yes + (pooled.hits > 0), no)), pooled)


@kernel
def _remember_patches(
    memory: Memory,
    observed: Observations,
    pairs: Pairs,
    fusion: Fusion,
    common: Common | None,
    kin: Kinship | None,
) -> Memory:
    """Inverse ranges about patches, of which a cell believes the one that most looks speak for."""
    cells, prior = memory.cells, memory.prior
    sight = see(observed, pairs, cells, prior.slope_std)
    ballot = cast(sight, memory, fusion)
    memory = blend(memory, (~ballot.anew).to(cells.dtype))._replace(votes=ballot.votes)
    pooled = pool_patches(
        sight.rho, sight.variance, sight.bearing, sight.row, ballot.keep, sight.cell, cells.shape[:-1]
    )
    kinship = None
    if kin is not None:
        patch, lasts = (
            part.to(ballot.keep).reshape(-1).index_select(0, pairs.observation) for part in (kin.patch, kin.lasting)
        )
        root = sight.variance.rsqrt()
        parts = torch.stack([root.square(), root, root * lasts.sqrt(), patch]) * ballot.keep
        sums = parts.new_zeros(4, pooled.hits.numel()).scatter_add(1, sight.cell.expand(4, -1), parts)
        *precision, patches = sums.reshape(4, *pooled.hits.shape)
        kinship = columns(*precision), patches
    memory = memory._replace(looks=memory.looks + (ballot.hits > 0))
    return _join(memory, pooled, kinship, kin, common)


def _join(
    memory: Memory,
    pooled: Pooled,
    kinship: tuple[Tensor, Tensor] | None,
    kin: Kinship | None,
    common: Common | None,
) -> Memory:
    """What the look's votes left of the memory, and what it tells with all that its errors have in common."""
    prior, lasting = memory.prior, None
    if kin is not None and kinship is not None:
        pooled, lasting = share_errors(pooled, *kinship, kin.shared)
    pooled = _add(pooled, memory, common)
    if lasting is not None:
        weight = torch.where(pooled.hits > 0, 1 / _variance(pooled, prior), 0.0)
        lasting = columns(weight * torch.where(lasting > 0, lasting, 1.0).sqrt() * (lasting > 0), weight**2 * lasting)
    return fuse(memory, pooled, lasting)._replace(looks=memory.looks)


def _variance(pooled: Pooled, prior: Prior) -> Tensor:
    """Of the pooled inverse range (..., Nx) by itself; 1 where nothing came."""
    return nearness(pooled.information, prior.slope_std**-2, (pooled.hits == 0).to(pooled.hits))[1].to(pooled.hits)


def _add(pooled: Pooled, memory: Memory, common: Common | None) -> Pooled:
    if common is None:
        return pooled
    cells, chart, slope_std = memory.cells, memory.chart, memory.prior.slope_std
    if callable(common):
        common = common(found_points(pooled, cells, chart, slope_std))
    return add_common(pooled, common.to(cells.dtype), chart, slope_std)
