"""The picture of an episode: what the eyes saw, what the memory holds, it all from outside, the curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import torch

from torchfovea.commands.shared.pictures import azimuth_elevation, found_map, inner_limits, sphere_map
from torchfovea.episode import Episode
from torchfovea.files import write_figure
from torchfovea.metrics import information
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import kept
from torchfovea.sim.model import Scene
from torchfovea.sim.room import FLOOR, ROOM, TARGET, Solid
from torchfovea.stereo.sweep import SweepRange

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

__all__ = ["draw_episode", "draw_outside", "outline"]

DARK = "0.15"
SPHERE_M = 0.4  # radius at which the memory's cells are drawn
CORNERS = 20  # of a round thing
NEAR_M = (-0.6, 2.6)  # what is drawn of the room, ahead; half as wide to either side


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
            str(k + 1),  # as the curves count them
            (azimuth[k], elevation[k]),
            textcoords="offset points",
            xytext=(5, 4),
            fontsize=9,
            color="white",
            bbox={"boxstyle": "round,pad=0.12", "fc": DARK, "ec": "none", "alpha": 0.75},
        )


def outline(solid: Solid) -> np.ndarray:
    """Faces of a solid in the world, (F, V, 3) [m]: a box's six, the sides of a round thing (a ball's as a barrel)."""
    size = solid.size_m
    if solid.shape == "box":
        x, y, z = size
        corner = np.array([[a, b, c] for a in (-x, x) for b in (-y, y) for c in (-z, z)])
        faces = corner[[[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]]
    else:
        angle = np.linspace(0, 2 * np.pi, CORNERS + 1)
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        up = np.array([0.0, 0.0, size[-1]])
        faces = np.stack([ring[:-1] - up, ring[1:] - up, ring[1:] + up, ring[:-1] + up], 1)
    c, s = np.cos(solid.yaw_rad), np.sin(solid.yaw_rad)
    placed: np.ndarray = faces @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + solid.position_m
    return placed


def draw_outside(figure: Figure | SubFigure, place: int, episode: Episode, scene: Scene) -> None:
    """The robot from outside, as the paper's Fig. 6: things, the memory's cells around E, the eyes and where they look.

    Args:
        figure: where it is drawn.
        place: a subplot's three digits.
        episode: whose last gaze and memory are shown.
        scene: the things, and where the robot stands.
    """
    axes = figure.add_subplot(place, projection="3d", computed_zorder=False)
    rotation, translation = scene.world_from_ego
    low, high = NEAR_M
    half = (high - low) / 2
    for solid in scene.solids:
        if solid.kind in (FLOOR, ROOM):
            continue
        faces = (outline(solid) - translation) @ rotation
        x, y, _ = faces.mean((0, 1))
        if not (low < x < high and abs(y) < half):
            continue
        sought = solid.kind == TARGET
        edge = "black" if sought else (0.0, 0.0, 0.0, 0.15)
        axes.add_collection3d(
            Poly3DCollection(faces, facecolors="gold" if sought else solid.base, edgecolors=edge, linewidths=0.4)
        )
    memory = episode.step.memory
    seen = (memory.looks > 0).cpu()
    cells = SPHERE_M * memory.cells.detach().cpu()
    axes.scatter(*cells[~seen].T, s=1, color="0.75", zorder=2)
    distance = episode.step.points.mean.detach().cpu().norm(dim=-1)[seen]
    axes.scatter(*cells[seen].T, s=3, c=distance, cmap="viridis_r", vmin=0.4, vmax=4.0, zorder=3)
    assert isinstance(scene.head, Head)
    pose = eyes(scene.head, Gaze(*(angle[-1] for angle in episode.gaze)))
    met = episode.direction[-1] * episode.range_m[-1]
    for eye, colour in ((pose.t_left, "#0072B2"), (pose.t_right, "#D55E00")):
        axes.plot(*torch.stack([eye.to(met), met]).T, color=colour, lw=1.4, zorder=5)
        axes.plot(*eye[:, None], marker="o", ms=5, color=colour, zorder=5)
    axes.plot(*met[:, None], marker="x", ms=8, mew=2, color="black", zorder=6)
    floor = -scene.head.ego_height_m
    axes.set(xlim=(low, high), ylim=(-half, half), zlim=(floor, floor + half))
    axes.set_box_aspect((2, 2, 1), zoom=1.35)
    axes.view_init(elev=30, azim=-130)
    axes.set(xlabel="ahead [m]", ylabel="left [m]", zlabel="up [m]")
    axes.zaxis.labelpad = 0  # layouts do not see what stands beside axes in space
    axes.set_title("from outside: cells, gaze, target (gold)")


def draw_episode(path: Path, episode: Episode, retina: Retina, title: str, scene: Scene) -> None:
    """Draw an episode: images, what the retina keeps, disparity, memory and scan path, all from outside, curves.

    Args:
        path: the PNG to write.
        episode: from `torchfovea.episode.run_episode`; without images the top row is left out.
        retina: of both eyes.
        title: the headline.
        scene: where the robot stands at the end.
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
    part = next(parts)
    row = [part.add_subplot(1, 3, k) for k in (1, 2)]
    draw_outside(part, 133, episode, scene)
    distance = torch.where(seen, points.mean.norm(dim=-1), torch.nan)
    nats = information(points.cov)
    sphere_map(row[0], memory.cells, distance, "range [m]", "viridis_r", (0.4, 4.0))
    sphere_map(row[1], memory.cells, nats, "information [nats]", "magma", inner_limits(nats))
    for axes, name in zip(row, ("range, and the fixations in order", "information"), strict=True):
        axes.set_title(f"memory: {name}")
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
