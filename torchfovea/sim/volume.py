"""Periodic volumes of numbers, looked up between their voxels.

`torch.nn.functional.grid_sample` is the definition. On a CPU it goes voxel by voxel; OpenCV, where it is installed and
does not round places to 1/32 of a voxel as it did before its version 5, is several times faster.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["PeriodicVolume"]

_WIDTH = 4096  # OpenCV is slower on narrow images


class PeriodicVolume:
    """Four numbers at each of S³ voxels that repeat for ever.

    Args:
        values: (4, S, S, S), float32; the last axis is x.
        device: where they are looked up.
    """

    def __init__(self, values: np.ndarray, device: torch.device) -> None:
        self.size = values.shape[-1]
        # one voxel more on each far side closes the period
        closed = np.pad(values, ((0, 0), (0, 1), (0, 1), (0, 1)), mode="wrap").astype(np.float32)
        # a voxel's channels side by side: one cache line instead of four
        self.values = torch.from_numpy(closed)[None].to(device, memory_format=torch.channels_last_3d)
        # floors above each other, for OpenCV
        self._sheet = np.ascontiguousarray(closed.transpose(1, 2, 3, 0)).reshape(-1, self.size + 1, 4)

    def at(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
        """The four numbers, by linear interpolation.

        Args:
            x: (R, C), places in periods, float32; any real numbers.
            y: likewise.
            z: likewise.

        Returns:
            Four tensors (R, C).
        """
        places = [part.sub(part.floor()) for part in (x, y, z)]
        return self._by_opencv(*places) if x.device.type == "cpu" and _exact() else self._by_torch(*places)

    def _by_torch(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
        grid = torch.stack([x, y, z], -1).mul_(2).sub_(1)
        return F.grid_sample(self.values, grid[None, None], align_corners=True)[0, :, 0].unbind(0)

    def _by_opencv(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
        import cv2

        z = z * self.size
        floor = z.floor().clamp_(max=self.size - 1)
        above = z.sub_(floor)
        column, row = x * self.size, torch.add(floor, y, alpha=self.size / (self.size + 1)).mul_(self.size + 1)

        def level(row: Tensor) -> Tensor:
            found = np.empty((x.numel(), 1, 4), np.float32)
            whole = x.numel() - x.numel() % _WIDTH
            for part in (slice(0, whole), slice(whole, None)):
                u, v = (flat.reshape(-1)[part].numpy() for flat in (column, row))
                if len(u) > 0:
                    shape = (-1, min(_WIDTH, len(u)))
                    out = found[part].reshape(*shape, 4)
                    cv2.remap(self._sheet, u.reshape(shape), v.reshape(shape), cv2.INTER_LINEAR, dst=out)
            return torch.from_numpy(found).view(*x.shape, 4)

        low, high = level(row), level(row.add_(self.size + 1))
        return tuple(torch.lerp(low[..., k], high[..., k], above) for k in range(4))


@lru_cache(maxsize=1)
def _exact() -> bool:
    """Whether OpenCV is there and interpolates at the very place."""
    try:
        import cv2
    except ImportError:
        return False
    image = np.repeat(np.arange(9, dtype=np.float32).reshape(3, 3, 1), 4, 2)
    x, y = np.full((1, 64), 1.29, np.float32), np.linspace(0.01, 1.99, 64, dtype=np.float32)[None]
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR)
    return bool(np.abs(found - (3 * y + x)[..., None]).max() < 1e-4)
