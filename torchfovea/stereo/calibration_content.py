"""What a calibration file holds, before anybody knows what it means: names with their values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchfovea.setting import SettingError, require

__all__ = ["read_content"]


def read_content(path: Path) -> dict[str, Any]:
    """A file's names with their values: arrays from OpenCV's, text from plain lines, whatever YAML holds.

    Raises:
        SettingError: for a file that is missing, or holds no names.
    """
    require(path.is_file(), "calibration", path, "an existing file")
    text = path.read_bytes()[: 2**20].decode("utf-8", "replace")
    if "opencv-matrix" in text or "<opencv_storage" in text:
        return _storage(path)
    lines = [line for line in text.splitlines() if line.strip()]
    if any("=" in line and line.split("=", 1)[0].strip().isidentifier() for line in lines):
        return {k.strip(): v.strip() for k, _, v in (line.partition("=") for line in lines)}
    names = [line.partition(":")[0] for line in lines]
    if any(name in names for name in ("P0", "P1", "P2", "P_rect_00", "P_rect_01", "P_rect_02")):
        return {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
    import yaml

    try:
        document = next(iter(yaml.safe_load_all(text)), None)
    except yaml.YAMLError as error:
        why = " ".join(str(error).split())
        raise SettingError(f"calibration = {path}: expected a calibration file ({why})") from error
    require(isinstance(document, dict), "calibration", path, "a calibration file")
    assert isinstance(document, dict)
    return document


def _storage(path: Path) -> dict[str, Any]:
    """The top of a file of OpenCV's: matrices and numbers as arrays, text as it is."""
    try:
        import cv2
    except ImportError as error:
        wanted = "OpenCV to read it (pip install 'torchfovea[stereo]')"
        raise SettingError(f"calibration = {path}: expected {wanted}") from error
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        root = storage.root()
        found: dict[str, Any] = {}
        for name in root.keys():
            node = storage.getNode(name)
            if node.isMap() and node.mat() is not None:
                found[name] = np.asarray(node.mat(), dtype=float)
            elif node.isSeq():
                found[name] = np.array([node.at(i).real() for i in range(node.size())])
            elif node.isInt() or node.isReal():
                found[name] = np.array(node.real())
            elif node.isString():
                found[name] = node.string()
        storage.release()
    except (cv2.error, SystemError) as error:
        why = " ".join(str(error).split())
        raise SettingError(f"calibration = {path}: expected a file of OpenCV's ({why})") from error
    return found
