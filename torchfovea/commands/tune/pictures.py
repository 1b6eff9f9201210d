"""Pictures of a tuning run: the bias on the sphere, learning curves, and the gradient against finite differences."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from torch import Tensor

from torchfovea.commands.shared.pictures import PALETTE
from torchfovea.files import write_figure
from torchfovea.tuning.cells import reachable
from torchfovea.tuning.density import log_density_each, log_normalizer_each
from torchfovea.tuning.problem import Problem
from torchfovea.tuning.scenes import Scenes, draw_scenes, stream
from torchfovea.tuning.study import Row, mean_curves, reads_scenes, student
from torchfovea.tuning.train import State

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

__all__ = ["draw_curves", "draw_gradients", "draw_tuning"]


def draw_tuning(
    folder: Path, problem: Problem, start: Tensor, state: State, checks: Sequence[dict[str, Any]], rows: Sequence[Row]
) -> None:
    """Draw bias.png and learning.png, and where there is something to draw, gradients.png and curves.png."""
    _draw_bias(folder / "bias.png", problem, start, state)
    _draw_learning(folder / "learning.png", state)
    if checks:
        draw_gradients(folder / "gradients.png", checks)
    if rows:
        draw_curves(folder / "curves.png", rows)


def _grid(problem: Problem) -> tuple[np.ndarray, np.ndarray, Tensor, Tensor]:
    azimuth, elevation = np.linspace(-65, 65, 131), np.linspace(-45, 35, 81)
    a, e = (torch.deg2rad(torch.tensor(g, dtype=problem.dtype)) for g in np.meshgrid(azimuth, elevation))
    direction = torch.stack((a.cos() * e.cos(), a.sin() * e.cos(), e.sin()), -1).reshape(-1, 3)
    return azimuth, elevation, direction, reachable(problem.task.observer.head, direction).reshape(a.shape)


def _draw_bias(path: Path, problem: Problem, start: Tensor, state: State) -> None:
    azimuth, elevation, direction, within = _grid(problem)
    middle = torch.tensor(state.history[len(state.history) // 2][2], dtype=torch.float64)
    scenes = draw_scenes(problem.distribution, problem.task.observer.head, 256, stream("validation", 0), problem.dtype)
    if problem.shape.conditioned:
        # one task: the scenes that have about it
        scenes = scenes._replace(task=torch.full_like(scenes.task, 0.5))
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    shown = []
    for ax, vector, title in zip(axes, (start, middle, state.best), ("before", "during", "after"), strict=True):
        with torch.no_grad():
            bias = problem.bias(vector, scenes.take(torch.arange(1)))
            density = log_density_each(bias, direction[None])[0] - log_normalizer_each(bias, problem.quadrature)
        shown.append(torch.where(within, density.exp().reshape(within.shape), torch.nan).numpy())
        ax.set(title=f"{title}, α = {float(bias.weights.alpha):.2f}", xlabel="azimuth [°] (left is positive)")
    most = max(float(np.nanmax(values)) for values in shown)
    for ax, values in zip(axes, shown, strict=True):
        drawn = ax.pcolormesh(azimuth, elevation, values, cmap="viridis", vmin=0, vmax=most, rasterized=True)
        _targets(ax, scenes)
        ax.invert_xaxis()
    figure.colorbar(drawn, ax=axes, label="share of cells per steradian", pad=0.01)
    axes[0].set_ylabel("elevation [°]")
    figure.suptitle(f"{problem.distribution.name}: density of memory cells, and where the nearest can stands (dots)")
    write_figure(path, figure, dpi=130)


def _targets(ax: Axes, scenes: Scenes) -> None:
    middle = (scenes.low + scenes.high)[:, 0] / 2
    flat = torch.hypot(scenes.x[:, 0], scenes.y[:, 0])
    azimuth = torch.rad2deg(torch.atan2(scenes.y[:, 0], scenes.x[:, 0]))
    ax.plot(azimuth, torch.rad2deg(torch.atan2(middle, flat)), ".", color="white", ms=3, mec="0.2", mew=0.3)


def _draw_learning(path: Path, state: State) -> None:
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    ax = figure.subplots()
    if state.curve:
        episodes, values = (np.array(c) for c in zip(*state.curve, strict=True))
        ax.plot(episodes, values, ".", color="0.75", ms=3, label="minibatch")
    ax.plot(
        [e for e, _, _ in state.history],
        [v for _, v, _ in state.history],
        "o-",
        color="tab:blue",
        ms=4,
        label="validation",
    )
    ax.axhline(state.best_value, color="tab:blue", lw=0.7, ls=":", label="best, kept")
    ax.set(xlabel="simulated episodes", ylabel="objective")
    ax.legend(frameon=False)
    write_figure(path, figure, dpi=130)


def draw_gradients(path: Path, checks: Sequence[dict[str, Any]]) -> None:
    """Each number's derivative, point by point: central differences beside the estimates."""
    points = list(dict.fromkeys(check["point"] for check in checks))
    size = len(checks[0]["difference"])
    figure = Figure(figsize=(min(max(7.6, 0.35 * size), 14), 2.6 * len(points)), layout="constrained")
    for ax, point in zip(np.atleast_1d(figure.subplots(len(points), 1, sharex=True)), points, strict=True):
        here = [check for check in checks if check["point"] == point]
        bars = [("central differences", "0.6", here[0]["difference"])]
        for colour, check in zip(cycle(PALETTE), here, strict=False):
            bars.append((f"{check['estimator']}, cosine {check['cosine']:.2f}", colour, check["estimate"]))
        width = 0.8 / len(bars)
        for k, (label, colour, values) in enumerate(bars):
            ax.bar(np.arange(size) + (k - (len(bars) - 1) / 2) * width, values, width, color=colour, label=label)
        ax.axhline(0, color="0.2", lw=0.6)
        ax.set(title=f"at {point}", ylabel="derivative")
        ax.legend(frameon=False, fontsize="small", ncols=2)
    ax.set_xlabel("number of the vector")
    write_figure(path, figure, dpi=130)


def draw_curves(path: Path, rows: Sequence[Row]) -> None:
    """Held-out score over episodes for each method: mean over seeds with its 95% interval (Student's t).

    Full lines read the training scenes, broken ones see nothing but their own episodes; each kind has a legend.
    """
    figure = Figure(figsize=(8.6, 4.6), layout="constrained")
    ax = figure.subplots()
    kinds: dict[bool, list[Line2D]] = {True: [], False: []}
    for k, (method, by_budget) in enumerate(mean_curves(rows).items()):
        mean, low, high = np.array([student(values) for values in by_budget.values()]).T
        budgets, colour, reads = list(by_budget), PALETTE[k % len(PALETTE)], reads_scenes(method)
        style, label = "o-" if reads else "s--", method.replace("_", " ").replace("+none", "")
        kinds[reads] += ax.plot(budgets, mean, style, ms=3.5, color=colour, label=label)
        ax.fill_between(budgets, low, high, color=colour, alpha=0.12, lw=0)
    ax.set(xscale="log", xlabel="simulated episodes, counterfactual runs and scenes that are read included",
           ylabel="held-out gap per saccade")  # fmt: skip
    budgets = sorted({row.episodes for row in rows})
    ax.set_xticks(budgets, [f"{budget:,}" for budget in budgets])
    ax.minorticks_off()
    if kinds[True]:
        figure.legend(handles=kinds[True], title="reads the scenes", loc="outside right upper", frameon=False)
    if kinds[False]:
        title = "sees its own\nepisodes alone"
        figure.legend(handles=kinds[False], title=title, loc="outside right lower", frameon=False)
    write_figure(path, figure, dpi=130)
