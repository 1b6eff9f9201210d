"""A recording as a robot: it does not go where it is told to, but where it went, and sees what it saw."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from torchfovea.looking import look_at
from torchfovea.perception import Observer
from torchfovea.recordings.frames import Calibration, Moment, Recording, Refuse
from torchfovea.search import Look, Move
from torchfovea.sensing.head import Gaze, Head, Kinematics, cyclopean
from torchfovea.setting import SettingError, require
from torchfovea.stereo.matchers import Match
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.views import Views, posed_views

__all__ = ["Playback", "observer_of", "views_of"]


def observer_of(observer: Observer, calibration: Calibration) -> Observer:
    """The observer with a recording's camera, in the pixels of its own retina.

    Raises:
        SettingError: for eyes that differ.
    """
    require(calibration.left == calibration.right, "calibration.right", calibration.right, "the left eye's camera")
    eye, scale = calibration.left, 2 * observer.retina.radius_px / min(calibration.size_px)
    return replace(observer, camera=eye.scaled(scale, (-scale * eye.cx_px, -scale * eye.cy_px)))


class Playback:
    """Plays a recording; a `torchfovea.search.Robot`.

    `torchfovea.search.search` over as many saccades as the recording has frames enters each into the memory and
    proposes the next fixation at each.

    Args:
        recording: what is played.
        observer: from `observer_of`.
        matcher: matches the images.
        sample: see `torchfovea.looking.look_at`.
        refuse: what to do with frames that cannot be used; None: they end the search by their error.
    """

    def __init__(
        self,
        recording: Recording,
        observer: Observer,
        matcher: Match,
        sample: int | None = None,
        refuse: Refuse | None = None,
    ) -> None:
        self.observer, self.matcher, self.sample = observer, matcher, sample
        self.calibration = recording.calibration
        self.moment: Moment | None = None
        self._frames = recording.frames(_raised if refuse is None else refuse)

    def saccade(self, gaze: Gaze) -> Move:
        """Go on to the next frame; where the head was then."""
        before, self.moment = self.moment, next(self._frames)
        now = self.moment
        if before is None:
            return Move(now.gaze, 0.0, 0.0, now.base)
        a, b = (cyclopean(self.observer.head, one.gaze)[0][..., 2] for one in (before, now))
        degrees = math.degrees(float(torch.atan2(torch.linalg.cross(a, b).norm(), (a * b).sum())))
        return Move(now.gaze, now.time_s - before.time_s, degrees, now.base)

    def look(self, gaze: Gaze, generator: Any) -> Look | None:
        """What the frame's images show; None where one did not arrive."""
        now = self.moment
        assert now is not None
        if now.left is None or now.right is None:
            return None
        views = views_of(now, self.calibration, self.observer.head, gaze)
        return look_at(self.observer, views, self.matcher, generator, self.sample)


def views_of(moment: Moment, calibration: Calibration, head: Head | Kinematics, gaze: Gaze) -> Views:
    """A moment's images as matchers want them, the head being believed to be at a gaze."""
    assert moment.left is not None and moment.right is not None
    left, right = calibration.left, calibration.right
    rig = rig_at(head, gaze)
    return posed_views(moment.left, moment.right, left, right, rig, (left.cx_px, left.cy_px))


def _raised(error: SettingError) -> None:
    raise error
