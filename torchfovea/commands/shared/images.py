"""Reading the two images of a pair as users have them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.setting import SettingError, require
from torchfovea.stereo.health import Fault, full_scale
from torchfovea.untrusted import Damaged, read_arrays, unpack_pixels

__all__ = ["Picture", "exposed", "read_levels"]

NOMINAL = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}


class Picture(NamedTuple):
    """An image file.

    Attributes:
        levels: (3, H, W), as they are stored, in floating point.
        nominal: the level that stands for 1 by the file's type.
        turned: whether its EXIF orientation turns or mirrors it; the levels are as they are stored.
    """

    levels: Tensor
    nominal: float
    turned: bool


def read_levels(path: Path, setting: str) -> Picture:
    """An image as it is stored.

    Args:
        path: anything that OpenCV reads, or NPY and NPZ arrays (H, W) or (H, W, 3).
        setting: the name of the setting, for errors.

    Raises:
        SettingError: for a file that is missing or cannot be read.
    """
    require(path.is_file(), setting, path, "an existing file")
    turned = False
    if path.suffix.lower() in (".npy", ".npz"):
        pixels = _array(path, setting)
        pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels
        fits = pixels.ndim == 3 and pixels.shape[-1] == 3 and pixels.size > 0 and pixels.dtype.kind in "bfiu"
        require(fits, setting, (*pixels.shape, str(pixels.dtype)), "an array (H, W) or (H, W, 3) of numbers")
    else:
        try:
            data = path.read_bytes()
            loaded = unpack_pixels(data, ("COLOR", "ANYDEPTH", "IGNORE_ORIENTATION"))
            tagged = b"exif" in data[: 2**16].lower()
            upright = unpack_pixels(data, ("COLOR", "ANYDEPTH")) if tagged else loaded
        except Damaged as error:
            raise SettingError(f"{setting} = {path}: expected an image that OpenCV can read ({error})") from error
        turned = not np.array_equal(loaded, upright)
        pixels = loaded[..., ::-1]
    nominal = NOMINAL.get(pixels.dtype, 1.0)
    levels = torch.from_numpy(np.ascontiguousarray(pixels, np.float32)).movedim(-1, 0)
    require(bool(torch.isfinite(levels).all()), setting, f"{path} with NaN or infinite pixels", "finite values")
    return Picture(levels, nominal, turned)


def exposed(left: Picture, right: Picture) -> tuple[Tensor, Tensor, list[Fault]]:
    """Both images in [0, 1], by the bits that their levels use, and what is wrong with the files."""
    found = []
    for name, picture in (("left", left), ("right", right)):
        if picture.turned:
            line = f"{name}: its EXIF orientation turns the picture: expected pixels as the calibration knows them; "
            found.append(Fault("exif", f"{line}store it upright without the tag (else it is taken as stored)", True))
    one = left.nominal == right.nominal
    peaks = [float(picture.levels.max()) for picture in (left, right)]
    images = []
    for name, picture, peak in zip(("left", "right"), (left, right), peaks, strict=True):
        scale = full_scale(max(peaks) if one else peak, picture.nominal)
        if scale != picture.nominal and (not one or name == "left"):
            bits = round(np.log2(scale + 1))
            who = "left, right" if one else name
            kind = "floating point" if picture.nominal == 1 else "16 bits"
            line = f"{who}: levels up to {max(peaks) if one else peak:g} in {kind}: taken for {bits} bits"
            found.append(Fault("bits", line, False))
        images.append(picture.levels / scale)
    return images[0], images[1], found


def _array(path: Path, setting: str) -> np.ndarray:
    try:
        return next(iter(read_arrays(path).values()))
    except (Damaged, StopIteration) as error:
        raise SettingError(
            f"{setting} = {path}: expected a NumPy file with an array of numbers ({error or 'it is empty'})"
        ) from error
