"""Parts of pictures that several commands draw."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import reconstruct
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.axes import Axes

__all__ = ["found_map", "sphere_map"]


def found_map(found: Disparity | SweepRange, retina: Retina | None, size_px: int) -> tuple[np.ndarray, str]:
    """What a matcher found as a picture, NaN where nothing, and its title.

    Args:
        found: a matcher's own map.
        retina: of a `SweepRange`.
        size_px: the side of the square picture of a `SweepRange`.
    """
    if isinstance(found, Disparity):
        return np.where(np.asarray(found.valid), np.asarray(found.disparity), np.nan), (
            "disparity of the rectified left view [px]"
        )
    assert retina is not None  # the sweep has no other fields
    both = torch.stack([found.inverse_range, found.valid.to(found.inverse_range)]).detach().cpu()
    value, weight = reconstruct(both[None], retina, size_px)[0][0]
    return np.asarray(torch.where(weight > 0.5, value / weight.clamp(min=0.5), torch.nan)), "inverse range found [1/m]"


def sphere_map(
    axes: Axes, cells: Tensor, values: Tensor, label: str, cmap: str, limits: tuple[float, float], size: float = 4.0
) -> Any:
    """Cells of an ego-sphere over azimuth (left is left) and elevation, coloured by a value."""
    azimuth = torch.rad2deg(torch.atan2(cells[:, 1], cells[:, 0]))
    elevation = torch.rad2deg(torch.asin(cells[:, 2].clamp(-1, 1)))
    drawn = axes.scatter(
        azimuth, elevation, c=values, s=size, cmap=cmap, vmin=limits[0], vmax=limits[1], linewidths=0, rasterized=True
    )
    axes.set(xlabel="azimuth [°] (left is positive)", ylabel="elevation [°]")
    axes.invert_xaxis()
    axes.set_aspect("equal")
    axes.figure.colorbar(drawn, ax=axes, label=label, pad=0.015)
    return drawn
