"""The picture of a memory's bias, after Figs. 4 and 7."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import torch
from torch import Tensor

from torchfovea.commands.shared.pictures import azimuth_elevation, inner_limits, sphere_map
from torchfovea.files import write_figure

matplotlib.use("Agg")
from matplotlib.figure import Figure

__all__ = ["draw_memory"]


def draw_memory(path: Path, cells: Tensor, spacing_deg: Tensor, target: Tensor, title: str) -> None:
    """Draw the cells on their sphere, seen from ahead and above, and over azimuth and elevation.

    Args:
        path: the PNG to write.
        cells: unit directions in E, (Nx, 3).
        spacing_deg: distance of each to its neighbours (Nx,), the colour.
        target: unit direction of the target (3,).
        title: the headline.
    """
    figure = Figure(figsize=(14, 6.4), layout="constrained")
    figure.suptitle(title, fontsize=15)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.7))
    ahead = torch.nn.functional.normalize(torch.tensor([1.0, 0.25, 0.25], dtype=torch.float64), dim=0)
    side = torch.nn.functional.normalize(torch.tensor([-ahead[1], ahead[0], 0.0], dtype=torch.float64), dim=0)
    up = torch.linalg.cross(ahead, side)
    # the viewer looks at the front of the sphere from outside: the robot's left is on the right
    size = float(min(6.0, max(0.5, 300 / len(cells) ** 0.5)))
    limits = inner_limits(spacing_deg, 1e-6)
    front = cells @ ahead > 0
    ball = torch.linspace(0, 2 * torch.pi, 200)
    left.plot(ball.cos(), ball.sin(), color="0.6", lw=1)
    colours = {"cmap": "viridis_r", "vmin": limits[0], "vmax": limits[1], "linewidths": 0, "rasterized": True}
    for mask, alpha in ((~front, 0.15), (front, 1.0)):
        left.scatter(cells[mask] @ side, cells[mask] @ up, c=spacing_deg[mask], s=size, alpha=alpha, **colours)
    left.plot(float(target @ side), float(target @ up), "o", mfc="none", mec="crimson", ms=14, mew=2)
    left.set(title="the sphere from ahead; the target in red", aspect="equal")
    left.set_axis_off()
    sphere_map(right, cells, spacing_deg, "distance to the neighbours [°]", "viridis_r", limits, size)
    right.plot(*map(float, azimuth_elevation(target)), "o", mfc="none", mec="crimson", ms=14, mew=2)
    right.set_title("cells within the head's reach; the target in red")
    write_figure(path, figure, dpi=100)
