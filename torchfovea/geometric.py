"""The geometric sensor: correspondences from known surface points, with noise drawn in both retinas; no images."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.camera import Camera
from torchfovea.correspondence import Budget, Correspondences, eye_sigma_px
from torchfovea.gaussian import columns
from torchfovea.head import Eyes, to_ego
from torchfovea.layout import Retina

__all__ = ["correspond_points"]


def correspond_points(
    points: Tensor,
    visible: Tensor,
    left_px: Tensor,
    eyes: Eyes,
    camera: Camera,
    retina: Retina,
    budget: Budget,
    generator: torch.Generator | None,
) -> Correspondences:
    """What both retinas would report of surface points that the left receptive fields look at (Eq. 6-7).

    Args:
        points: the surface point along each left receptive field's ray, (..., N, 3) in E [m].
        visible: whether there is one and the right eye sees it too, bool (..., N).
        left_px: the receptive fields, (..., N, 2).
        eyes: camera poses in E.
        camera: both eyes' camera.
        retina: both eyes' retina.
        budget: where the standard deviations come from.
        generator: draws the noise; None: no noise.

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
    if generator is not None:
        noise = torch.randn(4, *valid.shape, generator=generator, dtype=points.dtype, device=points.device)
        left_px = left_px + columns(left_sigma * noise[0], left_sigma * noise[1])
        right_px = right_px + columns(right_sigma * noise[2], right_sigma * noise[3])
    return Correspondences(left_px, right_px, left_sigma, right_sigma, valid)
