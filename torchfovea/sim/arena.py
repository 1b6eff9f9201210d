"""The simulated arena of an episode: a MuJoCo world behind the interface that a robot offers too, and the truth."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.arena import Fixation, Truth
from torchfovea.perception import Observer
from torchfovea.search import Look, Move
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.sensing.geometric import correspond_points, with_noise
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sim.truth import truth_of
from torchfovea.sim.world import World
from torchfovea.stereo.matchers import Match, checked_matches
from torchfovea.stereo.rig import verged
from torchfovea.stereo.sweep import SweepRange
from torchfovea.stereo.views import verged_views

__all__ = ["Pictures", "SimulatedArena"]


class Pictures(NamedTuple):
    """What a photometric look leaves to be drawn.

    Attributes:
        left: the left eye's image, (3, H, W) in [0, 1].
        right: the right eye's.
        found: what the matcher found, of the rectified view or along the left rays; of a user's own, anything.
    """

    left: Tensor
    right: Tensor
    found: Disparity | SweepRange | Any


class SimulatedArena:
    """A world seen by an observer, photometric or geometric.

    Args:
        world: the scene with its head, renderer and motor.
        observer: whose retina and error budget the sensor has.
        matcher: matches the images; None: the geometric sensor.
        sample: how many receptive fields a look goes through, drawn anew each time; None: all of them.
        seed: of the encoders' noise, where the observer's head has any: it then believes them, and the world does not.
    """

    def __init__(
        self,
        world: World,
        observer: Observer,
        matcher: Match | None,
        sample: int | None = None,
        seed: int = 0,
    ) -> None:
        self.world, self.observer, self.matcher, self.sample = world, observer, matcher, sample
        self.noise = torch.Generator().manual_seed(seed)

    def saccade(self, gaze: Gaze) -> Move:
        """Move the head and wait until it rests; the gaze that comes back is what the encoders tell."""
        moved = self.world.saccade(gaze)
        sigma = math.radians(self.observer.head.encoder_deg)
        error = sigma * torch.randn(3, generator=self.noise, dtype=torch.float64)
        return Move(Gaze(*(a + e for a, e in zip(moved.gaze, error, strict=True))), *moved[1:])

    def _true(self, gaze: Gaze) -> Gaze:
        """Where the head really looks; with exact encoders wherever one asks."""
        if self.observer.head.encoder_deg == 0:
            return gaze
        return Gaze(*(angle.to(told) for angle, told in zip(self.world.gaze, gaze, strict=True)))

    def fixation(self, gaze: Gaze) -> Fixation:
        """The first surface on the cyclopean ray."""
        seen = self.world.fixated(self._true(gaze))
        return Fixation(seen.point_e, seen.range_m, seen.is_floor, seen.is_target)

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        """Sense at a gaze; the generator draws the geometric sensor's noise."""
        observer = self.observer
        believed, gaze = gaze, self._true(gaze)
        if self.matcher is not None:
            left, right = self.world.images(gaze)
            return self.match(left.image, right.image, believed, generator)
        left_px = observer.retina.centers_px(dtype=gaze.pan.dtype)
        chosen = draw_fields(observer.retina.count, self.sample, generator)
        if chosen is not None:
            left_px = left_px[chosen]
        seen = self.world.correspond(gaze, observer.camera.rays(left_px))
        visible = seen.hit & seen.visible_right
        pose = eyes(observer.head, gaze)
        matches = correspond_points(
            seen.points_e, visible, left_px, pose, observer.camera, observer.retina, observer.budget
        )
        matches = with_noise(matches, observer.retina, generator)
        return Look(matches if chosen is None else for_all(matches, observer.retina))

    def match(self, left: Tensor, right: Tensor, gaze: Gaze, generator: torch.Generator) -> Look:
        """What the matcher makes of both eyes' pictures (3, H, W), the head being believed to be at a gaze."""
        assert self.matcher is not None
        head, camera, retina = self.observer.head, self.observer.camera, self.observer.retina
        views = verged_views(left, right, verged(gaze.vergence, head.baseline_m), camera, retina.radius_px)
        matches, found = checked_matches(self.matcher(views, retina, self.observer.budget), retina)
        chosen = draw_fields(retina.count, self.sample, generator)
        if chosen is not None:
            matches = for_all(matches.take(chosen), retina)
        return Look(matches, Pictures(left, right, found))

    def truth(self, cells: Tensor) -> Truth:
        """What the judge knows: the nearest point, and the surface behind every memory cell (Nx, 3)."""
        return truth_of(self.world.scene, cells)
