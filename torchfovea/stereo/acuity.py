"""Images as receptive fields (RFs) of several widths would see them, at the images' own size.

Differentiable in the images.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.retina import Retina
from torchfovea.sensing.sampling import halve

__all__ = ["acuity", "level_of"]


def acuity(images: Tensor, retina: Retina, scale: float, middle: tuple[float, float]) -> Tensor:
    """Images as RFs of several widths would see them.

    Level k shows averages over 2ᵏ⁺¹ pixels, or over the width of the retina's RFs there, where that is larger.

    Args:
        images: (B, 1, H, W).
        retina: their retina.
        scale: image pixels per retinal pixel.
        middle: image pixel of the optical axis.

    Returns:
        (B, L, H, W), about 0, up to the level of the widest RF. Differentiable.
    """
    height, width = images.shape[-2:]
    images = images - 0.5  # sums of squares lose least about 0
    own, top = _levels(retina, scale, middle, (height, width), images.device, images.dtype)
    pyramid = [images]
    for _ in range(top):
        pyramid.append(halve(pyramid[-1]))

    def shown(k: int) -> Tensor:
        """Level k of the pyramid, as large as the images."""
        if k == 0:
            return images
        large: Tensor = F.interpolate(pyramid[k], scale_factor=2**k, mode="bilinear", align_corners=False)
        return large[..., :height, :width]

    # from the coarsest down, in place: at full size every image more that is held is one too many
    levels = images.new_empty(len(images), top + 1, height, width)
    levels[:, top:] = coarse = shown(top)
    for k in reversed(range(top)):
        fine = shown(k)
        levels[:, k : k + 1] = torch.where(
            own > k + 1, levels[:, k + 1 : k + 2], torch.lerp(fine, coarse, (own - k).clamp(0, 1))
        )
        coarse = fine
    return levels


@lru_cache(maxsize=2)
def _levels(
    retina: Retina,
    scale: float,
    middle: tuple[float, float],
    size: tuple[int, int],
    device: torch.device,
    dtype: torch.dtype,
) -> tuple[Tensor, int]:
    """The level that shows what an RF at each pixel (H, W) would see, and that of the widest RF; see `acuity`."""
    with torch.inference_mode(False), torch.no_grad():
        x, y = (
            (torch.arange(n, device=device, dtype=dtype) - m) / scale for n, m in zip(size[::-1], middle, strict=True)
        )
        place = columns(x, y[:, None])
        rim = retina.width_px(place.new_tensor([retina.radius_px, 0.0]))
        top = min(math.ceil(float(level_of(rim, scale)) - 1e-3), int(math.log2(min(size))))
        return level_of(retina.width_px(place), scale), top


def level_of(width_px: Tensor, scale: float) -> Tensor:
    """The pyramid's level that shows averages of a width; see `torchfovea.sensing.retina`."""
    return (torch.log2(width_px * scale) - 1).clamp(min=0)
