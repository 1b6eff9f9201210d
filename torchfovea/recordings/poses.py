"""Poses of a base in its odometry's frame, and the steps between them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.memory.moving import Motion, motion
from torchfovea.setting import require

__all__ = ["Pose", "ahead", "matrix_from_quaternion", "quaternion_from_matrix", "step_between", "still"]


class Pose(NamedTuple):
    """Where the ego frame is in the frame of the odometry: X_odometry = R X_E + t.

    Attributes:
        rotation: (3, 3), float64.
        translation: (3,) [m].
    """

    rotation: Tensor
    translation: Tensor


def still() -> Pose:
    """Where odometry begins."""
    return Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def ahead(pose: Pose, step: Motion) -> Pose:
    """Where a step leads to."""
    return Pose(pose.rotation @ step.rotation, pose.translation + pose.rotation @ step.translation)


def step_between(before: Pose, after: Pose, covariance: Tensor | None = None) -> Motion:
    """The step that `ahead` would take; its covariance as `torchfovea.memory.moving.Motion` has it."""
    back = before.rotation.mT
    return motion(back @ after.rotation, back @ (after.translation - before.translation), covariance)


def quaternion_from_matrix(rotation: Tensor) -> Tensor:
    """Unit quaternion (w, x, y, z), w ≥ 0, of a rotation (3, 3): the eigenvector of Bar-Itzhack's matrix (2000)."""
    r = rotation.double()
    trace = r.diagonal().sum()
    axis = torch.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    k = torch.zeros(4, 4, dtype=torch.float64)
    k[0, 0], k[0, 1:], k[1:, 0] = trace, axis, axis
    k[1:, 1:] = r + r.mT - trace * torch.eye(3, dtype=torch.float64)
    q: Tensor = torch.linalg.eigh(k).eigenvectors[:, -1]
    return q if q[0] >= 0 else -q


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation (3, 3) of a quaternion (w, x, y, z) of any length but none.

    Raises:
        SettingError: for a quaternion without length, or one that is not finite.
    """
    q = quaternion.double()
    length = q.norm()
    require(bool(torch.isfinite(length)) and float(length) > 1e-6, "quaternion", q.tolist(), "some length")
    w, x, y, z = (q / length).unbind()
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row) for row in rows])
