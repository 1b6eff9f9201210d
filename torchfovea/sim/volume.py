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
        # and for torchfovea/sim/texture.c
        self.flat = (self.size, torch.from_numpy(self._sheet))

    def at(self, places: Tensor, count: int = 4) -> list[Tensor]:
        """The first numbers of each voxel, by linear interpolation.

        Args:
            places: (3, R, C), x, y and z in periods, float32; any real numbers.
            count: of the numbers, up to four.

        Returns:
            So many tensors (R, C).
        """
        within = places - places.floor()
        found = self._by_opencv if places.device.type == "cpu" and _exact() else self._by_torch
        return found(within, count)

    def _by_torch(self, places: Tensor, count: int) -> list[Tensor]:
        grid = places.movedim(0, -1).mul(2).sub_(1)
        return list(F.grid_sample(self.values[:, :count], grid[None, None], align_corners=True)[0, :, 0].unbind(0))

    def _by_opencv(self, places: Tensor, count: int) -> list[Tensor]:
        import cv2

        column, row, above = places * self.size
        floor = above.floor().clamp_(max=self.size - 1)
        above = above.sub_(floor)
        row = row.add_(floor, alpha=self.size + 1)

        def level(row: Tensor) -> Tensor:
            found = np.empty((column.numel(), 1, 4), np.float32)
            whole = column.numel() - column.numel() % _WIDTH
            for part in (slice(0, whole), slice(whole, None)):
                u, v = (flat.reshape(-1)[part].numpy() for flat in (column, row))
                if len(u) > 0:
                    shape = (-1, min(_WIDTH, len(u)))
                    out = found[part].reshape(*shape, 4)
                    cv2.remap(self._sheet, u.reshape(shape), v.reshape(shape), cv2.INTER_LINEAR, dst=out)
            return torch.from_numpy(found).view(*column.shape, 4)

        low, high = level(row), level(row.add_(self.size + 1))
        return [torch.lerp(low[..., k], high[..., k], above) for k in range(count)]


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
