"""A retina's look at an image beside the same by OpenCV and by kornia."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.commands.bench.timing import Growth, Path, Peer, compiled_peer, in_mode, nbytes, same
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.retina import fovea

__all__ = ["path_of_retina"]

_ROW = 1024  # places in a row of a map, which OpenCV wants less than 32768 wide


class _Level(NamedTuple):
    """The receptive fields first to last that read one level of the pyramid, and where, by rows of `_ROW` places."""

    level: int
    first: int
    last: int
    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray


def _plan(retina: LogPolar, size: int) -> list[_Level]:
    """Which level of the pyramid each receptive field reads, from widths: trilinear, as in mip-mapping."""
    centre = retina.centers_px("cpu", torch.float64)
    scale = size / (2 * retina.radius_px)
    level = torch.log2(retina.width_px(centre) * scale).numpy() - 1
    level = level.clip(0, max(0, min(math.ceil(level.max()), int(math.log2(size)))))
    place = (size - 1) / 2 + scale * centre.numpy()
    plan = []
    for k in range(math.ceil(level.max()) + 1):
        (those,) = np.nonzero(np.abs(level - k) < 1)
        if len(those) == 0:
            continue
        first, last = those[0], those[-1] + 1
        xy = ((place[first:last] + 0.5) / 2**k - 0.5).clip(0, -(-size // 2**k) - 1)
        padded = np.zeros((2, -(-len(xy) // _ROW) * _ROW), np.float32)
        padded[:, : len(xy)] = xy.T
        x, y = padded.reshape(2, -1, _ROW)
        weight = np.maximum(0, 1 - np.abs(level[first:last] - k)).astype(np.float32)
        plan.append(_Level(k, first, last, x, y, weight))
    return plan


def _by_opencv(image: np.ndarray, plan: list[_Level], count: int) -> np.ndarray:
    """(N, 3): the binomial pyramid and one cv2.remap for each of its levels."""
    kernel = np.array([1, 3, 3, 1], np.float32) / 8
    out, now, at = np.zeros((count, 3), np.float32), image, 0
    for part in plan:
        while at < part.level:
            now = cv2.sepFilter2D(now, -1, kernel, kernel, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE)[::2, ::2]
            now, at = np.ascontiguousarray(now), at + 1
        read = cv2.remap(now, part.x, part.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[part.first : part.last] += part.weight[:, None] * read.reshape(-1, 3)[: part.last - part.first]
    return out


def _by_kornia(image: Tensor, plan: list[_Level], places: list[tuple[Tensor, ...]], kernel: Tensor) -> Tensor:
    """(B, 3, N): the same pyramid by convolution and kornia's remap."""
    from kornia.geometry.transform import remap

    count, now, at, out = plan[-1].last, image, 0, []
    for part, (x, y, weight) in zip(plan, places, strict=True):
        while at < part.level:
            height, width = ((side + 1) // 2 for side in now.shape[-2:])
            padded = F.pad(now, (1, 3, 1, 3), "replicate")
            now, at = F.conv2d(padded, kernel, stride=2, groups=3)[..., :height, :width], at + 1
        read = remap(now, x, y, mode="bilinear", padding_mode="border", align_corners=True)
        read = read.flatten(-2)[..., : part.last - part.first]
        out.append(F.pad(weight * read, (part.first, count - part.last)))
    return torch.stack(out).sum(0)


def _picture(size: int) -> Tensor:
    """A smooth coloured picture (1, 3, size, size)."""
    axis = torch.linspace(0, 1, size)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    waves = [torch.sin(40 * x + 9 * y), torch.cos(25 * y * x + 3), torch.sin(60 * (x - 0.4) * (y + 0.2))]
    return (torch.stack(waves)[None] + 1) / 2


def path_of_retina(retina: LogPolar, size: int, batch: int, device: str, compile: str = "off") -> list[Path]:
    """One picture, and a batch of them.

    Args:
        retina: the layout.
        size: of the pictures [px].
        batch: how many pictures.
        device: ours and kornia's.
        compile: whether and how loops in C are timed, too.
    """
    kernel = torch.tensor([1.0, 3, 3, 1], device=device) / 8
    kernel = (kernel[:, None] * kernel).expand(3, 1, 4, 4).contiguous()
    plan = _plan(retina, size)

    def path(pictures: int) -> Path:
        image = _picture(size).expand(pictures, -1, -1, -1).contiguous().to(device)
        arrays = [np.ascontiguousarray(one.permute(1, 2, 0).cpu().numpy()) for one in image]
        places = [
            (*(torch.from_numpy(p)[None].to(device).expand(pictures, -1, -1) for p in (part.x, part.y)),
             torch.from_numpy(part.weight).to(device))
            for part in plan
        ]  # fmt: skip
        opencv = Peer("cv2: pyramid, remap", partial(_all_by_opencv, arrays, plan, retina.count))
        kornia = Peer("kornia: pyramid, remap", partial(_by_kornia, image, plan, places, kernel))
        ours = partial(fovea, image, None, retina)
        fast = compiled_peer(compile, lambda mode: partial(in_mode, mode, ours))
        sizes = tuple(retina.count // share for share in (4, 2, 1))
        runs = tuple(partial(fovea, image, None, LogPolar(count)) for count in sizes)
        return Path(
            "retina",
            f"{pictures} of 3 x {size} x {size} by {retina.count} RFs",
            device,
            ours,
            (*((opencv, kornia) if device == "cpu" else (kornia, opencv)), *fast),
            partial(_check, ours, opencv.run, kornia.run),
            nbytes(image, ours()),
            (Growth("RFs", sizes, runs),) if pictures == 1 else (),
            pictures,
        )

    return [path(1), path(batch)]


def _all_by_opencv(images: list[np.ndarray], plan: list[_Level], count: int) -> np.ndarray:
    return np.stack([_by_opencv(image, plan, count).T for image in images])


def _check(ours: Callable[[], Any], opencv: Callable[[], Any], kornia: Callable[[], Any]) -> None:
    """OpenCV rounds places to 1/32 of a pixel."""
    mine = ours()
    same("retina, cv2", mine, opencv(), 0.01)
    same("retina, kornia", mine, kornia(), 1e-3)
