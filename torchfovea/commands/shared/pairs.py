"""Stereo pairs: a user's own files, a folder of a benchmark, and one that comes with a package."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.cameras import BY_HAND, OF_FILES, cameras_of
from torchfovea.commands.shared.images import exposed, read_levels
from torchfovea.commands.shared.settings import choice
from torchfovea.commands.shared.truth import load_truth
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.setting import SettingError, is_number, require
from torchfovea.stereo.calibration_files import StereoCalibration, load_calibration
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.stereo.health import Fault
from torchfovea.stereo.rig import StereoRig
from torchfovea.stereo.views import Views, posed_views, rectified_views

__all__ = ["OWN", "Pair", "check_named", "gaze_of", "load_folder", "load_pair", "motorcycle", "named_pair"]

# what tells of a pair of one's own
OWN = (
    "left", "right", "calibration", "calibration_images", *OF_FILES, *BY_HAND, "doffs_px", "disparity",
    "disparity_unit_px", "disparity_unknown", "mask",
)  # fmt: skip
SUFFIXES = (".npy", ".npz", ".pfm", ".png")


class Pair(NamedTuple):
    """A stereo pair, rectified or raw.

    Attributes:
        left: (3, H, W) in [0, 1].
        right: the same size.
        camera_left: in image pixels.
        camera_right: in image pixels.
        baseline_m: between the cameras.
        disparity: the truth of a rectified pair, (H, W), not finite where unknown; or None.
        rig: how cameras stand whose images are raw; None: the pair is rectified.
        seen: bool (H, W), what both eyes see, by a mask; None: not told.
        faults: what is wrong with the files.
    """

    left: Tensor
    right: Tensor
    camera_left: Camera
    camera_right: Camera
    baseline_m: float
    disparity: Tensor | None
    rig: StereoRig | None = None
    seen: Tensor | None = None
    faults: tuple[Fault, ...] = ()

    def views(self, gaze_px: tuple[float, float] | None, gaze_right_px: tuple[float, float] | None = None) -> Views:
        """What a matcher is given of it, with retinas that look at a pixel (column, row), or at the middle."""
        left, right = self.camera_left, self.camera_right
        if self.rig is not None or gaze_right_px is not None:
            eye = torch.eye(3, dtype=torch.float64)
            rig = StereoRig(eye, eye, self.baseline_m) if self.rig is None else self.rig
            return posed_views(self.left, self.right, left, right, rig, gaze_px, gaze_right_px)
        assert isinstance(left, Pinhole) and isinstance(right, Pinhole)
        return rectified_views(self.left, self.right, left, right, self.baseline_m, gaze_px)

    def depth_m(self, disparity: Tensor) -> Tensor:
        """Depth of a rectified pair's disparities along the view's axis [m]."""
        doffs = self.camera_right.cx_px - self.camera_left.cx_px
        return self.camera_left.focal_px * self.baseline_m / (disparity + doffs)


def load_pair(cfg: DictConfig) -> Pair:
    """The pair that a configuration names, with the faults of its files.

    Raises:
        SettingError: for a missing file or calibration, numbers that no camera has, or images of different sizes.
    """
    if cfg.pair is not None:
        choice(cfg, "pair", ("motorcycle",))
        for name in OWN:
            alone = OmegaConf.select(cfg, name) in (None, "auto", 0)
            require(
                alone, name, OmegaConf.select(cfg, name), "none of your own with pair=motorcycle; pair=null is without"
            )
        return motorcycle()
    for name in ("left", "right"):
        if cfg[name] is None:
            raise SettingError(f"{name} = null: expected an image file (or pair=motorcycle)")
    left, right, faults = _images(Path(cfg.left), Path(cfg.right))
    height, width = left.shape[-2:]
    cameras = cameras_of(cfg, (width, height))
    raw = cfg.disparity is not None and not cameras.rectified
    require(not raw, "disparity", cfg.disparity, "null for raw images: a disparity is that of a rectified pair")
    truth, seen = load_truth(cfg)
    _fits(truth, left, "disparity")
    _fits(seen, left, "mask")
    return _pair(left, right, cameras, truth)._replace(seen=seen, faults=faults)


def check_named(name: Any, where: str) -> None:
    """Raise SettingError for what `named_pair` cannot find."""
    known = isinstance(name, str) and (name == "motorcycle" or Path(name).is_dir())
    require(known, where, name, "motorcycle, or a folder with left.png, right.png, calib.txt and disparity")


def named_pair(name: Any, where: str) -> Pair:
    """One of a list of pairs: ``motorcycle``, or a folder (`load_folder`)."""
    check_named(name, where)
    return motorcycle() if name == "motorcycle" else load_folder(Path(name), where)


def load_folder(folder: Path, where: str) -> Pair:
    """A pair as Middlebury's benchmark has them, with its truth.

    Args:
        folder: with left.png, right.png, disparity (.npy, .npz, .pfm or .png) and calib.txt, a calibration of a
            rectified pair (`torchfovea.stereo.calibration_files`).
        where: the setting's name, for errors.

    Raises:
        SettingError: for what is missing or does not fit.
    """
    left, right, faults = _images(folder / "left.png", folder / "right.png", f"{where}: ")
    found = [folder / f"disparity{suffix}" for suffix in SUFFIXES if (folder / f"disparity{suffix}").is_file()]
    require(len(found) == 1, f"{where}: {folder}/disparity", len(found), "one file (.npy, .npz, .pfm or .png)")
    truth = load_disparity(found[0], f"{where}: disparity")[0]
    _fits(truth, left, f"{where}: disparity")
    calibration = folder / "calib.txt"
    try:
        cameras = load_calibration([calibration], (left.shape[-1], left.shape[-2]))
    except SettingError as error:
        raise SettingError(f"{where}: {error}") from error
    require(cameras.rectified, f"{where}: {calibration}", "raw cameras", "those of a rectified pair")
    return _pair(left, right, cameras, truth)._replace(faults=faults)


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


def gaze_of(cfg: DictConfig, pair: Pair, name: str = "gaze_px") -> tuple[float, float] | None:
    """Where the retinas look, (column, row), by the setting of this name; None for what is not told.

    Raises:
        SettingError: for anything but a pixel of the images.
    """
    given = cfg[name]
    if given is None:
        return None
    height, width = pair.left.shape[-2:]
    expected = f"[column, row], a pixel of the {width}x{height} images{', or same' * (name == 'gaze_right_px')}"
    two = OmegaConf.is_list(given) and len(given) == 2 and all(is_number(v) for v in given)
    require(two, name, given, expected)
    column, row = (float(v) for v in given)
    require(0 <= column <= width - 1 and 0 <= row <= height - 1, name, given, expected)
    return column, row


def _images(left: Path, right: Path, where: str = "") -> tuple[Tensor, Tensor, tuple[Fault, ...]]:
    """Both images in [0, 1], and what is wrong with their files."""
    one, other = (read_levels(path, f"{where}{name}") for path, name in ((left, "left"), (right, "right")))
    size, found = (f"{p.levels.shape[-1]}x{p.levels.shape[-2]} px" for p in (one, other))
    require(size == found, f"{where}right", found, f"the left image's {size}")
    *images, faults = exposed(one, other)
    return images[0], images[1], tuple(faults)


def _pair(left: Tensor, right: Tensor, cameras: StereoCalibration, truth: Tensor | None) -> Pair:
    rig = None if cameras.rectified else cameras.rig
    return Pair(left, right, cameras.left, cameras.right, cameras.rig.baseline_m, truth, rig)


def _fits(truth: Tensor | None, image: Tensor, where: str) -> None:
    if truth is not None:
        size = tuple(image.shape[-2:])
        require(truth.shape == image.shape[-2:], where, tuple(truth.shape), f"the images' {size}")
