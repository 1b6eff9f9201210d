"""Two coordinate systems for a point seen from the ego frame, and Gaussians carried between them.

`cartesian` is (x, y, z). `inverse_range` is (a, b, ρ) about a nominal unit direction n: two bearing offsets on the
plane that touches the sphere at n, and the inverse range,

    X = u / ρ,   u = (n + a e₁ + b e₂) / √(1 + a² + b²),

after the inverse-depth parametrization of Civera, Davison, Montiel (2008). Retinal noise is Gaussian in the retinas,
hence nearly Gaussian here, and badly skewed in range. A negative ρ is a point beyond infinity: noise puts far points
there, and averaging is unbiased only if it is kept.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, columns

__all__ = [
    "basis",
    "cartesian_from_inverse_range",
    "inverse_range_coordinates",
    "turn_cartesian",
]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    x, y, z = a.unbind(-1)
    u, v, w = b.unbind(-1)
    return torch.addcmul(torch.addcmul(x * u, y, v), z, w)


def basis(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit tangents e₁, e₂ of the sphere, (..., 3) to two of (..., 3), with e₁ × e₂ = direction.

    Differentiable but on the equator z = 0, where the branch changes.

    References:
        Duff et al. (2017), Building an orthonormal basis, revisited.
    """
    x, y, z = direction.unbind(-1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    return columns(1 + sign * x * x * a, sign * b, -sign * x), columns(b, sign + y * y * a, -y)


def inverse_range_coordinates(
    homogeneous: Tensor, weight: Tensor, direction: Tensor, tangents: tuple[Tensor, ...] | None = None
) -> Tensor:
    """Coordinates (a, b, ρ) of the points homogeneous/weight.

    Args:
        homogeneous: (..., 3) in E, finite and in front (a point at infinity has weight 0).
        weight: (...), negative beyond infinity.
        direction: nominal unit directions, broadcastable to (..., 3).
        tangents: e₁ and e₂ where they are known in the frame of the points; None: `basis(direction)`.

    Returns:
        (..., 3). Differentiable in all.
    """
    e1, e2 = tangents or basis(direction)
    ahead = 1 / _dot(direction, homogeneous)
    return columns(
        _dot(e1, homogeneous) * ahead,
        _dot(e2, homogeneous) * ahead,
        weight * _dot(homogeneous, homogeneous).rsqrt(),
    )


def cartesian_from_inverse_range(belief: Gaussian, direction: Tensor, far_m: float = 1000.0) -> Gaussian:
    """Cartesian moments of a Gaussian in inverse range, to first order about its mean.

    Args:
        belief: mean (a, b, ρ) (..., 3) and packed covariance (..., 6) about `direction`.
        direction: unit (..., 3).
        far_m: a mean farther than this, or beyond infinity, is taken at this range [m].

    Returns:
        Mean [m] and packed covariance [m²]. Differentiable.
    """
    a, b, rho = belief.mean.unbind(-1)
    r = 1 / rho.clamp(min=1 / far_m)
    e1, e2 = basis(direction)
    norm = (1 + a * a + b * b).rsqrt()
    u = norm[..., None] * (direction + a[..., None] * e1 + b[..., None] * e2)
    mean = r[..., None] * u
    # columns of the Jacobian: ∂X/∂a = r norm (e₁ − norm a u), ∂X/∂b alike, ∂X/∂ρ = −r² u
    j_a = (r * norm)[..., None] * (e1 - (norm * a)[..., None] * u)
    j_b = (r * norm)[..., None] * (e2 - (norm * b)[..., None] * u)
    return Gaussian(mean, _congruence(belief.cov, j_a, j_b, -r[..., None] * mean))


def _congruence(cov: Tensor, *jacobian: Tensor) -> Tensor:
    """J Σ Jᵀ for packed Σ and the three columns (..., 3) of J."""
    xx, xy, xz, yy, yz, zz = cov.unbind(-1)
    j = [c.unbind(-1) for c in jacobian]
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    half = [[sum(rows[k][m] * j[m][i] for m in range(3)) for k in range(3)] for i in range(3)]
    return columns(
        *(
            j[0][p] * half[q][0] + j[1][p] * half[q][1] + j[2][p] * half[q][2]
            for p, q in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        )
    )


def turn_cartesian(belief: Gaussian, source: Tensor, target: Tensor) -> Gaussian:
    """Turn Gaussians by the smallest rotation that takes one direction to another.

    Args:
        belief: (..., 3) and (..., 6) in E.
        source: unit (..., 3).
        target: unit (..., 3), not opposite to source.

    Returns:
        The same shapes. Differentiable.
    """
    half = source + target
    scale = 1 / (1 + _dot(source, target))

    def turn(v: Tensor) -> Tensor:
        return v - (scale * _dot(half, v))[..., None] * half + (2 * _dot(source, v))[..., None] * target

    # the columns of R are the images of the axes of E
    axes = torch.eye(3, dtype=source.dtype, device=source.device).expand(*source.shape[:-1], 3, 3).unbind(-2)
    return Gaussian(turn(belief.mean), _congruence(belief.cov, *(turn(axis) for axis in axes)))
