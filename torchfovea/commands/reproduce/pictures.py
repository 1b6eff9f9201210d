"""The pictures of a reproduction, in the paper's layout; matplotlib is imported in the pictures' modules alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch

from torchfovea.files import write_figure
from torchfovea.studies.significance import bootstrap_interval

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["draw_ablation", "draw_arms", "draw_biases", "draw_course", "draw_vergences"]

Rows = Sequence[Mapping[str, Any]]

PANELS = (
    ("gap_per_saccade", "gap", "gap reduction G/S (Eq. 49)"),
    ("regret_per_saccade", "regret", "cumulative regret R/S (Eq. 51) [m]"),
    ("global_information_per_saccade", "global_information", "global information GI/S (Eq. 53) [nats]"),
    ("local_information_per_saccade", "local_information", "local information LI/S (Eq. 55) [nats]"),
)
# after Okabe and Ito: told apart by every eye; the dashes tell them apart in grey
BLUE, SKY, VERMILION, ORANGE, GREEN = "#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#009E73"
COLOURS = {("log_polar", 90): BLUE, ("log_polar", 135): SKY, ("uniform", 90): VERMILION, ("uniform", 135): ORANGE}
BIASES = {"unbiased": "0.4", "top": VERMILION, "down": BLUE, "target": GREEN, "aimed": GREEN}
DASHES = ("-", "--", "-.", ":")


def _interval(values: Sequence[float]) -> tuple[float, float, float]:
    x = torch.tensor(values, dtype=torch.float64)
    if len(x) < 2:
        return (float(x.mean()) if len(x) else math.nan,) * 3
    return tuple(float(v) for v in bootstrap_interval(x, torch.Generator().manual_seed(0), resamples=2000))  # type: ignore[return-value]


def _band(rows: Rows, name: str) -> tuple[np.ndarray, ...] | None:
    curves = [row["curves"][name] for row in rows if row.get("curves") and row["curves"][name] is not None]
    if len(curves) < 2:
        return None
    found = bootstrap_interval(torch.tensor(curves), torch.Generator().manual_seed(0), resamples=1000)
    return tuple(np.asarray(part) for part in found)


def _label(arm: str) -> str:
    if arm.startswith("ucb_") and arm != "ucb_cost":
        return "α=" + arm.removeprefix("ucb_").replace("inf", "∞")
    return {"pi": "PI", "ei": "EI"}.get(arm, arm.replace("_", " "))


def _panels(title: str) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(13, 8), layout="constrained")
    figure.suptitle(title)
    return figure, list(figure.subplots(2, 2).flat)


def _legend_below(axes: Axes) -> None:
    """A legend that covers no curve, below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    if handles and isinstance(axes.figure, Figure):
        axes.figure.legend(handles, labels, fontsize=9, ncols=len(handles), loc="outside lower center")


def draw_arms(path: Path, rows: Rows, title: str) -> None:
    """Fig. 8a: the four metrics per saccade over the arms, for both sensors and fields of view, mean with 95% CI."""
    arms = list(dict.fromkeys(row["arm"] for row in sorted(rows, key=lambda r: _order(r["arm"]))))
    figure, panels = _panels(title)
    for axes, (metric, _, name) in zip(panels, PANELS, strict=True):
        for k, ((sensor, fov), colour) in enumerate(COLOURS.items()):
            own = [row for row in rows if (row["sensor"], row["fov_deg"]) == (sensor, fov)]
            for x, arm in enumerate(arms):
                values = [row[metric] for row in own if row["arm"] == arm and row[metric] is not None]
                if not values:
                    continue
                mean, low, high = _interval(values)
                label = f"{sensor.replace('_', '-')}, {fov}°" if x == 0 else None
                axes.errorbar(
                    x + 0.14 * (k - 1.5), mean, [[max(mean - low, 0)], [max(high - mean, 0)]], fmt="o", color=colour,
                    ms=4, capsize=2, label=label,
                )  # fmt: skip
        axes.set_xticks(range(len(arms)), [_label(arm) for arm in arms], rotation=45, ha="right")
        axes.set(xlabel="strategy", ylabel=name)
        axes.grid(axis="y", alpha=0.3)
    _legend_below(panels[0])
    write_figure(path, figure, dpi=75)


def _order(arm: str) -> tuple[int, float, str]:
    if arm.startswith("ucb_") and arm != "ucb_cost":
        return 0, float(arm.removeprefix("ucb_")), arm
    return {"pi": 1, "ei": 2}.get(arm, 3), 0.0, arm


def draw_course(path: Path, groups: Mapping[str, tuple[str, Rows]], title: str) -> None:
    """Figs. 8b and 9b: the four metrics over time, mean with a band of 95% CI; groups are label: (colour, rows)."""
    figure, panels = _panels(title)
    for axes, (_, curve, name) in zip(panels, PANELS, strict=True):
        for dash, (label, (colour, rows)) in zip(cycle(DASHES), groups.items(), strict=False):
            band = _band(rows, curve)
            if band is None:
                continue
            t = np.arange(1, len(band[0]) + 1)
            axes.plot(t, band[0], dash, color=colour, label=label)
            axes.fill_between(t, band[1], band[2], color=colour, alpha=0.18, lw=0)
        axes.set(xlabel="saccade t", ylabel=name.replace("/S", "").replace(" (Eq. 49)", "").replace(" (Eq. 51)", ""))
        axes.grid(alpha=0.3)
    _legend_below(panels[0])
    write_figure(path, figure, dpi=75)


def draw_biases(path: Path, rows: Rows, title: str) -> None:
    """Fig. 9a: the four metrics per saccade over the biases, mean with 95% CI."""
    figure, panels = _panels(title)
    for axes, (metric, _, name) in zip(panels, PANELS, strict=True):
        biases = [bias for bias in BIASES if any(row["bias"] == bias for row in rows)]
        for x, bias in enumerate(biases):
            values = [row[metric] for row in rows if row["bias"] == bias and row[metric] is not None]
            if values:
                mean, low, high = _interval(values)
                axes.bar(x, mean, color=BIASES[bias], alpha=0.75)
                axes.errorbar(x, mean, [[max(mean - low, 0)], [max(high - mean, 0)]], color="0.1", capsize=4)
        axes.set_xticks(range(len(biases)), biases)
        axes.set(xlabel="bias of the memory", ylabel=name)
        axes.grid(axis="y", alpha=0.3)
    write_figure(path, figure, dpi=75)


def draw_vergences(path: Path, curves: Mapping[str, Any]) -> None:
    """Fig. 5b: information over vergence for planes at several distances; dots are the matched vergences."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots()
    degrees = torch.rad2deg(curves["vergence_rad"])
    shades = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(curves["distance_m"])))
    for i, (d, colour) in enumerate(zip(curves["distance_m"].tolist(), shades, strict=True)):
        axes.plot(degrees, curves["log_polar"][i], "-", color=colour, label=f"{d:g} m")
        axes.plot(degrees, curves["uniform"][i], "--", color=colour)
        axes.axvline(math.degrees(float(curves["matched_rad"][i])), color=colour, lw=0.6, ls=":")
    axes.set(xlabel="vergence [°]", ylabel="mean information (Eq. 45) [nats]")
    axes.set_title("log-polar (solid), uniform (dashed), matched vergences (dotted)", fontsize=10)
    axes.legend(fontsize=8, title="distance", loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.grid(alpha=0.3)
    write_figure(path, figure, dpi=75)


def draw_ablation(path: Path, table: Sequence[tuple[str, float, float, float]]) -> None:
    """Changes and what each does to the gap per saccade: name, difference, interval."""
    figure = Figure(figsize=(9, 0.6 + 0.38 * len(table)), layout="constrained")
    axes = figure.subplots()
    for y, (_, mean, low, high) in enumerate(table):
        axes.errorbar(
            mean, -y, xerr=[[max(mean - low, 0)], [max(high - mean, 0)]], fmt="o", color="tab:blue", capsize=3
        )
    axes.axvline(0, color="0.3", lw=0.8)
    axes.set_yticks([-y for y in range(len(table))], [name for name, *_ in table])
    axes.set_xlabel("gap per saccade, less that of the defaults")
    axes.grid(axis="x", alpha=0.3)
    write_figure(path, figure, dpi=75)
