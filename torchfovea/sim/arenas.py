"""Many simulated arenas that are sensed together, on any device, by the geometric sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfovea.arena import Fixation
from torchfovea.compiling import compiling
from torchfovea.memory.classes import Classes
from torchfovea.perception import Observer
from torchfovea.search import Look, Move
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.sensing.geometric import correspond_points, with_noise
from torchfovea.sensing.head import Gaze, clamp_gaze, cyclopean, eyes, to_ego
from torchfovea.sensing.marks import field_width_rad, read_marks, readable
from torchfovea.setting import require
from torchfovea.sim.marked import check_marks
from torchfovea.sim.model import Scene
from torchfovea.sim.motor import InstantMotor, Motor
from torchfovea.sim.room import FLOOR, TARGET
from torchfovea.sim.solids import solids_of, take
from torchfovea.sim.trace import occluded, ranges, trace

__all__ = ["GeometricArenas"]


class GeometricArenas:
    """B scenes seen by observers of one kind: what `torchfovea.sim.arena.SimulatedArena` does for one.

    Args:
        scenes: B, built for the observer's head; one may appear several times.
        observer: whose retina and error budget the sensor has.
        sample: how many receptive fields a look goes through, drawn anew each time; None: all of them.
        device: where rays are traced, in float64.
        motor: its model of durations.
        seeds: of each row's encoder noise, see `torchfovea.sim.arena.SimulatedArena`; by default 0, 1, ...
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        observer: Observer,
        sample: int | None = None,
        device: torch.device | str = "cpu",
        motor: Motor | None = None,
        seeds: Sequence[int] | None = None,
    ) -> None:
        instant = InstantMotor() if motor is None else motor
        require(isinstance(instant, InstantMotor), "motor", type(instant).__name__, "an InstantMotor, in a batch")
        assert isinstance(instant, InstantMotor)
        self.observer, self.sample, self.motor, self.device = observer, sample, instant, device
        self.pool: list[Scene] = []
        self.stands = torch.zeros(len(scenes), dtype=torch.int64)
        self._stand(range(len(scenes)), scenes)
        self.before = torch.zeros(len(scenes), 3, dtype=torch.float64)
        seeds = range(len(scenes)) if seeds is None else seeds
        require(len(seeds) == len(scenes), "seeds", len(seeds), f"one for each of {len(scenes)} scenes")
        self.noise = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._whole: tuple[GeometricArenas, Tensor] | None = None

    def _stand(self, rows: Sequence[int], scenes: Sequence[Scene]) -> None:
        """Put rows into scenes; every scene becomes tensors once."""
        places = {id(scene): k for k, scene in enumerate(self.pool)}
        new = list({id(scene): scene for scene in scenes if id(scene) not in places}.values())
        if new:
            self.pool += new
            places = {id(scene): k for k, scene in enumerate(self.pool)}
            most = max(len(scene.kind) for scene in self.pool)
            self._solids = solids_of(self.pool, self.device)
            self._kind = torch.stack([pad(scene.kind, (0, most - len(scene.kind)), value=-1) for scene in self.pool])
            if self.observer.classes is not None:
                self._mark, self.detail_m = _marks(self.pool, self.observer.classes, most)
        self.stands[list(rows)] = torch.tensor([places[id(scene)] for scene in scenes])
        self.solids = take(self._solids, self.stands.to(self.device))
        self.kind = self._kind[self.stands].to(self.device)
        self.mark = None if self.observer.classes is None else self._mark[self.stands].to(self.device)

    def renew(self, rows: Sequence[int], scenes: Sequence[Scene], seeds: Sequence[int]) -> None:
        """Put rows into other scenes, their heads straight ahead.

        Args:
            rows: their numbers.
            scenes: one for each; those that were here before cost next to nothing.
            seeds: of the rows' encoder noise.
        """
        self._stand(rows, scenes)
        self.before[list(rows)] = 0
        for row, seed in zip(rows, seeds, strict=True):
            self.noise[row] = torch.Generator().manual_seed(seed)

    def some(self, rows: Sequence[int]) -> GeometricArenas:
        """The arenas of some rows by themselves; heads that are moved there are ours."""
        if list(rows) == list(range(len(self.noise))):
            return self
        part, index = copy(self), torch.tensor(rows)
        part.solids, part.kind = take(self.solids, index.to(self.device)), self.kind[index.to(self.device)]
        part.stands, part.noise, part._whole = self.stands[index], [self.noise[row] for row in rows], (self, index)
        part.before = self.before[index]
        part.mark = None if self.mark is None else self.mark[index.to(self.device)]
        return part

    def saccade(self, gaze: Gaze) -> Move:
        """Turn each head to its gaze, clamped to the limits; the gazes that come back are what the encoders tell."""
        head = self.observer.head
        command = clamp_gaze(head, Gaze(*(angle.detach().cpu().double() for angle in gaze)))
        last = Gaze(*self.before.unbind(-1))
        a, b = (cyclopean(head, g)[0][..., 2] for g in (last, command))
        degrees = torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).square().sum(-1).sqrt(), (a * b).sum(-1)))
        thens, nows = (zip(*(angle.tolist() for angle in g), strict=True) for g in (last, command))
        seconds = [self.motor.duration_s(Gaze(*then), Gaze(*now)) for then, now in zip(thens, nows, strict=True)]
        self.before = torch.stack(command, -1)
        if self._whole is not None:
            whole, rows = self._whole
            whole.before[rows] = self.before
        error = torch.stack([torch.randn(3, generator=g, dtype=torch.float64) for g in self.noise])
        told = Gaze(*(self.before + math.radians(head.encoder_deg) * error).unbind(-1))
        return Move(told, torch.tensor(seconds, dtype=torch.float64), degrees)

    def _true(self, gaze: Gaze) -> Gaze:
        """Where the heads really look; with exact encoders wherever one asks."""
        if self.observer.head.encoder_deg == 0:
            return gaze
        return Gaze(*(angle.to(told) for angle, told in zip(self.before.unbind(-1), gaze, strict=True)))

    def fixation(self, gaze: Gaze) -> Fixation:
        """The first surface on each cyclopean ray."""
        gaze = self._true(gaze)
        rotation, origin = cyclopean(self.observer.head, Gaze(*(angle.to(self.kind.device).double() for angle in gaze)))
        range_m, geom = trace(self.solids, origin, rotation[:, None, :, 2])
        point = origin + range_m * rotation[..., 2]
        kind = self.kind.gather(1, geom)[:, 0]
        return Fixation(point, point.square().sum(-1).sqrt(), kind == FLOOR, kind == TARGET)

    def look(self, gaze: Gaze, generators: Sequence[torch.Generator]) -> Look:
        """Sense at each gaze; each generator draws its episode's receptive fields and noise."""
        observer, device, gaze = self.observer, gaze.pan.device, self._true(gaze)
        pose = eyes(observer.head, gaze)
        left_px = observer.retina.centers_px(device, gaze.pan.dtype)
        chosen = [draw_fields(observer.retina.count, self.sample, generator) for generator in generators]
        some = any(index is not None for index in chosen)
        if some:
            left_px = left_px[torch.stack([index for index in chosen if index is not None]).to(device)]
        with compiling(observer.compile):
            points, visible, geom = self._surfaces(gaze, observer.camera.rays(left_px))
        matches = correspond_points(points, visible, left_px, pose, observer.camera, observer.retina, observer.budget)
        matches = with_noise(matches, observer.retina, generators)
        if self.mark is not None and observer.classes is not None:
            away = (points - pose.t_left[:, None]).norm(dim=-1)
            width = field_width_rad(observer.camera, observer.retina, observer.budget, left_px) * away
            mark, share = self.mark.gather(1, geom), readable(width, self.detail_m)
            matches = matches._replace(classes=read_marks(mark, share, observer.classes.count, generators))
        return Look(for_all(matches, observer.retina) if some else matches)

    def _surfaces(self, gaze: Gaze, left_rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What each left ray meets, and whether the right eye sees it; see `torchfovea.sim.world.World.correspond`.

        And its geom, of which nothing comes where nobody asks for marks.
        """
        pose = eyes(self.observer.head, Gaze(*(angle.detach().double() for angle in gaze)))
        x, y, z = left_rays.double().unbind(-1)
        scale = torch.rsqrt(x * x + y * y + z * z)
        unit = torch.stack([x * scale, y * scale, z * scale]).movedim(0, -1)
        direction = to_ego(pose.R_left, unit.expand(len(self.kind), -1, -1))
        if self.mark is None:
            range_m = ranges(self.solids, pose.t_left, direction)
            geom = torch.empty(0, dtype=torch.int64)
        else:
            range_m, geom = trace(self.solids, pose.t_left, direction)
        points = pose.t_left[:, None] + range_m[..., None] * direction
        line = points - pose.t_right[:, None]
        ahead = (line * pose.R_right[:, None, :, 2]).sum(-1) > 0
        return points.to(left_rays.dtype), ahead & ~occluded(self.solids, pose.t_right, points), geom


def _marks(scenes: Sequence[Scene], classes: Classes, most: int) -> tuple[Tensor, float]:
    """The class of every geom, (B, G), and the detail that tells them; scenes without such marks are refused."""
    rows, detail_m = [], 0.0
    for scene in scenes:
        told = check_marks(scene, classes)
        require(detail_m in (0.0, told.detail_m), "scene.detail_m", told.detail_m, f"{detail_m}, as in the others")
        rows.append(pad(told.of_geom, (0, most - len(told.of_geom))))
        detail_m = told.detail_m
    return torch.stack(rows), detail_m
