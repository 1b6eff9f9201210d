"""The picture of a sensed pair."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from torch import Tensor

from torchfovea.commands.shared.pictures import found_map, inner_limits
from torchfovea.files import write_figure
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

__all__ = ["draw_sense"]

SHOWN_PX = 1000


def draw_sense(path: Path, left: Tensor, found: Any, retina: Retina | None, observed: Observations, px: Tensor) -> None:
    """Draw a sensed pair: the left image, what the matcher found, each point's range and its relative uncertainty.

    Args:
        path: the PNG to write.
        left: (3, H, W).
        found: a `Disparity`, a `SweepRange`, or what is not drawn.
        retina: of a `SweepRange`.
        observed: in inverse range.
        px: the receptive fields, (N, 2), for the two maps, where each is drawn as wide as it is.
    """
    figure = Figure(figsize=(14, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    step = max(1, max(left.shape[-2:]) // SHOWN_PX)  # as fine as it is drawn
    height, width = left.shape[-2:]
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes[0, 0].imshow(np.asarray(left[:, ::step, ::step].movedim(0, -1)).clip(0, 1), extent=extent)
    axes[0, 0].set(title="left image", xlabel="column [px]", ylabel="row [px]")
    axes[0, 1].set(title="what the matcher found", xticks=[], yticks=[])
    if isinstance(found, Disparity | SweepRange):
        values, name = found_map(found, retina, min(*left.shape[-2:], SHOWN_PX))
        step = max(1, max(values.shape) // SHOWN_PX)
        inner = np.nanquantile(values, (0.02, 0.98)) if np.isfinite(values).any() else (0.0, 1.0)  # false matches apart
        drawn = axes[0, 1].imshow(values[::step, ::step], cmap="viridis", vmin=inner[0], vmax=inner[1])
        figure.colorbar(drawn, ax=axes[0, 1], extend="both", label=name)
    keep = observed.valid & (observed.mean[:, 2] > 0)
    rho, sigma = observed.mean[keep, 2], observed.cov[keep, 5].sqrt()
    seen = px[keep] if bool(keep.any()) else px
    (left_px, top_px), (right_px, bottom_px) = (edge.tolist() for edge in (seen.amin(0) - 2, seen.amax(0) + 2))
    wide, kind = (1.0, "") if retina is None else (np.asarray(retina.width_px(px[keep])), "retinal ")
    maps = (
        (1 / rho, "range", "range [m]", "viridis_r", False),
        (sigma / rho, "how surely it is known", "relative standard deviation of inverse range", "magma", True),
    )
    for place, (value, name, label, cmap, log) in zip(axes[1], maps, strict=True):
        low, high = inner_limits(value, 0.0) if len(value) else (0.1, 1.0)
        drawn = EllipseCollection(
            wide, wide, 0.0, units="xy", offsets=np.asarray(px[keep]), offset_transform=place.transData,
            array=np.asarray(value), cmap=cmap, norm="log" if log else None, rasterized=True,
        )  # fmt: skip
        drawn.set_clim(low, max(high, low * 1.001 + 1e-9))
        place.add_collection(drawn)
        place.set(title=name, aspect="equal", facecolor="0.7", xlabel=f"{kind}column [px]", ylabel=f"{kind}row [px]")
        place.set(xlim=(left_px, right_px), ylim=(bottom_px, top_px))
        figure.colorbar(drawn, ax=place, label=label)
    write_figure(path, figure, dpi=100)
