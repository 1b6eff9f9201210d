"""Pictures, and parts of pictures, that several commands draw."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from torchfovea.commands.shared.precision import Dots, PlotFrame
from torchfovea.files import write_figure
from torchfovea.metrics import information
from torchfovea.search import Glance
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import kept, reconstruct
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

__all__ = ["PALETTE", "azimuth_elevation", "draw_glance", "draw_precision", "found_map", "inner_limits", "sphere_map"]

# after Okabe and Ito: told apart by every eye
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#000000")
VIEW = {"elev": 16.0, "azim": -68.0}  # from behind the eyes, above and to the right of them
MOST = 40_000  # points of a cloud that are drawn


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


def azimuth_elevation(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where unit directions (..., 3) in E lie on a sphere map [degrees]."""
    x, y, z = directions.unbind(-1)
    return torch.rad2deg(torch.atan2(y, x)), torch.rad2deg(torch.asin(z.clamp(-1, 1)))


def inner_limits(values: Tensor, apart: float = 1e-3) -> tuple[float, float]:
    """The ends of a colour scale: between them lie all values but 2% at either side; at least so far apart."""
    low, high = torch.quantile(values.double(), torch.tensor([0.02, 0.98], dtype=torch.float64)).tolist()
    return low, max(high, low + apart)


def sphere_map(
    axes: Axes, cells: Tensor, values: Tensor, label: str, cmap: str, limits: tuple[float, float], size: float = 4.0
) -> Any:
    """Cells of an ego-sphere over azimuth (left is left) and elevation, coloured by a value."""
    azimuth, elevation = azimuth_elevation(cells)
    drawn = axes.scatter(
        azimuth, elevation, c=values, s=size, cmap=cmap, vmin=limits[0], vmax=limits[1], linewidths=0, rasterized=True
    )
    axes.set(xlabel="azimuth [°] (left is positive)", ylabel="elevation [°]")
    axes.invert_xaxis()
    axes.set_aspect("equal")
    axes.figure.colorbar(drawn, ax=axes, label=label, location="bottom", aspect=30, pad=0.02)
    return drawn


def draw_glance(glance: Glance, path: Tensor, nats: Sequence[float], retina: Retina, head_line: str) -> Figure:
    """One frame of a search: what the eyes see, what is known then, where the head looks next.

    Args:
        glance: of one robot.
        path: (T, 3), directions in E of the fixations until now.
        nats: the mean information after each of them.
        retina: of both eyes.
        head_line: the title.
    """
    shown = glance.look.pictures if glance.look is not None else None
    figure = Figure(figsize=(12, 8.2 if shown is not None else 4.6), layout="constrained")
    figure.suptitle(head_line)
    parts = figure.subfigures(2, 1, squeeze=False)[:, 0] if shown is not None else [figure]
    if shown is not None:
        left, right = (image.detach().cpu().float() for image in (shown.left, shown.right))
        row = parts[0].subplots(1, 3)
        names = "left eye", "right eye", "what the left retina keeps"
        for axes, image, name in zip(row, (left, right, kept(left, retina)), names, strict=True):
            axes.imshow(np.asarray(image.movedim(0, -1)).clip(0, 1))
            axes.plot((image.shape[-1] - 1) / 2, (image.shape[-2] - 1) / 2, "+", color="white", ms=12, mew=2)
            axes.set_title(name)
            axes.set_axis_off()
    memory, points = glance.step.memory, glance.step.points
    wide = parts[-1].subplots(1, 3, width_ratios=(1, 1, 0.7))
    distance = torch.where(memory.looks > 0, points.mean.norm(dim=-1), torch.nan)
    sphere_map(wide[0], memory.cells, distance.cpu(), "range [m]", "viridis_r", (0.4, 4.0))
    known = information(points.cov).cpu()
    sphere_map(wide[1], memory.cells, known, "information [nats]", "magma", inner_limits(known))
    for axes, name in zip(wide, ("range of the seen cells", "information"), strict=False):
        axes.set_title(name)
        axes.set_facecolor("0.9")
        azimuth, elevation = azimuth_elevation(path)
        axes.plot(azimuth, elevation, ".-", color="white", lw=2.4, ms=8)
        axes.plot(azimuth, elevation, ".-", color="0.15", lw=1, ms=5)
        if int(glance.step.cell) >= 0:
            place = azimuth_elevation(memory.cells[glance.step.cell].cpu())
            axes.plot(*map(float, place), "o", mfc="none", mec="tab:orange", ms=13, mew=2.2)
    wide[2].plot(range(1, len(nats) + 1), nats, ".-", color="tab:purple")
    wide[2].set(xlabel="fixation", ylabel="mean information [nats]")
    wide[2].set_xlim(0.5, len(nats) + 0.5)
    wide[2].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    wide[2].grid(alpha=0.3)
    return figure


def draw_precision(path: Path, true: Dots, measured: Sequence[Dots], frame: PlotFrame) -> None:
    """Draw the paper's Fig. 1: a scene, and what each retina knows of it; in space, and as the left eye sees it.

    Args:
        path: the PNG to write.
        true: in the picture's colours; all are cut to where these points lie.
        measured: coloured by information, on one scale.
        frame: of all points.
    """
    edges = torch.stack([true.seen_deg.amin(0), true.seen_deg.amax(0)]).double()
    tall = float(((edges[1] - edges[0]) / (edges[1] - edges[0]).roll(1))[1].nan_to_num(1.0).clamp(0.4, 1.4))
    engine = ConstrainedLayoutEngine(rect=(0, 0, 0.975, 1))  # what axes in space are called stands out of them
    figure = Figure(figsize=(15, 5.2 + 4.6 * tall), layout=engine)
    turned, inner = torch.tensor(frame.turned).double(), torch.tensor([0.01, 0.99], dtype=torch.float64)
    low, high = torch.quantile(_thinned(true.points_m).double() @ turned.mT, inner, dim=0)
    low, high = low - 0.05 * (high - low) - 1e-3, high + 0.05 * (high - low) + 1e-3
    nats = torch.cat([cloud.colour for cloud in measured]).double()
    least, most = torch.quantile(_thinned(nats), inner).tolist() if len(nats) else (0.0, 1.0)
    clouds = (true, *measured)
    grid, dots = figure.add_gridspec(2, len(clouds), height_ratios=(3.8, 4.8 * tall)), []
    for k, cloud in enumerate(clouds):
        space: Any = figure.add_subplot(grid[0, k], projection="3d")
        seen = figure.add_subplot(grid[1, k])
        points = cloud.points_m.double() @ turned.mT
        inside = ((points >= low) & (points <= high)).all(-1)
        shown, places, colour = (np.asarray(_thinned(t[inside])) for t in (points, cloud.seen_deg, cloud.colour))
        scale: dict[str, Any] = {} if k == 0 else {"cmap": "viridis", "vmin": least, "vmax": max(most, least + 1e-3)}
        alike: dict[str, Any] = {"c": colour, "s": 5.0 if k == 0 else 2.0, "linewidths": 0, "rasterized": True, **scale}
        space.scatter(*shown.T, depthshade=False, **alike)
        dots.append(seen.scatter(*places.T, **alike))
        _in_space(space, frame.axes, low.tolist(), high.tolist())
        space.set_title(cloud.name, fontsize=13)
        seen.set(xlabel="right of the left eye's axis [°]", ylabel="above it [°]", aspect="equal", facecolor="0.88")
        seen.set(xlim=edges[:, 0].tolist(), ylim=edges[:, 1].tolist())
    bar: dict[str, Any] = {"location": "bottom", "shrink": 0.5, "aspect": 40}
    figure.colorbar(dots[-1], ax=figure.axes, label="information of a point, −log|Σ| [nats]", **bar)
    write_figure(path, figure, dpi=120)


def _in_space(axes: Any, names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> None:
    """Name and limit the axes of a cloud in space."""
    for axis, name, least, most in zip("xyz", names, low, high, strict=True):
        axes.set(**{f"{axis}label": f"{name} [m]", f"{axis}lim": (least, most)})
        getattr(axes, f"{axis}axis").set_pane_color((0.88, 0.88, 0.88, 1.0))
    axes.set_box_aspect([most - least for least, most in zip(low, high, strict=True)], zoom=1.08)
    axes.locator_params(nbins=4)
    axes.view_init(**VIEW)


def _thinned(points: Tensor) -> Tensor:
    """Every k-th point, so that no more than MOST are left."""
    return points[:: max(1, -(-len(points) // MOST))]
