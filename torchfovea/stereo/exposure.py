"""Two eyes that are exposed or processed differently, brought together: what block matching compares are grey levels.

A gain, an offset or a gamma between the eyes keeps the order of grey levels; the eyes see nearly the same things, so
that the levels of equal rank are the same level. Not differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["alike"]

RANKS = 33
STEPS = 2048


@torch.no_grad()
def alike(pair: Tensor) -> Tensor:
    """Give the right image the left one's exposure.

    Args:
        pair: (2, 1, H, W), the left image first, 0 to 1.

    Returns:
        The same, the right image through a curve that takes its quantiles to the left one's.
    """
    flat = pair.flatten(1)
    stride = max(1, flat.shape[1] // 5_000)
    rank = torch.linspace(0, 1, RANKS, device=pair.device, dtype=pair.dtype)
    left, right = torch.quantile(flat[:, ::stride], rank, dim=1).unbind(1)
    right = right + torch.arange(RANKS, device=pair.device, dtype=pair.dtype) * 1e-6  # ascending where levels repeat
    level = torch.linspace(0, 1, STEPS + 1, device=pair.device, dtype=pair.dtype)
    k = torch.searchsorted(right, level).clamp(1, RANKS - 1)
    part = (level - right[k - 1]) / (right[k] - right[k - 1])
    curve = torch.lerp(left[k - 1], left[k], part.clamp(0, 1))
    # read from a table of even steps, which is faster than a search for every pixel
    at = pair[1].clamp(0, 1) * STEPS
    step = at.int().clamp(max=STEPS - 1)
    low, high = (curve.index_select(0, (step + k).flatten()).view_as(at) for k in (0, 1))
    mapped = torch.lerp(low, high, at - step)
    return torch.stack([pair[0], mapped])
