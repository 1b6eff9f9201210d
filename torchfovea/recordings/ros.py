"""ROS 2 messages as frames, and a memory as a message: by their fields alone, so that no ROS is needed.

A message is anything with the fields that ROS documents: rclpy's own, or rosbags' out of a file. Angles are in radians,
lengths in metres and stamps in seconds, as everywhere in ROS (REP 103).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.cloud import Cloud
from torchfovea.memory.moving import Motion
from torchfovea.recordings.frames import gaze_from_angles
from torchfovea.recordings.pictures import image_from_pixels
from torchfovea.recordings.poses import Pose, matrix_from_quaternion, step_between
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze
from torchfovea.setting import SettingError, require
from torchfovea.untrusted import Damaged, unpack_pixels

__all__ = [
    "CloudData", "camera_from_info", "cloud_data", "gaze_from_joints", "image_from_message", "motion_from_odometry",
    "pose_from_odometry", "positions_from_gaze", "stamp_s",
]  # fmt: skip

# by ROS's name: bytes a value, channels kept, and whether they come as blue, green, red
_ENCODINGS = {
    "mono8": (1, 1, False),
    "mono16": (2, 1, False),
    "rgb8": (1, 3, False),
    "bgr8": (1, 3, True),
    "rgb16": (2, 3, False),
    "bgr16": (2, 3, True),
    "rgba8": (1, 4, False),
    "bgra8": (1, 4, True),
}
_JOINTS = ("pan", "tilt", "vergence")


def stamp_s(message: Any) -> float:
    """A message's time [s]."""
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def image_from_message(message: Any) -> Tensor:
    """A sensor_msgs/Image, or a CompressedImage (PNG, JPEG), as (3, H, W) in [0, 1].

    Raises:
        SettingError: for an encoding that is not known, or bytes that are no such image.
    """
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not hasattr(message, "encoding"):
        return _decompressed(data)
    known = ", ".join(_ENCODINGS)
    require(message.encoding in _ENCODINGS, "image encoding", message.encoding, f"one of {known}")
    size, channels, reversed_ = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    fits = len(data) == height * step and step >= width * channels * size
    require(fits, "image", f"{len(data)} bytes", f"{height} rows of {step}")
    rows = data.reshape(height, step)[:, : width * channels * size]
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    pixels = np.ascontiguousarray(rows).view(f"{order}u{size}").reshape(height, width, channels)[..., :3]
    pixels = pixels[..., ::-1] if reversed_ else pixels
    image: Tensor = torch.from_numpy(pixels.astype(np.int32)).movedim(-1, 0).float() / (256**size - 1)
    return image if channels > 1 else image.expand(3, -1, -1)


def _decompressed(data: np.ndarray) -> Tensor:
    try:
        return image_from_pixels(unpack_pixels(data.tobytes(), ("COLOR", "ANYDEPTH")))
    except Damaged as error:
        raise SettingError(
            f"image = {len(data)} bytes: expected a compressed image that OpenCV can read ({error})"
        ) from error


def camera_from_info(message: Any) -> tuple[Pinhole, tuple[int, int]]:
    """A sensor_msgs/CameraInfo as the camera of its rectified images, by P, and their width and height.

    Raises:
        SettingError: for one without a focal length.
    """
    p = np.asarray(message.p if hasattr(message, "p") else message.P, dtype=np.float64).reshape(3, 4)
    require(p[0, 0] > 0 and abs(p[0, 0] - p[1, 1]) < 1e-6 * p[0, 0], "camera_info.p", p.tolist(), "one focal length")
    return Pinhole(float(p[0, 0]), float(p[0, 2]), float(p[1, 2])), (int(message.width), int(message.height))


def gaze_from_joints(message: Any, joints: Mapping[str, str]) -> Gaze:
    """A sensor_msgs/JointState as a gaze.

    Args:
        message: with `name` and `position`.
        joints: the joints' names, by `pan`, `tilt` and `vergence`; what is not in it stays at 0.

    Raises:
        SettingError: for a joint that is not in the message, or has no finite position.
    """
    positions = {name: float(angle) for name, angle in zip(message.name, message.position, strict=False)}
    for ours, name in joints.items():
        require(ours in _JOINTS, "joints", ours, "pan, tilt and vergence")
        require(name in positions, f"joint {name}", "missing", "one of " + ", ".join(message.name))
        require(math.isfinite(positions[name]), f"joint {name}", positions[name], "a finite angle")
    return gaze_from_angles(*(positions[joints[name]] if name in joints else 0.0 for name in _JOINTS))


def positions_from_gaze(gaze: Gaze, joints: Mapping[str, str]) -> tuple[list[str], list[float]]:
    """A gaze as a JointState's (or a trajectory point's) names and positions."""
    angles = dict(zip(_JOINTS, (float(angle) for angle in gaze), strict=True))
    return list(joints.values()), [angles[name] for name in joints]


def pose_from_odometry(message: Any) -> tuple[Pose, Tensor]:
    """A nav_msgs/Odometry as a pose and its covariance (6, 6): translation first, in the odometry's frame, as ROS."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    quaternion = torch.tensor([turn.w, turn.x, turn.y, turn.z], dtype=torch.float64)
    translation = torch.tensor([place.x, place.y, place.z], dtype=torch.float64)
    require(bool(torch.isfinite(translation).all()), "odometry", translation.tolist(), "a finite place")
    covariance = torch.as_tensor(np.array(message.pose.covariance, dtype=np.float64)).reshape(6, 6)
    return Pose(matrix_from_quaternion(quaternion), translation), covariance


def motion_from_odometry(before: Any, after: Any) -> Motion:
    """The step between two nav_msgs/Odometry with what its covariance grew by on the way.

    An error in the heading turns what is travelled afterwards; with F for that, the step has C₂ − F C₁ Fᵀ, of which
    what is negative is left out: odometry whose covariance does not grow is taken as exact.
    """
    (pose, first), (then, second) = (pose_from_odometry(message) for message in (before, after))
    x, y, z = (then.translation - pose.translation).tolist()
    carry = torch.eye(6, dtype=torch.float64)
    carry[:3, 3:] = torch.tensor([[0, z, -y], [-z, 0, x], [y, -x, 0]], dtype=torch.float64)
    grown = second - carry @ first @ carry.mT
    values, vectors = torch.linalg.eigh((grown + grown.mT) / 2)
    grown = vectors @ torch.diag(values.clamp(min=0)) @ vectors.mT
    turn = torch.zeros(6, 6, dtype=torch.float64)  # to rotation first, in the new frame
    turn[:3, 3:] = turn[3:, :3] = then.rotation.mT
    return step_between(pose, then, turn @ grown @ turn.mT)


class CloudData(NamedTuple):
    """What a sensor_msgs/PointCloud2 holds besides its header.

    Attributes:
        fields: name and offset [bytes] of each, all FLOAT32 (datatype 7, count 1).
        point_step: bytes a point.
        width: points; the height is 1.
        data: bytes, little-endian.
    """

    fields: Sequence[tuple[str, int]]
    point_step: int
    width: int
    data: bytes


def cloud_data(cloud: Cloud) -> CloudData:
    """A cloud as PointCloud2: x, y, z [m], rgb, cov_xx … cov_zz [m²], inlier."""
    names = [*"xyz", "rgb", *(f"cov_{c}" for c in ("xx", "xy", "xz", "yy", "yz", "zz")), "inlier"]
    mean, cov, colour, inlier, _ = (part.detach().cpu().double().numpy() for part in cloud)
    red, green, blue = (colour.clip(0, 1) * 255).round().astype(np.uint32).T
    packed = (red << 16 | green << 8 | blue).view(np.float32)  # as RViz reads it: a whole number in a float's bits
    table = np.empty((len(mean), len(names)), "<f4")
    table[:, :3], table[:, 3], table[:, 4:10], table[:, 10] = mean, packed, cov, inlier
    return CloudData([(name, 4 * k) for k, name in enumerate(names)], 4 * len(names), len(mean), table.tobytes())
