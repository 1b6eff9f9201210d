"""The simulated arena of an episode: a MuJoCo world behind the interface that a robot would offer too."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.episode import Fixation, Look, Move, Truth
from torchfovea.geometric import correspond_points
from torchfovea.head import Gaze, eyes
from torchfovea.matching import Disparity, match_sgbm, verged
from torchfovea.perception import Observer
from torchfovea.sgbm import SGBM
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
        matcher: SGBM's parameters and the nearest range it searches [m]; None: the geometric sensor.
    """

    def __init__(self, world: World, observer: Observer, matcher: tuple[SGBM, float] | None) -> None:
        self.world, self.observer, self.matcher = world, observer, matcher

    def saccade(self, gaze: Gaze) -> Move:
        """Move the head and wait until it rests."""
        return Move(*self.world.saccade(gaze))

    def fixation(self, gaze: Gaze) -> Fixation:
        """The first surface on the cyclopean ray."""
        seen = self.world.fixated(gaze)
        return Fixation(seen.point_e, seen.range_m, seen.is_floor, seen.is_target)

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        """Sense at a gaze; the generator draws the geometric sensor's noise."""
        observer = self.observer
        if self.matcher is not None:
            left, right = self.world.images(gaze)
            rig = verged(gaze.vergence, observer.head.baseline_m)
            params, nearest_m = self.matcher
            matches, disparity = match_sgbm(
                left.image, right.image, rig, observer.camera, observer.retina, params, observer.budget, nearest_m
            )
            return Look(matches, Pictures(left.image, right.image, disparity))
        left_px = observer.retina.centers_px(dtype=gaze.pan.dtype)
        seen = self.world.correspond(gaze, observer.camera.rays(left_px))
        visible = seen.hit & seen.visible_right
        pose = eyes(observer.head, gaze)
        return Look(
            correspond_points(
                seen.points_e, visible, left_px, pose, observer.camera, observer.retina, observer.budget, generator
            )
        )

    def truth(self, cells: Tensor) -> Truth:
        """What the judge knows: the nearest point, and the surface behind every memory cell (Nx, 3)."""
        hits = self.world.panorama(cells)
        points = hits.range_m.to(cells)[:, None] * cells
        points = torch.where((hits.geom >= 0)[:, None], points, torch.full_like(points, torch.inf))
        scene = self.world.scene
        return Truth(float(scene.nearest_range_m), scene.nearest_point_e.to(cells), points)
