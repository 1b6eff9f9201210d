"""The simulated arena of an episode: a MuJoCo world behind the interface that a robot offers too, and the truth."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import torch
from torch import Tensor

from torchfovea.arena import Fixation, Truth
from torchfovea.compiling import compiling
from torchfovea.looking import Pictures, look_at, look_at_all, told
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.moving import Motion
from torchfovea.perception import Observer
from torchfovea.recordings.folder import Recorder
from torchfovea.recordings.frames import Calibration
from torchfovea.recordings.pictures import as_kept
from torchfovea.rows import stack
from torchfovea.search import Look, Move, steadied
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.sensing.geometric import correspond_points, with_noise
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.setting import require
from torchfovea.sim.truth import truth_of
from torchfovea.sim.walk import Route
from torchfovea.sim.world import World, images_together
from torchfovea.stereo.matchers import Match
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.views import Views, verged_views

__all__ = ["Pictures", "SimulatedArena", "look_together"]


class SimulatedArena:
    """A world seen by an observer, photometric or geometric.

    Args:
        world: the scene with its head, renderer and motor.
        observer: whose retina and error budget the sensor has.
        matcher: matches the images; None: the geometric sensor.
        sample: how many receptive fields a look goes through, drawn anew each time; None: all of them.
        seed: of the encoders' noise, where the observer's head has any (it then believes them, and the world does
            not), and of the odometry's.
        route: where the base goes, a step before each saccade but the first; None: nowhere.
    """

    def __init__(
        self,
        world: World,
        observer: Observer,
        matcher: Match | None,
        sample: int | None = None,
        seed: int = 0,
        route: Route | None = None,
    ) -> None:
        self.world, self.observer, self.matcher, self.sample = world, observer, matcher, sample
        self.noise = torch.Generator().manual_seed(seed)
        self.recorder: Recorder | None = None
        self.seconds, self.route = 0.0, route
        self.base: Motion | None = None  # of the last saccade
        self._steps = -1
        self._memory: Memory | None = None
        if route is not None:
            world.stand(route.pose(0))

    def record(self, folder: str | os.PathLike[str]) -> None:
        """From now on keep what the eyes see, in a new recording; and the eyes see what it keeps.

        Its clock is the motor's.

        Raises:
            SettingError: for the geometric sensor, which has no images, and a folder with a recording.
        """
        require(self.matcher is not None, "record", True, "images, fidelity=photometric")
        camera, side = self.world.image_camera, self.world.source_px
        self.recorder = Recorder(folder, Calibration(camera, camera, (side, side), self.observer.head, True))

    def saccade(self, gaze: Gaze) -> Move:
        """Move the base and the head and wait until they rest; what comes back is what odometry and encoders tell.

        While the base moves, the head keeps its gaze on the point that it was sent to, as the vestibulo-ocular reflex
        does.
        """
        self.base = self._walk()
        if self.base is not None:
            gaze = steadied(self.observer.head, gaze, self.base)
        moved = self.world.saccade(gaze)
        self.seconds += moved.seconds
        sigma = math.radians(self.observer.head.encoder_deg)
        error = sigma * torch.randn(3, generator=self.noise, dtype=torch.float64)
        return Move(Gaze(*(a + e for a, e in zip(moved.gaze, error, strict=True))), *moved[1:], self.base)

    def _walk(self) -> Motion | None:
        """Go a step along the route; what odometry tells of it, or None for no step."""
        self._steps += 1
        if self.route is None or self._steps == 0:
            return None
        before, after = self.route.pose(self._steps - 1), self.route.pose(self._steps)
        if before == after:
            return None
        self.world.stand(after)
        return self.route.odometry.tell(before, after, self.noise)

    def _true(self, gaze: Gaze) -> Gaze:
        """Where the head really looks; with exact encoders wherever one asks."""
        if self.observer.head.encoder_deg == 0:
            return gaze
        return Gaze(*(angle.to(told) for angle, told in zip(self.world.gaze, gaze, strict=True)))

    def fixation(self, gaze: Gaze) -> Fixation:
        """The first surface on the cyclopean ray."""
        seen = self.world.fixated(self._true(gaze))
        return Fixation(seen.point_e, seen.range_m, seen.is_floor, seen.is_target)

    def expect(self, memory: Memory) -> None:
        """Take what is known before the next look, for a matcher that asks."""
        self._memory = memory

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        """Sense at a gaze; the generator draws the geometric sensor's noise."""
        observer = self.observer
        believed, gaze = gaze, self._true(gaze)
        if self.matcher is not None:
            with compiling(observer.compile):
                left, right = (frame.image for frame in self.world.images(gaze))
            if self.recorder is not None:
                left, right = as_kept(left), as_kept(right)
                self.recorder.write(self.seconds, left, right, believed, self.base)
            return self.match(left, right, believed, generator)
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
        views, matcher = self.task(left, right, gaze)
        with compiling(self.observer.compile):
            return look_at(self.observer, views, matcher, generator, self.sample)

    def task(self, left: Tensor, right: Tensor, gaze: Gaze) -> tuple[Views, Match]:
        """What there is to match, and the matcher, which knows where to look if it asks; see `match`."""
        assert self.matcher is not None
        head, camera, retina = self.observer.head, self.observer.camera, self.observer.retina
        views = verged_views(left, right, rig_at(head, gaze), camera, retina.radius_px)
        return views, told(self.matcher, self.observer, self._memory, eyes(head, gaze))

    def truth(self, cells: Tensor) -> Truth:
        """What the judge knows as the robot stands now: the nearest point, and the surface behind each cell (Nx, 3)."""
        return truth_of(self.world.scene, cells)


def look_together(arenas: Sequence[SimulatedArena], gaze: Gaze, generators: Sequence[torch.Generator]) -> Look:
    """Looks of one observer in photometric arenas at B gazes, as `torchfovea.arena.Arenas` has them; not recorded.

    They are drawn together, and matched together by matchers that can (`torchfovea.stereo.matchers.match_all`).
    """
    first, gazes = arenas[0], [Gaze(*(angle[b] for angle in gaze)) for b in range(len(arenas))]
    with compiling(first.observer.compile):
        images = images_together([a.world for a in arenas], [a._true(g) for a, g in zip(arenas, gazes, strict=True)])
        tasks = [
            arena.task(left.image, right.image, own)
            for arena, (left, right), own in zip(arenas, images, gazes, strict=True)
        ]
        views, matchers = zip(*tasks, strict=True)
        looks = look_at_all(first.observer, views, matchers, generators, first.sample)
    return Look(stack([look.matches for look in looks]), [look.pictures for look in looks])
