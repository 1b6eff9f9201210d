"""Semi-global block matching of a rectified pair: OpenCV's matcher with what torchfovea needs around it.

Reference: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008.
Not differentiable. OpenCV is imported on the first call; it comes with the extra `torchfovea[stereo]`.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from types import ModuleType
from typing import ClassVar

import numpy as np

from torchfovea.setting import SettingError, check_types, require

__all__ = ["SGBM", "check_room", "disparity_sgbm"]

MODES = ("sgbm", "3way", "hh", "hh4")


@dataclass(frozen=True)
class SGBM:
    """Parameters of the matcher.

    Attributes:
        block_px: side of the matched block, odd.
        smooth_small: penalty P1 of a disparity step of 1 px; None for 8·block².
        smooth_large: penalty P2 > P1 of a larger step; None for 32·block².
        prefilter_cap: image gradients are clipped at this many grey levels.
        uniqueness_percent: by how much the best cost must beat the second.
        left_right_px: largest difference between the left and the right disparity; negative: unchecked.
        speckle_px: smaller patches of one disparity are dropped; 0: none.
        speckle_range_px: disparity step at which a patch ends.
        mode: `hh` sums costs along eight directions, `sgbm` five, `hh4` four in two passes, `3way` three. Three take a
            quarter of the time of eight and a few rows of memory, and make more errors where texture is weak.
        first_disparity_px: where the search begins; None lets it follow from the farthest range.
        disparities: how many are searched, a multiple of 16; None lets it follow from the nearest range.
        texture: mean horizontal gradient [grey levels of 255 per px] over the block below which nothing can be matched.
        rectified_fov_deg: widest rectified view; what lies beyond is masked.
        edge_px: neighbouring disparities further apart than this are different surfaces, never averaged.
        half_from_px: receptive fields at least this wide [image px] are matched on views of half the size, with half
            the block; None: none are.
    """

    block_px: int = 5
    smooth_small: int | None = None
    smooth_large: int | None = None
    prefilter_cap: int = 63
    uniqueness_percent: int = 5
    left_right_px: int = 1
    speckle_px: int = 50
    speckle_range_px: int = 2
    mode: str = "hh"
    first_disparity_px: int | None = None
    disparities: int | None = None
    texture: float = 0.1
    rectified_fov_deg: float = 140.0
    edge_px: float = 1.0
    half_from_px: float | None = None

    authors: ClassVar[SGBM]

    def __post_init__(self) -> None:
        """Raise SettingError for what the matcher cannot run with."""
        check_types(self, "matcher.")
        odd = self.block_px >= 1 and self.block_px % 2 == 1
        require(odd, "matcher.block_px", self.block_px, "an odd number of pixels")
        small, large = self.penalties
        require(0 < small < large, "matcher.smooth_large", large, f"more than smooth_small = {small} > 0")
        require(1 <= self.prefilter_cap <= 63, "matcher.prefilter_cap", self.prefilter_cap, "1 to 63 grey levels")
        # a pixel costs at most twice the cap, for its gradient, and a quarter of its grey level; OpenCV adds a block of
        # them to P2 in 16 bits, and beyond these wraps around: the worst match becomes the best
        most = math.isqrt(max(0, (2**15 - 1 - large) // (2 * max(self.prefilter_cap | 1, 15) + 63)))
        fits = f"at most {most - 1 + most % 2} with prefilter_cap = {self.prefilter_cap} and smooth_large = {large}"
        require(self.block_px <= most, "matcher.block_px", self.block_px, fits + " (16-bit sums)")
        percent = self.uniqueness_percent
        require(0 <= percent < 100, "matcher.uniqueness_percent", percent, "0 to less than 100")
        require(self.speckle_px >= 0, "matcher.speckle_px", self.speckle_px, "0 or more pixels")
        require(self.speckle_range_px >= 1, "matcher.speckle_range_px", self.speckle_range_px, "at least 1 pixel")
        require(self.mode in MODES, "matcher.mode", self.mode, f"one of {', '.join(MODES)}")
        whole = self.disparities is None or (self.disparities > 0 and self.disparities % 16 == 0)
        require(whole, "matcher.disparities", self.disparities, "a positive multiple of 16")
        few = self.disparities is None or self.disparities <= 16384
        require(few, "matcher.disparities", self.disparities, "a positive multiple of 16, at most 16384")
        require(0 <= self.texture < math.inf, "matcher.texture", self.texture, "0 or more grey levels")
        fov = self.rectified_fov_deg
        require(0 < fov <= 160, "matcher.rectified_fov_deg", fov, "more than 0 and at most 160 degrees")
        require(self.edge_px > 0, "matcher.edge_px", self.edge_px, "a positive number of pixels")
        wide = self.half_from_px is None or self.half_from_px > 0
        require(wide, "matcher.half_from_px", self.half_from_px, "a positive number of pixels, or null")

    @property
    def penalties(self) -> tuple[int, int]:
        """P1 and P2."""
        square = self.block_px**2
        small = 8 * square if self.smooth_small is None else self.smooth_small
        return small, 32 * square if self.smooth_large is None else self.smooth_large

    def halved(self) -> SGBM:
        """The same on pictures of half the size, in their pixels."""
        block = self.block_px // 4 * 2 + 1
        small, large = (max(1, round(penalty * (block / self.block_px) ** 2)) for penalty in self.penalties)
        return replace(
            self,
            block_px=block,
            smooth_small=small,
            smooth_large=max(large, small + 1),
            left_right_px=min(self.left_right_px, -(-self.left_right_px // 2)),
            speckle_px=-(-self.speckle_px // 4),
            speckle_range_px=-(-self.speckle_range_px // 2),
            first_disparity_px=None if self.first_disparity_px is None else self.first_disparity_px // 2,
            disparities=None if self.disparities is None else 16 * math.ceil(self.disparities / 32),
        )

    def search(self, low_px: float, high_px: float) -> tuple[int, int]:
        """The first disparity searched and one past the last, for a scene between `low_px` and `high_px`."""
        first = math.floor(low_px) - 1 if self.first_disparity_px is None else self.first_disparity_px
        count = self.disparities or 16 * max(1, math.ceil((math.ceil(high_px) + 2 - first) / 16))
        return first, first + count


# The parameters of the authors' programs.
SGBM.authors = SGBM(
    block_px=7,
    smooth_small=768,
    smooth_large=1536,
    prefilter_cap=63,
    uniqueness_percent=15,
    left_right_px=0,
    speckle_px=50,
    speckle_range_px=16,
    mode="hh",
    first_disparity_px=0,
    disparities=80,
)


def check_room(size: tuple[int, int], search: tuple[int, int], params: SGBM, most_bytes: float = math.inf) -> None:
    """Refuse pictures whose costs do not fit into memory, before the system ends the program.

    Args:
        size: height and width of the pictures [px].
        search: the first disparity searched and one past the last.
        params: of the matcher; its modes `hh` and `hh4` keep two costs of 16 bits for every pixel and disparity, the
            others a few rows of them.
        most_bytes: the most that is allowed; never more than the machine has.

    Raises:
        SettingError: for more.
    """
    height, width = size
    cells = (search[1] - search[0]) * width * (height if params.mode.startswith("hh") else params.block_px + 2)
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        most_bytes = min(most_bytes, float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")))
    what = f"{search[1] - search[0]} for {width} x {height} px, {4e-9 * cells:.1f} GB"
    expected = (
        f"at most {1e-9 * most_bytes:.1f} GB (a greater matcher.nearest_range_m, matcher.mode=sgbm, matcher=sweep)"
    )
    require(4 * cells <= most_bytes, "matcher.disparities", what, expected)


def disparity_sgbm(
    left: np.ndarray, right: np.ndarray, search: tuple[int, int], params: SGBM, pad: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity of every pixel of the left image.

    Args:
        left: (H, W) float32, grey, 0 to 1.
        right: (H, W) float32; what is at column x on the left is at x − d on the right.
        search: the first disparity searched and one past the last (`SGBM.search`).
        params: the matcher's parameters.
        pad: extend both images so that every left pixel can be searched. Without it the first `search[1]` columns and
            the last −`search[0]`, if these are positive, stay invalid.

    Returns:
        disparity (H, W) float32, to 1/16 px, 0 where invalid; valid (H, W) bool.

    Raises:
        SettingError: without OpenCV.
    """
    cv2 = _opencv()
    first, end = search
    # from the unrounded image: where it is flat between two grey levels, rounding draws a texture of its own
    gradient = np.abs(cv2.Sobel(left, cv2.CV_32F, 1, 0, ksize=3)) * (255 / 8)
    window = params.block_px + 4
    textured = cv2.blur(gradient, (window, window)) > params.texture
    left, right = (np.rint(image.clip(0, 1) * 255).astype(np.uint8) for image in (left, right))
    before, after = (max(end, 0), max(-first, 0)) if pad is None else pad
    width = left.shape[1]
    if before or after:
        left, right = (cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right))
    # on narrower images OpenCV reads beyond its buffers (opencv#25828)
    if min(left.shape) <= params.block_px or left.shape[1] <= max(end, 0) + max(-first, 0) + params.block_px:
        return np.zeros((left.shape[0], width), np.float32), np.zeros((left.shape[0], width), bool)
    small, large = params.penalties
    modes = {"sgbm": cv2.STEREO_SGBM_MODE_SGBM, "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY}
    modes |= {"hh": cv2.STEREO_SGBM_MODE_HH, "hh4": cv2.STEREO_SGBM_MODE_HH4}
    matcher = cv2.StereoSGBM_create(
        minDisparity=first,
        numDisparities=end - first,
        blockSize=params.block_px,
        P1=small,
        P2=large,
        disp12MaxDiff=params.left_right_px if params.left_right_px >= 0 else 2**15,  # it takes negative ones for 1
        preFilterCap=params.prefilter_cap,
        uniquenessRatio=params.uniqueness_percent,
        speckleWindowSize=params.speckle_px,
        speckleRange=params.speckle_range_px,
        mode=modes[params.mode],
    )
    raw = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))
    inner = slice(before, before + width)
    # equal costs pass the matcher's uniqueness test: without texture it reports its first disparity
    valid = (raw[:, inner] >= 16 * first) & textured
    return np.where(valid, raw[:, inner] / np.float32(16), np.float32(0)), valid


def _opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise SettingError(
            "matcher = sgbm: expected OpenCV, which comes with pip install 'torchfovea[stereo]'"
        ) from error
    return cv2
