"""Directions of the sensory ego-sphere: the biased random topology of Eq. 20-21.

A cell is p = v/|v| with v drawn from a mixture of Gaussians. Its density on the sphere, the projected normal mixture,
has a closed form, so that a bias can be tuned by gradient: in the mixture weights, the means and the Cholesky factors.

References:
    Pukkila, Rao (1988), Pattern recognition based on scale invariant discriminant functions, Information Sciences 45.
    Muller (1959), A note on a method for generating points uniformly on n-dimensional spheres, Comm. ACM 2(4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.memory.topology import (
    Reachable,
    ask,
    fibonacci_directions,
    geodesic_directions,
    latitude_longitude_directions,
    reachable_directions,
    truncated_icosahedron_directions,
)
from torchfovea.rounding import unrounded
from torchfovea.setting import SettingError, require

__all__ = [
    "DirectionMixture",
    "Quadrature",
    "Reachable",
    "direction_mixture",
    "fibonacci_directions",
    "fix_gauge",
    "geodesic_directions",
    "latitude_longitude_directions",
    "log_density",
    "log_normalizer",
    "reachable_directions",
    "sample",
    "sphere_quadrature",
    "truncated_icosahedron_directions",
]

_LOG_2PI = math.log(2 * math.pi)
_FEWEST_ACCEPTED = 1e-4  # share of proposals below which restricted sampling gives up


class DirectionMixture(NamedTuple):
    """A mixture of projected normal distributions; build it with `direction_mixture`, which checks it.

    Attributes:
        logits: logarithms of the weights up to a constant, (M,).
        means: (M, 3).
        cholesky: lower Cholesky factors of the covariances, positive diagonals, (M, 3, 3).
    """

    logits: Tensor
    means: Tensor
    cholesky: Tensor


class Quadrature(NamedTuple):
    """Fixed directions that integrate over a part of the sphere.

    Attributes:
        directions: unit vectors, (Q, 3).
        solid_angle_sr: the part of the sphere each one stands for, (Q,).
    """

    directions: Tensor
    solid_angle_sr: Tensor


def direction_mixture(
    weights: Tensor | Sequence[float],
    means: Tensor | Sequence[Sequence[float]],
    covariances: Tensor | Sequence[Any] | None = None,
    *,
    cholesky: Tensor | Sequence[Any] | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> DirectionMixture:
    """Check and build the mixture of Eq. 21.

    Args:
        weights: (M,), positive; they are normalized.
        means: (M, 3).
        covariances: (M, 3, 3), or their diagonals (M, 3), positive definite.
        cholesky: lower Cholesky factors (M, 3, 3) in place of the covariances.
        dtype: of the result; default that of `means`, or torch's default for lists of numbers.
        device: of the result; default that of `means`.

    Returns:
        The mixture, differentiable in the tensors given.

    Raises:
        SettingError: naming what is wrong: shapes, half precision, values that are not finite, weights that are not
            positive, covariances that are not symmetric positive definite, or factors that are not lower triangular
            with a positive diagonal.
    """
    one = (covariances is None) != (cholesky is None)
    require(one, "covariances", covariances, "either covariances or cholesky, not both")
    mean = _numbers("means", means, dtype, device)
    require(
        mean.ndim == 2 and mean.shape[-1] == 3 and len(mean) > 0, "means", tuple(mean.shape), "the shape (M, 3), M >= 1"
    )
    require(mean.dtype in (torch.float32, torch.float64), "means.dtype", mean.dtype, "torch.float32 or torch.float64")
    m = len(mean)
    weight = _numbers("weights", weights, mean.dtype, mean.device)
    require(weight.shape == (m,), "weights", tuple(weight.shape), f"the shape ({m},), one for each mean")
    require(bool((weight > 0).all()), "weights", weight.tolist(), "positive weights")
    logits = (weight / weight.sum()).log()
    if cholesky is not None:
        factor = _numbers("cholesky", cholesky, mean.dtype, mean.device)
        require(factor.shape == (m, 3, 3), "cholesky", tuple(factor.shape), f"the shape ({m}, 3, 3)")
        lower = bool((factor == factor.tril()).all()) and bool((factor.diagonal(dim1=-2, dim2=-1) > 0).all())
        require(lower, "cholesky", factor.tolist(), "lower triangular matrices with a positive diagonal")
        return DirectionMixture(logits, mean, factor)
    assert covariances is not None
    cov = _numbers("covariances", covariances, mean.dtype, mean.device)
    cov = torch.diag_embed(cov) if cov.shape == (m, 3) else cov
    expected = f"the shape ({m}, 3, 3), or ({m}, 3) for diagonals"
    require(cov.shape == (m, 3, 3), "covariances", tuple(cov.shape), expected)
    scale = cov.detach().abs().amax((-2, -1), keepdim=True)
    symmetric = ((cov - cov.mT).abs() <= 1e-5 * scale).all((-2, -1))
    factor, info = torch.linalg.cholesky_ex(cov)
    for i, good in enumerate((symmetric & (info == 0)).tolist()):
        require(good, f"covariances[{i}]", cov[i].tolist(), "a symmetric positive definite matrix")
    return DirectionMixture(logits, mean, factor)


def _numbers(name: str, value: Any, dtype: torch.dtype | None, device: torch.device | str | None) -> Tensor:
    """A finite floating-point tensor of a user's value."""
    try:
        # lists straight into the dtype asked for: by way of float32 they would lose digits
        tensor = torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else dtype, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise SettingError(f"{name} = {value}: expected numbers in equal rows ({error})") from error
    if dtype is not None or not tensor.is_floating_point():
        tensor = tensor.to(dtype or torch.get_default_dtype())
    require(bool(torch.isfinite(tensor).all()), name, tensor.tolist(), "finite numbers")
    return tensor


@unrounded
def log_density(mixture: DirectionMixture, directions: Tensor) -> Tensor:
    """Log density of directions on the unit sphere, per steradian.

    For one component with Σ = LLᵀ, A = uᵀΣ⁻¹u, B = uᵀΣ⁻¹μ, C = μᵀΣ⁻¹μ and D = B/√A:

        f(u) = (2π)⁻¹ |L|⁻¹ A^(−3/2) exp((D² − C)/2) [(1 + D²)Φ(D) + Dφ(D)]

    Args:
        mixture: of M components.
        directions: (..., 3), of any positive length.

    Returns:
        (...), in the dtype of the mixture. Finite wherever |D| can be squared in it.

    Raises:
        SettingError: for directions that are zero, not finite, or not (..., 3).

    Differentiable in all arguments, once and twice.
    """
    u = _unit(directions).to(mixture.means.dtype)
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    whitening = torch.linalg.solve_triangular(mixture.cholesky, eye, upper=False)
    w = torch.einsum("mij,...j->...mi", whitening, u)
    y = (whitening @ mixture.means.unsqueeze(-1)).squeeze(-1)
    length = w.square().sum(-1).sqrt()
    w = w / length.unsqueeze(-1)
    d = (w * y).sum(-1)
    # C - D² as a cross product: the difference itself would cancel.
    off_axis = torch.linalg.cross(w, y.expand_as(w)).square().sum(-1)
    radial = log_radial_moment(d) - 0.5 * torch.where(d > -deep_tail(d.dtype)[0], off_axis, y.square().sum(-1))
    log_det = mixture.cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return torch.logsumexp(mixture.logits.log_softmax(-1) - _LOG_2PI - log_det - 3 * length.log() + radial, -1)


def deep_tail(dtype: torch.dtype) -> tuple[float, int]:
    """Where the tail formula takes over, at D <= -x, and how deep its continued fraction is."""
    return (2.5, 48) if dtype == torch.float64 else (1.5, 24)


def log_radial_moment(d: Tensor) -> Tensor:
    """Log of Q(D) = (1 + D²)Φ(D) + Dφ(D) for D > -x, and of exp(D²/2) Q(D) in the tail below.

    In the tail Q cancels to 2φ(D)/|D|³ (and so does the form with erfcx). With x = −D and the moments
    J_n = ∫₀^∞ sⁿ exp(−s²/2 − xs) ds, the product is J_2/√(2π); integration by parts gives J_{n+1} = n J_{n−1} − x J_n,
    hence for r_n = J_n/J_{n−1} the continued fraction r_n = n/(x + r_{n+1}), which has positive terms only, and
    J_2 = r_1 r_2/(x + r_1).
    """
    start, depth = deep_tail(d.dtype)
    tail = d <= -start
    body = torch.where(tail, torch.zeros_like(d), d)
    normal = torch.exp(-0.5 * body.square()) * (1 / math.sqrt(2 * math.pi))
    log_body = torch.log((1 + body.square()) * torch.special.ndtr(body) + body * normal)

    deep = torch.where(tail, d, torch.full_like(d, -start))
    x = -deep.detach()
    ratios = [0.5 * (torch.sqrt(x.square() + 4 * (depth + 1)) - x)]
    for n in range(depth, 0, -1):
        ratios = [n / (x + ratios[0]), *ratios[:3]]
    r1, r2, r3, r4 = ratios
    # d log J_2/dD = r_3 and dr_3/dD = r_3 (r_4 − r_3): two derivatives without a graph as deep as the fraction.
    step = deep + x
    log_deep = torch.log(r1 * r2 / (x + r1)) - 0.5 * _LOG_2PI + r3 * step + 0.5 * r3 * (r4 - r3) * step.square()
    return torch.where(tail, log_deep, log_body)


def log_normalizer(mixture: DirectionMixture, quadrature: Quadrature) -> Tensor:
    """Log probability of the part of the sphere that a quadrature covers.

    The mixture restricted to that part has the log density `log_density(...) - log_normalizer(...)`.

    Args:
        mixture: of M components.
        quadrature: from `sphere_quadrature`; its error shows where the density varies between neighbouring directions.

    Returns:
        A scalar, differentiable in the mixture.
    """
    return torch.logsumexp(log_density(mixture, quadrature.directions) + quadrature.solid_angle_sr.log(), 0)


def sphere_quadrature(
    n: int,
    reachable: Reachable | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Quadrature:
    """Equal-weight quadrature over the sphere or its reachable part, on a spherical Fibonacci lattice.

    Args:
        n: directions on the whole sphere; the reachable part keeps its share.
        reachable: predicate of the part, None for the whole sphere.
        dtype: default torch's.
        device: default torch's.

    Raises:
        SettingError: where none of the directions is reachable.
    """
    directions = fibonacci_directions(n, dtype, device)
    if reachable is not None:
        directions = directions[ask(reachable, directions)]
        require(len(directions) > 0, "reachable", "no direction", f"at least one of {n} directions of the sphere")
    return Quadrature(directions, directions.new_full((len(directions),), 4 * math.pi / n))


@unrounded
def sample(
    mixture: DirectionMixture, n: int, generator: torch.Generator | int, reachable: Reachable | None = None
) -> Tensor:
    """Draw cells p = v/|v|, v ~ Σ φ_m N(μ_m, L_m L_mᵀ) (Eq. 21), restricted to a reachable set by rejection.

    Numbers are drawn on the generator's device, so that one seed gives the same cells on every device.

    Args:
        mixture: of M components.
        n: how many.
        generator: random state, or a seed.
        reachable: predicate that the cells must fulfil, None for the whole sphere.

    Returns:
        Unit vectors (n, 3), in the dtype and on the device of the mixture. Differentiable in the means and the Cholesky
        factors for a given choice of components and of accepted draws (the restriction's own gradient is that of
        `log_normalizer`).

    Raises:
        SettingError: if n < 1, or if fewer than one draw in 10,000 is reachable.
    """
    require(n >= 1, "cells", n, "at least 1")
    generator = torch.Generator().manual_seed(generator) if isinstance(generator, int) else generator
    weights = mixture.logits.detach().softmax(-1).to(generator.device)
    mean, factor = mixture.means.detach(), mixture.cholesky.detach()
    kept: list[tuple[Tensor, Tensor]] = []
    accepted = proposed = 0
    while accepted < n:
        share = max(accepted / proposed, _FEWEST_ACCEPTED) if proposed else 1.0
        count = min(int(1.1 * (n - accepted) / share) + 64, 1 << 20)
        component = torch.multinomial(weights, count, replacement=True, generator=generator)
        noise = torch.randn((count, 3), generator=generator, dtype=mean.dtype, device=generator.device)
        component, noise = component.to(mean.device), noise.to(mean.device)
        v = mean[component] + (factor[component] @ noise.unsqueeze(-1)).squeeze(-1)
        good = v.abs().amax(-1) > 0
        if reachable is not None:
            good = good & ask(reachable, torch.nn.functional.normalize(v, dim=-1))
        kept.append((component[good], noise[good]))
        accepted += len(kept[-1][0])
        proposed += count
        enough = proposed < 1 << 17 or accepted >= _FEWEST_ACCEPTED * proposed
        drawn = f"{accepted} of {proposed} directions drawn from the memory's bias"
        expected = f"at least one in {1 / _FEWEST_ACCEPTED:.0f}: the bias and the reachable set do not overlap"
        require(enough, "reachable", drawn, expected)
    component, noise = (torch.cat(parts)[:n] for parts in zip(*kept, strict=True))
    return _unit(mixture.means[component] + (mixture.cholesky[component] @ noise.unsqueeze(-1)).squeeze(-1))


def fix_gauge(mixture: DirectionMixture) -> DirectionMixture:
    """Scale each component so that E|v|² = |μ|² + tr(LLᵀ) = 1; the density of directions is unchanged.

    (μ, L) and (cμ, cL) are one distribution of directions: an optimizer drifts along this gauge unless it is fixed.
    """
    scale = (mixture.means.square().sum(-1) + mixture.cholesky.square().sum((-2, -1))).rsqrt()
    return DirectionMixture(
        mixture.logits.log_softmax(-1), mixture.means * scale[:, None], mixture.cholesky * scale[:, None, None]
    )


def _unit(directions: Tensor) -> Tensor:
    require(directions.shape[-1:] == (3,), "directions", tuple(directions.shape), "the shape (..., 3)")
    largest = directions.detach().abs().amax(-1, keepdim=True)
    require(bool(((largest > 0) & (largest < math.inf)).all()), "directions", "zero or not finite", "non-zero vectors")
    scaled = directions / largest  # so that no square under- or overflows
    return scaled / scaled.square().sum(-1, keepdim=True).sqrt()
