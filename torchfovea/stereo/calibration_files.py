"""A stereo calibration from the file that its program wrote, checked against the images that it is for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.lens import BrownConrady
from torchfovea.setting import require
from torchfovea.stereo.calibration_formats import Described, Options, described
from torchfovea.stereo.rig import StereoRig, posed

__all__ = ["Options", "StereoCalibration", "load_calibration"]

KINDS = ("auto", "raw", "rectified")
BASELINES_M = (0.001, 10.0)  # beyond these a file of another unit is more likely


class StereoCalibration(NamedTuple):
    """Two cameras and how they stand.

    Attributes:
        left: in image pixels.
        right: in image pixels.
        rig: how they stand.
        rectified: whether these are pinholes side by side, which differ in cx alone.
    """

    left: Camera
    right: Camera
    rig: StereoRig
    rectified: bool


def load_calibration(
    paths: Sequence[str | Path],
    size_px: tuple[int, int],
    images: str = "auto",
    options: Options | None = None,
) -> StereoCalibration:
    """Read a calibration: one file, or two (ROS's left and right, OpenCV's intrinsics and extrinsics).

    Args:
        paths: the files.
        size_px: width and height of the images that it is for.
        images: ``raw`` or ``rectified``: what the images are, where files describe both; ``auto``: raw, unless only the
            rectified ones have this size.
        options: what the files do not tell.

    Raises:
        SettingError: for what is no calibration, lacks something, is of another image size, and cameras that do not
            stand beside each other, the right one to the right.
    """
    require(images in KINDS, "calibration_images", images, ", ".join(KINDS))
    where = " and ".join(str(path) for path in paths)
    told = described([Path(path) for path in paths], options or Options())
    kinds = {"raw": told.raw, "rectified": told.rectified}
    if images == "auto":
        there = {name: kind for name, kind in kinds.items() if kind is not None}
        fitting = [name for name, kind in there.items() if kind.size_px in (None, size_px)]
        images = fitting[0] if fitting else next(iter(there))
    kind = kinds[images]
    require(kind is not None, "calibration_images", images, f"the other; {where} does not tell of {images} images")
    assert kind is not None
    _check_size(kind, size_px, where)
    return _standing(kind, where)


def _check_size(kind: Described, size_px: tuple[int, int], where: str) -> None:
    width, height = size_px
    if kind.size_px is not None:
        told = "x".join(map(str, kind.size_px))
        require(kind.size_px == size_px, f"calibration = {where}: size", told, f"{width}x{height} px, the images' own")
        return
    # a file without a size: the axis of a camera is nearer to its image's middle than to a border
    for name, camera in (("left", kind.left), ("right", kind.right)):
        off = max(abs(camera.cx_px / width - 0.5), abs(camera.cy_px / height - 0.5))
        both = min(abs(camera.cx_px / width - 0.5), abs(camera.cy_px / height - 0.5))
        fits = off < 0.5 and both < 0.2
        at = f"({camera.cx_px:g}, {camera.cy_px:g})"
        expected = f"a place nearer the middle of the {width}x{height} images (a calibration of another image size?)"
        require(fits, f"calibration = {where}: optical axis of the {name} camera", at, expected)


def _standing(kind: Described, where: str) -> StereoCalibration:
    """The cameras as a rig; those that only differ in cx as a rectified pair."""
    R, shift = kind.rotation, kind.shift_m
    unit = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
    require(bool(unit), f"calibration = {where}: R", np.round(R, 4).tolist(), "a rotation")
    u, _, v = np.linalg.svd(R)  # files round
    rotation = u @ v
    baseline = float(np.linalg.norm(shift))
    place = f"({', '.join(f'{c:.4g}' for c in shift)})"
    expected = "it to the right (x > 0): are left and right exchanged?"
    aside = baseline > 0 and shift[0] > 0.5 * baseline
    require(bool(aside), f"calibration = {where}: right camera as the left one sees it", f"{place} m", expected)
    low, high = BASELINES_M
    expected = f"{low:g} to {high:g} m; calibration_unit_m = 0.001 if its lengths are in millimetres"
    require(low <= baseline <= high, f"calibration = {where}: baseline", f"{baseline:g} m", expected)
    left, right = _plain(kind.left), _plain(kind.right)
    still = np.abs(rotation - np.eye(3)).max() < 1e-9 and np.abs(shift[1:]).max() < 1e-6 * baseline
    if isinstance(left, Pinhole) and isinstance(right, Pinhole) and still:
        same = abs(left.focal_px - right.focal_px) < 1e-6 * left.focal_px and abs(left.cy_px - right.cy_px) < 1e-3
        if same:
            eye = torch.eye(3, dtype=torch.float64)
            right = Pinhole(left.focal_px, right.cx_px, left.cy_px)
            return StereoCalibration(left, right, StereoRig(eye, eye, float(shift[0])), True)
    rig = posed(torch.from_numpy(rotation), torch.from_numpy(np.asarray(shift, dtype=float)))
    return StereoCalibration(left, right, rig, False)


def _plain(camera: Camera) -> Camera:
    """A pinhole for a lens that distorts nothing and has one focal length."""
    if isinstance(camera, BrownConrady) and camera.straight:
        if abs(camera.fx_px - camera.fy_px) < 1e-6 * camera.fx_px:
            return Pinhole(camera.fx_px, camera.cx_px, camera.cy_px)
    return camera
