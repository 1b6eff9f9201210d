"""Gaussians of three dimensions in moment and in information form, and the symmetric 3x3 algebra they need.

Layout. Tensors keep the component axis last in shape, but outermost in memory (a structure of arrays, see `columns`),
so that `x.unbind(-1)` gives contiguous components and every formula below runs at the speed of memory. A symmetric
matrix is packed into six columns in the order (xx, xy, xz, yy, yz, zz).

All functions broadcast over leading axes and are differentiable in every tensor argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = [
    "Gaussian",
    "Information",
    "columns",
    "definiteness",
    "gaussian_from_information",
    "information_from_gaussian",
    "inverse3",
    "pack",
    "positive_definite",
    "quadratic3",
    "rotate3",
    "rounding_of_minors",
    "times3",
    "unpack",
]


class Gaussian(NamedTuple):
    """Moment form.

    Attributes:
        mean: (..., 3).
        cov: packed covariance, (..., 6).
    """

    mean: Tensor
    cov: Tensor


class Information(NamedTuple):
    """Information form: vector = matrix @ mean, matrix = inverse covariance.

    Attributes:
        vector: (..., 3).
        matrix: packed information matrix, (..., 6).
    """

    vector: Tensor
    matrix: Tensor


def columns(*components: Tensor) -> Tensor:
    """Join components (...) into (..., k) with each component contiguous in memory."""
    return torch.stack(torch.broadcast_tensors(*components)).movedim(0, -1)


def pack(matrix: Tensor) -> Tensor:
    """Upper triangle of symmetric matrices (..., 3, 3) as packed columns (..., 6)."""
    return columns(*(matrix[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))))


def unpack(sym: Tensor) -> Tensor:
    """Packed (..., 6) as symmetric matrices (..., 3, 3)."""
    matrix: Tensor = sym[..., torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5], device=sym.device)].unflatten(-1, (3, 3))
    return matrix


def inverse3(sym: Tensor) -> Tensor:
    """Inverse of packed symmetric positive definite matrices, (..., 6) to (..., 6), by their factors L D Lᵀ.

    Good to the rounding times the ratio of the eigenvalues, whatever the units of the axes. Cofactors lose twice the
    digits: their determinant multiplies the small eigenvalues.
    """
    xx, xy, xz, yy, yz, zz = sym.unbind(-1)
    one = 1 / xx
    yx, zx = xy * one, xz * one
    two = 1 / (yy - yx * xy)
    left = yz - yx * xz
    zy = left * two
    i_zz = 1 / (zz - zx * xz - zy * left)
    i_yz = -zy * i_zz
    i_yy = two - zy * i_yz
    i_xz = -zx * i_zz - yx * i_yz
    i_xy = -yx * i_yy - zx * i_yz
    return columns(one - yx * i_xy - zx * i_xz, i_xy, i_xz, i_yy, i_yz, i_zz)


def positive_definite(sym: Tensor, tolerance: float | None = None) -> Tensor:
    """Whether packed symmetric matrices are finite and positive definite, (..., 6) to bool (...).

    Sylvester's criterion on the matrix scaled to a unit diagonal, whose minors must exceed `tolerance`: by default the
    rounding of its dtype, so that what passes can be inverted in it.
    """
    return definiteness(sym.detach().unbind(-1), tolerance) > 0


def rounding_of_minors(dtype: torch.dtype) -> float:
    """What the minors of a matrix that can be inverted in a type exceed."""
    return max(8 * torch.finfo(dtype).eps, 1e-13)


def definiteness(sym: Sequence[Tensor], tolerance: float | None = None) -> Tensor:
    """The number that `positive_definite` compares, of six components (...): positive there, elsewhere not, or NaN."""
    xx, xy, xz, yy, yz, zz = sym
    if tolerance is None:
        tolerance = rounding_of_minors(xx.dtype)
    sx, sy, sz = xx.rsqrt(), yy.rsqrt(), zz.rsqrt()  # NaN, which no comparison passes, for what is not positive
    xy, xz, yz = xy * sx * sy, xz * sx * sz, yz * sy * sz
    minor, other, rest = 1 - xy * xy, 1 - xz * xz, yz - xy * xz
    least = torch.minimum(minor, minor * other - rest * rest) - tolerance
    return torch.add(least, xx + yy + zz, alpha=0)  # NaN where a diagonal is infinite


def times3(sym: Tensor, vector: Tensor) -> Tensor:
    """Packed symmetric matrices times vectors, (..., 6) and (..., 3) to (..., 3)."""
    xx, xy, xz, yy, yz, zz = sym.unbind(-1)
    x, y, z = vector.unbind(-1)
    return columns(xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)


def quadratic3(sym: Tensor, vector: Tensor) -> Tensor:
    """The quadratic form vᵀ S v, (..., 6) and (..., 3) to (...)."""
    xx, xy, xz, yy, yz, zz = sym.unbind(-1)
    x, y, z = vector.unbind(-1)
    return xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)


def rotate3(rotation: Tensor, sym: Tensor) -> Tensor:
    """Σ' = R Σ Rᵀ (Eq. 27 with one and the same R on both sides).

    Args:
        rotation: (..., 3, 3), one for all or one for each.
        sym: packed (..., 6).
    """
    rows = rotation.unbind(-2)
    images = [times3(sym, row) for row in rows]
    return columns(*((rows[i] * images[j]).sum(-1) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))))


def information_from_gaussian(gaussian: Gaussian) -> Information:
    """Λ = Σ⁻¹, η = Λ μ."""
    matrix = inverse3(gaussian.cov)
    return Information(times3(matrix, gaussian.mean), matrix)


def gaussian_from_information(information: Information) -> Gaussian:
    """Σ = Λ⁻¹, μ = Σ η."""
    cov = inverse3(information.matrix)
    return Gaussian(times3(cov, information.vector), cov)
