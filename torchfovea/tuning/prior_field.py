"""The rival of a biased memory: an unbiased one that knows, for each direction, what inverse range to expect.

Fixations on the floor count as far away, so the field is fitted to inverse ranges in which the floor is at far_m.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.setting import require
from torchfovea.tuning.adam import adam, at_rest
from torchfovea.tuning.scenes import Scenes, first_surfaces

__all__ = ["PriorField", "fit_by_gradient", "fit_closed_form", "look_up"]

_SHARPNESS = 150.0  # of the kernel exp(κ (cos − 1)): a standard deviation of 4.7 degrees
_SMALLEST_STD = 0.02  # 1/m


class PriorField(NamedTuple):
    """Beliefs on a grid of directions.

    Attributes:
        direction: unit (G, 3).
        mean: of the inverse range, (G,) [1/m].
        std: (G,) [1/m].
    """

    direction: Tensor
    mean: Tensor
    std: Tensor


def look_up(field: PriorField, cells: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation at cells (..., 3), by kernel interpolation; differentiable in the field."""
    flat = cells.reshape(-1, 3)
    weight = (_SHARPNESS * (flat @ field.direction.to(flat).mT - 1)).softmax(-1)
    mean, std = weight @ field.mean.to(flat), weight @ field.std.to(flat)
    return mean.reshape(cells.shape[:-1]), std.reshape(cells.shape[:-1])


def _samples(scenes: Scenes, direction: Tensor, far_m: float) -> Tensor:
    """True inverse ranges (B, G), the floor taken as far."""
    n = len(scenes.nearest_m)
    hits = first_surfaces(scenes, direction.new_zeros(n, 1, 3), direction.expand(n, -1, 3))
    return torch.where(hits.floor, torch.full_like(hits.range_m, 1 / far_m), 1 / hits.range_m)


def fit_closed_form(scenes: Scenes, direction: Tensor, far_m: float = 6.0) -> PriorField:
    """Mean and standard deviation over scenes, direction by direction, smoothed over neighbours.

    Args:
        scenes: at least 2.
        direction: grid (G, 3).
        far_m: range that floor counts as.
    """
    require(len(scenes.nearest_m) >= 2, "scenes", len(scenes.nearest_m), "at least 2 to fit a prior field")
    rho = _samples(scenes, direction, far_m)
    weight = (_SHARPNESS * (direction @ direction.mT - 1)).softmax(-1)
    mean = weight @ rho.mean(0)
    square = weight @ rho.square().mean(0)
    return PriorField(direction, mean, (square - mean * mean).clamp(min=_SMALLEST_STD**2).sqrt())


def fit_by_gradient(scenes: Scenes, direction: Tensor, far_m: float = 6.0, steps: int = 100) -> PriorField:
    """Maximum likelihood of independent Gaussians, with Adam, in the interpolating kernel's own coefficients."""
    rho = _samples(scenes, direction, far_m)
    weight = (_SHARPNESS * (direction @ direction.mT - 1)).softmax(-1)
    # all that a likelihood of Gaussians knows of its samples
    centre, variance = rho.mean(0), rho.var(0, unbiased=False)
    own = torch.stack((centre, rho.std(0).clamp(min=_SMALLEST_STD).log()), -1)  # means and logarithms
    moments = at_rest(own)

    def beliefs(own: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = (weight @ own).unbind(-1)
        return mean, log_std.exp().clamp(min=_SMALLEST_STD)

    for _ in range(steps):
        own.requires_grad_()
        mu, sigma = beliefs(own)
        loss = (0.5 * (variance + (centre - mu).square()) / sigma.square() + sigma.log()).mean()
        moments, move = adam(moments, torch.autograd.grad(loss, own)[0], 0.02, (0.9, 0.999))
        own = own.detach() - move
    return PriorField(direction, *beliefs(own))
