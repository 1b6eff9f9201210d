"""A recording as a robot: it does not go where it is told to, but where it went, and sees what it saw."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

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
    """The observer with a recording's cameras, in the pixels of its own retinas, each about its camera's axis."""
    scale = 2 * observer.retina.radius_px / min(calibration.size_px)
    left, right = (
        eye.scaled(scale, (-scale * eye.cx_px, -scale * eye.cy_px)) for eye in (calibration.left, calibration.right)
    )
    return replace(observer, camera=left, camera_right=None if left == right else right)


class _Coming(NamedTuple):
    """A frame that was read ahead, or why it cannot be used; what is to be seen of it, and the matches on their way."""

    moment: Moment | SettingError
    views: Views | None = None
    matches: Future[Any] | None = None


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
        ahead: how many frames are read and matched ahead, each in a thread of its own; 0: each when it is looked at.
            The matcher must bear that, as the built-in ones do; the result is the same.
    """

    def __init__(
        self,
        recording: Recording,
        observer: Observer,
        matcher: Match,
        sample: int | None = None,
        refuse: Refuse | None = None,
        ahead: int = 0,
    ) -> None:
        require(ahead >= 0, "ahead", ahead, "how many frames are matched ahead, 0 or more")
        self.observer, self.matcher, self.sample = observer, matcher, sample
        self.calibration = recording.calibration
        self.moment: Moment | None = None
        self._frames = recording.frames(_raised if refuse is None else refuse)
        self._ahead, self._coming = ahead, deque[_Coming]()
        self._now: _Coming | None = None
        self._threads = ThreadPoolExecutor(ahead, "match") if ahead else None

    def saccade(self, gaze: Gaze) -> Move:
        """Go on to the next frame; where the head was then."""
        before = self.moment
        self._now = self._coming.popleft() if self._coming else _Coming(next(self._frames))
        if isinstance(self._now.moment, SettingError):
            raise self._now.moment
        now = self.moment = self._now.moment
        if before is None:
            return Move(now.gaze, 0.0, 0.0, now.base)
        a, b = (cyclopean(self.observer.head, one.gaze)[0][..., 2] for one in (before, now))
        degrees = math.degrees(float(torch.atan2(torch.linalg.cross(a, b).norm(), (a * b).sum())))
        return Move(now.gaze, now.time_s - before.time_s, degrees, now.base)

    def look(self, gaze: Gaze, generator: Any) -> Look | None:
        """What the frame's images show; None where one did not arrive."""
        now, coming = self.moment, self._now
        assert now is not None and coming is not None
        self._look_ahead(gaze)
        if now.left is None or now.right is None:
            return None
        matches = coming.matches
        if matches is None or coming.views is None:
            views = views_of(now, self.calibration, self.observer.head, gaze)
            return look_at(self.observer, views, self.matcher, generator, self.sample)
        return look_at(self.observer, coming.views, lambda *_: matches.result(), generator, self.sample)

    def _look_ahead(self, like: Gaze) -> None:
        """Read the next frames and have them matched; what a recording shows does not depend on what is made of it."""
        while self._threads is not None and len(self._coming) < self._ahead:
            try:
                moment = next(self._frames)
            except StopIteration:
                return
            except SettingError as error:  # told when it is that frame's turn
                self._coming.append(_Coming(error))
                return
            if moment.left is None or moment.right is None:
                self._coming.append(_Coming(moment))
                continue
            gaze = Gaze(*(angle.to(told) for angle, told in zip(moment.gaze, like, strict=True)))
            views = views_of(moment, self.calibration, self.observer.head, gaze)
            matches = self._threads.submit(self.matcher, views, self.observer.retina, self.observer.budget)
            self._coming.append(_Coming(moment, views, matches))


def views_of(moment: Moment, calibration: Calibration, head: Head | Kinematics, gaze: Gaze) -> Views:
    """A moment's images as matchers want them, the head being believed to be at a gaze."""
    assert moment.left is not None and moment.right is not None
    left, right = calibration.left, calibration.right
    rig = rig_at(head, gaze)
    axes = ((eye.cx_px, eye.cy_px) for eye in (left, right))
    return posed_views(moment.left, moment.right, left, right, rig, *axes)


def _raised(error: SettingError) -> None:
    raise error
