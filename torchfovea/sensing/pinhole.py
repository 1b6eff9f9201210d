"""The unscented transform of pinhole eyes in inverse range, component by component: the form that compilers want.

It is what `torchfovea.sensing.triangulation.observe` does by stacked tensors (`bilinear_moments`), which is the
definition and as fast as PyTorch's own functions go. Compiled, the components below are one loop over the receptive
fields, in which no intermediate result leaves the processor's registers: on the CPU that of observe.c.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.compiling import kernel
from torchfovea.gaussian import definiteness, rounding_of_minors
from torchfovea.machine import columns_of, loops
from torchfovea.sensing.unscented import SigmaPoints

__all__ = ["Weights", "fast_observations", "pinhole_observations", "weights_of"]

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Weights(NamedTuple):
    """Of the sigma points.

    Attributes:
        spread: their distance in standard deviations.
        each: weight of each but the central one.
        rest: see `torchfovea.sensing.unscented.moments_of_differences`.
        by_axis: see `torchfovea.sensing.unscented.SigmaPoints`.
    """

    spread: float
    each: float
    rest: float
    by_axis: bool


def weights_of(points: SigmaPoints) -> Weights:
    """The numbers of sigma points of four dimensions."""
    mean, cov = points.weights
    return Weights(points.spread, mean[1], sum(cov) - 2, points.by_axis)


def fast_observations(
    left_px: Tensor,
    right_px: Tensor,
    sigmas: tuple[Tensor, Tensor],
    valid: Tensor,
    form: tuple[Tensor, Tensor, Tensor],
    weights: Weights,
    rotated: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """`pinhole_observations` by the loop of observe.c where there is one, else as a kernel; see there."""
    library = loops(left_px, right_px, *sigmas, *form)
    if library is None:
        return pinhole_observations(left_px, right_px, sigmas, valid, form, weights, rotated)
    shape, like = valid.shape, left_px
    share = 1 - 2 * weights.each if weights.by_axis else 1.0
    numbers = (weights.spread, weights.each, 0.0 if weights.by_axis else weights.rest, share, int(rotated))
    given = (
        shape[:-1].numel(),
        shape[-1],
        *map(columns_of, (left_px, right_px)),
        *(sigma.expand(shape).contiguous() for sigma in sigmas),
        valid.contiguous(),
        *(part.expand(*part.shape[: -len(shape)], *shape[:-1], 1).contiguous() for part in form),
    )
    found = (
        like.new_empty(9, *shape),
        like.new_empty(3, *shape),
        torch.empty_like(valid, memory_format=torch.contiguous_format),
    )
    library("observe", given, (*numbers, rounding_of_minors(like.dtype)), found)
    return found


@kernel
def pinhole_observations(
    left_px: Tensor,
    right_px: Tensor,
    sigmas: tuple[Tensor, Tensor],
    valid: Tensor,
    form: tuple[Tensor, Tensor, Tensor],
    weights: Weights,
    rotated: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Moments in inverse range of correspondences of two pinhole eyes.

    Args:
        left_px: (..., N, 2).
        right_px: (..., N, 2).
        sigmas: σₗ and σᵣ, (..., N) [px].
        valid: bool (..., N).
        form: coefficients of the points (4, 3, 3, ..., 1), of the left and of the right depths (3, ..., 1).
        weights: of the sigma points.
        rotated: see `torchfovea.sensing.unscented.sigma_root`.

    Returns:
        Mean and covariance by components (9, ..., N), the directions (3, ..., N), and what is valid; elsewhere a unit
        Gaussian. Differentiable.
    """
    (u, v), (p, q) = left_px.unbind(-1), right_px.unbind(-1)
    (left, right), (point, *depths) = sigmas, form
    f = [[list(row.unbind(0)) for row in h.unbind(0)] for h in point.unbind(0)]
    by_left = [[_affine(row, p, q) for row in h] for h in f]
    by_right = [[_affine([h[0][k], h[1][k], h[2][k]], u, v) for k in range(2)] for h in f]
    centre = [_affine(h, u, v) for h in by_left]
    if rotated:
        scale = (left * left + right * right).rsqrt()
        both = left * right * scale
        alpha, beta = [left * left * scale, both], [-(right * right) * scale, both]
    else:
        alpha, beta = [left, torch.zeros_like(left)], [torch.zeros_like(right), right]
    x, y, z, w = centre
    inverse = (x * x + y * y + z * z).rsqrt()
    direction, rho = [x * inverse, y * inverse, z * inverse], w * inverse
    axes = range(2)
    turned_left, turned_right, turned_both = (
        [_turned(direction, [part[h][i] for h in range(4)]) for i in axes]
        for part in (by_left, by_right, [[h[0][0], h[1][1]] for h in f])
    )
    zero = torch.zeros_like(rho)
    total, evens, odds = [zero, zero, zero], [], []
    for j in axes:
        one, other = (root[j] * weights.spread * inverse for root in (alpha, beta))
        twice = alpha[j] * beta[j] * (weights.spread * weights.spread) * inverse
        for i in axes:
            even = [twice * h for h in turned_both[i]]
            odd = [one * a + other * b for a, b in zip(turned_left[i], turned_right[i], strict=True)]
            ahead, behind = (_off([e + sign * o for e, o in zip(even, odd, strict=True)], rho) for sign in (1.0, -1.0))
            evens.append([a + b for a, b in zip(ahead, behind, strict=True)])
            odds.append([a - b for a, b in zip(ahead, behind, strict=True)])
            total = [t + e for t, e in zip(total, evens[-1], strict=True)]
    shift = [weights.each * t for t in total]
    # δ₊δ₊ᵀ + δ₋δ₋ᵀ is half of o oᵀ + e eᵀ
    share = 1 - 2 * weights.each if weights.by_axis else 1.0
    second = []
    for a, b in _PAIRS:
        square = zero
        for e, o in zip(evens, odds, strict=True):
            square = square + (o[a] * o[b] + share * (e[a] * e[b]))
        square = square * (weights.each / 2)
        second.append(square if weights.by_axis else square + weights.rest * shift[a] * shift[b])
    nearest = [
        _affine(depth.unbind(0), *place) - weights.spread * _largest(depth[:2].unbind(0)) * _largest(root)
        for depth, place, root in zip(depths, ((u, v), (p, q)), (alpha, beta), strict=True)
    ]
    least = torch.minimum(torch.minimum(*nearest), torch.minimum(left, right))
    keep = (torch.minimum(least, definiteness(second)) > 0) & valid
    found = [shift[0], shift[1], rho + shift[2], *second]
    unit = (1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    settled = torch.stack([torch.where(keep, a, b) for a, b in zip(found, unit, strict=True)])
    return settled, torch.stack(direction), keep


def _affine(coefficients: Sequence[Tensor], u: Tensor, v: Tensor) -> Tensor:
    return coefficients[0] * u + coefficients[1] * v + coefficients[2]


def _largest(pair: Sequence[Tensor]) -> Tensor:
    return torch.maximum(pair[0].abs(), pair[1].abs())


def _turned(direction: Sequence[Tensor], vector: Sequence[Tensor]) -> list[Tensor]:
    """`torchfovea.sensing.chart.in_tangent_frame` of the first three components; the fourth stays."""
    (x, y, z), (a, b, c, w) = direction, vector
    sign = torch.copysign(torch.ones_like(z), z)
    level = x * a + y * b
    t = c + level / (sign + z)
    return [a - sign * x * t, sign * b - y * t, level + z * c, w]


def _off(image: Sequence[Tensor], rho: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates of a sigma point's image less those of the central one."""
    a, b, n, w = image
    n = n + 1
    nearer = 1 / n
    return a * nearer, b * nearer, (w + rho) * (a * a + b * b + n * n).rsqrt() - rho
