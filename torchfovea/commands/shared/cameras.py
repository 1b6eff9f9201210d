"""The two cameras of a user's pair: from the files of a calibration, or a rectified pair's numbers typed by hand."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.settings import choice, within
from torchfovea.sensing.camera import Pinhole
from torchfovea.setting import SettingError, require
from torchfovea.stereo.calibration_files import BASELINES_M, KINDS, Options, StereoCalibration, load_calibration
from torchfovea.stereo.calibration_formats import LENSES
from torchfovea.stereo.rig import StereoRig

__all__ = ["BY_HAND", "OF_FILES", "cameras_of", "cameras_of_files"]

BY_HAND = ("focal_px", "cx_px", "cy_px", "baseline_m")
OF_FILES = ("calibration_right", "calibration_lens", "calibration_cameras", "calibration_unit_m")


def cameras_of(cfg: DictConfig, size_px: tuple[int, int]) -> StereoCalibration:
    """The cameras that a configuration tells of, for images of a width and height.

    Raises:
        SettingError: for what is missing, what is told twice, numbers that no camera has, and all that
            `load_calibration` refuses.
    """
    if cfg.calibration is None:
        for name in OF_FILES:
            require(cfg[name] is None, name, cfg[name], "null without a calibration file")
        return _by_hand(cfg, size_px)
    for name in BY_HAND:
        require(cfg[name] is None, name, cfg[name], f"null: calibration = {cfg.calibration} tells it")
    require(cfg.doffs_px == 0, "doffs_px", cfg.doffs_px, f"0: calibration = {cfg.calibration} tells it")
    return cameras_of_files(cfg, size_px)


def cameras_of_files(cfg: DictConfig, size_px: tuple[int, int]) -> StereoCalibration:
    """The cameras of the files that a configuration names, for images of a width and height.

    Raises:
        SettingError: for all that `load_calibration` refuses.
    """
    names = [name for name in ("calibration", "calibration_right") if cfg[name] is not None]
    lens = None if cfg.calibration_lens is None else choice(cfg, "calibration_lens", LENSES)
    unit = cfg.calibration_unit_m
    if unit is not None:
        unit = within(cfg, "calibration_unit_m", 1e-6, 1e3, "metres per unit of the file's lengths, 1e-6 to 1e3")
    options = Options(_indices(cfg), lens, unit)
    return load_calibration([cfg[name] for name in names], size_px, choice(cfg, "calibration_images", KINDS), options)


def _indices(cfg: DictConfig) -> tuple[int, int] | None:
    given = cfg.calibration_cameras
    if given is None:
        return None
    two = OmegaConf.is_list(given) and len(given) == 2 and all(type(i) is int and i >= 0 for i in given)
    require(two, "calibration_cameras", given, "[left, right], two whole numbers such as [2,3]")
    return given[0], given[1]


def _by_hand(cfg: DictConfig, size_px: tuple[int, int]) -> StereoCalibration:
    for name in BY_HAND:
        if cfg[name] is None:
            raise SettingError(
                f"{name} = null: expected the calibration of the left camera, in image pixels and metres, or "
                "calibration=FILE"
            )
    focal = within(cfg, "focal_px", 1.0, 1e6, "a positive number of pixels, 1 to 1e6")
    baseline = within(cfg, "baseline_m", *BASELINES_M, "{:g} to {:g} metres".format(*BASELINES_M))
    reach = 100.0 * max(size_px)
    near = f"a number of pixels within 100 images, {-reach:g} to {reach:g}"
    cx, cy, doffs = (within(cfg, name, -reach, reach, near) for name in ("cx_px", "cy_px", "doffs_px"))
    eye = torch.eye(3, dtype=torch.float64)
    rig = StereoRig(eye, eye, baseline)
    return StereoCalibration(Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), rig, True)
