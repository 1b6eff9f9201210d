"""Files of every kind that is read, and ways to damage them."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

import torchfovea as tf
from torchfovea.commands.shared.images import read_levels
from torchfovea.commands.shared.truth import load_mask
from torchfovea.recordings.folder import Folder, Recorder
from torchfovea.recordings.frames import Calibration
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, Head
from torchfovea.stereo.calibration_files import load_calibration
from torchfovea.stereo.disparity_files import load_disparity

__all__ = ["READERS", "damaged", "make_files"]

HUGE = (b"100000", b"99999999999", b"-1", b"0", b"nan", b"1e999", b"abc", b"")


def damaged(whole: bytes, source: random.Random) -> bytes:
    """A file with one thing wrong."""
    what = source.randrange(7)
    at = source.randrange(len(whole))
    end = min(at + source.randrange(1, 64), len(whole))
    if what == 0:
        return whole[:at]
    if what == 1:
        flipped = bytearray(whole)
        for _ in range(source.randrange(1, 8)):
            flipped[source.randrange(len(whole))] ^= 1 << source.randrange(8)
        return bytes(flipped)
    if what == 2:
        return whole[:at] + source.randbytes(end - at) + whole[end:]
    if what == 3:
        return whole[:at] + bytes(end - at) + whole[end:]
    if what == 4:
        return whole[:at] + whole[end:]
    if what == 5:
        return whole[:at] + source.randbytes(source.randrange(1, 64)) + whole[at:]
    # a number in what is text, or looks like it
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", whole[:2000]))
    if not numbers:
        return b""
    one = source.choice(numbers)
    return whole[: one.start()] + source.choice(HUGE) + whole[one.end() :]


def _pfm(path: Path, values: np.ndarray) -> None:
    height, width = values.shape
    path.write_bytes(b"Pf\n%d %d\n-1.0\n" % (width, height) + values[::-1].astype("<f4").tobytes())


def _memory() -> Any:
    observer = tf.Observer(retina=tf.LogPolar(200))
    px = observer.retina.centers_px()
    sigma = torch.full((len(px),), 0.5)
    matches = tf.Correspondences(px, px - torch.tensor([3.0, 0.0]), sigma, sigma, sigma > 0)
    cells = tf.sample(tf.direction_mixture([1.0], [[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]), 40, 0)
    seen = tf.eyes(observer.head, Gaze(*(torch.tensor(v) for v in (0.1, 0.2, 0.1))))
    return tf.perceive(observer, tf.new_memory(observer, cells), matches, seen)


def make_files(folder: Path) -> None:
    """One whole file of each kind."""
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    disparity = rng.random((24, 32), dtype=np.float32) * 9 + 1
    for kind in ("png", "jpg", "tiff", "bmp", "ppm"):
        cv2.imwrite(str(folder / f"image.{kind}"), levels)
    np.save(folder / "image.npy", levels)
    np.savez(folder / "image.npz", image=levels)
    np.save(folder / "disparity.npy", disparity)
    np.savez_compressed(folder / "disparity.npz", disparity=disparity, confidence=disparity / 10)
    cv2.imwrite(str(folder / "disparity.png"), (disparity * 256).astype(np.uint16))
    cv2.imwrite(str(folder / "disparity.tiff"), disparity)
    cv2.imwrite(str(folder / "mask.png"), np.where(disparity > 5, 255, 128).astype(np.uint8))
    np.save(folder / "mask.npy", disparity > 5)
    _pfm(folder / "disparity.pfm", disparity)
    tf.save_memory(folder / "memory.npz", _memory())
    camera = Pinhole(30.0, 15.5, 11.5)
    recorder = Recorder(folder / "recording", Calibration(camera, camera, (32, 24), Head()))
    image = torch.from_numpy(levels).movedim(-1, 0).float() / 255
    for k in range(3):
        recorder.write(0.1 * k, image, image, Gaze(*(torch.tensor(0.1 * k) for _ in range(3))))
    (folder / "middlebury.txt").write_text(
        "cam0=[30.0 0 15.5; 0 30.0 11.5; 0 0 1]\ncam1=[30.0 0 16.5; 0 30.0 11.5; 0 0 1]\n"
        "doffs=1.0\nbaseline=100.0\nwidth=32\nheight=24\nndisp=10\n"
    )
    (folder / "kitti.txt").write_text("P0: 30 0 15.5 0 0 30 11.5 0 0 0 1 0\nP1: 30 0 15.5 -3.0 0 30 11.5 0 0 0 1 0\n")
    (folder / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  intrinsics: [30.0, 30.0, 15.5, 11.5]\n"
        "  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]\n  resolution: [32, 24]\n"
        "cam1:\n  camera_model: pinhole\n  distortion_model: radtan\n  intrinsics: [30.0, 30.0, 15.5, 11.5]\n"
        "  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]\n  resolution: [32, 24]\n"
        "  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n"
        "  - [0.0, 0.0, 0.0, 1.0]\n"
    )
    for suffix in ("yaml", "xml", "json"):
        storage = cv2.FileStorage(str(folder / f"opencv.{suffix}"), cv2.FILE_STORAGE_WRITE)
        for side in ("1", "2"):
            storage.write(f"M{side}", np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]]))
            storage.write(f"D{side}", np.array([[0.01, 0, 0, 0]]))
        storage.write("R", np.eye(3))
        storage.write("T", np.array([[-0.1], [0.0], [0.0]]))
        storage.release()


def _raise(error: Exception) -> None:
    raise error


def _recording(path: Path) -> list[Any]:
    folder = next(above for above in path.parents if above.name == "recording")
    return list(Folder(folder).frames(_raise))


READERS: dict[str, Callable[[Path], object]] = {
    **{f"image.{k}": lambda p: read_levels(p, "left") for k in ("png", "jpg", "tiff", "bmp", "ppm", "npy", "npz")},
    **{
        f"disparity.{k}": lambda p: load_disparity(p, "truth", unit_px=1.0)
        for k in ("npy", "npz", "png", "tiff", "pfm")
    },
    **{f"mask.{k}": lambda p: load_mask(p, "mask") for k in ("png", "npy")},
    "memory.npz": tf.load_memory,
    **{
        name: lambda p: load_calibration([p], (32, 24))
        for name in ("middlebury.txt", "kitti.txt", "camchain.yaml", "opencv.yaml", "opencv.xml", "opencv.json")
    },
    **{f"recording/{name}": _recording for name in ("frames.csv", "calibration.json", "left/000001.png")},
}
