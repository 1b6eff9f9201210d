"""The unscented transform: moments of any function of a Gaussian, as one batched tensor operation (Eq. 9-18).

References:
    Julier, Uhlmann (2004), Unscented filtering and nonlinear estimation.
    van der Merwe (2004), Sigma-point Kalman filters for probabilistic inference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.setting import require

__all__ = ["SigmaPoints", "unscented_transform"]


@dataclass(frozen=True)
class SigmaPoints:
    """Where the 2n + 1 sigma points lie and what they weigh.

    The default puts them at ±√3 standard deviations with equal weights for mean and covariance. Along each axis of the
    square root that is three-point Gauss-Hermite quadrature, exact to fifth order. The paper's choice is `paper()`.

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
        require(self.dimensions >= 1, "sigma_points.dimensions", self.dimensions, "at least 1")
        require(self.alpha > 0, "sigma_points.alpha", self.alpha, "a positive spread")
        require(
            self.dimensions + self.kappa > 0,
            "sigma_points.kappa",
            self.kappa,
            f"more than -{self.dimensions}, so that dimensions + kappa is positive",
        )

    @staticmethod
    def paper() -> SigmaPoints:
        """The authors' parameters for a correspondence: L 4, α 0.25, β 2, κ 3."""
        return SigmaPoints(4, 0.25, 2.0, 3.0)

    @property
    def spread(self) -> float:
        """√(L + λ), the distance of the sigma points in standard deviations (Eq. 11-12)."""
        return self.alpha * (self.dimensions + self.kappa) ** 0.5

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
    step = points.spread * root
    x = mean.unbind(-1)
    sigma = columns(
        *(
            torch.stack(
                [x[i], *(x[i] + step[..., i, j] for j in range(n)), *(x[i] - step[..., i, j] for j in range(n))]
            )
            for i in range(n)
        )
    )
    image = function(sigma)
    delta = (image - image[0]).unbind(-1)
    weights_mean, weights_cov = points.weights
    w = torch.tensor(weights_mean, dtype=mean.dtype, device=mean.device)
    shift = [torch.tensordot(w, d, 1) for d in delta]
    total = sum(weights_cov)
    w = torch.tensor(weights_cov, dtype=mean.dtype, device=mean.device)
    m = len(delta)
    packed = []
    for i in range(m):
        weighted = w.reshape(-1, *(1,) * (delta[i].dim() - 1)) * delta[i]
        first = weighted.sum(0)
        for j in range(i, m):
            # Σ w (δi − si)(δj − sj) = Σ w δi δj − sj Σ w δi − si Σ w δj + si sj Σ w
            other = first if j == i else torch.tensordot(w, delta[j], 1)
            packed.append(
                (weighted * delta[j]).sum(0) - shift[j] * first - shift[i] * other + total * shift[i] * shift[j]
            )
    return image[0] + columns(*shift), columns(*packed), image
