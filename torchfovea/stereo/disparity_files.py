"""Disparity maps, and their confidences, from files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.setting import SettingError, require
from torchfovea.untrusted import Damaged, read_arrays, read_grey_pfm, read_pixels

__all__ = ["check_maps", "load_disparity"]


def load_disparity(
    path: str | Path,
    setting: str = "matcher.source",
    span: tuple[float, float] = (0.0, 1.0),
    unit_px: float | None = None,
    unknown: float | None = None,
) -> tuple[Tensor, Tensor | None]:
    """A disparity map, and its confidence where the file has one.

    Args:
        path: NPZ with `disparity` (or one array alone) and perhaps `confidence`; NPY; PFM; or a PNG, TIFF or PGM image,
            in which 0 is unknown if its numbers are whole.
        setting: the name the user knows the path by.
        span: between which values a confidence lies.
        unit_px: pixels that a stored 1 stands for; None: 1, and 1/256 in a PNG of 16 bits (KITTI's). Other images of
            whole numbers need it (Middlebury's quarters: 0.25).
        unknown: the stored number that stands for nothing, beside NaN.

    Returns:
        (H, W) float32 [px], not finite where unknown; and the confidence (H, W), or None.

    Raises:
        SettingError: for a file that is missing, of another form, or whose parts do not fit.
    """
    path = Path(path)
    require(path.is_file(), setting, path, "an existing file")
    suffix = path.suffix.lower()
    readers = {".npz": _arrays, ".npy": _arrays, ".pfm": _pfm} | dict.fromkeys(
        (".png", ".tif", ".tiff", ".pgm"), _image
    )
    require(suffix in readers, setting, path, f"a file that ends in {', '.join(readers)}")
    try:
        stored, sure = readers[suffix](path)
    except Damaged as error:
        raise SettingError(f"{setting} = {path}: expected a disparity map ({error})") from error
    disparity, confidence = check_maps(stored, sure, None, f"{setting} = {path}", span)
    if readers[suffix] is _image and stored.dtype.kind == "u":
        if unit_px is None:
            told = suffix == ".png" and stored.dtype.itemsize == 2
            expected = "the pixels that a stored 1 stands for (disparity_unit_px of a truth), or a PNG of 16 bits"
            require(told, setting, path, expected)
            unit_px = 1 / 256
        unknown = 0 if unknown is None else unknown
    if unknown is not None:
        disparity = torch.where(disparity == unknown, torch.nan, disparity)
    return disparity if unit_px is None else disparity * unit_px, confidence


def _arrays(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    arrays = read_arrays(path)
    key = "disparity" if "disparity" in arrays else next(iter(arrays)) if len(arrays) == 1 else None
    if key is None:
        raise Damaged(f"it holds {', '.join(arrays) or 'nothing'}, and no disparity")
    return arrays[key], arrays.get("confidence")


def _pfm(path: Path) -> tuple[np.ndarray, None]:
    return read_grey_pfm(path), None


def _image(path: Path) -> tuple[np.ndarray, None]:
    try:
        values = read_pixels(path)
    except ImportError as error:
        raise SettingError(
            f"{path}: expected OpenCV, which comes with pip install 'torchfovea[stereo]', to read an image"
        ) from error
    if values.ndim == 3 and bool((values == values[..., :1]).all()):
        values = values[..., 0]
    if values.ndim != 2 or values.dtype not in (np.uint8, np.uint16, np.float32):
        raise Damaged("it is no grey image of 8 or 16 bits, or of floating point")
    return values, None


def check_maps(
    disparity: Any, confidence: Any, size: tuple[int, int] | None, where: str, span: tuple[float, float] = (0.0, 1.0)
) -> tuple[Tensor, Tensor | None]:
    """A matcher's answer as float32 tensors.

    Raises:
        SettingError: unless the disparity is (H, W) numbers, of the given size if any, and the confidence is alike,
            within its span; a standard deviation or a variance may also be NaN.
    """
    maps: list[Tensor] = []
    for name, value in (("disparity", disparity), ("confidence", confidence)):
        if value is None and name == "confidence":
            return maps[0], None
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
        expected = "(H, W)" if size is None else str(size)
        fits = array.ndim == 2 and array.size > 0 and (size is None or array.shape == size)
        require(fits, f"{where}: {name}.shape", array.shape, expected)
        require(array.dtype.kind in "fiu", f"{where}: {name}.dtype", array.dtype, "numbers")
        maps.append(torch.from_numpy(np.array(array, dtype=np.float32, order="C")))
        size = array.shape
    inside = (maps[1] >= span[0]) & (maps[1] <= span[1])
    inside |= maps[1].isnan() & (span[1] > 1)
    found = f"{maps[1].min():g} to {maps[1].max():g}"
    require(bool(inside.all()), f"{where}: confidence", found, f"{span[0]:g} to {span[1]:g}")
    return maps[0], maps[1]
