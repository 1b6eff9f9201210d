"""The sensory ego-sphere: what the observer knows, one Gaussian for each direction cell (Sec. 5).

One saccade's observations enter in three moves. *Pool*: the observations of a cell add up in information form, as the
paper fuses all (Eq. 34-35). *Add*: what they share, and no averaging removes, is added to the pooled covariance. *Fuse*:
the result joins the memory. With nothing shared the three are exactly Eq. 34-35.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.chart import cartesian_from_inverse_range, turn_cartesian, turn_inverse_range
from torchfovea.gaussian import (
    Gaussian,
    Information,
    columns,
    gaussian_from_information,
    information_from_gaussian,
    inverse3,
    times3,
)
from torchfovea.nearest import CellIndex, nearest_cell, nearest_observation
from torchfovea.setting import require
from torchfovea.triangulation import Observations

__all__ = ["EgoSphere", "Fusion", "Prior", "belief", "cartesian_belief", "fuse", "new_egosphere", "pool", "remember"]


class EgoSphere(NamedTuple):
    """The memory; its size never changes.

    Attributes:
        cells: unit directions in E, (..., Nx, 3) (Eq. 20).
        information: vector (..., Nx, 3) and packed matrix (..., Nx, 6) in the fusion's chart.
        looks: how many saccades brought each cell something, (..., Nx); 0 is unseen.
    """

    cells: Tensor
    information: Information
    looks: Tensor


@dataclass(frozen=True)
class Prior:
    """What a cell believes before it is seen.

    Attributes:
        mean: range along the cell [m] in the Cartesian chart, inverse range [1/m] in the other.
        std: the same unit; the Cartesian prior is isotropic.
        bearing_std: of the two bearing offsets, inverse range only.
    """

    mean: float = 0.4
    std: float = 0.4
    bearing_std: float = 0.1

    def __post_init__(self) -> None:
        """Raise SettingError unless all are positive."""
        for name in ("mean", "std", "bearing_std"):
            require(getattr(self, name) > 0, f"prior.{name}", getattr(self, name), "a positive number")


@dataclass(frozen=True)
class Fusion:
    """How observations enter the memory.

    Attributes:
        name: `inverse_range` (aligned, in that chart), `aligned` (each observation first turned onto its cell's
            direction, Cartesian) or `printed` (the paper's, Cartesian, without the turn: it pulls toward the eye).
        gate_deg: observations farther than this from their cell are dropped, unless their receptive field covers it.
        gate_spacing: the gate is at least this many times the cell's distance to its neighbour.
        slant: a cell is a patch, not a point. An observation off the cell's direction by δ sees the range of another
            place on it; this adds (slant · δ)² to the relative variance of its range. 0: none, as printed.
        fill: whether a cell within a receptive field's cover that got no observation takes the nearest one.
    """

    name: str = "inverse_range"
    gate_deg: float = 0.8
    gate_spacing: float = 2.0
    slant: float = 1.0
    fill: bool = True

    def __post_init__(self) -> None:
        """Raise SettingError for an unknown name or a negative size."""
        names = ("inverse_range", "aligned", "printed")
        require(self.name in names, "fusion", self.name, "one of " + ", ".join(names))
        for name in ("gate_deg", "gate_spacing", "slant"):
            require(getattr(self, name) >= 0, f"fusion.{name}", getattr(self, name), "at least 0")

    @property
    def chart(self) -> str:
        """The chart that the memory is kept in."""
        return "inverse_range" if self.name == "inverse_range" else "cartesian"


def new_egosphere(cells: Tensor, prior: Prior, chart: str = "inverse_range") -> EgoSphere:
    """An empty memory.

    Args:
        cells: unit directions (..., Nx, 3).
        prior: what every cell believes at first.
        chart: of the information, see `Fusion.chart`.

    Raises:
        SettingError: for no cells or directions that are not unit vectors.

    Differentiable in the cells.
    """
    require(cells.shape[-1] == 3 and cells.dim() >= 2, "cells", tuple(cells.shape), "a shape (..., cells, 3)")
    require(cells.shape[-2] > 0, "memory.cells", cells.shape[-2], "at least 1")
    unit = bool(((cells * cells).sum(-1) - 1).abs().max() < 1e-3)
    require(unit, "cells", "directions", "finite unit vectors")
    variance = torch.full_like(cells[..., 0], prior.std**2)
    zero = torch.zeros_like(variance)
    if chart == "cartesian":
        gaussian = Gaussian(prior.mean * cells, columns(variance, zero, zero, variance, zero, variance))
    else:
        bearing = torch.full_like(variance, prior.bearing_std**2)
        mean = columns(zero, zero, torch.full_like(variance, prior.mean))
        gaussian = Gaussian(mean, columns(bearing, zero, zero, bearing, zero, variance))
    return EgoSphere(cells, information_from_gaussian(gaussian), torch.zeros_like(variance))


def _gather(values: Tensor, index: Tensor) -> Tensor:
    """values (..., Nx, k) at index (..., N) as columns (..., N, k)."""
    return columns(*(value.gather(-1, index) for value in values.unbind(-1)))


def _assign(
    memory: EgoSphere, index: CellIndex, spacing_rad: Tensor, observed: Observations, fusion: Fusion
) -> tuple[Observations, Tensor]:
    """Pair observations with cells (Eq. 23): each with its nearest, then each empty covered cell with its nearest.

    Returns observations, as many as pairs, and their cells; pairs out of the gate are invalid.
    """
    cell, cosine = nearest_cell(index, observed.direction)
    angle = torch.acos(cosine.clamp(-1, 1))
    gate = torch.maximum(
        (fusion.gate_spacing * spacing_rad.gather(-1, cell)).clamp(min=fusion.gate_deg * torch.pi / 180),
        observed.support_rad,
    )
    paired = observed._replace(valid=observed.valid & (angle <= gate))
    if not fusion.fill:
        return paired, cell
    got = torch.zeros_like(memory.looks).scatter_add(-1, cell, paired.valid.to(memory.looks.dtype)) > 0
    usable = torch.where(observed.valid[..., None], observed.direction, torch.zeros_like(observed.direction))
    nearest, cosine = nearest_observation(usable, memory.cells)
    angle = torch.acos(cosine.clamp(-1, 1))
    gate = observed.support_rad.gather(-1, nearest).clamp(min=fusion.gate_deg * torch.pi / 180)
    extra = Observations(
        _gather(observed.mean, nearest),
        _gather(observed.cov, nearest),
        _gather(observed.direction, nearest),
        observed.support_rad.gather(-1, nearest),
        ~got & (angle <= gate) & observed.valid.gather(-1, nearest),
    )
    every = torch.arange(memory.cells.shape[-2], device=cell.device).expand(nearest.shape)
    axes = (-2, -2, -2, -1, -1)
    both = (torch.cat(pair, axis) for pair, axis in zip(zip(paired, extra, strict=True), axes, strict=True))
    return Observations(*both), torch.cat([cell, every], -1)


def _onto_cells(observed: Observations, target: Tensor, fusion: Fusion) -> Gaussian:
    """Observations as Gaussians about their cells' directions, with the patch's own scatter along the range."""
    gaussian = Gaussian(observed.mean, observed.cov)
    square = ((observed.direction - target) ** 2).sum(-1) * fusion.slant**2
    if fusion.chart == "inverse_range":
        turned = turn_inverse_range(gaussian, observed.direction, target)
        aa, ab, ar, bb, br, rr = turned.cov.unbind(-1)
        rho = turned.mean[..., 2]
        return Gaussian(turned.mean, columns(aa, ab, ar, bb, br, rr + square * rho * rho))
    if fusion.name == "aligned":
        gaussian = turn_cartesian(gaussian, observed.direction, target)
    if fusion.slant == 0:
        return gaussian
    x, y, z = gaussian.mean.unbind(-1)
    scatter = square[..., None] * columns(x * x, x * y, x * z, y * y, y * z, z * z)
    return gaussian._replace(cov=gaussian.cov + scatter)


def pool(gaussian: Gaussian, cell: Tensor, valid: Tensor, cells: int) -> tuple[Information, Tensor]:
    """Add up the information of one saccade's observations, cell by cell (Eq. 34-35 without the memory).

    Args:
        gaussian: (..., N, 3) and (..., N, 6), about their cells' directions.
        cell: (..., N) int64.
        valid: bool (..., N); the others count nothing.
        cells: Nx.

    Returns:
        Information (..., Nx, 3) and (..., Nx, 6), zero where nothing came, and the number of observations (..., Nx).

    Differentiable in the Gaussians.
    """
    information = information_from_gaussian(gaussian)
    weight = valid.to(gaussian.mean.dtype)
    parts = torch.cat([information.vector, information.matrix, weight[..., None]], -1)
    parts = torch.where(valid[..., None], parts, torch.zeros_like(parts))
    batch = valid.shape[:-1]
    offset = torch.arange(batch.numel(), device=cell.device).reshape(*batch, 1) * cells
    total = torch.zeros(batch.numel() * cells, 10, dtype=parts.dtype, device=parts.device)
    total = total.index_add(0, (cell + offset).flatten(), parts.reshape(-1, 10)).reshape(*batch, cells, 10)
    return Information(total[..., :3], total[..., 3:9]), total[..., 9]


def fuse(memory: EgoSphere, pooled: Information, count: Tensor, common: Tensor | None = None) -> EgoSphere:
    """Join one saccade's pooled observations with the memory.

    Args:
        memory: (..., Nx).
        pooled: their information, see `pool`.
        count: observations of each cell (..., Nx); 0 leaves the cell as it was.
        common: packed covariance (..., Nx, 6) that all observations of the saccade share (encoder errors), or None.

    Differentiable.
    """
    seen = count > 0
    if common is not None:
        one = torch.tensor([0.0, 0, 0, 0, 0, 0], dtype=common.dtype, device=common.device)
        one[[0, 3, 5]] = 1
        matrix = torch.where(seen[..., None], pooled.matrix, one)
        moments = gaussian_from_information(Information(pooled.vector, matrix))
        matrix = inverse3(moments.cov + common)
        pooled = Information(times3(matrix, moments.mean), matrix)
    keep = seen[..., None]
    vector = memory.information.vector + torch.where(keep, pooled.vector, torch.zeros_like(pooled.vector))
    matrix = memory.information.matrix + torch.where(keep, pooled.matrix, torch.zeros_like(pooled.matrix))
    return EgoSphere(memory.cells, Information(vector, matrix), memory.looks + seen)


def remember(
    memory: EgoSphere,
    index: CellIndex,
    spacing_rad: Tensor,
    observed: Observations,
    fusion: Fusion,
    common: Tensor | None = None,
) -> EgoSphere:
    """Enter one saccade's observations: associate (Eq. 22-23), pool, add, fuse (Eq. 34-35).

    Args:
        memory: the ego-sphere before.
        index: of its cells, from `torchfovea.nearest.build_index`.
        spacing_rad: distance of each cell to its neighbours (..., Nx).
        observed: in the fusion's chart.
        fusion: how.
        common: see `fuse`.

    Returns:
        The ego-sphere after. Differentiable in the observations (the association is held fixed).
    """
    pairs, cell = _assign(memory, index, spacing_rad, observed, fusion)
    gaussian = _onto_cells(pairs, _gather(memory.cells, cell), fusion)
    pooled, count = pool(gaussian, cell, pairs.valid, memory.cells.shape[-2])
    return fuse(memory, pooled, count, common)


def belief(memory: EgoSphere) -> Gaussian:
    """Moments in the memory's own chart, (..., Nx, 3) and (..., Nx, 6). Differentiable."""
    return gaussian_from_information(memory.information)


def cartesian_belief(memory: EgoSphere, chart: str) -> Gaussian:
    """Moments in 3-D, in E: what information, exports and pictures use. Differentiable."""
    moments = belief(memory)
    return moments if chart == "cartesian" else cartesian_from_inverse_range(moments, memory.cells)
