"""OpenCV's block matching as a disparity function: the benchmark's example of somebody else's matcher."""

from __future__ import annotations

import numpy as np

__all__ = ["stereo_bm"]

DISPARITIES, BLOCK_PX = 128, 15


def stereo_bm(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparity (H, W) [px] of rectified float32 images (H, W, 3) in [0, 1]; NaN where it finds none."""
    import cv2

    greys = [cv2.cvtColor((image * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY) for image in (left, right)]
    padded = [cv2.copyMakeBorder(grey, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for grey in greys]
    sixteenths = cv2.StereoBM.create(DISPARITIES, BLOCK_PX).compute(*padded)[:, DISPARITIES:]
    return np.where(sixteenths > 0, sixteenths / 16, np.nan).astype(np.float32)
