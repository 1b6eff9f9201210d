"""The simulated arena of an episode: a MuJoCo world behind the interface that a robot would offer too."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.episode import Fixation, Look, Move, Truth
from torchfovea.geometric import correspond_points
from torchfovea.head import Gaze, eyes, to_ego
from torchfovea.matching import SGBM, Disparity, match_sgbm
from torchfovea.perception import Observer
from torchfovea.sim.world import World

__all__ = ["Arena", "Pictures"]


class Pictures(NamedTuple):
    """What a photometric look leaves to be drawn.

    Attributes:
        left: the left eye's image, (3, H, W) in [0, 1].
        right: the right eye's.
        disparity: of the rectified view.
    """

    left: Tensor
    right: Tensor
    disparity: Disparity


class Arena:
    """A world seen by an observer, photometric or geometric.

    Args:
        world: the scene with its head, renderer and motor.
        observer: whose retina and error budget the sensor has.
        matcher: SGBM's parameters, or None for the geometric sensor.
    """

    def __init__(self, world: World, observer: Observer, matcher: SGBM | None) -> None:
        self.world, self.observer, self.matcher = world, observer, matcher

    def saccade(self, gaze: Gaze) -> Move:
        """Move the head and wait until it rests."""
        moved = self.world.saccade(gaze)
        return Move(moved.gaze, moved.seconds, moved.degrees)

    def fixation(self, gaze: Gaze) -> Fixation:
        """The first surface on the cyclopean ray."""
        seen = self.world.fixated(gaze)
        return Fixation(float(seen.range_m), bool(seen.is_floor), bool(seen.is_target))

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        """Sense at a gaze; the generator draws the geometric sensor's noise."""
        observer = self.observer
        if self.matcher is None:
            left_px = observer.retina.centers_px(dtype=gaze.pan.dtype)
            points, hit, visible = self.world.correspond(gaze, observer.camera.rays(left_px))
            matches = correspond_points(
                points.to(left_px),
                hit & visible,
                left_px,
                eyes(observer.head, gaze),
                observer.camera,
                observer.retina,
                observer.budget,
                generator,
            )
            return Look(matches)
        left, right = self.world.images(gaze)
        matches, disparity = self._match(left.image, right.image, gaze)
        return Look(matches, Pictures(left.image, right.image, disparity))
