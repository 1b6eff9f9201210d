"""The unscented transform of pinhole eyes in inverse range: in stacked tensors, and by the loop of observe.c.

The loop takes the receptive fields one by one, and no intermediate result leaves the processor's registers.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.compiling import kernel
from torchfovea.gaussian import rounding_of_minors
from torchfovea.machine import Loops, columns_of
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.chart import Components, bilinear_moments
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.two_rays import EyePair, Moments, placed, rectified
from torchfovea.sensing.unscented import SigmaPoints, eye_root

__all__ = ["Form", "form_moments", "form_of", "observe_by_loops"]


class Form(NamedTuple):
    """Triangulation with pinhole eyes, whose rays are linear in (u, v, 1): a bilinear form of the two places.

    Attributes:
        point: coefficients, the homogeneous points (X, w) in E between the rays of the places' axes, (4, 3, 3, ..., 1).
        left: coefficients of the left ray's depth in the rig's frame, (3, ..., 1).
        right: of the right one's.
    """

    point: Tensor
    left: Tensor
    right: Tensor


def form_of(rig: EyePair, left_camera: Pinhole, right_camera: Pinhole) -> Form:
    """Triangulation with two pinhole eyes. Differentiable."""
    left, right = left_camera.turned(rig.left), right_camera.turned(rig.right)
    x, w, _ = rectified(left.unsqueeze(-1).unbind(-3), right.unsqueeze(-2).unbind(-3))
    w = (w * (2 / rig.baseline[..., None, None])).flatten(-2)
    point = torch.stack([*placed(rig, tuple(c.flatten(-2) for c in x), w), w])
    point = point.unflatten(-1, (3, 3)).movedim((-2, -1), (1, 2)).unsqueeze(-1)
    return Form(point, *(ray[..., 2, :].movedim(-1, 0).unsqueeze(-1) for ray in (left, right)))


def _affine(coefficients: Tensor | Components, u: Tensor, v: Tensor) -> Tensor:
    return (coefficients[0] * u).addcmul_(coefficients[1], v).add_(coefficients[2])


@kernel
def form_moments(matches: Correspondences, form: Form, points: SigmaPoints, rotated: bool) -> Moments:
    """The unscented transform without forming the sigma points, see `bilinear_moments`. Differentiable."""
    # the form is linear in either place, so that a place's axes u and v move the point by multiples of the form there
    (u, v), (there_u, there_v) = matches.left_px.unbind(-1), matches.right_px.unbind(-1)
    by_left = _affine(form.point.unbind(2), there_u, there_v)
    by_right = _affine(form.point[:, :, :2].unbind(1), u, v)
    by_both = torch.stack([form.point[:, 0, 0], form.point[:, 1, 1]], 1)
    centre = torch.addcmul(by_left[:, 2], by_left[:, 0], u).addcmul_(by_left[:, 1], v)
    root = eye_root(matches.left_sigma_px, matches.right_sigma_px, rotated)
    # the depth of the ray nearest to the side: no column moves it by more than the larger of its two parts
    depths = [
        _affine(z, *place).sub_(z[:2].abs().amax(0) * eye.abs().amax(0), alpha=points.spread)
        for z, place, eye in ((form.left, (u, v), root[0]), (form.right, (there_u, there_v), root[1]))
    ]
    return *bilinear_moments(centre, by_left[:, :2], by_right, by_both, *root, points), torch.minimum(*depths)


def observe_by_loops(
    library: Loops,
    matches: Correspondences,
    eyes: Eyes,
    cameras: tuple[Pinhole, Pinhole],
    support_px: Tensor,
    points: SigmaPoints,
    rotated: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Gaussians of correspondences (..., N) of pinhole eyes.

    Args:
        library: from `torchfovea.machine.loops`, for the dtype of all that follows.
        matches: (..., N).
        eyes: (...).
        cameras: the left one's and the right one's.
        support_px: half the width of each left receptive field, (..., N) or (N,) [px].
        points: of four dimensions.
        rotated: see `torchfovea.sensing.unscented.sigma_root`.

    Returns:
        Mean and covariance by components (9, ..., N), directions (3, ..., N), half the angle that each receptive field
        covers (..., N), and what is valid; elsewhere a unit Gaussian. None where the eyes are at one place.
    """
    shape, like = matches.valid.shape, matches.left_px
    given = (
        shape[:-1].numel(),
        shape[-1],
        *map(columns_of, matches[:2]),
        *(part.expand(shape).contiguous() for part in (*matches[2:4], matches.valid, support_px)),
        *(part.contiguous() for part in eyes),
    )
    mean, cov = points.weights
    # what is even in the sigma points counts less by axis, else what is left of the weights counts the mean's shift
    rest, share = (0.0, 1 - 2 * mean[1]) if points.by_axis else (sum(cov) - 2, 1.0)
    optics = (number for camera in cameras for number in (camera.focal_px, camera.cx_px, camera.cy_px))
    numbers = tuple(map(float, (points.spread, mean[1], rest, share, rounding_of_minors(like.dtype), *optics)))
    found = like.new_empty(9, *shape), like.new_empty(3, *shape), like.new_empty(shape), matches.valid.new_empty(shape)
    return None if library("observe", given, (*numbers, int(rotated)), found) else found
