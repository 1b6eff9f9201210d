"""What the head's encoders get wrong moves all points of a saccade together: their common covariance.

Pan and tilt errors turn everything about E and leave ranges alone; a vergence error changes every disparity alike. None
of it averages out over the receptive fields of one look, hence the *add* of `torchfovea.memory.egosphere`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.chart import basis
from torchfovea.sensing.head import Eyes
from torchfovea.setting import require

__all__ = ["encoder_covariance", "encoder_jacobian"]

_NEAREST_M = 1e-3


def encoder_jacobian(points: Tensor, eyes: Eyes) -> tuple[Tensor, Tensor, Tensor]:
    """How triangulated points move with the pan, tilt and vergence that the head is believed to have.

    Args:
        points: (..., N, 3) in E [m]; on the baseline's line, where two rays have no crossing, vergence moves none.
        eyes: the believed poses (...).

    Returns:
        ∂X/∂pan, ∂X/∂tilt and ∂X/∂vergence, each (..., N, 3) [m/rad]. Differentiable.
    """
    x, y, z = points.unbind(-1)
    pan = columns(-y, x, torch.zeros_like(z))
    base = (eyes.t_right - eyes.t_left).unsqueeze(-2).expand_as(points)
    tilt = torch.linalg.cross(points, base) / torch.linalg.vector_norm(base, dim=-1, keepdim=True)
    down = eyes.R_left[..., 1].unsqueeze(-2).expand_as(points)
    left, right = points - eyes.t_left.unsqueeze(-2), points - eyes.t_right.unsqueeze(-2)
    # the left ray turns by +ε/2 about the optical y, the right one by −ε/2; where do they pass closest?
    turn_left, turn_right = torch.linalg.cross(down, left) / 2, -torch.linalg.cross(down, right) / 2
    normal = torch.linalg.cross(base, left)
    square = (normal * normal).sum(-1, keepdim=True)
    crossing = square > torch.finfo(square.dtype).tiny ** 0.5
    normal = normal / torch.where(crossing, square, torch.ones_like(square))
    miss = turn_left - turn_right
    s = -(torch.linalg.cross(miss, right) * normal).sum(-1, keepdim=True)
    t = -(torch.linalg.cross(miss, left) * normal).sum(-1, keepdim=True)
    vergence = (s * left + t * right + turn_left + turn_right) / 2
    return pan, tilt, torch.where(crossing, vergence, torch.zeros_like(vergence))


def encoder_covariance(
    points: Tensor, eyes: Eyes, sigma_rad: tuple[float, float, float], chart: str = "inverse_range"
) -> Tensor:
    """Covariance that all points of one saccade share, from independent errors of the three encoders.

    Args:
        points: where each cell's point is, (..., N, 3) in E [m].
        eyes: the believed poses (...).
        sigma_rad: standard deviations of pan, tilt and vergence.
        chart: `cartesian`, or `inverse_range`: of (a, b, ρ) about the points' own directions, and for one within a
            millimetre of E's origin, which has none, as for one that is a millimetre ahead.

    Returns:
        Packed (..., N, 6), for `torchfovea.memory.pooling.add_common`. Differentiable.

    Raises:
        SettingError: for negative standard deviations or an unknown chart.
    """
    require(len(sigma_rad) == 3 and min(sigma_rad) >= 0, "sigma_rad", sigma_rad, "three numbers not below 0")
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    moves = [sigma * move for sigma, move in zip(sigma_rad, encoder_jacobian(points, eyes), strict=True)]
    if chart == "inverse_range":
        square = (points * points).sum(-1)
        apart = square > _NEAREST_M**2
        rho = torch.where(apart, square, torch.full_like(square, _NEAREST_M**2)).rsqrt()
        ahead = points.new_tensor([1.0, 0.0, 0.0])
        direction = torch.where(apart[..., None], points * rho[..., None], ahead)
        axes = (*basis(direction), direction)
        scale = (rho, rho, -rho * rho)
        moves = [columns(*(k * (m * a).sum(-1) for k, a in zip(scale, axes, strict=True))) for m in moves]
    parts = [move.unbind(-1) for move in moves]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return columns(*(sum((p[i] * p[j] for p in parts), torch.zeros_like(parts[0][0])) for i, j in pairs))
