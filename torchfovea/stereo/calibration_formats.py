"""What calibration files of five kinds say, each read into the same terms; which kind a file is its content tells.

Middlebury's calib.txt; KITTI's calib.txt (P0, P1, ...) and calib_cam_to_cam.txt; OpenCV's stereo YAML, XML or JSON
(FileStorage); ROS's camera_info YAML of both cameras; Kalibr's camchain YAML.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchfovea.sensing.camera import Camera
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.setting import SettingError, require
from torchfovea.stereo.calibration_content import read_content

__all__ = ["LENSES", "Described", "Options", "Told", "described"]

LENSES = ("brown_conrady", "kannala_brandt")
# what formats call them
BROWN = ("brown_conrady", "plumb_bob", "rational_polynomial", "radtan", "none")
KANNALA = ("kannala_brandt", "equidistant", "fisheye")

# OpenCV's matrices have names of the writer's own; these are usual
MATRIX = ("M", "K", "cameraMatrix", "camera_matrix", "intrinsics")
COEFFICIENTS = ("D", "distCoeffs", "dist_coeffs", "distortion_coefficients", "dist")
PROJECTION = r"P\d|P_rect_\d\d"  # KITTI's names
SIDES = (("1", "2"), ("_1", "_2"), ("_left", "_right"), ("Left", "Right"), ("L", "R"), ("_l", "_r"), ("0", "1"))


class Options(NamedTuple):
    """What only the user may know.

    Attributes:
        cameras: which two of a file with several took the left and the right image.
        lens: the model of an OpenCV file's coefficients, which it does not tell; null: as it tells, or brown_conrady.
        unit_m: metres per unit of the file's lengths; None: the format's own (Middlebury: 0.001; else 1).
    """

    cameras: tuple[int, int] | None = None
    lens: str | None = None
    unit_m: float | None = None


class Described(NamedTuple):
    """Two cameras of one kind of images.

    Attributes:
        left: in image pixels.
        right: in image pixels.
        rotation: (3, 3), X_left = rotation · X_right + shift.
        shift_m: (3,).
        size_px: width and height; None: not told.
    """

    left: Camera
    right: Camera
    rotation: np.ndarray
    shift_m: np.ndarray
    size_px: tuple[int, int] | None


class Told(NamedTuple):
    """What files say of the raw images, and of rectified ones; at least one of them."""

    raw: Described | None
    rectified: Described | None


def described(paths: Sequence[Path], options: Options) -> Told:
    """Read one file, or two that belong together.

    Raises:
        SettingError: for what is no calibration, or lacks something, which it names.
    """
    where = " and ".join(str(path) for path in paths)
    try:
        contents = [read_content(path) for path in paths]
        first, whole = contents[0], {k: v for content in reversed(contents) for k, v in content.items()}
        if "cam0" in first and not isinstance(first["cam0"], Mapping):
            return _middlebury(whole, options)
        if any(re.fullmatch(PROJECTION, str(name)) and isinstance(whole[name], str) for name in whole):
            return _kitti(whole, options)
        if "cam0" in first:
            return _kalibr(whole, options)
        if any(isinstance(value, np.ndarray) for value in whole.values()):
            return _opencv(contents, whole, options)
        if {"camera_matrix", "K", "k"} & set(first):
            require(len(contents) == 2, "calibration_right", None, "the right camera's camera_info, beside the left's")
            return _ros(first, contents[1], options)
    except KeyError as error:
        raise SettingError(f"calibration = {where}: expected {error.args[0]}, which it lacks") from error
    except (ValueError, TypeError, IndexError, AttributeError) as error:
        if isinstance(error, SettingError):
            raise SettingError(str(error) if where in str(error) else f"calibration = {where}: {error}") from error
        raise SettingError(f"calibration = {where}: expected numbers of a calibration ({error})") from error
    names = [name[:20] for name in map(str, whole) if name.isascii() and name.isprintable()]
    raise SettingError(
        f"calibration = {where}: expected Middlebury's or KITTI's calib.txt, OpenCV's YAML or XML, ROS's camera_info "
        f"or Kalibr's camchain; it has {', '.join(names[:6]) or 'none of their names'}"
    )


# ----------------------------------------------------------------------------------------------------- the five kinds


def _middlebury(content: Mapping[str, Any], options: Options) -> Told:
    left = _numbers(content["cam0"], 9).reshape(3, 3)
    right = left.copy()
    if "cam1" in content:
        right = _numbers(content["cam1"], 9).reshape(3, 3)
    shift = right[0, 2] - left[0, 2]
    if "doffs" in content:
        doffs = float(_numbers(content["doffs"], 1)[0])
        right[0, 2] = left[0, 2] + doffs
        agreed = "cam1" not in content or abs(shift - doffs) < 0.1
        require(agreed, "calibration's doffs", doffs, f"cx of cam1 less cx of cam0, {shift:g}")
    elif "cam1" not in content:
        raise KeyError("cam1 or doffs")
    unit = 0.001 if options.unit_m is None else options.unit_m
    across = np.array([float(_numbers(content["baseline"], 1)[0]) * unit, 0.0, 0.0])
    size = None
    if "width" in content and "height" in content:
        size = _size(content["width"], content["height"])
    return Told(None, Described(_lens(left), _lens(right), np.eye(3), across, size))


def _kitti(content: Mapping[str, Any], options: Options) -> Told:
    unit = options.unit_m or 1.0
    if not any(name.startswith("P_rect_") for name in content):
        here = sorted(int(name[1:]) for name in content if name[:1] == "P" and name[1:].isdigit())
        left, right = (_numbers(content[f"P{i}"], 12).reshape(3, 4) for i in _chosen(here, options))
        return Told(None, _parallel(left, right, unit, None))
    here = sorted(int(name[7:]) for name in content if name.startswith("P_rect_"))
    names = [f"{i:02d}" for i in _chosen(here, options)]
    projections = [_numbers(content[f"P_rect_{n}"], 12).reshape(3, 4) for n in names]
    size = _size(*_numbers(content[f"S_rect_{names[0]}"], 2)) if f"S_rect_{names[0]}" in content else None
    rectified = _parallel(projections[0], projections[1], unit, size)
    if not all(f"{k}_{n}" in content for k in "KDRT" for n in names):
        return Told(None, rectified)
    cameras = [_lens(_numbers(content[f"K_{n}"], 9).reshape(3, 3), _numbers(content[f"D_{n}"])) for n in names]
    poses = [(_numbers(content[f"R_{n}"], 9).reshape(3, 3), _numbers(content[f"T_{n}"], 3)) for n in names]
    (R_left, t_left), (R_right, t_right) = poses  # X_i = R_i X_0 + t_i
    rotation = R_left @ R_right.T
    size = _size(*_numbers(content[f"S_{names[0]}"], 2)) if f"S_{names[0]}" in content else None
    raw = Described(cameras[0], cameras[1], rotation, (t_left - rotation @ t_right) * unit, size)
    return Told(raw, rectified)


def _kalibr(content: Mapping[str, Any], options: Options) -> Told:
    here = sorted(int(name[3:]) for name in content if name[:3] == "cam" and name[3:].isdigit())
    first, second = _chosen(here, options)
    cameras = []
    for i in (first, second):
        entry = content[f"cam{i}"]
        pinhole = entry["camera_model"] == "pinhole"
        require(pinhole, f"calibration's cam{i}.camera_model", entry["camera_model"], "pinhole")
        fx, fy, cx, cy = _numbers(entry["intrinsics"], 4)
        model = str(entry["distortion_model"])
        bent = () if model == "none" else _numbers(entry["distortion_coeffs"], 4)
        cameras.append(_lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), bent, model))
    if all("T_cam_imu" in content[f"cam{i}"] for i in (first, second)):
        left, right = (_numbers(content[f"cam{i}"]["T_cam_imu"], 16).reshape(4, 4) for i in (first, second))
        chain = left @ np.linalg.inv(right)
    else:
        chain = np.eye(4)  # from camera `first` to `second`
        for i in range(min(first, second) + 1, max(first, second) + 1):
            chain = _numbers(content[f"cam{i}"]["T_cn_cnm1"], 16).reshape(4, 4) @ chain
        chain = np.linalg.inv(chain) if first < second else chain
    resolution = content[f"cam{first}"].get("resolution")
    size = None if resolution is None else _size(*_numbers(resolution, 2))
    shift = chain[:3, 3] * (options.unit_m or 1.0)
    return Told(Described(cameras[0], cameras[1], chain[:3, :3], shift, size), None)


def _opencv(contents: Sequence[Mapping[str, Any]], whole: Mapping[str, Any], options: Options) -> Told:
    model = options.lens or str(whole.get("distortion_model", whole.get("model", "brown_conrady")))
    if float(np.asarray(whole.get("fisheye_model", 0))) and options.lens is None:
        model = "kannala_brandt"
    if len(contents) == 2 and all("camera_matrix" in content for content in contents):  # one camera a file
        pairs = [(content["camera_matrix"], content.get("distortion_coefficients", [])) for content in contents]
    else:
        pairs = _both_sides(whole)
    cameras = [_lens(_numbers(k, 9).reshape(3, 3), d, model) for k, d in pairs]
    if "R" not in whole or not {"T", "t"} & set(whole):
        raise KeyError("R and T, from the left camera to the right one")
    unit = options.unit_m or 1.0
    turn = _numbers(whole["R"])
    if turn.size == 3:  # a rotation vector
        import cv2

        turn = cv2.Rodrigues(turn)[0]
    rotation = _numbers(turn, 9).reshape(3, 3).T  # OpenCV's takes left to right
    shift = -rotation @ _numbers(whole["T"] if "T" in whole else whole["t"], 3)
    size = None
    for names in (("image_width", "image_height"), ("width", "height")):
        if all(name in whole for name in names):
            size = _size(*(whole[name] for name in names))
    for name in ("image_size", "imageSize", "size"):
        size = _size(*_numbers(whole[name], 2)) if size is None and name in whole else size
    raw = Described(cameras[0], cameras[1], rotation, shift * unit, size)
    if not {"P1", "P2"} <= set(whole):
        return Told(raw, None)
    left, right = (_numbers(whole[name], 12).reshape(3, 4) for name in ("P1", "P2"))
    return Told(raw, _parallel(left, right, unit, size))


def _both_sides(whole: Mapping[str, Any]) -> list[tuple[Any, Any]]:
    """The left and the right camera's matrix and coefficients, by whichever names there are."""
    for sides in SIDES:
        for name in MATRIX:
            matrices = [whole.get(name + side) for side in sides]
            if all(isinstance(m, np.ndarray) and m.size == 9 for m in matrices):
                told = [[whole.get(other + side) for side in sides] for other in COEFFICIENTS]
                bent = next((pair for pair in told if all(k is not None for k in pair)), [(), ()])
                return list(zip(matrices, bent, strict=True))
    raise KeyError("both camera matrices (M1 and M2, with D1 and D2)")


def _ros(left: Mapping[str, Any], right: Mapping[str, Any], options: Options) -> Told:
    cameras, turns, projections = [], [], []
    for content in (left, right):
        matrix = _numbers(_entry(content, "camera_matrix", "K"), 9).reshape(3, 3)
        coefficients = _numbers(_entry(content, "distortion_coefficients", "D"))
        cameras.append(_lens(matrix, coefficients, str(content.get("distortion_model") or "plumb_bob")))
        turns.append(_numbers(_entry(content, "rectification_matrix", "R"), 9).reshape(3, 3))
        projections.append(_numbers(_entry(content, "projection_matrix", "P"), 12).reshape(3, 4))
    names = next((n for n in (("image_width", "image_height"), ("width", "height")) if n[0] in left), None)
    size = None if names is None else _size(left[names[0]], left[names[1]])
    parallel = _parallel(projections[0], projections[1], options.unit_m or 1.0, size)
    # both cameras' rectified frames are parallel: X_rectified = R X
    raw = Described(cameras[0], cameras[1], turns[0].T @ turns[1], turns[0].T @ parallel.shift_m, size)
    return Told(raw, parallel)


def _entry(content: Mapping[str, Any], name: str, letter: str) -> Any:
    """A matrix of a calibration file, or of a message printed: ``camera_matrix: {data: ...}``, ``K`` or ``k``."""
    for key in (name, letter, letter.lower()):
        if key in content:
            value = content[key]
            return value["data"] if isinstance(value, Mapping) else value
    raise KeyError(f"{name} ({letter})")


# ------------------------------------------------------------------------------------------------------------- parts


def _chosen(here: list[int], options: Options) -> tuple[int, int]:
    """The indices of the left and the right camera."""
    if options.cameras is None:
        require(len(here) >= 2, "calibration's cameras", here, "at least two")
        require(len(here) == 2, "calibration_cameras", None, f"which two of {here} took the left and the right image")
        return here[0], here[1]
    good = set(options.cameras) <= set(here) and options.cameras[0] != options.cameras[1]
    require(good, "calibration_cameras", list(options.cameras), f"two of {here}")
    return options.cameras


def _parallel(left: np.ndarray, right: np.ndarray, unit: float, size: tuple[int, int] | None) -> Described:
    """Rectified cameras by their projection matrices, in which X = K (X_rectified − centre)."""
    centres = [-np.linalg.solve(p[:, :3], p[:, 3]) for p in (left, right)]
    if not np.any(left[:, 3] - right[:, 3]):
        raise KeyError("a baseline (P of the right camera, fourth column)")
    return Described(_lens(left[:, :3]), _lens(right[:, :3]), np.eye(3), (centres[1] - centres[0]) * unit, size)


def _lens(matrix: np.ndarray, coefficients: Any = (), model: str = "brown_conrady") -> Camera:
    """A camera by its matrix; coefficients that are 0 are none."""
    require(model in BROWN + KANNALA, "calibration's distortion_model", model, ", ".join(BROWN + KANNALA))
    values = tuple(float(k) for k in np.asarray(coefficients, dtype=float).reshape(-1))
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    skew = abs(float(matrix[0, 1])) < 1e-6 * abs(fx)
    require(skew, "calibration's skew", float(matrix[0, 1]), "0: columns and rows at right angles")
    if model in KANNALA:
        return KannalaBrandt(fx, fy, cx, cy, (*values, 0.0, 0.0, 0.0, 0.0)[:4])
    while values and values[-1] == 0:
        values = values[:-1]
    least = next((n for n in (0, 4, 5, 8) if n >= len(values)), len(values))
    return BrownConrady(fx, fy, cx, cy, (*values, *[0.0] * (least - len(values))))


def _numbers(value: Any, count: int | None = None) -> np.ndarray:
    """Finite numbers from text, lists or arrays, so many of them."""
    if isinstance(value, str):
        value = value.replace("[", " ").replace("]", " ").replace(";", " ").replace(",", " ").split()
    numbers = np.asarray(value, dtype=float).reshape(-1)
    if count is not None and numbers.size != count:
        raise ValueError(f"{numbers.size} numbers for {count}")
    if not np.isfinite(numbers).all():
        raise ValueError("not all are finite")
    return numbers


def _size(width: Any, height: Any) -> tuple[int, int]:
    pair = (float(_numbers(width, 1)[0]), float(_numbers(height, 1)[0]))
    if any(n < 1 or not math.isclose(n, round(n)) for n in pair):
        raise ValueError(f"an image of {pair[0]:g}x{pair[1]:g} pixels")
    return round(pair[0]), round(pair[1])
