"""Rectified stereo pairs: a user's own files, a folder of a benchmark, and one that comes with a package."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.images import read_image
from torchfovea.commands.shared.settings import choice
from torchfovea.sensing.camera import Pinhole
from torchfovea.setting import SettingError, require
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.stereo.views import Views, rectified_views

__all__ = ["Pair", "gaze_of", "load_folder", "load_pair", "motorcycle", "named_pair"]

SUFFIXES = (".npy", ".npz", ".pfm", ".png")


class Pair(NamedTuple):
    """A rectified stereo pair.

    Attributes:
        left: (3, H, W) in [0, 1].
        right: the same size.
        camera_left: in image pixels.
        camera_right: in image pixels.
        baseline_m: between the cameras.
        disparity: the truth, (H, W), not finite where unknown; or None.
    """

    left: Tensor
    right: Tensor
    camera_left: Pinhole
    camera_right: Pinhole
    baseline_m: float
    disparity: Tensor | None

    def views(self, gaze_px: tuple[float, float] | None) -> Views:
        """What a matcher is given of it, with retinas that look at a pixel (column, row), or at the middle."""
        return rectified_views(*self[:5], gaze_px)

    def depth_m(self, disparity: Tensor) -> Tensor:
        """Depth of disparities along the view's axis [m]."""
        doffs = self.camera_right.cx_px - self.camera_left.cx_px
        return self.camera_left.focal_px * self.baseline_m / (disparity + doffs)


def load_pair(cfg: DictConfig) -> Pair:
    """The pair that a configuration names.

    Raises:
        SettingError: for a missing file or calibration, numbers that no camera has, or images of different sizes.
    """
    if cfg.pair is not None:
        choice(cfg, "pair", ("motorcycle",))
        return motorcycle()
    for name in ("left", "right"):
        if cfg[name] is None:
            raise SettingError(f"{name} = null: expected an image file (or pair=motorcycle)")
    left, right = (read_image(_file(cfg, name), name) for name in ("left", "right"))
    _alike(left, right, "right")
    height, width = left.shape[-2:]
    for name in ("focal_px", "cx_px", "cy_px", "baseline_m"):
        if cfg[name] is None:
            raise SettingError(
                f"{name} = null: expected the calibration of the left camera, in image pixels and metres"
            )
    focal = _within(cfg, "focal_px", 1.0, 1e6, "a positive number of pixels, 1 to 1e6")
    baseline = _within(cfg, "baseline_m", 1e-6, 1e4, "a positive number of metres, 1e-6 to 1e4")
    reach = 100.0 * max(width, height)
    near = f"a number of pixels within 100 images, {-reach:g} to {reach:g}"
    cx, cy, doffs = (_within(cfg, name, -reach, reach, near) for name in ("cx_px", "cy_px", "doffs_px"))
    truth = None if cfg.disparity is None else load_disparity(_file(cfg, "disparity"), "disparity")[0]
    _fits(truth, left, "disparity")
    return Pair(left, right, Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), baseline, truth)


def named_pair(name: Any, where: str) -> Pair:
    """One of a list of pairs: ``motorcycle``, or a folder (`load_folder`)."""
    require(isinstance(name, str), where, name, "motorcycle, or a folder")
    return motorcycle() if name == "motorcycle" else load_folder(Path(name), where)


def load_folder(folder: Path, where: str) -> Pair:
    """A pair as Middlebury's benchmark has them, with its truth.

    Args:
        folder: with left.png, right.png, disparity (.npy, .npz, .pfm or .png) and calib.txt: lines ``name=value`` with
            cam0 as [f 0 cx; 0 f cy; 0 0 1], doffs [px] and baseline [mm].
        where: the setting's name, for errors.

    Raises:
        SettingError: for what is missing or does not fit.
    """
    require(folder.is_dir(), where, folder, "motorcycle, or a folder with left.png, right.png, calib.txt and disparity")
    left, right = (read_image(folder / f"{name}.png", f"{where}: {name}") for name in ("left", "right"))
    _alike(left, right, f"{where}: right")
    found = [folder / f"disparity{suffix}" for suffix in SUFFIXES if (folder / f"disparity{suffix}").is_file()]
    require(len(found) == 1, f"{where}: {folder}/disparity", len(found), "one file (.npy, .npz, .pfm or .png)")
    truth = load_disparity(found[0], f"{where}: disparity")[0]
    _fits(truth, left, f"{where}: disparity")
    calibration = folder / "calib.txt"
    require(calibration.is_file(), f"{where}: calib.txt", calibration, "an existing file")
    text = calibration.read_text(encoding="utf-8", errors="replace")
    numbers = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    try:
        focal, _, cx, _, _, cy, *_ = (float(v) for v in numbers["cam0"].strip(" []").replace(";", " ").split())
        doffs, baseline = float(numbers["doffs"]), float(numbers["baseline"]) / 1000
    except (KeyError, ValueError) as error:
        raise SettingError(f"{where}: {calibration}: expected cam0, doffs and baseline as numbers ({error})") from error
    good = all(map(math.isfinite, (focal, cx, cy, doffs, baseline))) and min(focal, baseline) > 0
    require(good, f"{where}: {calibration}", (focal, cx, cy, doffs, baseline), "positive, finite numbers")
    return Pair(left, right, Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), baseline, truth)


def motorcycle() -> Pair:
    """Middlebury 2014's motorcycle at a quarter of its size, as scikit-image ships it."""
    try:
        from skimage.data import stereo_motorcycle
    except ModuleNotFoundError as error:
        raise SettingError("pair = motorcycle: expected scikit-image (pip install torchfovea[samples])") from error
    left, right, disparity = stereo_motorcycle()
    left, right = (torch.from_numpy(np.ascontiguousarray(i)).movedim(-1, 0).float() / 255 for i in (left, right))
    focal, cx, cy, doffs = 994.978, 311.193, 254.877, 31.086
    truth = torch.from_numpy(np.array(disparity, dtype=np.float32))
    return Pair(left, right, Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), 0.193001, truth)


def gaze_of(cfg: DictConfig, pair: Pair) -> tuple[float, float] | None:
    """Where the retinas look, (column, row); None for the images' middle.

    Raises:
        SettingError: for anything but a pixel of the images.
    """
    given = cfg.gaze_px
    if given is None:
        return None
    height, width = pair.left.shape[-2:]
    expected = f"[column, row], a pixel of the {width}x{height} images"
    two = OmegaConf.is_list(given) and len(given) == 2 and all(_number(v) for v in given)
    require(two, "gaze_px", given, expected)
    column, row = (float(v) for v in given)
    require(0 <= column <= width - 1 and 0 <= row <= height - 1, "gaze_px", given, expected)
    return column, row


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _within(cfg: DictConfig, name: str, least: float, most: float, expected: str) -> float:
    value = cfg[name]
    require(_number(value), name, value, f"a number: {expected}")
    require(least <= value <= most, name, value, expected)
    return float(value)


def _file(cfg: DictConfig, name: str) -> Path:
    require(isinstance(cfg[name], str), name, cfg[name], "a file's name")
    return Path(cfg[name])


def _alike(left: Tensor, right: Tensor, where: str) -> None:
    size, other = (f"{image.shape[-1]}x{image.shape[-2]} px" for image in (left, right))
    require(left.shape == right.shape, where, other, f"the left image's {size}")


def _fits(truth: Tensor | None, image: Tensor, where: str) -> None:
    if truth is not None:
        size = tuple(image.shape[-2:])
        require(truth.shape == image.shape[-2:], where, tuple(truth.shape), f"the images' {size}")
