"""Arrays and pictures from files that nobody vouches for: of bounded size, and whatever is wrong is one kind of error.

A file of a few kilobytes may say that it holds terabytes, and decompressors fail in as many ways as there are layers.
Nothing that a file says is run: NumPy's pickles are refused.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

__all__ = [
    "MOST_BYTES",
    "MOST_PIXELS",
    "Damaged",
    "path_within",
    "read_arrays",
    "read_grey_pfm",
    "read_pixels",
    "read_tensors",
    "unpack_pixels",
]

MOST_PIXELS = 10**8
"""Of a picture; a file that says more is refused before it is unpacked."""
MOST_BYTES = 2**32
"""Of all arrays of a file, unpacked."""


class Damaged(ValueError):
    """A file that is not what it should be; the message says why in one line, without the file's name."""


@contextmanager
def _one_error() -> Iterator[None]:
    try:
        yield
    except Damaged:
        raise
    except Exception as error:  # zipfile, zlib, tokenize and NumPy each have their own
        raise Damaged(" ".join(str(error).split())[:160] or type(error).__name__) from error


def path_within(folder: Path, name: str) -> Path:
    """The file that data name by its path in their folder.

    Raises:
        Damaged: for a path that leads out of the folder.
    """
    path = PureWindowsPath(name)  # which knows the separators of all systems, and drives
    if path.drive or path.root or ".." in path.parts:
        raise Damaged("a path out of the folder")
    return folder / name


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file by their names, or that of an NPY file as ``""``.

    Raises:
        Damaged: for what is no such file, holds objects, or is larger than `MOST_BYTES`; of an NPY file also, if it is
            shorter than it says.
    """
    with _one_error(), open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            return {"": _whole_array(file)}
        with zipfile.ZipFile(file) as archive:
            _bounded(sum(entry.file_size for entry in archive.infolist()))
        file.seek(0)
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):
            raise Damaged(f"{name} is no array")
    return arrays


def _whole_array(file: Any) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise Damaged(f"a NumPy file of version {version[0]}.{version[1]}")
    shape, _, kind = readers[version](file)
    size, there = math.prod(shape) * kind.itemsize, os.fstat(file.fileno()).st_size - file.tell()
    _bounded(size)
    if size != there and not kind.hasobject:
        raise Damaged(f"{there} bytes for an array of {size}")
    file.seek(0)
    return np.asarray(np.load(file, allow_pickle=False))


def _bounded(size: int) -> None:
    if not 0 <= size <= MOST_BYTES:
        raise Damaged(f"{size} bytes of arrays, and more than {MOST_BYTES} are not read")


def read_tensors(path: str | os.PathLike[str]) -> Any:
    """What `torchfovea.files.write_tensors` wrote: tensors, numbers, text, and collections of them; nothing runs.

    Raises:
        Damaged: for what is missing, damaged, or would run something.
    """
    import torch

    with _one_error():
        return torch.load(path, weights_only=True)


def read_grey_pfm(path: str | os.PathLike[str]) -> np.ndarray:
    """A grey PFM picture (H, W), float32, the first row on top.

    Raises:
        Damaged: for what is no such file, or has another number of pixels than it says.
    """
    with _one_error(), open(path, "rb") as file:
        kind, size, scale = (file.readline(80).decode("ascii", "replace").split() for _ in range(3))
        if kind != ["Pf"] or len(size) != 2 or len(scale) != 1:
            raise Damaged("it is no grey PFM")
        width, height = map(int, size)
        there = os.fstat(file.fileno()).st_size - file.tell()
        if width < 1 or height < 1 or 4 * width * height != there:
            raise Damaged(f"{there} bytes for {width}x{height} pixels")
        values = np.frombuffer(file.read(), "<f4" if float(scale[0]) < 0 else ">f4")
    return values.reshape(height, width)[::-1].astype(np.float32)


def read_pixels(path: str | os.PathLike[str], how: Sequence[str] = ("UNCHANGED",)) -> np.ndarray:
    """A picture as OpenCV reads it, unless it is cut off or larger than `MOST_PIXELS`.

    Args:
        path: the file.
        how: as `unpack_pixels`.

    Raises:
        Damaged: for what is no picture.
        ImportError: without OpenCV.
    """
    with _one_error():
        data = Path(path).read_bytes()
    return unpack_pixels(data, how)


def unpack_pixels(data: bytes, how: Sequence[str] = ("UNCHANGED",)) -> np.ndarray:
    """A picture of the bytes of its file; see `read_pixels`.

    Args:
        data: the file's.
        how: the names of OpenCV's flags, without IMREAD_; as it is stored by default.
    """
    # read when the library is loaded
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
    import cv2

    flags = sum(getattr(cv2, f"IMREAD_{name}") for name in how)
    log = cv2.utils.logging
    said = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)  # we say it ourselves, in one line
    try:
        # unlike imread, imdecode refuses a JPEG that is cut off
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as error:
        raise Damaged(" ".join(str(error).split())) from error
    finally:
        log.setLogLevel(said)
    if pixels is None:
        raise Damaged("it is no whole image that OpenCV can read")
    if pixels.shape[0] * pixels.shape[1] > MOST_PIXELS:
        raise Damaged(f"{pixels.shape[1]}x{pixels.shape[0]} pixels, and more than {MOST_PIXELS} are not read")
    return np.asarray(pixels)
