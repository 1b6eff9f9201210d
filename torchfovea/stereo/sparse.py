"""A few hundred sure matches of two images, found without believing anything of how the cameras stand.

Corners of the left image are looked for in the right one by normalized correlation, on pictures small enough to search
a band of rows through their whole width, and back; then refined by Lucas and Kanade's method at full size, there and
back again. What survives is sparse and nearly free of outliers: a measure for calibrations, truths and other matchers.
Not differentiable. OpenCV is imported on the first call; it comes with the extra `torchfovea[stereo]`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.setting import SettingError, require
from torchfovea.stereo.exposure import alike
from torchfovea.stereo.views import Views

__all__ = ["SparseMatches", "match_sparse"]

SMALL_PX = 320  # shorter side of the pictures that are searched
CORNERS = 400
HALF = 7  # of a template's side [px of the small pictures]
ROWS = 0.06  # of the height: the band that is searched, either way
CORRELATION = 0.8
UNIQUE = 0.8  # 1 - correlation of the best place, over that of the next best elsewhere
BACK_PX = 1.5  # how near a match back has to come, in small pixels; at full size a third
WINDOW_PX = 15


class SparseMatches(NamedTuple):
    """Places that show the same point.

    Attributes:
        left_px: (M, 2), columns and rows [image px].
        right_px: (M, 2).
        tried: corners of the left image that were looked for.
    """

    left_px: Tensor
    right_px: Tensor
    tried: int


@torch.no_grad()
def match_sparse(views: Views) -> SparseMatches:
    """Match the corners of the left image.

    Args:
        views: a single pair of images; their cameras are not asked.

    Returns:
        The matches, in the images' type and on their device.

    Raises:
        SettingError: for a batch of images, and without OpenCV.
    """
    cv2 = _opencv()
    require(views.left.dim() == 3, "left.shape", tuple(views.left.shape), "(3, H, W) or (1, H, W)")
    left, right = (_bytes(image) for image in alike(views.grey().float())[:, 0])
    scale = min(1.0, SMALL_PX / min(left.shape))
    size = tuple(max(1, round(n * scale)) for n in left.shape[::-1])
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    factor = np.array(left.shape[::-1]) / np.array(size)
    corners = cv2.goodFeaturesToTrack(small[0], CORNERS, 0.01, 6)
    found = np.zeros((0, 2)) if corners is None else corners[:, 0].round().astype(int)
    inside = ((found >= HALF) & (found < np.array(size) - HALF)).all(-1)
    start = found[inside].astype(int)
    pairs = [
        (place, there) for place in start if (there := _there_and_back(cv2, small[0], small[1], place)) is not None
    ]
    none = views.left.new_zeros(0, 2)
    if not pairs:
        return SparseMatches(none, none, len(start))
    one, other = ((np.array(side, np.float32) + 0.5) * factor - 0.5 for side in zip(*pairs, strict=True))
    one, other = _refined(cv2, left, right, one.astype(np.float32), other.astype(np.float32), 1 / scale)
    return SparseMatches(torch.from_numpy(one).to(none), torch.from_numpy(other).to(none), len(start))


def _bytes(image: Tensor) -> np.ndarray:
    """Grey (H, W) as bytes, stretched over their whole range: dark pictures have corners, too."""
    flat = image.flatten()[:: max(1, image.numel() // 20_000)]
    low, high = (float(q) for q in torch.quantile(flat, flat.new_tensor([0.01, 0.99])))
    stretched = (image - low) / max(high - low, 1e-3)
    return np.asarray((stretched.clamp(0, 1) * 255).round().byte().cpu())


def _there_and_back(cv2: Any, left: np.ndarray, right: np.ndarray, place: np.ndarray) -> np.ndarray | None:
    """The right place of a left one, columns and rows; None where it is not sure."""
    there = _like(cv2, left, right, place)
    if there is None:
        return None
    back = _like(cv2, right, left, there)
    return there if back is not None and np.abs(back - place).max() <= BACK_PX else None


def _like(cv2: Any, mine: np.ndarray, theirs: np.ndarray, place: np.ndarray) -> np.ndarray | None:
    """Where the other picture looks as this one does at a place; None for nowhere, or for several such places."""
    height = len(theirs)
    (x, y), band = place, round(ROWS * height) + 2
    top, bottom = max(y - band - HALF, 0), min(y + band + HALF + 1, height)
    template = mine[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
    score = cv2.matchTemplate(theirs[top:bottom], template, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(score)
    if not best >= CORRELATION:  # NaN of a picture without contrast
        return None
    score[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -1
    if 1 - best > UNIQUE * (1 - float(score.max())):
        return None
    return np.array([column + HALF, top + row + HALF])


def _refined(
    cv2: Any, left: np.ndarray, right: np.ndarray, one: np.ndarray, other: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Matches (M, 2) to a part of a pixel of the images; those that lead back to where they came from."""
    levels = max(0, round(float(np.log2(scale)))) + 1
    how = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, seen, _ = cv2.calcOpticalFlowPyrLK(left, right, one, other.copy(), **how)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(right, left, there, one.copy(), **how)
    near = np.abs(there - other).max(-1) <= 2 * BACK_PX * scale
    good = (seen[:, 0] > 0) & (seen_back[:, 0] > 0) & near & (np.abs(back - one).max(-1) <= BACK_PX / 3)
    return one[good], there[good]


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise SettingError("health: expected OpenCV, which comes with pip install 'torchfovea[stereo]'") from error
    return cv2
