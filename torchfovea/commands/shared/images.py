"""Reading images that users have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchfovea.setting import SettingError, require

__all__ = ["read_image"]


def _exists(path: Path, setting: str) -> None:
    require(path.is_file(), setting, path, "an existing file")


def read_image(path: Path, setting: str) -> Tensor:
    """An image as (3, H, W) in [0, 1].

    Args:
        path: anything that OpenCV reads, or NPY and NPZ arrays (H, W) or (H, W, 3), bytes or in [0, 1].
        setting: the name of the setting, for errors.

    Raises:
        SettingError: for a file that is missing or cannot be read.
    """
    import cv2

    _exists(path, setting)
    if path.suffix.lower() in (".npy", ".npz"):
        pixels = _array(path, setting)
        pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels
        require(pixels.ndim == 3 and pixels.shape[-1] == 3, setting, pixels.shape, "an array (H, W) or (H, W, 3)")
    else:
        loaded = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if loaded is None:
            raise SettingError(f"{setting} = {path}: expected an image that OpenCV can read")
        pixels = cv2.cvtColor(loaded, cv2.COLOR_BGR2RGB)
    scale = 255.0 if pixels.dtype == np.uint8 else 1.0
    image = torch.from_numpy(np.ascontiguousarray(pixels)).float().movedim(-1, 0) / scale
    require(bool(torch.isfinite(image).all()), setting, f"{path} with NaN or infinite pixels", "finite values")
    return image


def _array(path: Path, setting: str) -> np.ndarray:
    try:
        loaded = np.load(path, allow_pickle=False)
        return np.asarray(loaded if isinstance(loaded, np.ndarray) else loaded[loaded.files[0]])
    except (ValueError, IndexError, OSError) as error:
        raise SettingError(f"{setting} = {path}: expected a NumPy file with an array of numbers") from error
