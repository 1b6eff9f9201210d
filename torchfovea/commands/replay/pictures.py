"""The picture of a replay: the last frame with images, the memory and what it knows in colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from torchfovea.commands.shared.pictures import azimuth_elevation, found_map, sphere_map
from torchfovea.files import write_figure
from torchfovea.search import Glance
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["draw_replay"]


def draw_replay(
    path: Path,
    look: Glance | None,
    last: Glance,
    colours: Tensor,
    rows: Sequence[Sequence[Any]],
    retina: Retina,
) -> None:
    """Draw a replay.

    Args:
        path: the PNG to write.
        look: the last glance with images; None: there was none.
        last: the last glance.
        colours: of the cells, (Nx, 3).
        rows: of fixations.csv.
        retina: of both eyes.
    """
    figure = Figure(figsize=(15, 8.8), layout="constrained")
    figure.suptitle(f"{len(rows)} frames", fontsize=15)
    top, bottom = figure.subfigures(2, 1, squeeze=False)[:, 0]
    if look is not None and look.look is not None:
        pictures = look.look.pictures
        row = top.subplots(1, 3)
        for axes, image, name in zip(row, (pictures.left, pictures.right), ("left eye", "right eye"), strict=False):
            axes.imshow(np.asarray(image.movedim(0, -1)).clip(0, 1))
            axes.set_title(f"{name}, last frame with images")
        if isinstance(pictures.found, Disparity | SweepRange):  # a user's own matcher may show nothing
            values, name = found_map(pictures.found, retina, min(pictures.left.shape[-2:]))
            figure.colorbar(row[2].imshow(values, cmap="viridis"), ax=row[2])
            row[2].set_title(name)
        for axes in row:
            axes.set_axis_off()
    memory, points = last.step.memory, last.step.points
    seen = memory.looks > 0
    left, right = bottom.subplots(1, 2)
    distance = torch.where(seen, points.mean.norm(dim=-1), torch.nan)
    far = float(torch.nanquantile(distance.double(), 0.98)) if bool(seen.any()) else 1.0
    near = float(distance[seen].min()) if bool(seen.any()) else 0.0
    sphere_map(left, memory.cells, distance, "range [m]", "viridis_r", (near, max(far, near + 1e-3)))
    left.set_title("memory: range of the seen cells; the next fixation in red")
    _in_colour(right, memory.cells, torch.where(seen[:, None], colours, torch.full_like(colours, 0.9)))
    right.set_title("memory: colours, and where the head looked")
    if int(last.step.cell) >= 0:
        left.plot(*azimuth_elevation(memory.cells[last.step.cell][None]), "o", mfc="none", mec="crimson", ms=14, mew=2)
    pan, tilt = (np.degrees([row[k] for row in rows]) for k in (2, 3))
    right.plot(pan, -tilt, ".-", color="black", lw=0.8)
    for axes in (left, right):
        axes.set_facecolor("0.9")
    write_figure(path, figure, dpi=100)


def _in_colour(axes: Axes, cells: Tensor, colours: Tensor) -> None:
    axes.scatter(*azimuth_elevation(cells), c=np.asarray(colours.clamp(0, 1)), s=4, linewidths=0, rasterized=True)
    axes.set(xlabel="azimuth [°] (left is positive)", ylabel="elevation [°]", aspect="equal")
    axes.invert_xaxis()
