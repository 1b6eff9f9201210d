"""A compiled scene and the truth about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.head import Head
from torchfovea.sim.room import FLOOR, TARGET, Solid
from torchfovea.sim.texture import Paint

__all__ = ["EgoPose", "Marks", "Nearest", "Scene"]


class EgoPose(NamedTuple):
    """Where the robot stands: E is above (x, y) at the head's ego height, turned left by yaw."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


class Nearest(NamedTuple):
    """The nearest surface point, other than the floor's, that the head can fixate and that E sees.

    Attributes:
        point_e: (3,) in E [m], float64; zero if nothing is within reach.
        range_m: its distance from E's origin; infinite if nothing is within reach.
        geom: which it lies on; -1 if nothing is within reach.
    """

    point_e: Tensor
    range_m: float
    geom: int


_ORIGIN = EgoPose()
_NOTHING = Nearest(torch.zeros(3, dtype=torch.float64), math.inf, -1)


class Marks(NamedTuple):
    """What tells the things of a scene apart.

    Attributes:
        of_geom: the class of each geom, int64 (G,), 0 for what bears no mark.
        classes: how many there are, K.
        sought: the class of the target.
        detail_m: size of what tells the marks apart.
    """

    of_geom: Tensor
    classes: int
    sought: int
    detail_m: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene seen from one place.

    Attributes:
        model: the MjModel; geoms have names, the head is in it.
        data: two MjData, one for each thread that casts rays.
        solids: what it was compiled from, in the order of the geoms.
        paint: what the geoms look like.
        kind: (G,) FLOOR, ROOM, FURNITURE, POLE, CAN or TARGET of each geom (`torchfovea.sim.room`).
        head: whose reach the truth is about.
        pose: where the ego frame E is in the world.
        nearest: the truth, from `torchfovea.sim.truth`.
        params: the settings it was built from.
        seed: and the seed.
        marks: what tells its things apart; the truth then is about the target alone. None: nearness does.
    """

    model: Any
    data: tuple[Any, Any]
    solids: tuple[Solid, ...]
    paint: Paint
    kind: Tensor
    head: Head
    pose: EgoPose = _ORIGIN
    nearest: Nearest = _NOTHING
    params: object = None
    seed: int = 0
    marks: Marks | None = None

    @property
    def world_from_ego(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and translation (3,): X_world = R X_E + t, float64."""
        c, s = math.cos(self.pose.yaw_rad), math.sin(self.pose.yaw_rad)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return rotation, np.array([self.pose.x_m, self.pose.y_m, self.head.ego_height_m])

    @property
    def nearest_point_e(self) -> Tensor:
        """(3,) the nearest reachable point that is not floor, in E [m]."""
        return self.nearest.point_e

    @property
    def nearest_range_m(self) -> float:
        """Its distance from E's origin."""
        return self.nearest.range_m

    @property
    def target_geoms(self) -> frozenset[int]:
        """The geoms of the target."""
        return frozenset((self.kind == TARGET).nonzero()[:, 0].tolist())

    def is_kind(self, geom: Tensor, kind: int) -> Tensor:
        """Whether geoms (...), -1 for none, are of a kind; bool (...)."""
        return (geom >= 0) & (self.kind[geom.clamp(min=0)] == kind)

    def is_floor(self, geom: Tensor) -> Tensor:
        """Whether geoms (...) are the floor; bool (...), false for -1."""
        return self.is_kind(geom, FLOOR)

    def is_target(self, geom: Tensor) -> Tensor:
        """Whether geoms (...) are the target's; bool (...), false for -1."""
        return self.is_kind(geom, TARGET)
