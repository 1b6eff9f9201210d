"""How densely a bias puts cells in a direction, of many biases at once; by density.c where compiling is asked for."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchfovea.machine import Loops, loops
from torchfovea.memory.sphere import Quadrature, deep_tail, log_radial_moment
from torchfovea.tuning.bias import Bias

__all__ = ["log_density_each", "log_normalizer_each"]


def log_density_each(bias: Bias, directions: Tensor) -> Tensor:
    """`torchfovea.memory.sphere.log_density` of a batch of mixtures, each at its own directions.

    Args:
        bias: B mixtures (or one for all).
        directions: unit (B, K, 3).

    Returns:
        (B, K), per steradian. Differentiable in the mixtures.
    """
    eye = torch.eye(3, dtype=directions.dtype, device=directions.device)
    whitening = torch.linalg.solve_triangular(bias.cholesky, eye.expand_as(bias.cholesky), upper=False)
    mean = (whitening @ bias.means[..., None])[..., 0]
    log_det = bias.cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = bias.logits.log_softmax(-1) - math.log(2 * math.pi) - log_det
    if not directions.requires_grad:
        library = loops(whitening.detach(), mean.detach(), weight.detach(), directions)
        if library is not None:
            found: Tensor = _Density.apply(library, directions, whitening, mean, weight)  # type: ignore[no-untyped-call]
            return found
    w = torch.einsum("bmij,bkj->bkmi", whitening.expand(len(directions), -1, -1, -1), directions)
    y = mean[:, None]
    length = w.square().sum(-1).sqrt()
    w = w / length[..., None]
    d = (w * y).sum(-1)
    off_axis = torch.linalg.cross(w, y.expand_as(w)).square().sum(-1)
    radial = log_radial_moment(d) - 0.5 * torch.where(d > -deep_tail(d.dtype)[0], off_axis, y.square().sum(-1))
    return torch.logsumexp(weight[:, None] - 3 * length.log() + radial, -1)


class _Density(torch.autograd.Function):
    """The log density by loops, with the gradient in the mixtures: of a component it is an expectation over distance.

    With u = r s, r the distance and s the whitened unit direction, log f = log ∫ r² N(r s; y, 1) dr + …, whose slope by
    the whitened mean y is E[r] s − y.
    """

    @staticmethod
    def forward(
        ctx: Any, library: Loops, directions: Tensor, whitening: Tensor, mean: Tensor, weight: Tensor
    ) -> Tensor:
        shared = directions.shape[0] == 1 or directions.stride(0) == 0
        rows, count = directions.shape[:2]
        at = (rows, count, 0 if shared else count, (directions[:1] if shared else directions).contiguous())
        of = (*weight.shape, *(part.contiguous() for part in (whitening, mean, weight)))
        start, depth = deep_tail(weight.dtype)
        ctx.library, ctx.given = library, ((*of, float(start), depth), at)
        value = directions.new_empty(rows, count)
        library("density", *ctx.given, value, None, (None, None, None))
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        found = tuple(torch.zeros(part.shape, dtype=torch.float64) for part in ctx.given[0][2:5])
        ctx.library("density", *ctx.given, None, gradient.contiguous(), found)
        return None, None, *(part.to(gradient) for part in found)


def log_normalizer_each(bias: Bias, quadrature: Quadrature) -> Tensor:
    """Log probability of the reachable set under each mixture, (B,). Differentiable."""
    directions = quadrature.directions.to(bias.means).expand(len(bias.means), -1, -1)
    return torch.logsumexp(log_density_each(bias, directions) + quadrature.solid_angle_sr.to(bias.means).log(), -1)
