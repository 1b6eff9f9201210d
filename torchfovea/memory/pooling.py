"""One saccade's observations added up, cell by cell, before they join the memory (Sec. 5.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, Information, columns, information_from_gaussian, inverse3, times3

__all__ = ["Pooled", "add_common", "found_points", "nearness", "pool", "pool_patches", "share_errors"]


class Pooled(NamedTuple):
    """What one saccade tells about each cell.

    Attributes:
        information: (..., Nx, 3) and (..., Nx, 6), zero where nothing came; of patches in float64, as the memory's.
        bearing: see `Memory`, (..., Nx).
        hits: number of observations (..., Nx).
    """

    information: Information
    bearing: Tensor
    hits: Tensor


def _sum_up(information: list[Tensor], others: list[Tensor], cell: Tensor, shape: Sequence[int]) -> Pooled:
    """Add up the nine components (M,) of vectors and matrices, and two of bearings and counts, cell by cell."""
    vector_matrix, rest = (
        torch.zeros(len(parts), math.prod(shape), dtype=parts[0].dtype, device=cell.device)
        .scatter_add(1, cell.expand(len(parts), -1), torch.stack(parts))
        .reshape(len(parts), *shape)
        .movedim(0, -1)
        for parts in (information, others)
    )
    return Pooled(Information(vector_matrix[..., :3], vector_matrix[..., 3:9]), *rest.unbind(-1))


def pool(gaussian: Gaussian, cell: Tensor, shape: Sequence[int]) -> Pooled:
    """Add up the information of one saccade's points, cell by cell (Eq. 34-35 without the memory).

    Args:
        gaussian: (M, 3) and (M, 6), points in E.
        cell: (M,) int64, counted through all batches.
        shape: of the memory, (..., Nx).

    Differentiable in the Gaussians.
    """
    vector, matrix = information_from_gaussian(gaussian)
    one = torch.ones_like(vector[..., 0])
    return _sum_up([*vector.unbind(-1), *matrix.unbind(-1)], [torch.zeros_like(one), one], cell, shape)


def pool_patches(
    rho: Tensor,
    variance: Tensor,
    bearing: Tensor,
    row: Tensor,
    keep: Tensor,
    cell: Tensor,
    shape: Sequence[int],
) -> Pooled:
    """Add up the information of one saccade's inverse ranges about the patches that they fall on.

    Args:
        rho: observed inverse ranges (M,) [1/m].
        variance: theirs (M,).
        bearing: precision of their directions (M,) [1/rad²].
        row: their directions in their cells' frames (e₁, e₂, p), (M, 3).
        keep: how often each counts, 1 or 0, (M,).
        cell: (M,) int64, counted through all batches.
        shape: of the memory, (..., Nx).

    Differentiable in all but the cells.
    """
    # each adds to the information of one direction alone: rounded in float32 it would tell of the others too
    x, y, z = row.double().unbind(-1)
    weight = keep / variance
    wx, wy, wz = weight * x, weight * y, weight * z
    parts = [wx * rho, wy * rho, wz * rho, wx * x, wx * y, wx * z, wy * y, wy * z, wz * z]
    return _sum_up(parts, [keep * bearing, keep], cell, shape)


def share_errors(pooled: Pooled, precision: Tensor, patches: Tensor, shared: float) -> tuple[Pooled, Tensor]:
    """Count what a look's fields have in common: their errors do not average out as if each erred by itself.

    Fields of variances v, weighted by 1/v, share c = r/(1 + D) of each variance over a cell that D patches of common
    error cover. With Λ = Σ 1/v and s = Σ 1/√v the variance of their mean is (1 − c)/Λ + c s²/Λ²: what is their own
    averages out, what they share stays, and tells slopes from nothing, for it is the same all over the cell.

    Args:
        pooled: from `pool_patches`.
        precision: Λ, s and Σ √(l/v) with the shares l of their variances that last between looks, (..., Nx, 3).
        patches: D, (..., Nx).
        shared: r.

    Returns:
        The pooled observations with their true information, and the variance of inverse range that lasts (..., Nx).
        Differentiable.
    """
    total, *roots = precision.unbind(-1)
    seen, spread = total > 0, 1 / (1 + patches)
    common, lasting = (torch.where(seen, root / torch.where(seen, total, 1.0), 0.0).square() for root in roots)
    share = shared * spread
    own = 1 / (1 - share)
    information = _with_common(Information(*(own[..., None] * part for part in pooled.information)), share * common)
    return Pooled(information, pooled.bearing, pooled.hits), spread * lasting


def _with_common(information: Information, variance: Tensor) -> Information:
    """Information of patches whose inverse range has an error in common besides, of a variance (...).

    (Λ⁻¹ + v e eᵀ)⁻¹ = Λ − v Λe (Λe)ᵀ/(1 + v eᵀΛe), e the axis of ρ: good for a singular Λ too.
    """
    vector, matrix = information
    xz, yz, zz = matrix[..., 2], matrix[..., 4], matrix[..., 5]
    scale = variance / (1 + variance * zz)
    outer = columns(xz * xz, xz * yz, xz * zz, yz * yz, yz * zz, zz * zz)
    less = scale * vector[..., 2]
    return Information(
        vector - columns(less * xz, less * yz, less * zz), matrix - columns(*(scale * o for o in outer.unbind(-1)))
    )


def add_common(pooled: Pooled, common: Tensor, chart: str, slope_std: float = 0.0) -> Pooled:
    """Add a covariance that all observations of the saccade share (encoder errors) to the pooled one.

    Args:
        pooled: from `pool` or `pool_patches`.
        common: packed covariance (..., Nx, 6): of (x, y, z), or of (a, b, ρ) at the cells.
        chart: of the memory.
        slope_std: patches only: how steep they may be, see `Prior`. A common bearing error shifts what lies on a slope.

    Differentiable.
    """
    seen = (pooled.hits > 0)[..., None]
    vector, matrix = pooled.information
    if chart == "cartesian":
        one = columns(*(torch.full_like(pooled.hits, float(k in (0, 3, 5))) for k in range(6)))
        cov = inverse3(torch.where(seen, matrix, one))
        mean = times3(cov, vector)
        matrix = torch.where(seen, inverse3(cov + common), matrix)
        return pooled._replace(information=Information(torch.where(seen, times3(matrix, mean), vector), matrix))
    aa, _, _, bb, _, rr = common.unbind(-1)
    information = _with_common(pooled.information, rr + slope_std**2 * (aa + bb))
    bearing = pooled.bearing / (1 + pooled.bearing * (aa + bb) / 2)
    return pooled._replace(information=information, bearing=bearing)


def nearness(information: Information, slope: float = 0.0, weak: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """Mean and variance (...) of patches' inverse range at their cells, from their information.

    Args:
        information: of patches (g₁, g₂, ρ), (..., 3) and (..., 6).
        slope: information of each slope to add, which pooled observations may lack.
        weak: the same of ρ, so that empty cells have finite moments too; broadcastable to (...).

    Differentiable.
    """
    x, y, z = information.vector.unbind(-1)
    xx, xy, xz, yy, yz, zz = information.matrix.unbind(-1)
    xx, yy = xx + slope, yy + slope
    scale = 1 / (xx * yy - xy * xy)
    # the row (xz, yz) times the inverse of the slopes' block
    a, b = scale * (xz * yy - yz * xy), scale * (yz * xx - xz * xy)
    variance = 1 / (zz + weak - a * xz - b * yz)
    return variance * (z - a * x - b * y), variance


def found_points(pooled: Pooled, cells: Tensor, chart: str, slope_std: float, far_m: float = 1000.0) -> Tensor:
    """Where a saccade alone sees each cell's point, (..., Nx, 3) [m]; 1 m out where it saw none."""
    seen = pooled.hits > 0
    one, zero = torch.ones_like(pooled.hits), torch.zeros_like(pooled.hits)
    vector, matrix = pooled.information
    if chart == "cartesian":
        safe = torch.where(seen[..., None], matrix, columns(one, zero, zero, one, zero, one))
        return torch.where(seen[..., None], times3(inverse3(safe), vector), cells)
    rho = torch.where(seen, nearness(pooled.information, slope_std**-2, torch.where(seen, zero, one))[0], one)
    return cells / rho.to(cells.dtype).clamp(min=1 / far_m)[..., None]
