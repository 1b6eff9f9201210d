"""What every head has in common: a gaze, where both eyes are at it, and what follows from that; see `head`."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.setting import require

__all__ = ["Eyes", "Gaze", "Kinematics", "axes_meet", "rig_frame", "to_ego"]


class Gaze(NamedTuple):
    """Where the head looks; all [rad], any common shape (...).

    Attributes:
        pan: neck pan, positive to the left.
        tilt: neck tilt, positive down.
        vergence: angle between the optical axes; each eye turns half of it inward.
    """

    pan: Tensor
    tilt: Tensor
    vergence: Tensor


class Eyes(NamedTuple):
    """Poses of the two cameras in the ego frame: X_E = R X_camera + t.

    Attributes:
        R_left: (..., 3, 3), columns are the left camera's axes in E.
        t_left: (..., 3), the left camera's centre in E [m].
        R_right: (..., 3, 3).
        t_right: (..., 3) [m].
    """

    R_left: Tensor
    t_left: Tensor
    R_right: Tensor
    t_right: Tensor


@runtime_checkable
class Kinematics(Protocol):
    """A head of your own, where `Head` does not describe it: the functions of this module ask it.

    Both methods take any leading axes, in the dtype and on the device of what they are given. What the three numbers of
    a gaze mean is its own; a number that it does not use is 0.
    """

    @property
    def ego_height_m(self) -> float:
        """Height of the ego frame's origin above the floor."""
        ...

    @property
    def encoder_deg(self) -> float:
        """Standard deviation of what the encoders tell of each angle; 0: they are exact."""
        ...

    def eyes(self, gaze: Gaze, /) -> Eyes:
        """Where both cameras are at a gaze (...)."""
        ...

    def fixate(self, points: Tensor, /) -> tuple[Gaze, Tensor]:
        """The gaze that looks at points (..., 3) in E, one that the head can take, and whether it does: bool (...)."""
        ...


def to_ego(rotation: Tensor, vector: Tensor) -> Tensor:
    """R v for each of N vectors.

    Args:
        rotation: (..., 3, 3).
        vector: (*any, ..., N, 3).

    Returns:
        The shape of `vector`, in columns. Differentiable.
    """
    x, y, z = vector.unbind(-1)
    row = [[rotation[..., i, j].unsqueeze(-1) for j in range(3)] for i in range(3)]
    return columns(*(torch.addcmul(torch.addcmul(r[0] * x, r[1], y), r[2], z) for r in row))


def rig_frame(eyes: Eyes) -> tuple[Tensor, Tensor, Tensor]:
    """The rectified frame of two eyes: x along the baseline to the right, z midway between the optical axes.

    For a head it is the cyclopean frame.

    Args:
        eyes: poses in E, (...).

    Returns:
        Its axes in E as the columns of R (..., 3, 3), its origin midway between the eyes t (..., 3) and the baseline
        (...) [m].

    Raises:
        SettingError: for a baseline of no length.

    Differentiable.
    """
    across = eyes.t_right - eyes.t_left
    baseline = across.square().sum(-1).sqrt()
    require(bool((baseline > 0).all()), "baseline_m", 0.0, "eyes some distance apart")
    x = across / baseline[..., None]
    z = eyes.R_left[..., 2] + eyes.R_right[..., 2]
    z = z - (z * x).sum(-1, keepdim=True) * x
    z = z / z.square().sum(-1, keepdim=True).sqrt()
    return torch.stack([x, torch.linalg.cross(z, x), z], -1), (eyes.t_left + eyes.t_right) / 2, baseline


def axes_meet(pose: Eyes) -> Tensor:
    """Midway between the nearest points of both optical axes, (..., 3); infinitely far where these are parallel."""
    a, b, across = pose.R_left[..., 2], pose.R_right[..., 2], pose.t_right - pose.t_left
    cosine = (a * b).sum(-1)
    sine2 = torch.linalg.cross(a, b).square().sum(-1)
    along_a, along_b = (across * a).sum(-1), (across * b).sum(-1)
    s, t = ((along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2)
    met = (pose.t_left + s[..., None] * a + pose.t_right + t[..., None] * b) / 2
    return torch.where((sine2 > 0)[..., None], met, (pose.t_left + pose.t_right) / 2 + a * torch.inf)
