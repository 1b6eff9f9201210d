"""Images of recordings: 16-bit PNG, which keeps 65,535 levels and is read by everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchfovea.files import replacing
from torchfovea.setting import SettingError, require
from torchfovea.untrusted import Damaged, read_pixels

__all__ = ["WHITE", "as_kept", "image_from_pixels", "read_picture", "write_picture"]

WHITE = 65535


def as_kept(image: Tensor) -> Tensor:
    """What is left of an image (3, H, W) in [0, 1] once it was written and read: at most half a level off."""
    return _levels(image).float() / WHITE


def _levels(image: Tensor) -> Tensor:
    return (image.detach().cpu().double().clamp(0, 1) * WHITE).round().to(torch.int32)


def write_picture(path: Path, image: Tensor) -> None:
    """Write an image (3, H, W) in [0, 1] as PNG with 16 bits a channel, without further loss."""
    import cv2

    pixels = _levels(image).movedim(0, -1).numpy().astype(np.uint16)
    with replacing(path) as temporary:
        # the fastest compression: a robot records while it searches
        done = cv2.imwrite(str(temporary), pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
        require(bool(done), "recording", path, "a PNG that can be written")


def read_picture(path: Path) -> Tensor:
    """Read an image as (3, H, W) in [0, 1]: 8 or 16 bits, grey or colour.

    Raises:
        SettingError: for a file that is missing or no image.
    """
    require(path.is_file(), "frame", path, "an image, but there is no such file")
    try:
        return image_from_pixels(read_pixels(path, ("COLOR", "ANYDEPTH")))
    except Damaged as error:
        raise SettingError(f"frame = {path}: expected an image that OpenCV can read ({error})") from error


def image_from_pixels(pixels: np.ndarray) -> Tensor:
    """OpenCV's pixels (H, W, 3), blue first, as (3, H, W) in [0, 1].

    Raises:
        SettingError: for pixels of neither 8 nor 16 bits.
    """
    require(pixels.dtype in (np.uint8, np.uint16), "frame", f"an image of {pixels.dtype}", "8 or 16 bits")
    most = 255 if pixels.dtype == np.uint8 else WHITE
    rgb = torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1]).astype(np.int32))
    return rgb.movedim(-1, 0).float() / most
