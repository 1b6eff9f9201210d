"""Pictures of `torchfovea characterize`: layouts, information over distance and vergence, propagation, errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import torch
from torch import Tensor

from torchfovea.files import write_figure
from torchfovea.sensing.layout import Retina
from torchfovea.studies.characterization import Characterization, matched_vergence
from torchfovea.studies.realised import Ring

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

__all__ = ["draw_advantage", "draw_fig5", "draw_layouts", "draw_propagation", "draw_realised"]

STYLE = {"log_polar": "-", "uniform": "--"}
COLOUR = {"log_polar": "tab:blue", "uniform": "tab:orange"}
NAME = {"log_polar": "log-polar", "uniform": "uniform"}
WAYS = {
    "first_order": "first order",
    "ut_paper": "unscented, the paper's weights",
    "ut_default": "unscented, ours",
}


def draw_layouts(path: Path, retinas: Mapping[str, Retina], sigma_over_width: float) -> None:
    """Draw receptive fields as circles of three standard deviations (paper Fig. 3).

    Args:
        path: the PNG to write.
        retinas: by title.
        sigma_over_width: standard deviation over width.
    """
    figure = Figure(figsize=(5 * len(retinas), 5.4), layout="constrained")
    for axes, (title, retina) in zip(figure.subplots(1, len(retinas), squeeze=False)[0], retinas.items(), strict=True):
        px = retina.centers_px(dtype=torch.float64)
        across = 6 * sigma_over_width * np.asarray(retina.width_px(px))
        axes.add_collection(
            EllipseCollection(
                across, across, np.zeros(len(px)), units="xy", offsets=np.asarray(px), offset_transform=axes.transData,
                facecolors="none", edgecolors="tab:blue", linewidths=0.5,
            )
        )  # fmt: skip
        axes.plot(*np.asarray(px).T, ".", color="0.3", ms=1.2)
        limit = 1.06 * retina.radius_px
        axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="x [px]", ylabel="y [px]")
        axes.set_title(f"{title}: {retina.count} receptive fields, 3σ")
    write_figure(path, figure, dpi=90)


def _nats(grid: Characterization) -> np.ndarray:
    return np.where(np.asarray(grid.matched_fraction) > 0, np.asarray(grid.information), np.nan)


def _curves(axes: Axes, grids: Mapping[str, Characterization], over: str) -> None:
    first = next(iter(grids.values()))
    distance, vergence = np.asarray(first.distance_m), np.rad2deg(np.asarray(first.vergence_rad))
    x, rows, label = (distance, vergence, "{:.0f}°") if over == "distance" else (vergence, distance, "{:.2g} m")
    picks = sorted({round(i) for i in np.linspace(0, len(rows) - 1, min(6, len(rows)))})
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(picks)))
    for sensor, grid in grids.items():
        nats = _nats(grid) if over == "vergence" else _nats(grid).T
        for colour, k in zip(colours, picks, strict=True):
            name = label.format(rows[k]) if sensor == "log_polar" else None
            axes.plot(x, nats[k], STYLE[sensor], color=colour, lw=1.6, label=name)
    axes.set_ylabel("mean information over matched RFs [nats]")
    axes.grid(alpha=0.3)
    title = "vergence" if over == "distance" else "distance"
    axes.legend(title=title, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))


def draw_fig5(path: Path, grids: Mapping[str, Characterization], baseline_m: float, title: str) -> None:
    """Draw the paper's two panels and the maps over distance and vergence.

    Args:
        path: the PNG to write.
        grids: of `log_polar` and `uniform`, on one grid.
        baseline_m: for the curve of matched vergences.
        title: the headline.
    """
    figure = Figure(figsize=(15, 9.8), layout="constrained")
    figure.suptitle(title, fontsize=14)
    above, below = figure.subfigures(2, 1, squeeze=False)[:, 0]
    a, b = above.subplots(1, 2)
    _curves(a, grids, "distance")
    a.set(xlabel="distance [m]", title="a: over distance (solid log-polar, dashed uniform)")
    _curves(b, grids, "vergence")
    b.set(xlabel="vergence [°]", title="b: over vergence (solid log-polar, dashed uniform)")
    nats = {sensor: _nats(grid) for sensor, grid in grids.items()}
    finite = np.concatenate([v[np.isfinite(v)] for v in nats.values()] or [np.zeros(1)])
    low, high = (np.quantile(finite, q) for q in (0.01, 0.99)) if len(finite) else (0.0, 1.0)
    gap = nats["log_polar"] - nats["uniform"]
    most = max(float(np.nanmax(np.abs(gap), initial=0.0)), 1e-3)
    fraction = np.asarray(grids["log_polar"].matched_fraction)
    maps: Sequence[tuple[str, np.ndarray, str, tuple[float, float]]] = (
        ("log-polar [nats]", nats["log_polar"], "viridis", (low, high)),
        ("uniform [nats]", nats["uniform"], "viridis", (low, high)),
        ("log-polar less uniform [nats]", gap, "RdBu_r", (-most, most)),
        ("log-polar: share of RFs matched", fraction, "magma", (0.0, 1.0)),
    )
    first = grids["log_polar"]
    distance, vergence = np.asarray(first.distance_m), np.rad2deg(np.asarray(first.vergence_rad))
    fine = np.linspace(distance[0], distance[-1], 200)
    matched = np.rad2deg(np.asarray(matched_vergence(baseline_m, torch.from_numpy(fine))))
    for axes, (name, values, cmap, limits) in zip(below.subplots(1, 4, sharey=True), maps, strict=True):
        axes.set_facecolor("0.85")
        drawn = axes.pcolormesh(
            distance, vergence, values.T, cmap=cmap, vmin=limits[0], vmax=limits[1], shading="nearest"
        )
        axes.plot(fine, matched, color="white", lw=2.4)
        axes.plot(fine, matched, color="black", lw=1.0, ls=":")
        axes.set(xlabel="distance [m]", title=name, ylim=(vergence[0], vergence[-1]))
        below.colorbar(drawn, ax=axes, pad=0.015)
    below.axes[0].set_ylabel("vergence [°] (dotted: axes meet on the plane)")
    write_figure(path, figure, dpi=100)


def draw_advantage(path: Path, distance_m: Tensor, rows: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> None:
    """Draw the foveal sensor's advantage at the matched vergence.

    Args:
        path: the PNG to write.
        distance_m: (D,).
        rows: by reading: the advantage as a plain mean over RFs and weighted by solid angle, D each.
    """
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    colours = matplotlib.colormaps["plasma"](np.linspace(0, 0.85, len(rows)))
    for axes, column, name in zip(
        figure.subplots(1, 2, sharey=True), (0, 1), ("mean over RFs (Eq. 45)", "weighted by solid angle"), strict=True
    ):
        for colour, (reading, values) in zip(colours, rows.items(), strict=True):
            axes.plot(distance_m, np.array(values[column], dtype=float), color=colour, marker=".", label=reading)
        axes.axhline(0, color="0.4", lw=0.8)
        axes.set(xlabel="distance [m]", title=name)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("log-polar less uniform, matched vergence [nats]")
    figure.axes[1].legend(fontsize=8)
    write_figure(path, figure, dpi=90)


def draw_propagation(
    path: Path, ratios: Sequence[float], worst: Mapping[tuple[str, str], Sequence[Sequence[float]]]
) -> None:
    """Draw the errors of each way of propagation over e.

    Args:
        path: the PNG to write.
        ratios: e = σ_D/D.
        worst: by chart and way, for each ratio the worst error of the range's variance, of the covariance, of the mean.
    """
    charts = list(dict.fromkeys(chart for chart, _ in worst))
    ways = list(dict.fromkeys(way for _, way in worst))
    names = ("range variance (relative)", "covariance (whitened Frobenius/√3)", "mean [standard deviations]")
    figure = Figure(figsize=(14, 4.2 * len(charts)), layout="constrained")
    panels = figure.subplots(len(charts), 3, squeeze=False, sharey="row")
    for row, chart in zip(panels, charts, strict=True):
        for k, axes in enumerate(row):
            for way, marker in zip(ways, "osd^v", strict=False):
                axes.plot(ratios, [v[k] for v in worst[chart, way]], marker=marker, label=WAYS.get(way, way))
            title = f"{chart.replace('_', ' ')}: {names[k]}"
            axes.set(yscale="log", ylim=(1e-4, 1), xlabel="e = σ_D/D", title=title)
            if k < 2:
                axes.axhline(0.02, color="0.4", ls=":", lw=1)
            axes.grid(alpha=0.3, which="both")
        row[0].set_ylabel("worst error against Monte Carlo")
    panels[0, 0].legend(fontsize=8)
    write_figure(path, figure, dpi=100)


def draw_realised(
    path: Path, edges_deg: Sequence[float], rings: Mapping[tuple[str, int], Sequence[Ring]], title: str
) -> None:
    """Draw actual and predicted errors over eccentricity.

    Args:
        path: the PNG to write.
        edges_deg: of the rings.
        rings: by sensor and source_px.
        title: the headline.
    """
    sizes = sorted({size for _, size in rings})
    figure = Figure(figsize=(min(5.4 * len(sizes), 15), 5.2), layout="constrained")
    figure.suptitle(title)
    place = np.arange(len(edges_deg) - 1)
    labels = [f"{low:.3g}-{high:.3g}" for low, high in pairwise(edges_deg)]
    kinds = (
        ("error_m", "-", 2.2, "actual"),
        ("predicted_m", "--", 1.4, "predicted"),
        ("printed_m", ":", 1.4, "printed"),
    )
    for axes, size in zip(figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0], sizes, strict=True):
        for sensor in STYLE:
            series: list[Ring] = list(rings[sensor, size])
            for field, style, width, label in kinds:
                values = [1e3 * getattr(r, field) if r.matched_fraction > 0 else math.nan for r in series]
                name = f"{NAME[sensor]}, {label}"
                axes.plot(place, values, style, lw=width, marker=".", color=COLOUR[sensor], label=name)
        axes.set(yscale="log", xlabel="eccentricity [°]", title=f"source image {size} px")
        axes.set_xticks(place, labels)
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("median |range error| [mm]")
    handles, names = figure.axes[-1].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=9, loc="outside lower center", ncols=2 if len(sizes) == 1 else len(names))
    write_figure(path, figure, dpi=90)
