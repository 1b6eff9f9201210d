"""The picture of an episode: what the eyes saw, what the memory holds, the curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import torch

from torchfovea.commands.shared.pictures import azimuth_elevation, found_map, sphere_map
from torchfovea.episode import Episode
from torchfovea.files import write_figure
from torchfovea.metrics import information
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import kept
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["draw_episode"]

DARK = "0.15"


def _cross(axes: Axes, size: Sequence[int]) -> None:
    """Mark the fixation: the optical axis."""
    height, width = size[-2:]
    axes.plot((width - 1) / 2, (height - 1) / 2, "+", color="white", ms=16, mew=3)
    axes.plot((width - 1) / 2, (height - 1) / 2, "+", color="crimson", ms=14, mew=1.4)


def _scan_path(axes: Axes, episode: Episode) -> None:
    """The fixations in order over a sphere map: the directions in E of the fixated points."""
    azimuth, elevation = azimuth_elevation(episode.direction)
    axes.plot(azimuth, elevation, "-", color="white", lw=2.2, alpha=0.8)
    axes.plot(azimuth, elevation, "-", color=DARK, lw=0.9)
    axes.scatter(
        azimuth, elevation, c=np.arange(len(azimuth)), cmap="autumn", s=26, edgecolors=DARK, linewidths=0.6, zorder=3
    )
    for k in range(min(len(azimuth), 6)):
        axes.annotate(
            str(k),
            (azimuth[k], elevation[k]),
            textcoords="offset points",
            xytext=(5, 4),
            fontsize=9,
            color="white",
            bbox={"boxstyle": "round,pad=0.12", "fc": DARK, "ec": "none", "alpha": 0.75},
        )


def draw_episode(path: Path, episode: Episode, retina: Retina, title: str) -> None:
    """Draw an episode: images, what the retina keeps, disparity, the memory with the scan path, the curves.

    Args:
        path: the PNG to write.
        episode: from `torchfovea.episode.run_episode`; without images the top row is left out.
        retina: of both eyes.
        title: the headline.
    """
    shown = episode.look.pictures
    rows = ([1.0] if shown is not None else []) + [1.0, 0.62]
    figure = Figure(figsize=(15, 4.5 * sum(rows)), layout="constrained")
    figure.suptitle(title, fontsize=15)
    parts = iter(figure.subfigures(len(rows), 1, height_ratios=rows, squeeze=False)[:, 0])
    if shown is not None:
        row = next(parts).subplots(1, 4)
        left, right = shown.left.detach().cpu().float(), shown.right.detach().cpu().float()
        for axes, picture, name in zip(
            row,
            (left.movedim(0, -1), right.movedim(0, -1), kept(left, retina).movedim(0, -1)),
            ("left eye", "right eye", "what the left retina keeps"),
            strict=False,
        ):
            axes.imshow(np.asarray(picture).clip(0, 1))
            axes.set_title(f"{name} (last fixation at +)")
            _cross(axes, np.asarray(picture).shape[:2])
        row[3].set_facecolor("0.85")
        if isinstance(shown.found, Disparity | SweepRange):  # a user's own matcher may show nothing
            values, name = found_map(shown.found, retina, left.shape[-1])
            drawn = row[3].imshow(values, cmap="viridis")
            row[3].set_title(name)
            figure.colorbar(drawn, ax=row[3], pad=0.015)
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
    memory, points = episode.step.memory, episode.step.points
    seen = memory.looks > 0
    row = next(parts).subplots(1, 2)
    distance = torch.where(seen, points.mean.norm(dim=-1), torch.nan)
    nats = information(points.cov)
    sphere_map(row[0], memory.cells, distance, "range [m]", "viridis_r", (0.4, 4.0))
    low, high = (float(q) for q in torch.quantile(nats.double(), torch.tensor([0.02, 0.98], dtype=torch.float64)))
    sphere_map(row[1], memory.cells, nats, "information [nats]", "magma", (low, max(high, low + 1e-3)))
    for axes, name in zip(row, ("memory: range of the seen cells", "memory: information"), strict=True):
        axes.set_title(f"{name}, fixations in order")
        axes.set_facecolor("0.9")
        _scan_path(axes, episode)
    row = next(parts).subplots(1, 3)
    t = np.arange(1, len(episode.gap) + 1)
    row[0].plot(t, episode.gap, color="tab:blue", marker=".")
    row[0].set(title="gap (Eq. 46)", ylabel="gap, 0 to 1", ylim=(-0.05, 1.05))
    row[1].plot(t, episode.regret, color="tab:red", marker=".")
    row[1].set(title="regret (Eq. 50)", ylabel="regret [m]")
    row[2].plot(t, episode.global_information, color="#0072B2", marker=".", label="global (Eq. 52)")
    if episode.local_information is not None:
        row[2].plot(
            t, episode.local_information, color="#D55E00", marker="^", ls="--", label="near the target (Eq. 54)"
        )
    row[2].set(title="information", ylabel="information [nats]")
    row[2].legend()
    for axes in row:
        axes.set_xlabel("fixation t")
        axes.grid(alpha=0.3)
    write_figure(path, figure, dpi=100)
