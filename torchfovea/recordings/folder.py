"""Recordings as folders: frames.csv, calibration.json and two images a frame (docs/recordings.md)."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchfovea.memory.moving import Motion
from torchfovea.recordings.frames import (
    Calibration,
    Moment,
    Refuse,
    gaze_from_angles,
    read_calibration,
    write_calibration,
)
from torchfovea.recordings.pictures import read_picture, write_picture
from torchfovea.recordings.poses import Pose, ahead, matrix_from_quaternion, quaternion_from_matrix, step_between, still
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.head import Gaze
from torchfovea.setting import SettingError, require
from torchfovea.untrusted import Damaged, path_within

__all__ = ["COLUMNS", "Folder", "Recorder"]

_IMAGES = ("time_s", "left", "right")
_JOINTS = ("pan_rad", "tilt_rad", "vergence_rad")
_PLACE, _TURN = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
_YAW = "yaw_rad"
_AXES = ("rx", "ry", "rz", "x", "y", "z")  # of a step's error, as in `torchfovea.memory.moving.Motion`
_PAIRS = [(i, j) for i in range(6) for j in range(i, 6)]
_COVARIANCE = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in _PAIRS)

COLUMNS = (*_IMAGES, *_JOINTS, *_PLACE, *_TURN, *_COVARIANCE)
"""Of frames.csv, as `Recorder` writes it; `Folder` does without all but time_s, left and right."""


Cameras = Callable[[tuple[int, int]], tuple[Camera, Camera]]


class Recorder:
    """Writes a recording frame by frame; cut off at any moment, it is a recording as far as it goes.

    Args:
        folder: where; made if it is missing.
        calibration: of all frames.

    Raises:
        SettingError: for a folder that holds a recording already.
    """

    def __init__(self, folder: str | os.PathLike[str], calibration: Calibration) -> None:
        self.folder, self.calibration = Path(folder), calibration
        self._table = self.folder / "frames.csv"
        require(not self._table.exists(), "recording", self.folder, "a folder without a recording")
        write_calibration(self.folder / "calibration.json", calibration)
        self._count, self._pose, self._time = 0, still(), -math.inf
        self._append(COLUMNS)

    def _append(self, cells: tuple[object, ...]) -> None:
        with self._table.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(cells)

    def write(
        self, time_s: float, left: Tensor | None, right: Tensor | None, gaze: Gaze, base: Motion | None = None
    ) -> None:
        """Add a frame. Who works with `torchfovea.recordings.pictures.as_kept` of the images sees what will be read.

        Args:
            time_s: of the images; never less than before.
            left: (3, H, W) in [0, 1]; None: it did not arrive.
            right: the same.
            gaze: as the encoders tell.
            base: how the base moved since the frame before.

        Raises:
            SettingError: for a time that runs backward, and images of another size than the calibration's.
        """
        require(self._time <= time_s < math.inf, "time_s", time_s, f"at least {self._time:g}, the frame's before")
        names = [self._kept("left", left), self._kept("right", right)]
        if base is not None:
            self._pose = ahead(self._pose, base)
        place, turn = self._pose.translation.tolist(), quaternion_from_matrix(self._pose.rotation).tolist()
        covariance = [0.0] * len(_PAIRS) if base is None else [float(base.covariance[i, j]) for i, j in _PAIRS]
        self._append((time_s, *names, *(float(angle) for angle in gaze), *place, *turn, *covariance))
        self._count, self._time = self._count + 1, time_s

    def _kept(self, side: str, image: Tensor | None) -> str:
        if image is None:
            return ""
        width, height = self.calibration.size_px
        require(tuple(image.shape) == (3, height, width), side, tuple(image.shape), f"(3, {height}, {width})")
        name = f"{side}/{self._count:06d}.png"
        write_picture(self.folder / name, image)
        return name


class Folder:
    """A recording in a folder; a `torchfovea.recordings.frames.Recording`.

    Args:
        folder: as `Recorder` writes it, or made by hand.
        cameras: tells both cameras for images of a width and height, in place of calibration.json's, which may be
            missing then.

    Raises:
        SettingError: for a folder without frames.csv or calibration.json, or a table without its columns, or with
            others.
    """

    def __init__(self, folder: str | os.PathLike[str], cameras: Cameras | None = None) -> None:
        self.folder = Path(folder)
        self._table = self.folder / "frames.csv"
        require(self._table.is_file(), "recording", self.folder, "a folder with frames.csv, or a bag")
        try:
            with self._table.open(newline="", encoding="utf-8") as file:
                reader = csv.DictReader(file)
                given = reader.fieldnames or []
                self._rows = list(reader)
        except (csv.Error, UnicodeDecodeError) as error:
            raise SettingError(f"recording = {self._table}: expected a table of frames ({error})") from error
        missing = [name for name in _IMAGES if name not in given]
        require(
            not missing, f"{self._table}: columns", ", ".join(given), f"{', '.join(_IMAGES)}, and what else is known"
        )
        unknown = [name for name in given if name not in (*COLUMNS, _YAW)]  # missing is 0: a misspelt one is not
        of_these = ", ".join((*_IMAGES, *_JOINTS, *_PLACE, *_TURN, _YAW, _COVARIANCE[0]))
        require(not unknown, f"{self._table}: columns", ", ".join(map(str, unknown)), f"none but {of_these}, ...")
        turn = set(_TURN) <= set(given) or _YAW in given
        self._moves = {"x_m", "y_m"} <= set(given) and turn
        require(bool(self._rows), "recording", self._table, "at least one frame")
        told = self.folder / "calibration.json"
        if cameras is None:
            self.calibration = read_calibration(told)
        elif told.is_file():
            known = read_calibration(told)
            left, right = cameras(known.size_px)
            self.calibration = known._replace(left=left, right=right)
        else:
            size = self._size()
            self.calibration = Calibration(*cameras(size), size, None, False)

    def _size(self) -> tuple[int, int]:
        """Width and height of the first image."""
        names = [row[side] for row in self._rows for side in _IMAGES[1:] if row[side]]
        require(bool(names), "recording", self._table, "at least one image")
        height, width = self._picture(names[0]).shape[-2:]
        return width, height

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self._rows)

    def frames(self, refuse: Refuse) -> Iterator[Moment]:
        """The frames in order; see `torchfovea.recordings.frames.Recording`."""
        then, pose, gaze = -math.inf, None, gaze_from_angles(0.0, 0.0, 0.0)
        for k, row in enumerate(self._rows):
            left = right = base = None
            time_s = then
            try:
                time_s = _number(row, "time_s", None)
                require(time_s >= then, "time_s", time_s, f"at least {then:g}, the frame's before: time runs backward")
                then = time_s
                gaze = gaze_from_angles(*(_number(row, name) for name in _JOINTS))
                if self._moves:
                    now = _pose(row)
                    base = None if pose is None or _same(pose, now) else step_between(pose, now, _covariance(row))
                    pose = now
                left, right = (self._image(row[side]) for side in ("left", "right"))
            except SettingError as error:
                left = right = None
                refuse(SettingError(f"{self._table}, frame {k}: {error}"))
            yield Moment(max(time_s, then), left, right, gaze, base)

    def _picture(self, name: str) -> Tensor:
        try:
            return read_picture(path_within(self.folder, name))
        except Damaged as error:
            raise SettingError(f"frame = {name}: expected an image within {self.folder} ({error})") from error

    def _image(self, name: str) -> Tensor | None:
        if not name:
            return None
        image, (width, height) = self._picture(name), self.calibration.size_px
        size = (image.shape[-1], image.shape[-2])
        require(size == (width, height), f"size of {name}", size, f"{(width, height)}, the calibration's")
        return image


def _number(row: Mapping[str, str | None], name: str, default: float | None = 0.0) -> float:
    cell = row.get(name)
    if not cell and default is not None:
        return default
    try:
        value = float(cell or "")
    except ValueError:
        value = math.nan
    require(math.isfinite(value), name, cell, "a finite number")
    return value


def _pose(row: Mapping[str, str | None]) -> Pose:
    place = torch.tensor([_number(row, name) for name in _PLACE], dtype=torch.float64)
    if row.get("qw"):
        quaternion = [_number(row, name) for name in _TURN]
    else:
        half = _number(row, _YAW) / 2
        quaternion = [math.cos(half), 0.0, 0.0, math.sin(half)]
    return Pose(matrix_from_quaternion(torch.tensor(quaternion, dtype=torch.float64)), place)


def _same(before: Pose, after: Pose) -> bool:
    return all(map(torch.equal, before, after))


def _covariance(row: Mapping[str, str | None]) -> Tensor:
    covariance = torch.zeros(6, 6, dtype=torch.float64)
    for (i, j), name in zip(_PAIRS, _COVARIANCE, strict=True):
        covariance[i, j] = covariance[j, i] = _number(row, name)
    return covariance
