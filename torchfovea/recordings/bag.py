"""ROS 2 bags (a folder with metadata.yaml, an .mcap or .db3 file) as recordings, read by rosbags without any ROS."""

from __future__ import annotations

import math
import os
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from torchfovea.memory.moving import Motion
from torchfovea.recordings.frames import Calibration, Moment, Refuse, gaze_from_angles
from torchfovea.recordings.ros import (
    camera_from_info,
    gaze_from_joints,
    image_from_message,
    motion_from_odometry,
    stamp_s,
)
from torchfovea.sensing.head import Gaze
from torchfovea.setting import SettingError, check_types, require

__all__ = ["Bag", "Topics"]


@dataclass(frozen=True)
class Topics:
    """What is where in a bag.

    Attributes:
        left: sensor_msgs/Image or CompressedImage of the left eye, rectified.
        right: of the right eye.
        camera: sensor_msgs/CameraInfo of the left eye; its P is used.
        joints: sensor_msgs/JointState; None: the head does not move.
        odometry: nav_msgs/Odometry of the ego frame; None: the base does not move.
        pan: name of the joint; None: there is no such joint.
        tilt: the same.
        vergence: the same.
        together_s: stamps so near to each other are of one moment.
        told_s: joints and odometry at most so old or so early are believed.
    """

    left: str = "/left/image_rect"
    right: str = "/right/image_rect"
    camera: str = "/left/camera_info"
    joints: str | None = None
    odometry: str | None = None
    pan: str | None = None
    tilt: str | None = None
    vergence: str | None = None
    together_s: float = 0.005
    told_s: float = 0.1

    def __post_init__(self) -> None:
        """Raise SettingError for times that are not positive, and joints without their topic."""
        check_types(self, "bag.")
        for name in ("together_s", "told_s"):
            require(
                0 < getattr(self, name) < math.inf, f"bag.{name}", getattr(self, name), "a positive time in seconds"
            )
        named = [name for name in ("pan", "tilt", "vergence") if getattr(self, name) is not None]
        require(not named or self.joints is not None, "bag.joints", None, "the topic of " + ", ".join(named))

    @property
    def named(self) -> dict[str, str]:
        """The joints that there are, by what they turn."""
        return {name: getattr(self, name) for name in ("pan", "tilt", "vergence") if getattr(self, name) is not None}


@dataclass
class _Told:
    """Messages in the order of their stamps."""

    stamps: list[float] = field(default_factory=list)
    messages: list[Any] = field(default_factory=list)

    def add(self, message: Any) -> None:
        at = bisect_left(self.stamps, stamp_s(message))
        self.stamps.insert(at, stamp_s(message))
        self.messages.insert(at, message)

    def nearest(self, time_s: float, within_s: float, what: str) -> Any:
        """The message nearest to a time.

        Raises:
            SettingError: where none is near enough.
        """
        at = bisect_left(self.stamps, time_s)
        near = sorted((abs(self.stamps[k] - time_s), k) for k in (at - 1, at) if 0 <= k < len(self.stamps))
        away = near[0][0] if near else math.inf
        require(away <= within_s, what, f"{away:.3g} s away", f"a message within {within_s:g} s")
        return self.messages[near[0][1]]


class Bag:
    """A bag; a `torchfovea.recordings.frames.Recording`.

    Every left image is a frame; the right one of the same moment belongs to it, the nearest joints and odometry too.

    Args:
        path: a folder with metadata.yaml, or a file.
        topics: what is where.

    Raises:
        SettingError: without rosbags (the extra `ros`), for what is no bag, and a bag without a topic: it names it, and
            those that there are.
    """

    def __init__(self, path: str | os.PathLike[str], topics: Topics | None = None) -> None:
        self.path, self.topics = Path(path), topics or Topics()
        self._joints, self._odometry = _Told(), _Told()
        t = self.topics
        infos: list[Any] = []
        wanted: dict[str, Callable[[Any], None]] = {t.camera: infos.append}
        wanted |= {t.joints: self._joints.add} if t.joints is not None else {}
        wanted |= {t.odometry: self._odometry.add} if t.odometry is not None else {}
        with self._open() as reader:
            there = {c.topic: c.msgcount for c in reader.connections}
            for name in ("left", "right", "camera", "joints", "odometry"):
                topic = getattr(t, name)
                known = topic is None or there.get(topic, 0) > 0
                require(known, f"bag.{name}", topic, "a topic of the bag with messages: " + ", ".join(sorted(there)))
            self._count = int(there[t.left])
            for topic, message in self._messages(reader, wanted):
                wanted[topic](message)
        camera, size = camera_from_info(infos[0])
        self.calibration = Calibration(camera, camera, size)

    def __len__(self) -> int:
        """How many frames there are."""
        return self._count

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise SettingError(
                f"recording = {self.path}: expected rosbags for a bag: pip install 'torchfovea[ros]'"
            ) from None
        try:
            with AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                yield reader
        except SettingError:
            raise
        except Exception as error:  # rosbags reads bytes as they come: a damaged bag fails anywhere
            why = " ".join(str(error).split())[:160] or type(error).__name__
            raise SettingError(f"recording = {self.path}: expected a ROS 2 bag that can be read ({why})") from error

    def _messages(self, reader: Any, topics: Mapping[str, object]) -> Iterator[tuple[str, Any]]:
        some = [c for c in reader.connections if c.topic in topics]
        for connection, _, data in reader.messages(connections=some):
            yield connection.topic, reader.deserialize(data, connection.msgtype)

    def frames(self, refuse: Refuse) -> Iterator[Moment]:
        """The frames in order; see `torchfovea.recordings.frames.Recording`."""
        then, gaze, odometry = -math.inf, gaze_from_angles(0.0, 0.0, 0.0), None
        for k, (left, right) in enumerate(self._pairs()):
            images: list[Tensor | None] = [None, None]
            base, time_s = None, stamp_s(left)
            try:
                expected = f"at least {then:.3f}, the frame's before: time runs backward"
                require(time_s >= then, "stamp", f"{time_s:.3f}", expected)
                then = time_s
                gaze = self._gaze(time_s)
                if self.topics.odometry is not None:
                    now = self._odometry.nearest(time_s, self.topics.told_s, self.topics.odometry)
                    base, odometry = _step(odometry, now), now
                images = [None if message is None else self._image(message) for message in (left, right)]
            except SettingError as error:
                images = [None, None]
                refuse(SettingError(f"{self.path}, frame {k}: {error}"))
            yield Moment(max(time_s, then), images[0], images[1], gaze, base)

    def _gaze(self, time_s: float) -> Gaze:
        if self.topics.joints is None:
            return gaze_from_angles(0.0, 0.0, 0.0)
        told = self._joints.nearest(time_s, self.topics.told_s, self.topics.joints)
        return gaze_from_joints(told, self.topics.named)

    def _image(self, message: Any) -> Tensor:
        image, (width, height) = image_from_message(message), self.calibration.size_px
        size = (image.shape[-1], image.shape[-2])
        require(size == (width, height), "image's size", size, f"{(width, height)}, the camera_info's")
        return image

    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        """Left images with the right ones of the same moment, or None."""
        lefts: list[Any] = []
        rights: list[Any] = []
        names = {self.topics.left: lefts, self.topics.right: rights}
        with self._open() as reader:
            for topic, message in self._messages(reader, names):
                names[topic].append(message)
                yield from self._matched(lefts, rights)
        yield from ((left, None) for left in lefts)

    def _matched(self, lefts: list[Any], rights: list[Any]) -> Iterator[tuple[Any, Any]]:
        """The pairs that are certain by now; what is used is taken off both lists."""
        while lefts and rights:
            apart = stamp_s(rights[0]) - stamp_s(lefts[0])
            if apart < -self.topics.together_s:
                rights.pop(0)
            elif apart > self.topics.together_s:
                yield lefts.pop(0), None
            else:
                yield lefts.pop(0), rights.pop(0)


def _step(before: Any, now: Any) -> Motion | None:
    return None if before is None or before is now else motion_from_odometry(before, now)
