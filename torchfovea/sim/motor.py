"""How the head gets from one gaze to the next, how long it takes and how far it turns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch

from torchfovea.sensing.head import Gaze, Head, cyclopean
from torchfovea.setting import check_types, require

__all__ = ["InstantMotor", "Motor", "Moved", "turned_deg"]


class Moved(NamedTuple):
    """A saccade as executed.

    Attributes:
        gaze: where the head looks afterwards, as the joints say.
        seconds: from command to rest.
        degrees: angle that the cyclopean axis turned through.
    """

    gaze: Gaze
    seconds: float
    degrees: float


@runtime_checkable
class Motor(Protocol):
    """What turns the head: `InstantMotor`, `torchfovea.sim.servo.ServoMotor`, or anything else that moves like them."""

    def move(self, head: Head, before: Gaze, command: Gaze) -> Moved:
        """Execute a saccade.

        Args:
            head: of the scene.
            before: where the head looks.
            command: where it shall look, within the head's limits.
        """
        ...


def turned_deg(head: Head, before: Gaze, after: Gaze) -> float:
    """Angle between the cyclopean axes of two gazes [deg]."""
    a, b = (cyclopean(head, g)[0][..., 2].double() for g in (before, after))
    return math.degrees(float(torch.atan2(torch.linalg.cross(a, b).norm(), (a * b).sum())))


@dataclass(frozen=True)
class InstantMotor:
    """Jumps exactly to the commanded gaze; its duration is a model.

    Eyes follow the main sequence, duration = 21 ms + 2.2 ms/deg of rotation (Carpenter, Movements of the Eyes, 1988;
    for the half vergence each eye turns by); the neck's pan and tilt accelerate and brake at a constant rate up to
    a top speed, as a robot's do. All joints start together: the slowest counts. Nothing moved takes no time.

    Attributes:
        eye_base_s: of the main sequence.
        eye_slope_s_per_deg: of the main sequence.
        neck_speed_deg_s: top speed of pan and tilt.
        neck_acceleration_deg_s2: of pan and tilt.
    """

    eye_base_s: float = 0.021
    eye_slope_s_per_deg: float = 0.0022
    neck_speed_deg_s: float = 200.0
    neck_acceleration_deg_s2: float = 1500.0

    def __post_init__(self) -> None:
        """Raise SettingError for durations that are not positive."""
        check_types(self, "motor.")
        for name in ("eye_base_s", "eye_slope_s_per_deg"):
            require(getattr(self, name) >= 0, f"motor.{name}", getattr(self, name), "zero or more")
        for name in ("neck_speed_deg_s", "neck_acceleration_deg_s2"):
            require(getattr(self, name) > 0, f"motor.{name}", getattr(self, name), "more than zero")

    def duration_s(self, before: Gaze, after: Gaze) -> float:
        """Seconds that a saccade takes."""
        pan, tilt, vergence = (abs(math.degrees(float(b) - float(a))) for a, b in zip(before, after, strict=True))
        eye = self.eye_base_s + self.eye_slope_s_per_deg * vergence / 2 if vergence > 0 else 0.0
        return max(eye, self._neck_s(pan), self._neck_s(tilt))

    def _neck_s(self, angle_deg: float) -> float:
        speed, acceleration = self.neck_speed_deg_s, self.neck_acceleration_deg_s2
        ramp = speed * speed / acceleration  # what reaching the top speed and braking from it takes
        if angle_deg < ramp:
            return 2 * math.sqrt(angle_deg / acceleration)
        return angle_deg / speed + speed / acceleration

    def move(self, head: Head, before: Gaze, command: Gaze) -> Moved:
        """Execute a saccade from one gaze to another."""
        return Moved(command, self.duration_s(before, command), turned_deg(head, before, command))
