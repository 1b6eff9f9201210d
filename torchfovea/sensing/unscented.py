"""The unscented transform: moments of any function of a Gaussian, as one batched tensor operation (Eq. 9-18).

References:
    Julier, Uhlmann (2004), Unscented filtering and nonlinear estimation.
    van der Merwe (2004), Sigma-point Kalman filters for probabilistic inference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.setting import check_types, require

__all__ = [
    "SigmaPoints",
    "eye_root",
    "moments",
    "moments_of_differences",
    "root_rows",
    "sigma_components",
    "sigma_root",
    "unscented_transform",
]


@dataclass(frozen=True)
class SigmaPoints:
    """Where the 2n + 1 sigma points lie and what they weigh.

    The default puts them at ±√3 standard deviations with equal weights for mean and covariance. Along each axis of the
    square root that is three-point Gauss-Hermite quadrature, exact to fifth order. The paper's choice is `paper()`.

    With a negative weight of the centre, Eq. 18 may give a negative variance, or none: −4 for the default and |x|² of
    four standard normals, where 8 is right. Where that can happen (`by_axis`) the covariances of the quadratures along
    the axes add up instead, as they do for a function that is a sum over the axes. Where only one axis is curved, both
    are the same.

    Attributes:
        dimensions: n, of the input.
        alpha: spread (Eq. 14-16), > 0.
        beta: prior knowledge of the distribution.
        kappa: secondary scaling; n + kappa > 0.
    """

    dimensions: int = 4
    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = -1.0

    def __post_init__(self) -> None:
        """Raise SettingError for parameters without real sigma points."""
        check_types(self, "sigma_points.")
        require(self.dimensions >= 1, "sigma_points.dimensions", self.dimensions, "at least 1")
        require(self.alpha > 0, "sigma_points.alpha", self.alpha, "a positive spread")
        require(
            self.dimensions + self.kappa > 0,
            "sigma_points.kappa",
            self.kappa,
            f"more than -{self.dimensions}, so that dimensions + kappa is positive",
        )
        for name in ("alpha", "beta", "kappa"):
            require(math.isfinite(getattr(self, name)), f"sigma_points.{name}", getattr(self, name), "a finite number")
        require(
            not self.by_axis or self.spread >= 1,
            "sigma_points.beta",
            self.beta,
            f"more than {-(self.alpha**2) * self.kappa / self.dimensions:g}, or points at a standard deviation or "
            "more: otherwise variances may be negative",
        )

    @staticmethod
    def paper() -> SigmaPoints:
        """The authors' parameters for a correspondence: L 4, α 0.25, β 2, κ 3."""
        return SigmaPoints(4, 0.25, 2.0, 3.0)

    @staticmethod
    def midpoint() -> SigmaPoints:
        """For the midpoint method in the Cartesian chart: at ±1 standard deviation, β 1.

        The midpoint of skew rays lies at D/(D² + v²) of the disparities, horizontal and vertical. To fourth order in
        e = σ/D its variance is e²(1 + 4e²), of which products of D and v take 6e² off what 1/D alone has; points on the
        axes, at ±s, see no products and find e²(1 + 4s²e²): right for s = 1, and 8% too much at e = 0.1 for s = √3.
        """
        return SigmaPoints(4, 1.0, 1.0, -3.0)

    @property
    def spread(self) -> float:
        """√(L + λ), the distance of the sigma points in standard deviations (Eq. 11-12)."""
        return self.alpha * math.sqrt(self.dimensions + self.kappa)

    @property
    def by_axis(self) -> bool:
        """Whether Eq. 18 may give a negative variance, or none, so that variances are those along each axis, added up.

        Σ w_c (δ − s)(δ − s)ᵀ = w Σ δδᵀ + (β − α²) s sᵀ with s = w Σ δ, and s sᵀ is at most n/spread² of the first term.
        """
        return self.beta <= -(self.alpha**2) * self.kappa / self.dimensions

    @cached_property
    def weights(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Weights of the mean and of the covariance (Eq. 14-16), 2n + 1 each, in float64, from filterpy."""
        from filterpy.kalman import MerweScaledSigmaPoints

        merwe = MerweScaledSigmaPoints(self.dimensions, alpha=self.alpha, beta=self.beta, kappa=self.kappa)
        return tuple(merwe.Wm.tolist()), tuple(merwe.Wc.tolist())


def unscented_transform(
    function: Callable[[Tensor], Tensor], mean: Tensor, root: Tensor, points: SigmaPoints
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and covariance of `function(x)` for Gaussian x (Eq. 9-18).

    Args:
        function: maps (2n+1, ..., n) to (2n+1, ..., m), element by element.
        mean: (..., n).
        root: (..., n, n), any square root of the covariance (Σ = root rootᵀ); its *columns* carry the sigma points.
        points: their spread and weights, for the same n.

    Returns:
        mean (..., m), covariance packed row by row as its upper triangle (..., m(m+1)/2), and the images of all sigma
        points (2n+1, ..., m), the mean's own first.

    Raises:
        SettingError: if n does not fit.

    Differentiable in mean and root. The moments are formed from differences to the central image, so that the large
    weights of the paper's parameters (−8.14 and 1.14) cost no precision in float32.
    """
    n = mean.shape[-1]
    require(points.dimensions == n, "sigma_points.dimensions", points.dimensions, f"{n}, the size of the input")
    rows = [[root[..., i, j] for j in range(n)] for i in range(n)]
    image = function(columns(*sigma_components(mean.unbind(-1), rows, points)))
    first, second = moments(image.unbind(-1), points)
    return columns(*first), columns(*second), image


def sigma_components(
    mean: Sequence[Tensor], root: Sequence[Sequence[Tensor | None]], points: SigmaPoints
) -> list[Tensor]:
    """The sigma points (Eq. 10-12), component by component: the form that speed wants.

    Args:
        mean: n components (...).
        root: rows of the square root, n by n components (...); None is zero.
        points: their spread.

    Returns:
        n components (2n+1, ...), the mean itself first. Differentiable.
    """
    components = []
    for centre, row in zip(mean, root, strict=True):
        steps = [None if entry is None else points.spread * entry for entry in row]
        plus = [centre if step is None else centre + step for step in steps]
        minus = [centre if step is None else centre - step for step in steps]
        components.append(torch.stack([centre, *plus, *minus]))
    return components


def moments(image: Sequence[Tensor], points: SigmaPoints) -> tuple[list[Tensor], list[Tensor]]:
    """Mean and covariance of the images of the sigma points (Eq. 17-18).

    Args:
        image: m components (2n+1, ...), the central one first.
        points: their weights.

    Returns:
        m components of the mean and m(m+1)/2 of the covariance's upper triangle, row by row, each (...).
        Differentiable.
    """
    shift, second = moments_of_differences([component[1:] - component[0] for component in image], points)
    return [component[0] + s for component, s in zip(image, shift, strict=True)], second


def moments_of_differences(delta: Sequence[Tensor], points: SigmaPoints) -> tuple[list[Tensor], list[Tensor]]:
    """`moments` from the differences δ to the central image, m components (2n, ...); the mean less that image.

    The images of the points ahead on every axis come first, then those of the points behind.
    """
    # δ₀ = 0 and the other weights are all one w (Eq. 16), for mean and covariance alike
    weights_mean, weights_cov = points.weights
    weight, pairs = weights_mean[1], [(i, j) for i in range(len(delta)) for j in range(i, len(delta))]
    if points.by_axis:
        # with the even part e = δ₊ + δ₋ and the odd part o = δ₊ − δ₋ of an axis, its quadrature's covariance is
        # w (δ₊δ₊ᵀ + δ₋δ₋ᵀ) − w² e eᵀ = w/2 (o oᵀ + (1 − 2w) e eᵀ): squares alone, for w ≤ 1/2
        rows, shift = [], []
        for ahead, behind in (d.unflatten(0, (2, -1)).unbind(0) for d in delta):
            even = ahead + behind
            shift.append(even.sum(0) * weight)
            rows.append([*(ahead - behind).unbind(0), *(even * (1 - 2 * weight) ** 0.5).unbind(0)])
        second = []
        for i, j in pairs:
            total = rows[i][0] * rows[j][0]
            for a, b in zip(rows[i][1:], rows[j][1:], strict=True):
                total.addcmul_(a, b)
            second.append(total * (weight / 2))
        return shift, second
    # with s = w Σ δ, Σ w (δ − s)(δ − s)ᵀ = w Σ δ δᵀ + (Σ w_c − 2) s sᵀ, the sum of the weights with the centre's
    rest = sum(weights_cov) - 2
    shift = [component.sum(0) * weight for component in delta]
    second = [((delta[i] * delta[j]).sum(0) * weight).addcmul_(shift[i], shift[j], value=rest) for i, j in pairs]
    return shift, second


def sigma_root(left_sigma: Tensor, right_sigma: Tensor, rotated: bool = True) -> Tensor:
    """A square root of Σ = diag(σₗ², σₗ², σᵣ², σᵣ²) over (uₗ, vₗ, uᵣ, vᵣ) (Eq. 7).

    Args:
        left_sigma: (...) [px].
        right_sigma: (...) [px].
        rotated: turn the root so that its columns are disparity and version, horizontal and vertical: the version
            columns move both eyes alike and leave the disparity alone, so that the whole curvature of triangulation
            lies along one axis, where the sigma points integrate it. False: the diagonal (Cholesky) root.

    Returns:
        (..., 4, 4), Σ = root rootᵀ. Differentiable.
    """
    zero = torch.zeros_like(left_sigma)
    rows = root_rows(left_sigma, right_sigma, rotated)
    entries = columns(*(zero if entry is None else entry for row in rows for entry in row))
    root: Tensor = entries.unflatten(-1, (4, 4))
    return root


def eye_root(left: Tensor, right: Tensor, rotated: bool) -> tuple[Tensor, Tensor]:
    """A square root of diag(σₗ², σᵣ²), for one axis of the retinas: a row for each eye, columns first (2, ...)."""
    if not rotated:
        zero = torch.zeros_like(left)
        return torch.stack([left, zero]), torch.stack([zero, right])
    scale = (left * left + right * right).rsqrt()
    both = left * right * scale
    return torch.stack([left * left * scale, both]), torch.stack([-(right * right) * scale, both])


def root_rows(left: Tensor, right: Tensor, rotated: bool) -> list[list[Tensor | None]]:
    """The rows of `sigma_root`, None for zero."""
    (a, b), (c, d) = eye_root(left, right, rotated)
    if rotated:
        return [[a, b, None, None], [None, None, a, b], [c, d, None, None], [None, None, c, d]]
    return [[a, None, None, None], [None, a, None, None], [None, None, d, None], [None, None, None, d]]
