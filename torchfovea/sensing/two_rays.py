"""Rays of two eyes in their rectified frame, where they meet, and the way from there to E."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.sensing.chart import Components

__all__ = ["EyePair", "Moments", "placed", "rectified", "turned"]

# of the images of the sigma points: mean and covariance by components, the direction of the central one (3, ..., N),
# and a number that is positive where all of them are in front
Moments = tuple[list[Tensor], list[Tensor], Tensor, Tensor]


class EyePair(NamedTuple):
    """The rig's frame, origin and baseline, see `torchfovea.sensing.kinematics.rig_frame`; the eyes in that frame.

    Those are their rotations into it, and their cameras.
    """

    frame: Tensor
    origin: Tensor
    baseline: Tensor
    left: Tensor
    right: Tensor
    left_camera: Camera
    right_camera: Camera


def turned(rotation: Tensor, vector: Components) -> Components:
    """`torchfovea.sensing.head.to_ego` by components: R v, rotation (..., 3, 3) and v's (*any, ..., N)."""
    row = [[rotation[..., i, j].unsqueeze(-1) for j in range(3)] for i in range(3)]
    return tuple(torch.addcmul(torch.addcmul(r[2] * vector[2], r[0], vector[0]), r[1], vector[1]) for r in row)


def rectified(left: Components, right: Components) -> tuple[Components, Tensor, Tensor]:
    """2 X/b and w of `torchfovea.sensing.triangulation.triangulate_rectified`, and how far ahead the rays look.

    That is more than 0 where both do.
    """
    xl, yl, zl = left
    xr, yr, zr = right
    across, back = xl * zr, xr * zl
    return (
        (across + back, torch.addcmul(yl * zr, yr, zl), 2 * (zl * zr)),
        across - back,
        torch.minimum(zl, zr),
    )


def placed(rig: EyePair, x: Components, w: Tensor) -> Components:
    """Homogeneous points from the rig's frame to E: R X + w t."""
    origin = rig.origin.unsqueeze(-1).unbind(-2)
    return tuple(torch.addcmul(c, w, o) for c, o in zip(turned(rig.frame, x), origin, strict=True))
