"""How two cameras stand to the rectified frame in which their views are parallel."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.head import Eyes, Gaze, Head, Kinematics
from torchfovea.setting import require

__all__ = ["StereoRig", "posed", "rig_at", "verged"]


class StereoRig(NamedTuple):
    """How the eyes stand to the rectified frame, whose x axis is the baseline; see `verged` and `posed`.

    Attributes:
        R_left: (3, 3), columns are the left camera's axes in the rectified frame.
        R_right: (3, 3).
        baseline_m: distance between the eyes, > 0.
    """

    R_left: Tensor
    R_right: Tensor
    baseline_m: float


def verged(vergence_rad: float | Tensor, baseline_m: float) -> StereoRig:
    """The rig of a head: the left eye turned +θ/2 about the optical y axis, the right −θ/2 (paper Sec. 4.1).

    The rectified frame is parallel to the cyclopean one.
    """
    half = torch.as_tensor(vergence_rad, dtype=torch.float64).detach().cpu() / 2
    require(half.numel() == 1 and abs(half.item()) < math.pi / 2, "vergence_rad", vergence_rad, "one angle below π")
    c, s = math.cos(half.item()), math.sin(half.item())
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    return _rig(rotation, rotation.mT, baseline_m)


def rig_at(head: Head | Kinematics, gaze: Gaze) -> StereoRig:
    """The rig of a head, or of one of your own, at one gaze."""
    if isinstance(head, Head):
        return verged(gaze.vergence, head.baseline_m)
    pose = Eyes(*(part.detach().cpu().double() for part in head.eyes(gaze)))
    turn = pose.R_left.mT
    return posed(turn @ pose.R_right, turn @ (pose.t_right - pose.t_left))


def posed(R_left_right: Tensor, t_left_right_m: Tensor) -> StereoRig:
    """The rig of any calibrated pair: X_left = R X_right + t, with the right eye to the right (t_x > 0).

    The rectified frame has its x axis along the baseline and its z axis midway between the optical axes.
    """
    rotation = torch.as_tensor(R_left_right, dtype=torch.float64).detach().cpu()
    shift = torch.as_tensor(t_left_right_m, dtype=torch.float64).detach().cpu()
    require(rotation.shape == (3, 3) and shift.shape == (3,), "R, t", (rotation.shape, shift.shape), "(3, 3) and (3,)")
    unit = bool(torch.isfinite(shift).all()) and torch.allclose(
        rotation @ rotation.mT, torch.eye(3, dtype=torch.float64), atol=1e-4
    )
    require(unit, "R_left_right", rotation.tolist(), "a rotation and a finite translation")
    baseline = shift.norm().item()
    require(
        shift[0].item() > 0.5 * baseline, "t_left_right_m", shift.tolist(), "the right eye to the right of the left"
    )
    x = shift / baseline
    z = rotation[:, 2] + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    z = z - (z @ x) * x
    z = z / z.norm()
    rectified = torch.stack([x, torch.linalg.cross(z, x), z])  # rows are its axes in the left camera
    return _rig(rectified, rectified @ rotation, baseline)


def _rig(R_left: Tensor, R_right: Tensor, baseline_m: float) -> StereoRig:
    require(0 < baseline_m < math.inf, "baseline_m", baseline_m, "a positive distance in metres")
    return StereoRig(R_left, R_right, float(baseline_m))
