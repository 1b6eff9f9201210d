"""The sensory ego-sphere: what the observer knows, one Gaussian for each direction cell (Sec. 5).

In the Cartesian charts a cell holds the point (x, y, z), as printed. In inverse range it holds a *patch*, the plane
q·X = 1 around its direction p. Seen from E, inverse range is linear in the direction, ρ(u) = q·u, so that observations
on different rays of one cell enter exactly, wherever in the cell they fall; a slanted floor neither biases the range
nor passes for noise. In the cell's own frame (e₁, e₂, p) the state is (g₁, g₂, ρ), the slope of the inverse range and
the inverse range itself; an observation of ρ in direction u is the row (u·e₁, u·e₂, u·p) of a linear filter.

One saccade's observations enter in three moves. *Pool*: the observations of a cell add up in information form, as the
paper fuses all (Eq. 34-35). *Add*: what they share, and no averaging removes, is added to the pooled covariance.
*Fuse*: the result joins the memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, Information, columns, gaussian_from_information
from torchfovea.memory.association import associate, gather_columns
from torchfovea.memory.nearest import CellIndex
from torchfovea.memory.pooling import Pooled, add_common, found_points, nearness, pool, pool_in_front
from torchfovea.sensing.chart import turn_cartesian
from torchfovea.sensing.triangulation import Observations
from torchfovea.setting import require

__all__ = [
    "Common",
    "EgoSphere",
    "Fusion",
    "Prior",
    "belief",
    "cartesian_belief",
    "cartesian_from_patches",
    "forget",
    "fuse",
    "new_egosphere",
    "prior_information",
    "remember",
    "settle",
]


Common = Tensor | Callable[[Tensor], Tensor]
"""Packed covariance (..., Nx, 6) that a saccade's observations share, or a function of their points (..., Nx, 3)."""


class EgoSphere(NamedTuple):
    """The memory; its size never changes.

    Attributes:
        cells: unit directions in E, (..., Nx, 3) (Eq. 20).
        information: vector (..., Nx, 3) and packed matrix (..., Nx, 6), of (x, y, z) or of a patch (g₁, g₂, ρ).
        bearing: how well the patches' places across the line of sight are known [1/rad²], (..., Nx); zero in x, y, z.
        looks: how many saccades brought each cell something, (..., Nx); 0 is unseen.
    """

    cells: Tensor
    information: Information
    bearing: Tensor
    looks: Tensor


@dataclass(frozen=True)
class Prior:
    """What a cell believes before it is seen.

    Attributes:
        mean: range along the cell [m] in the Cartesian charts, inverse range [1/m] in the other.
        std: the same unit; the Cartesian prior is isotropic.
        bearing_std: across the line of sight [rad], inverse range only.
        slope_std: of the inverse range over the angle [1/m/rad], inverse range only. A plane at distance d from E has a
            slope of at most 1/d.
    """

    mean: float = 0.4
    std: float = 0.4
    bearing_std: float = 0.1
    slope_std: float = 1.5

    def __post_init__(self) -> None:
        """Raise SettingError unless all are positive, of a size whose square, and its inverse, float32 can hold."""
        for name in ("mean", "std", "bearing_std", "slope_std"):
            value = getattr(self, name)
            require(1e-9 <= value <= 1e9, f"prior.{name}", value, "a positive number, 1e-9 to 1e9")


@dataclass(frozen=True)
class Fusion:
    """How observations enter the memory.

    Attributes:
        name: `inverse_range` (patches), `aligned` (each observation first turned onto its cell's direction, Cartesian)
            or `printed` (the paper's, Cartesian, without the turn: it pulls toward the eye).
        gate_deg: observations farther than this from their cell are dropped, unless their receptive field covers it.
        gate_spacing: the gate is at least this many times the cell's distance to its neighbour.
        fill: whether a cell within a receptive field's cover that got no observation takes the nearest one.
        conflict: patches only. Two inverse ranges this many standard deviations apart are two surfaces, and E sees the
            nearer one alone; inf: they are averaged.
        erode: the share of its information that a cell keeps when a saccade sees past it: once it is the eyes'
            parallax, again and again the memory was wrong. 0: the latest look is believed, which false matches need.
        half_life: saccades after which half of the information is forgotten; inf: never.
    """

    name: str = "inverse_range"
    gate_deg: float = 0.8
    gate_spacing: float = 2.0
    fill: bool = True
    conflict: float = 4.0
    erode: float = 0.0
    half_life: float = math.inf

    def __post_init__(self) -> None:
        """Raise SettingError for an unknown name or a size out of range."""
        names = ("inverse_range", "aligned", "printed")
        require(self.name in names, "fusion", self.name, "one of " + ", ".join(names))
        for name in ("gate_deg", "gate_spacing"):
            require(0 <= getattr(self, name) <= 1e6, f"fusion.{name}", getattr(self, name), "0 to 1e6")
        require(isinstance(self.fill, bool), "fusion.fill", self.fill, "true or false")
        require(self.conflict > 0, "fusion.conflict", self.conflict, "a positive number of standard deviations")
        require(0 <= self.erode <= 1, "fusion.erode", self.erode, "a share from 0 to 1")
        require(self.half_life > 0, "fusion.half_life", self.half_life, "a positive number of saccades")

    @property
    def chart(self) -> str:
        """The chart that the memory is kept in."""
        return "inverse_range" if self.name == "inverse_range" else "cartesian"


def _prior_scalars(cells: Tensor, prior: Prior, chart: str) -> tuple[list[tuple[Tensor | float, float]], float]:
    """The prior's information vector and diagonal matrix, axis by axis, and its bearing precision."""
    weight, slope = prior.std**-2, prior.slope_std**-2
    if chart == "cartesian":
        return [(prior.mean * weight * c, weight) for c in cells.unbind(-1)], 0.0
    return [(0.0, slope), (0.0, slope), (prior.mean * weight, weight)], prior.bearing_std**-2


def prior_information(cells: Tensor, prior: Prior, chart: str = "inverse_range") -> tuple[Information, Tensor]:
    """What every cell believes at first, and its bearing precision, in the shapes of `EgoSphere`."""
    zero = torch.zeros_like(cells[..., 0])
    ((x, xx), (y, yy), (z, zz)), bearing = _prior_scalars(cells, prior, chart)
    matrix = columns(zero + xx, zero, zero, zero + yy, zero, zero + zz)
    return Information(columns(zero + x, zero + y, zero + z), matrix), zero + bearing


def new_egosphere(cells: Tensor, prior: Prior, chart: str = "inverse_range") -> EgoSphere:
    """An empty memory.

    Args:
        cells: unit directions (..., Nx, 3).
        prior: what every cell believes at first.
        chart: of the information, see `Fusion.chart`.

    Raises:
        SettingError: for no cells, directions that are not unit vectors, or an unknown chart.

    Differentiable in the cells.
    """
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    require(cells.dim() >= 2 and cells.shape[-1] == 3, "cells", tuple(cells.shape), "a shape (..., cells, 3)")
    require(cells.numel() > 0, "memory.cells", cells.shape[-2], "at least 1")
    unit = bool(((cells * cells).sum(-1) - 1).abs().max() < 1e-3)
    require(unit, "cells", "directions", "finite unit vectors")
    return EgoSphere(cells, *prior_information(cells, prior, chart), torch.zeros_like(cells[..., 0]))


def settle(memory: EgoSphere, pooled: Pooled, fusion: Fusion, prior: Prior) -> tuple[EgoSphere, Pooled]:
    """A z-buffer between what is remembered and what a saccade brought; patches only.

    Where the two are `fusion.conflict` standard deviations apart they are two surfaces. If the new one is nearer, the
    cell forgets the old one, which it hides. If it is farther, the eyes looked past the old one, which keeps the share
    `fusion.erode` of its information while the new one is not entered; with a share of 0 the new one takes its place.

    Differentiable; which is nearer is held fixed.
    """
    seen = (memory.looks > 0) & (pooled.hits > 0)
    with torch.no_grad():
        new, new_variance = nearness(pooled.information, prior.slope_std**-2, (~seen).to(memory.looks.dtype))
        old, old_variance = nearness(memory.information)
        apart = (new - old) * (new_variance + old_variance).rsqrt()
        nearer, farther = seen & (apart > fusion.conflict), seen & (apart < -fusion.conflict)
        keep = torch.where(farther, fusion.erode, (~nearer).to(apart.dtype))
        take = (~farther).to(apart.dtype) if fusion.erode > 0 else torch.ones_like(apart)
    memory = _blend(memory, prior, "inverse_range", keep)
    information = Information(*(take[..., None] * part for part in pooled.information))
    return memory, Pooled(information, take * pooled.bearing, take * pooled.hits)


def _blend(memory: EgoSphere, prior: Prior, chart: str, keep: Tensor) -> EgoSphere:
    """Keep a share (..., Nx) of what was learned; the rest is the prior's."""
    first, bearing = _prior_scalars(memory.cells, prior, chart)
    less = 1 - keep
    vector, matrix = ([keep * part for part in parts.unbind(-1)] for parts in memory.information)
    for k, (mean, weight) in enumerate(first):
        vector[k] = vector[k] + less * mean
        matrix[(0, 3, 5)[k]] = matrix[(0, 3, 5)[k]] + less * weight
    information = Information(columns(*vector), columns(*matrix))
    return memory._replace(information=information, bearing=keep * memory.bearing + less * bearing)


def forget(memory: EgoSphere, prior: Prior, chart: str, keep: float | Tensor) -> EgoSphere:
    """Let information decay toward the prior.

    Args:
        memory: before.
        prior: what a cell believes that knows nothing.
        chart: of the memory.
        keep: the share that remains, 0 to 1, broadcastable to (..., Nx); for a half-life of h saccades 0.5^(1/h).

    Differentiable. Seen cells stay seen.
    """
    share = torch.as_tensor(keep, dtype=memory.cells.dtype, device=memory.cells.device)
    require(bool(((share >= 0) & (share <= 1)).all()), "keep", keep, "a share from 0 to 1")
    return _blend(memory, prior, chart, share.expand(memory.looks.shape))


def fuse(memory: EgoSphere, pooled: Pooled) -> EgoSphere:
    """Join one saccade's pooled observations with the memory (Eq. 34-35). Differentiable."""
    information = Information(*(old + new for old, new in zip(memory.information, pooled.information, strict=True)))
    return EgoSphere(memory.cells, information, memory.bearing + pooled.bearing, memory.looks + (pooled.hits > 0))


def remember(
    memory: EgoSphere,
    index: CellIndex,
    spacing_rad: Tensor,
    observed: Observations,
    fusion: Fusion,
    prior: Prior,
    common: Common | None = None,
) -> EgoSphere:
    """Enter one saccade's observations: associate (Eq. 22-23), pool, add, fuse (Eq. 34-35).

    Args:
        memory: the ego-sphere before.
        index: of its cells, from `torchfovea.memory.nearest.build_index`.
        spacing_rad: distance of each cell to its neighbours (..., Nx).
        observed: in the fusion's chart; see `associate` for what is left out.
        fusion: how.
        prior: what the memory began with.
        common: see `add_common`; a function of the points that the saccade found, see `torchfovea.memory.encoders`.

    Returns:
        The ego-sphere after, in the dtype of the one before. Differentiable in the observations (the association is
        held fixed).
    """
    mean, cov, direction, support, valid, inlier = observed
    mean, cov, direction, support = (part.to(memory.cells.dtype) for part in (mean, cov, direction, support))
    observed = Observations(mean, cov, direction, support, valid, inlier)
    cells, batch, chart = memory.cells, memory.cells.shape[:-2], fusion.chart
    if fusion.half_life < math.inf:
        memory = forget(memory, prior, chart, 0.5 ** (1 / fusion.half_life))
    gate_rad = math.radians(fusion.gate_deg)
    pairs = associate(cells, index, spacing_rad, observed, gate_rad, fusion.gate_spacing, fusion.fill)
    target = gather_columns(cells, pairs.cell)
    direction = gather_columns(observed.direction, pairs.observation)
    if chart == "cartesian":
        gaussian = Gaussian(*(gather_columns(part, pairs.observation) for part in (observed.mean, observed.cov)))
        if fusion.name == "aligned":
            gaussian = turn_cartesian(gaussian, direction, target)
        pooled = pool(gaussian, pairs.cell, batch, cells.shape[-2])
    else:
        pooled = pool_in_front(observed, direction, target, pairs, cells, fusion.conflict, prior.slope_std)
    if common is not None:
        if callable(common):
            common = common(found_points(pooled, cells, chart, prior.slope_std))
        pooled = add_common(pooled, common.to(cells.dtype), chart, prior.slope_std)
    if chart == "inverse_range" and fusion.conflict < math.inf:
        memory, pooled = settle(memory, pooled, fusion, prior)
    return fuse(memory, pooled)


def belief(memory: EgoSphere) -> Gaussian:
    """Moments in the memory's own coordinates, (..., Nx, 3) and (..., Nx, 6): a point, or a patch (g₁, g₂, ρ).

    Differentiable.
    """
    return gaussian_from_information(memory.information)


def cartesian_belief(memory: EgoSphere, chart: str) -> Gaussian:
    """Moments in 3-D, in E: what information, exports and pictures use. Differentiable."""
    moments = belief(memory)
    return moments if chart == "cartesian" else cartesian_from_patches(moments, memory)


def cartesian_from_patches(moments: Gaussian, memory: EgoSphere, far_m: float = 1000.0) -> Gaussian:
    """Cartesian moments of the patches' points in their cells' directions, to first order.

    Args:
        moments: of the patches, from `belief`.
        memory: whose.
        far_m: an inverse range below 1/far_m is taken as 1/far_m.

    Differentiable.
    """
    r = 1 / moments.mean[..., 2].clamp(min=1 / far_m)
    across = r * r / memory.bearing
    along = r**4 * moments.cov[..., 5] - across
    x, y, z = memory.cells.unbind(-1)
    mean = columns(r * x, r * y, r * z)
    xx, yy, zz = across + along * x * x, across + along * y * y, across + along * z * z
    return Gaussian(mean, columns(xx, along * x * y, along * x * z, yy, along * y * z, zz))
