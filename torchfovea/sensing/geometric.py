"""The geometric sensor: correspondences from known surface points, with noise drawn in both retinas; no images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Correspondences, eye_sigma_px
from torchfovea.sensing.head import Eyes, to_ego
from torchfovea.sensing.layout import Retina

__all__ = ["correspond_points", "with_noise"]


def correspond_points(
    points: Tensor,
    visible: Tensor,
    left_px: Tensor,
    eyes: Eyes,
    camera: Camera,
    retina: Retina,
    budget: Budget,
) -> Correspondences:
    """Where both retinas would see surface points that the left receptive fields look at (Eq. 6-7), without noise.

    Args:
        points: the surface point along each left receptive field's ray, (..., N, 3) in E [m].
        visible: whether there is one and the right eye sees it too, bool (..., N).
        left_px: the receptive fields, (..., N, 2).
        eyes: camera poses in E.
        camera: both eyes' camera.
        retina: both eyes' retina.
        budget: where the standard deviations come from.

    Returns:
        Correspondences; invalid where not visible or outside the right retina. Differentiable in points and poses.
    """
    seen = torch.where(visible[..., None], points, torch.ones_like(points)) - eyes.t_right.unsqueeze(-2)
    direction = to_ego(eyes.R_right.mT, seen)
    right_px = camera.project(direction)
    valid = visible & camera.in_view(direction) & retina.inside(right_px)
    right_px = torch.where(valid[..., None], right_px, torch.zeros_like(right_px))
    left_px = left_px.expand_as(right_px)
    left_sigma, right_sigma = eye_sigma_px(budget, retina, left_px), eye_sigma_px(budget, retina, right_px)
    support, sure = retina.width_px(left_px) / 2, torch.ones_like(left_sigma)
    return Correspondences(left_px, right_px, left_sigma, right_sigma, valid, sure, support)


def with_noise(
    matches: Correspondences, retina: Retina, generator: torch.Generator | Sequence[torch.Generator]
) -> Correspondences:
    """Both places moved by chance as far as their standard deviations say.

    Args:
        matches: from `correspond_points`, (..., N).
        retina: both eyes'.
        generator: one, or one for each row of a batch (B, N).
    """
    noise = _noise(matches.valid.shape, generator, matches.left_px)
    left, right = matches.left_sigma_px, matches.right_sigma_px
    left_px = matches.left_px + columns(left * noise[0], left * noise[1])
    right_px = matches.right_px + columns(right * noise[2], right * noise[3])
    return matches._replace(left_px=left_px, right_px=right_px, support_px=retina.width_px(left_px) / 2)


def _noise(shape: torch.Size, generator: torch.Generator | Sequence[torch.Generator], like: Tensor) -> Tensor:
    """Standard normal numbers (4, ...), drawn where the generators live; a row's do not depend on the batch."""
    if isinstance(generator, torch.Generator):
        return torch.randn(4, *shape, generator=generator, dtype=like.dtype, device=generator.device).to(like)
    rows = [torch.randn(4, *shape[1:], generator=g, dtype=like.dtype, device=g.device) for g in generator]
    return torch.stack(rows, 1).to(like)
