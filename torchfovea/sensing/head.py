"""The head: two eyes on a neck that pans and tilts, their forward and inverse kinematics.

Frames (x forward, y left, z up unless optical): the ego frame E sits where the pan and tilt axes cross and keeps the
world's orientation; the neck frame N is E turned by pan (about z, left positive) and tilt (about y, down positive); the
cyclopean frame C is optical (x right, y down, z forward) with its origin midway between the eyes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfovea.finite import require_tensor
from torchfovea.rounding import unrounded
from torchfovea.sensing.kinematics import Eyes, Gaze, Kinematics, axes_meet, rig_frame, to_ego
from torchfovea.setting import check_types, require

__all__ = [
    "FARTHEST_M",
    "Eyes",
    "Gaze",
    "Head",
    "Kinematics",
    "can_fixate",
    "clamp_gaze",
    "cyclopean",
    "eyes",
    "fixate",
    "gaze_point",
    "reach_numbers",
    "rig_frame",
    "to_ego",
    "turns_of",
]


FARTHEST_M = 1e12  # farther points are looked at as if they were here


@dataclass(frozen=True)
class Head:
    """Geometry and limits of a stereo head; the defaults are Vizzy's.

    A rectified pair on a pan-tilt unit is one with `vergence_max_deg` 0, a pair that does not move one with limits of 0
    and some `sight_deg`.

    Attributes:
        baseline_m: distance between the eyes, > 0.
        eyes_forward_m: the eyes before the tilt axis, at tilt 0.
        eyes_up_m: the eyes above the tilt axis, at tilt 0.
        ego_height_m: height of the pan-tilt crossing above the floor.
        pan_limit_deg: neck pan reaches this far to either side.
        tilt_up_deg: neck tilt upward.
        tilt_down_deg: neck tilt downward.
        vergence_max_deg: largest angle between the optical axes; 0: they are parallel, and the axis between them looks.
        sight_deg: a point still counts as looked at so far beyond what the head can turn to.
        encoder_deg: standard deviation of what the encoders tell of pan, tilt and vergence.
    """

    baseline_m: float = 0.204
    eyes_forward_m: float = 0.048
    eyes_up_m: float = 0.124
    ego_height_m: float = 0.54
    pan_limit_deg: float = 53.0
    tilt_up_deg: float = 18.0
    tilt_down_deg: float = 37.0
    vergence_max_deg: float = 40.0
    sight_deg: float = 0.0
    encoder_deg: float = 0.0

    def __post_init__(self) -> None:
        """Raise SettingError for a head that cannot exist."""
        check_types(self, "head.")
        between = 0 < self.baseline_m <= 10  # more is millimetres
        require(between, "head.baseline_m", self.baseline_m, "a positive distance in metres, at most 10")
        require(
            0 <= self.pan_limit_deg < 180, "head.pan_limit_deg", self.pan_limit_deg, "from 0 to less than 180 degrees"
        )
        require(0 <= self.sight_deg < 90, "head.sight_deg", self.sight_deg, "from 0 to less than 90 degrees")
        if self.sight_deg == 0:
            require(self.pan_limit_deg > 0, "head.pan_limit_deg", 0, "some range, or some head.sight_deg")
        for name in ("tilt_up_deg", "tilt_down_deg"):
            require(
                0 <= getattr(self, name) < 90, f"head.{name}", getattr(self, name), "from 0 to less than 90 degrees"
            )
        tilts = self.tilt_up_deg + self.tilt_down_deg + self.sight_deg > 0
        require(tilts, "head.tilt_down_deg", self.tilt_down_deg, "some range, or some head.sight_deg")
        vergence = self.vergence_max_deg
        require(0 <= vergence < 180, "head.vergence_max_deg", vergence, "from 0 to less than 180 degrees")
        require(0 <= self.encoder_deg < 10, "head.encoder_deg", self.encoder_deg, "from 0 to less than 10 degrees")
        for name in ("eyes_forward_m", "eyes_up_m", "ego_height_m"):
            require(
                math.isfinite(getattr(self, name)), f"head.{name}", getattr(self, name), "a finite length in metres"
            )

    @property
    def nearest_m(self) -> float:
        """How near to the eyes their axes can meet; 0 if they need not."""
        half = math.radians(self.vergence_max_deg) / 2
        return self.baseline_m / 2 / math.tan(half) if half > 0 else 0.0


def _rotation(rows: tuple[tuple[Tensor, ...], ...]) -> Tensor:
    """Matrices (..., 3, 3) from components (...)."""
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def cyclopean(head: Head | Kinematics, gaze: Gaze) -> tuple[Tensor, Tensor]:
    """Pose of the cyclopean frame in E; of a head of your own, of the rectified frame (`rig_frame`).

    Returns:
        R (..., 3, 3), whose columns are C's x (right), y (down) and z (forward) axes in E, and its origin
        t (..., 3) [m].

    Raises:
        SettingError: for angles of several dtypes, or of whole numbers.

    Differentiable in the gaze.
    """
    kinds = {str(angle.dtype) for angle in gaze}
    require(len(kinds) == 1 and gaze.pan.is_floating_point(), "gaze.dtype", sorted(kinds), "one floating-point dtype")
    if not isinstance(head, Head):
        return rig_frame(head.eyes(gaze))[:2]
    cp, sp = torch.cos(gaze.pan), torch.sin(gaze.pan)
    ct, st = torch.cos(gaze.tilt), torch.sin(gaze.tilt)
    zero = torch.zeros_like(cp)
    # columns: right, down, forward = -y, -z, x of the neck frame, whose axes are R_z(pan) R_y(tilt)
    rotation = _rotation(((sp, -cp * st, cp * ct), (-cp, -sp * st, sp * ct), (zero, -ct, -st)))
    return rotation, head.eyes_forward_m * rotation[..., 2] - head.eyes_up_m * rotation[..., 1]


@unrounded
def eyes(head: Head | Kinematics, gaze: Gaze) -> Eyes:
    """Forward kinematics: the poses of both cameras in E (the left eye turns +θ/2 about the optical y, the right −θ/2).

    Differentiable in the gaze.

    Raises:
        SettingError: for a gaze of plain numbers.
    """
    for angle in gaze:
        require_tensor(angle, "gaze", "a Gaze of tensors, such as Gaze(*torch.zeros(3))")
    if not isinstance(head, Head):
        return head.eyes(gaze)
    rotation, origin = cyclopean(head, gaze)
    c, s = torch.cos(gaze.vergence / 2), torch.sin(gaze.vergence / 2)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    inward = _rotation(((c, zero, s), (zero, one, zero), (-s, zero, c)))
    half = head.baseline_m / 2 * rotation[..., 0]
    return Eyes(rotation @ inward, origin - half, rotation @ inward.mT, origin + half)


def fixate(head: Head | Kinematics, point: Tensor) -> tuple[Gaze, Tensor]:
    """Inverse kinematics: the gaze in which both optical axes meet at a point.

    Args:
        head: geometry and limits.
        point: (..., 3) in E [m].

    Returns:
        The gaze, clamped to the limits (so always one that the head can take), and whether it does meet the point:
        bool (...). A point behind, too near, out of limits or not finite is unreachable, never NaN.

    Raises:
        SettingError: for a point of another shape or type.

    Differentiable in the point where it is reachable; zero gradient where it is not.
    """
    if not isinstance(head, Head):
        return head.fixate(point)
    (x, y, z), side, reach, solvable, within = _aim(head, point)
    distance = (reach - head.eyes_forward_m).clamp(min=1e-6)
    pan = torch.atan2(y, x)
    tilt = torch.atan2(torch.full_like(reach, head.eyes_up_m), reach) - torch.atan2(z, side)
    vergence = 2 * torch.atan2(torch.full_like(distance, head.baseline_m / 2), distance)
    pan_limit, up_limit, down_limit = (math.radians(a) for a in _limits_deg(head))
    gaze = Gaze(
        pan.clamp(-pan_limit, pan_limit),
        tilt.clamp(up_limit, down_limit),
        vergence.clamp(max=math.radians(head.vergence_max_deg)),
    )
    held = (torch.where(within, angle, angle.detach()) for angle in gaze)
    return Gaze(*(torch.where(solvable, angle, torch.zeros_like(angle)) for angle in held)), within


def can_fixate(head: Head | Kinematics, point: Tensor) -> Tensor:
    """Whether the head can fixate points (..., 3) in E, bool (...): the second result of `fixate`, without the angles.

    Raises:
        SettingError: for a point of another shape or type.
    """
    if not isinstance(head, Head):
        return head.fixate(point.detach())[-1]
    _check_point(point)
    with torch.no_grad():
        x, y, z = point.unbind(-1)
        less = FARTHEST_M / _largest(x, y, z).clamp(min=FARTHEST_M)
        x, y, z = x * less, y * less, z * less
        side, ahead = _squares(head, x, y, z)
        # no comparison passes NaN: a square that has no root, a point that is not finite
        return _within(head, x, y, z, side.sqrt(), ahead.sqrt()) & _solvable(head, side, ahead)


def _limits_deg(head: Head) -> tuple[float, float, float]:
    """Of pan to either side, and of tilt, up and down."""
    return head.pan_limit_deg, -head.tilt_up_deg, head.tilt_down_deg


def turns_of(head: Head) -> tuple[tuple[float, float], ...]:
    """Sine and cosine of how far a head sees by turning: of pan to either side, and of tilt, up and down."""
    pan, low, high = _limits_deg(head)
    reached = min(pan + head.sight_deg, 180.0), low - head.sight_deg, high + head.sight_deg
    return tuple((math.sin(math.radians(a)), math.cos(math.radians(a))) for a in reached)


def reach_numbers(head: Head) -> tuple[float, ...]:
    """How loops in C are told what a head can fixate, see head.h."""
    turns = (angle for pair in turns_of(head) for angle in pair)
    return tuple(map(float, (head.eyes_up_m, head.eyes_forward_m, head.nearest_m, FARTHEST_M, *turns)))


def _aim(head: Head, point: Tensor) -> tuple[tuple[Tensor, ...], Tensor, Tensor, Tensor, Tensor]:
    """A point as the head's inverse kinematics wants it.

    Returns:
        x, y and z; √(x² + y²); √(|X|² − up²), how far before the tilt axis the gaze meets it; whether there is a gaze
        at all; whether it lies within the limits. Where there is none the numbers are 1.
    """
    _check_point(point)
    x, y, z = point.unbind(-1)
    with torch.no_grad():
        largest = _largest(x, y, z)
        finite = largest < math.inf
        # all angles are there long before squares overflow; what is not finite counts as a point at the origin
        less = torch.where(finite, FARTHEST_M / largest.clamp(min=FARTHEST_M), 0.0)
    one = torch.ones_like(x)
    x, y, z = (torch.where(finite, c, one) * less for c in (x, y, z))
    side, ahead = _squares(head, x, y, z)
    solvable = _solvable(head, side, ahead)
    x, y, z = (torch.where(solvable, c, one) for c in (x, y, z))
    side, reach = (torch.where(solvable, square, one).sqrt() for square in (side, ahead))
    with torch.no_grad():
        within = solvable & _within(head, x, y, z, side, reach)
    return (x, y, z), side, reach, solvable, within


def _check_point(point: Tensor) -> None:
    good = point.dim() >= 1 and point.shape[-1] == 3 and point.dtype in (torch.float32, torch.float64)
    require(good, "point", f"{tuple(point.shape)} {point.dtype}", "a tensor (..., 3) of torch.float32 or torch.float64")


def _largest(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())


def _squares(head: Head, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """In the neck's vertical plane a point is at (d + forward, up): x² + y², and |X|² − up² = (d + forward)²."""
    side = x * x + y * y
    return side, side + z * z - head.eyes_up_m**2


def _solvable(head: Head, side: Tensor, ahead: Tensor) -> Tensor:
    """Whether there is a gaze at all."""
    return (side > 1e-12) & (ahead > max(head.eyes_forward_m + 1e-3, 1e-3) ** 2)


def _within(head: Head, x: Tensor, y: Tensor, z: Tensor, side: Tensor, reach: Tensor) -> Tensor:
    """Whether a gaze lies within the limits: angles α ≤ β where sin(β − α) ≥ 0.

    They are those of pan, and of tilt, the angle from (side, z) to (reach, up).
    """
    up, (pan_s, pan_c), (up_s, up_c), (down_s, down_c) = head.eyes_up_m, *turns_of(head)
    sine, cosine = up * side - reach * z, reach * side + up * z
    within = (pan_s * x >= pan_c * y.abs()) & (up_c * sine >= up_s * cosine) & (down_c * sine <= down_s * cosine)
    return within & (reach - head.eyes_forward_m >= head.nearest_m)


def gaze_point(head: Head | Kinematics, gaze: Gaze) -> Tensor:
    """Where both optical axes meet, (..., 3) in E [m]: what `fixate` inverts; infinitely far without vergence.

    Of a head of your own, where both are nearest to each other. Differentiable in the gaze where it converges.
    """
    if not isinstance(head, Head):
        return axes_meet(head.eyes(gaze))
    rotation, origin = cyclopean(head, gaze)
    distance = head.baseline_m / 2 / torch.tan(gaze.vergence / 2)
    axis = rotation[..., 2]
    return torch.where(axis == 0, origin, origin + distance[..., None] * axis)


def clamp_gaze(head: Head, gaze: Gaze) -> Gaze:
    """The nearest gaze within the head's limits."""
    pan, up, down, widest = (
        math.radians(a) for a in (head.pan_limit_deg, head.tilt_up_deg, head.tilt_down_deg, head.vergence_max_deg)
    )
    return Gaze(gaze.pan.clamp(-pan, pan), gaze.tilt.clamp(-up, down), gaze.vergence.clamp(0.0, widest))
