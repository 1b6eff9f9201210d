"""A base that moves through the room: where it goes, and what its odometry tells of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchfovea.memory.moving import Motion, motion
from torchfovea.setting import check_types, require
from torchfovea.sim.model import EgoPose

__all__ = ["Odometry", "Route"]


@dataclass(frozen=True)
class Odometry:
    """Errors of a step, independent of the others.

    Attributes:
        shift_m: standard deviation along x and along y.
        turn_deg: standard deviation of the turn.
    """

    shift_m: float = 0.005
    turn_deg: float = 0.3

    def __post_init__(self) -> None:
        """Raise SettingError for standard deviations that are none."""
        check_types(self, "motion.")
        require(0 <= self.shift_m < math.inf, "motion.shift_m", self.shift_m, "at least 0 metres")
        require(0 <= self.turn_deg < math.inf, "motion.turn_deg", self.turn_deg, "at least 0 degrees")

    def tell(self, before: EgoPose, after: EgoPose, generator: torch.Generator) -> Motion:
        """What is told of a step between two poses.

        Args:
            before: where the base was.
            after: where it is.
            generator: draws the errors.
        """
        away = torch.tensor([after.x_m - before.x_m, after.y_m - before.y_m, 0.0], dtype=torch.float64)
        turn, turn_rad = _yaw(after.yaw_rad - before.yaw_rad), math.radians(self.turn_deg)
        noise = torch.randn(3, generator=generator, dtype=torch.float64)
        error = torch.cat([self.shift_m * noise[:2], torch.zeros(1, dtype=torch.float64)])
        sigma = torch.tensor([0.0, 0.0, turn_rad, self.shift_m, self.shift_m, 0.0], dtype=torch.float64)
        told = turn @ _yaw(turn_rad * float(noise[2]))
        return motion(told, _yaw(-before.yaw_rad) @ away + turn @ error, torch.diag(sigma.square()))


@dataclass(frozen=True)
class Route:
    """A path through waypoints at an even pace, a step before each saccade but the first.

    Attributes:
        waypoints: places and headings [x m, y m, yaw °] in the world, whose origin and x axis are where the robot would
            stand and face if it stood still. The heading turns evenly along each stretch.
        step_m: length of a step; at the last waypoint the base stays.
        odometry: what is told.
    """

    waypoints: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, -0.4, 0.0))
    step_m: float = 0.1
    odometry: Odometry = field(default_factory=Odometry)

    def __post_init__(self) -> None:
        """Raise SettingError for a path that is none."""
        check_types(self, "motion.")
        require(0 < self.step_m < math.inf, "motion.step_m", self.step_m, "a positive distance in metres")
        some = isinstance(self.waypoints, Sequence) and not isinstance(self.waypoints, str) and len(self.waypoints) >= 1
        require(some, "motion.waypoints", self.waypoints, "at least one [x m, y m, yaw deg]")
        for k, point in enumerate(self.waypoints):
            good = isinstance(point, Sequence) and len(point) == 3
            good = good and all(isinstance(v, int | float) and math.isfinite(v) for v in point)
            require(good, f"motion.waypoints[{k}]", point, "three finite numbers, [x m, y m, yaw deg]")

    def pose(self, step: int) -> EgoPose:
        """Where the base is after so many steps."""
        left = step * self.step_m
        for (x, y, yaw), (x1, y1, yaw1) in zip(self.waypoints[:-1], self.waypoints[1:], strict=True):
            length = math.hypot(x1 - x, y1 - y)
            if left < length:
                share = left / length
                x, y, yaw = x + share * (x1 - x), y + share * (y1 - y), yaw + share * (yaw1 - yaw)
                return EgoPose(x, y, math.radians(yaw))
            left -= length
        x, y, yaw = self.waypoints[-1]
        return EgoPose(x, y, math.radians(yaw))


def _yaw(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
