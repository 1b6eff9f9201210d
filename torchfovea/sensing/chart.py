"""Two coordinate systems for a point seen from the ego frame, and Gaussians carried between them.

`cartesian` is (x, y, z). `inverse_range` is (a, b, ρ) about a nominal unit direction n: two bearing offsets on the
plane that touches the sphere at n, and the inverse range,

    X = u / ρ,   u = (n + a e₁ + b e₂) / √(1 + a² + b²),

after the inverse-depth parametrization of Civera, Davison, Montiel (2008). Retinal noise is Gaussian in the retinas,
hence nearly Gaussian here, and badly skewed in range. A negative ρ is a point beyond infinity: noise puts far points
there, and averaging is unbiased only if it is kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, columns
from torchfovea.sensing.unscented import SigmaPoints, moments_of_differences

__all__ = [
    "Components",
    "basis",
    "bilinear_moments",
    "cartesian_from_inverse_range",
    "in_tangent_frame",
    "inverse_range_coordinates",
    "turn_cartesian",
]

Components = Sequence[Tensor]  # of vectors, each (...)


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
    sign = torch.copysign(z.new_ones(()), z)
    a = -1 / (sign + z)
    b = x * y * a
    return columns(1 + sign * x * x * a, sign * b, -sign * x), columns(b, sign + y * y * a, -y)


def in_tangent_frame(direction: Components, vector: Components) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates of vectors along e₁, e₂ and n of `basis`, without forming it.

    With s the sign of z and t = (x v₁ + y v₂)/(s + z) + v₃: e₁·v = v₁ − s x t and e₂·v = s v₂ − y t.

    Args:
        direction: unit n, three components (x, y, z) broadcastable to (...).
        vector: three components (...) in the frame of n.

    Returns:
        Three components (...). Differentiable but on the equator.
    """
    x, y, z = direction
    first, second, third = vector
    sign = torch.copysign(z.new_ones(()), z)
    level = (x * first).addcmul_(y, second)
    t = torch.addcmul(third, (sign + z).reciprocal(), level)
    return (
        torch.addcmul(first, sign * x, t, value=-1),
        (sign * second).addcmul_(y, t, value=-1),
        torch.addcmul(level, z, third),
    )


def inverse_range_coordinates(homogeneous: Tensor, weight: Tensor, direction: Tensor) -> Tensor:
    """Coordinates (a, b, ρ) of the points homogeneous/weight.

    Args:
        homogeneous: (..., 3) in E, finite and in front (a point at infinity has weight 0).
        weight: (...), negative beyond infinity.
        direction: nominal unit directions, broadcastable to (..., 3).

    Returns:
        (..., 3). Differentiable in all.
    """
    e1, e2 = basis(direction)
    ahead = 1 / _dot(direction, homogeneous)
    return columns(
        _dot(e1, homogeneous) * ahead,
        _dot(e2, homogeneous) * ahead,
        weight * _dot(homogeneous, homogeneous).rsqrt(),
    )


def bilinear_moments(
    centre: Tensor,
    by_left: Tensor,
    by_right: Tensor,
    by_both: Tensor,
    alpha: Tensor,
    beta: Tensor,
    points: SigmaPoints,
) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """The unscented transform of a bilinear h(p, q) = (X, w), in inverse range, without forming the sigma points.

    A column of the root moves p and q along one axis i of both, by α and β. The form takes that, for either sign, to

        h(p ± α i, q ± β i) = h(p, q) ± (α h(i, q) + β h(p, i)) + α β h(i, i).

    In the tangent frame of X at the centre, with its length as the unit, the images are X = (a, b, n) and their
    coordinates a/n, b/n and w/|X|; what they share is turned into that frame once.

    Args:
        centre: h(p, q), (4, ..., N).
        by_left: h(i, q) for both axes, (4, 2, ..., N).
        by_right: h(p, i).
        by_both: h(i, i), (4, 2, ..., 1).
        alpha: of both columns, (2, ..., N), standard deviations.
        beta: the same for q.
        points: sigma points of the four dimensions.

    Returns:
        Mean and covariance by components, as `torchfovea.sensing.unscented.moments`, about the direction of the central
        image (3, ..., N). Differentiable.
    """
    length = (centre[:3] * centre[:3]).sum(0).sqrt_()
    *direction, rho = (unit := centre / length).unbind(0)
    scale = points.spread / length
    twice = (alpha * beta * (points.spread * scale)).unsqueeze(1)
    alpha, beta = (alpha * scale).unsqueeze(1), (beta * scale).unsqueeze(1)
    one, signs = rho.new_ones(()), rho.new_tensor([1.0, -1.0]).reshape(-1, *[1] * alpha.dim())
    forms = [h.unbind(0) for h in (by_left, by_right, by_both)]
    parts = zip(*((*in_tangent_frame(direction, h[:3]), h[3]) for h in forms), strict=True)
    image = []
    for start, (p, q, both) in zip((None, None, one, rho), parts, strict=True):
        even = twice * both if start is None else torch.addcmul(start, twice, both)
        image.append(torch.addcmul(even, signs, (alpha * p).addcmul_(beta, q)).flatten(0, 2))
    a, b, n, w = image
    off = w / (a * a).addcmul_(b, b).addcmul_(n, n).sqrt_() - rho
    nearer = n.reciprocal()
    shift, second = moments_of_differences((a * nearer, b * nearer, off), points)
    return [shift[0], shift[1], rho + shift[2]], second, unit[:3]


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
