"""A recording: what two cameras saw and what the encoders told, frame by frame, with the calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfovea.files import write_json
from torchfovea.memory.moving import Motion
from torchfovea.sensing.camera import Camera, Fisheye, Pinhole
from torchfovea.sensing.head import Gaze, Head
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.setting import SettingError, require

__all__ = ["Calibration", "Moment", "Recording", "Refuse", "gaze_from_angles", "read_calibration", "write_calibration"]

_CAMERAS: dict[str, Any] = {kind.__name__: kind for kind in (Pinhole, Fisheye, BrownConrady, KannalaBrandt)}

Refuse = Callable[[SettingError], None]
"""What is done with a frame that cannot be used: raising the error, or noting it to go on."""


class Moment(NamedTuple):
    """What was seen and told at one moment of a recording.

    Attributes:
        time_s: of the images, on any clock that does not run backward.
        left: the left eye's image, (3, H, W) in [0, 1]; None: it did not arrive.
        right: the right eye's.
        gaze: as the encoders told, scalars, float64.
        base: how the base moved since the frame before, as odometry told; None: there is no odometry.
    """

    time_s: float
    left: Tensor | None
    right: Tensor | None
    gaze: Gaze
    base: Motion | None = None


class Calibration(NamedTuple):
    """What stays the same over a recording.

    Attributes:
        left: the left eye's camera, in image pixels whose centres are integers.
        right: the right eye's.
        size_px: width and height of the images.
        head: of the robot; None: the recording does not tell.
        rendered: whether the images come from a simulator, without noise, so that another error budget suits them.
    """

    left: Camera
    right: Camera
    size_px: tuple[int, int]
    head: Head | None = None
    rendered: bool = False


class Recording(Protocol):
    """Where frames come from: `torchfovea.recordings.folder.Folder`, `torchfovea.recordings.bag.Bag`, or any other."""

    @property
    def calibration(self) -> Calibration:
        """Of all frames."""
        ...

    def __len__(self) -> int:
        """How many frames there are."""
        ...

    def frames(self, refuse: Refuse) -> Iterator[Moment]:
        """The frames in order.

        Args:
            refuse: called for each frame that cannot be used, with the error that says why. If it returns, the frame
                comes without images.
        """
        ...


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as JSON.

    Args:
        path: the file.
        calibration: whose head is a `Head`, or None.
    """
    head = None if calibration.head is None else asdict(calibration.head)
    cameras = {name: _told(getattr(calibration, name)) for name in ("left", "right")}
    write_json(path, {"size_px": list(calibration.size_px), **cameras, "head": head, "rendered": calibration.rendered})


def read_calibration(path: Path) -> Calibration:
    """Read what `write_calibration` wrote, or what was written by hand.

    Raises:
        SettingError: for a file that is missing, or what is missing in it or is no camera or head; it names the file.
    """
    require(path.is_file(), "recording", path, "a recording's calibration.json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        width, height = (int(side) for side in content["size_px"])
        left, right = (_camera(content[name]) for name in ("left", "right"))
        head = None if content.get("head") is None else _head(content["head"])
    except SettingError as error:
        raise SettingError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise SettingError(f"{path} = {what}: expected size_px, left, right and head (docs/recordings.md)") from None
    require(width > 1 and height > 1, f"{path}: size_px", [width, height], "width and height of the images")
    rendered = content.get("rendered", False)
    require(isinstance(rendered, bool), f"{path}: rendered", rendered, "true or false")
    return Calibration(left, right, (width, height), head, rendered)


def _told(camera: Camera) -> dict[str, Any]:
    kind = type(camera).__name__
    require(kind in _CAMERAS and is_dataclass(camera), "calibration", kind, "one of " + ", ".join(_CAMERAS))
    assert is_dataclass(camera)
    return {"model": kind, **asdict(camera)}


def _camera(told: dict[str, Any]) -> Camera:
    model = told["model"]
    require(model in _CAMERAS, "model", model, "one of " + ", ".join(_CAMERAS))
    numbers = {name: tuple(value) if isinstance(value, list) else value for name, value in told.items()}
    del numbers["model"]
    camera: Camera = _CAMERAS[model](**numbers)
    return camera


def _head(told: dict[str, Any]) -> Head:
    known = [field.name for field in fields(Head)]
    for name, value in told.items():
        require(name in known, f"head.{name}", value, "one of " + ", ".join(known))
        good = isinstance(value, int | float) and math.isfinite(value)
        require(good, f"head.{name}", value, "a number")
    return Head(**told)


def gaze_from_angles(pan: float, tilt: float, vergence: float) -> Gaze:
    """Angles [rad] as a gaze."""
    return Gaze(*(torch.tensor(angle, dtype=torch.float64) for angle in (pan, tilt, vergence)))
