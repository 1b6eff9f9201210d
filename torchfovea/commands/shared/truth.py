"""The true disparity of a user's pair, and the mask of what both eyes see."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.setting import SettingError, require
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.untrusted import Damaged, read_arrays, read_pixels

__all__ = ["load_mask", "load_truth"]


def load_truth(cfg: DictConfig) -> tuple[Tensor | None, Tensor | None]:
    """The settings `disparity`, `disparity_unit_px`, `disparity_unknown` and `mask`.

    Returns:
        The truth (H, W) [px], not finite where it is unknown; and bool (H, W), what both eyes see; or None for either.

    Raises:
        SettingError: for files that are not such maps.
    """
    told = {name: OmegaConf.select(cfg, name) for name in ("disparity_unit_px", "disparity_unknown")}
    for name, value in told.items():
        require(value is None or math.isfinite(value), name, value, "a number")
    unit, unknown = (None if value is None else float(value) for value in told.values())
    require(unit is None or unit != 0, "disparity_unit_px", unit, "the pixels that a stored 1 stands for")
    if cfg.disparity is None:
        for name in ("disparity_unit_px", "disparity_unknown", "mask"):
            require(OmegaConf.select(cfg, name) is None, name, OmegaConf.select(cfg, name), "null without a disparity")
        return None, None
    truth, _ = load_disparity(Path(cfg.disparity), "disparity", unit_px=unit, unknown=unknown)
    name = OmegaConf.select(cfg, "mask")
    if name is None:
        return truth, None
    known, seen = load_mask(Path(name), "mask")
    require(known.shape == truth.shape, "mask", tuple(known.shape), f"the disparity's {tuple(truth.shape)}")
    return torch.where(known, truth, torch.nan), seen


def load_mask(path: Path, setting: str) -> tuple[Tensor, Tensor]:
    """Where a truth is known, and what both eyes see, bool (H, W) each.

    Args:
        path: an image or an NPY array. Its greatest value marks what both eyes see, 0 what is unknown, and anything
            between what only the left eye sees (Middlebury's mask0nocc.png: 255, 0 and 128).
        setting: the name of the setting, for errors.

    Raises:
        SettingError: for a file that is missing or no such map.
    """
    require(path.is_file(), setting, path, "an existing file")
    try:
        values = next(iter(read_arrays(path).values())) if path.suffix == ".npy" else read_pixels(path, ("ANYDEPTH",))
    except Damaged as error:
        raise SettingError(f"{setting} = {path}: expected a grey image, or an NPY array (H, W) ({error})") from error
    fits = values.ndim == 2 and values.size > 0 and values.dtype.kind in "bu"
    require(fits, setting, path, "a grey image, or an NPY array (H, W) of bool or unsigned whole numbers")
    require(bool(values.any()), setting, path, "a mask that leaves something to judge")
    return torch.from_numpy(values > 0), torch.from_numpy(values == values.max())
