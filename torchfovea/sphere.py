"""Directions of the sensory ego-sphere: the biased random topology of Eq. 20-21 and the regular ones of Fig. 4.

A cell is p = v/|v| with v drawn from a mixture of Gaussians. Its density on the sphere, the projected normal mixture,
has a closed form, so that a bias can be tuned by gradient: in the mixture weights, the means and the Cholesky factors.

References:
    Pukkila, Rao (1988), Pattern recognition based on scale invariant discriminant functions, Information Sciences 45.
    Muller (1959), A note on a method for generating points uniformly on n-dimensional spheres, Comm. ACM 2(4).
    Goldberg (1937), A class of multi-symmetric polyhedra, Tohoku Mathematical Journal 43.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

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

Reachable = Callable[[Tensor], Tensor]
"""Predicate of a set of directions: unit vectors (n, 3) to bool (n,)."""

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
        SettingError: naming what is wrong: shapes, values that are not finite, weights that are not positive,
            covariances that are not symmetric positive definite, or factors that are not lower triangular with a
            positive diagonal.
    """
    one = (covariances is None) != (cholesky is None)
    require(one, "covariances", covariances, "either covariances or cholesky, not both")
    mean = _numbers("means", means, dtype, device)
    require(
        mean.ndim == 2 and mean.shape[-1] == 3 and len(mean) > 0, "means", tuple(mean.shape), "the shape (M, 3), M >= 1"
    )
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
    radial = _log_moment(d) - 0.5 * torch.where(d > -_tail(d.dtype)[0], off_axis, y.square().sum(-1))
    log_det = mixture.cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return torch.logsumexp(mixture.logits.log_softmax(-1) - _LOG_2PI - log_det - 3 * length.log() + radial, -1)


def _tail(dtype: torch.dtype) -> tuple[float, int]:
    """Where the tail formula takes over, at D <= -x, and how deep its continued fraction is."""
    return (2.5, 48) if dtype == torch.float64 else (1.5, 24)


def _log_moment(d: Tensor) -> Tensor:
    """Log of Q(D) = (1 + D²)Φ(D) + Dφ(D) for D > -x, and of exp(D²/2) Q(D) in the tail below.

    In the tail Q cancels to 2φ(D)/|D|³ (and so does the form with erfcx). With x = −D and the moments
    J_n = ∫₀^∞ sⁿ exp(−s²/2 − xs) ds, the product is J_2/√(2π); integration by parts gives J_{n+1} = n J_{n−1} − x J_n,
    hence for r_n = J_n/J_{n−1} the continued fraction r_n = n/(x + r_{n+1}), which has positive terms only, and
    J_2 = r_1 r_2/(x + r_1).
    """
    start, depth = _tail(d.dtype)
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
        directions = directions[_ask(reachable, directions)]
        require(len(directions) > 0, "reachable", "no direction", f"at least one of {n} directions of the sphere")
    return Quadrature(directions, directions.new_full((len(directions),), 4 * math.pi / n))


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
    if isinstance(generator, int):
        generator = torch.Generator().manual_seed(generator)
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
            good = good & _ask(reachable, torch.nn.functional.normalize(v, dim=-1))
        kept.append((component[good], noise[good]))
        accepted += len(kept[-1][0])
        proposed += count
        require(
            proposed < 1 << 17 or accepted >= _FEWEST_ACCEPTED * proposed,
            "reachable",
            f"{accepted} of {proposed} directions drawn from the memory's bias",
            f"at least one in {1 / _FEWEST_ACCEPTED:.0f}: the bias and the reachable set do not overlap",
        )
    component = torch.cat([c for c, _ in kept])[:n]
    noise = torch.cat([e for _, e in kept])[:n]
    return _unit(mixture.means[component] + (mixture.cholesky[component] @ noise.unsqueeze(-1)).squeeze(-1))


def fix_gauge(mixture: DirectionMixture) -> DirectionMixture:
    """Scale each component so that E|v|² = |μ|² + tr(LLᵀ) = 1; the density of directions is unchanged.

    (μ, L) and (cμ, cL) are one distribution of directions: an optimizer drifts along this gauge unless it is fixed.
    """
    power = mixture.means.square().sum(-1) + mixture.cholesky.square().sum((-2, -1))
    scale = power.rsqrt()
    return DirectionMixture(
        mixture.logits.log_softmax(-1), mixture.means * scale[:, None], mixture.cholesky * scale[:, None, None]
    )


def _unit(directions: Tensor) -> Tensor:
    require(directions.shape[-1:] == (3,), "directions", tuple(directions.shape), "the shape (..., 3)")
    largest = directions.detach().abs().amax(-1, keepdim=True)
    require(bool(((largest > 0) & (largest < math.inf)).all()), "directions", "zero or not finite", "non-zero vectors")
    scaled = directions / largest  # so that no square under- or overflows
    return scaled / scaled.square().sum(-1, keepdim=True).sqrt()


def _ask(reachable: Reachable, directions: Tensor) -> Tensor:
    answer = reachable(directions)
    n = len(directions)
    good = answer.dtype == torch.bool and answer.shape == (n,)
    require(good, "reachable", f"{answer.dtype} {tuple(answer.shape)}", f"a predicate that returns bool ({n},)")
    return answer


def fibonacci_directions(n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """Spherical Fibonacci lattice: n directions, each with nearly the same share of the sphere.

    Args:
        n: how many, exactly.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    i = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * i + 1) / n
    azimuth = i * (math.pi * (3 - math.sqrt(5)))
    r = (1 - z * z).sqrt()
    return torch.stack((r * azimuth.cos(), r * azimuth.sin(), z), -1).to(device, dtype or torch.get_default_dtype())


def latitude_longitude_directions(
    n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """The 2-D array of Fig. 4a: rows of latitude, twice as many columns of longitude, denser toward the poles.

    Args:
        n: about how many; the result has 2 rows² directions.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    rows = max(1, round(math.sqrt(n / 2)))
    latitude = ((torch.arange(rows, dtype=torch.float64) + 0.5) / rows - 0.5).mul(math.pi)[:, None]
    longitude = (torch.arange(2 * rows, dtype=torch.float64) + 0.5).mul(math.pi / rows)
    x, y, z = torch.broadcast_tensors(
        latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()
    )
    return torch.stack((x, y, z), -1).flatten(0, 1).to(device, dtype or torch.get_default_dtype())


def geodesic_directions(n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """The geodesic dome of Fig. 4b: vertices of an icosahedron whose faces are divided b times.

    Args:
        n: about how many; the result has 10 b² + 2 directions.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    return _divide(_icosahedron(), round(math.sqrt(max(n - 2, 0) / 10))).to(device, dtype or torch.get_default_dtype())


def truncated_icosahedron_directions(
    n: int = 32, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """The truncated icosahedron of Fig. 4c: its 12 pentagons and 20 hexagons are the cells, and finer ones divide them.

    Args:
        n: about how many; the result has 30 b² + 2 directions (Goldberg's polyhedra of class (b, b)), 32 for b = 1.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    corners = _icosahedron()
    faces = corners[ConvexHull(corners).simplices].sum(1)
    cells = np.concatenate((corners, faces / np.linalg.norm(faces, axis=-1, keepdims=True)))
    return _divide(cells, round(math.sqrt(max(n - 2, 0) / 30))).to(device, dtype or torch.get_default_dtype())


def reachable_directions(topology: Callable[[int], Tensor], n: int, reachable: Reachable) -> Tensor:
    """A regular topology made so dense that about n of its directions are reachable; returns those.

    Args:
        topology: such as `geodesic_directions`, called with a number of directions on the whole sphere.
        n: how many reachable ones to aim at (a regular topology comes in steps).
        reachable: predicate of the reachable set.

    Raises:
        SettingError: where the reachable set is empty or smaller than 1/100,000 of the sphere.
    """
    probe = 100_000
    share = int(_ask(reachable, fibonacci_directions(probe)).sum()) / probe
    require(share > 0, "reachable", "no direction", f"at least one of {probe} directions of the sphere")
    for _ in range(3):  # a topology need not be equally dense everywhere
        directions = topology(max(1, round(n / share)))
        reached = directions[_ask(reachable, directions)]
        share = max(len(reached), 1) / len(directions)
    return reached


def _icosahedron() -> np.ndarray:
    golden = (1 + math.sqrt(5)) / 2
    corners = [np.roll((0.0, i, j * golden), k) for i in (-1, 1) for j in (-1, 1) for k in range(3)]
    return np.stack(corners) / math.hypot(1, golden)


def _divide(vertices: np.ndarray, times: int) -> Tensor:
    """Vertices of a convex polyhedron with triangular faces after each edge is divided `times` (at least 1)."""
    times = max(times, 1)
    i, j = np.meshgrid(np.arange(times + 1), np.arange(times + 1))
    weights = np.stack((i, j, times - i - j), -1)[i + j <= times] / times
    points = np.einsum("wk,fkx->fwx", weights, vertices[ConvexHull(vertices).simplices]).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    _, first = np.unique(np.round(points, 9) + 0.0, axis=0, return_index=True)  # faces share their edges
    return torch.from_numpy(points[np.sort(first)])
