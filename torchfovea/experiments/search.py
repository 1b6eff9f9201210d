"""`torchfovea search`: visual-search episodes, their figures, tables and a picture (paper Sec. 7.2)."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from torchfovea.config import run_folder
from torchfovea.episode import Episode, Look, run_episode
from torchfovea.experiments.build import build_arena, build_cells, build_observer, number, whole
from torchfovea.files import write_csv, write_result
from torchfovea.perception import Step, new_mind

__all__ = ["EPISODE_COLUMNS", "SACCADE_COLUMNS", "episode_row", "run", "saccade_rows", "summarize"]

EPISODE_COLUMNS = (
    "episode", "seed", "gap_final", "gap_per_saccade", "regret_per_saccade", "global_information_per_saccade",
    "local_information_per_saccade", "saccades_to_target", "found", "target_error_m", "degrees_travelled",
    "motor_seconds", "seconds_per_saccade",
)  # fmt: skip
SACCADE_COLUMNS = (
    "episode", "saccade", "pan_rad", "tilt_rad", "vergence_rad", "range_m", "reward", "gap", "regret",
    "global_information", "local_information",
)  # fmt: skip


def run(cfg: DictConfig) -> float:
    """Run the episodes of a configuration; the mean gap per saccade is what a sweeper sees."""
    episodes, saccades, seed = whole(cfg, "episodes"), whole(cfg, "saccades"), whole(cfg, "seed", 0)
    observer, folder = build_observer(cfg), run_folder()
    far_m, near_target_m = number(cfg, "far_m"), number(cfg, "near_target_m")
    rows: list[tuple[Any, ...]] = []
    steps: list[tuple[Any, ...]] = []
    last: Episode | None = None
    bars = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*bars, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("search", total=episodes * saccades)
        for k in range(episodes):
            generator = torch.Generator().manual_seed(seed + k)
            arena = build_arena(cfg, observer, seed + k)
            mind = new_mind(observer, build_cells(cfg, observer.head, generator))

            def show(t: int, look: Look, step: Step, k: int = k) -> None:
                progress.update(task, advance=1, description=f"episode {k + 1}/{episodes}")

            truth = arena.truth(mind.memory.cells)
            last = run_episode(observer, mind, arena, truth, saccades, generator, far_m, near_target_m, show)
            rows.append((k, seed + k, *episode_row(last)))
            steps.extend((k, *row) for row in saccade_rows(last))
    assert last is not None
    write_csv(folder / "episodes.csv", EPISODE_COLUMNS, rows)
    write_csv(folder / "saccades.csv", SACCADE_COLUMNS, steps)
    _draw(folder, cfg, observer.retina, last, rows[-1])
    figures = summarize(rows)
    write_result(folder, figures)
    _print(figures)
    return float(figures["gap_per_saccade"])


def episode_row(episode: Episode) -> tuple[Any, ...]:
    """An episode's figures, in the order of EPISODE_COLUMNS from gap_final on."""
    local = episode.local_information
    return (
        float(episode.gap[-1]), float(episode.gap.mean()), float(episode.regret.mean()),
        float(episode.global_information.mean()), None if local is None else float(local.mean()),
        episode.moves, int(episode.hit.any()), episode.target_error_m, episode.degrees, episode.motor_seconds,
        episode.compute_seconds,
    )  # fmt: skip


def saccade_rows(episode: Episode) -> list[tuple[Any, ...]]:
    """An episode's course, in the order of SACCADE_COLUMNS from saccade (counted from 1) on."""
    local = episode.local_information
    columns = (*episode.gaze, episode.range_m, episode.reward, episode.gap, episode.regret, episode.global_information)
    return [
        (t + 1, *(float(c[t]) for c in columns), None if local is None else float(local[t]))
        for t in range(len(episode.gap))
    ]


def summarize(rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Means over the episodes; a figure that some episode lacks is averaged over those that have it."""
    figures: dict[str, Any] = {}
    for name, values in zip(EPISODE_COLUMNS[2:], list(zip(*rows, strict=True))[2:], strict=True):
        known = [v for v in values if v is not None]
        figures[name] = statistics.fmean(known) if known else None
    figures["saccades_to_target_median"] = statistics.median(
        row[EPISODE_COLUMNS.index("saccades_to_target")] for row in rows
    )
    figures["episodes"] = len(rows)
    return figures


def _draw(folder: Path, cfg: DictConfig, retina: Any, episode: Episode, row: tuple[Any, ...]) -> None:
    from torchfovea.pictures import draw_episode

    moves = row[EPISODE_COLUMNS.index("saccades_to_target")]
    outcome = f"target fixated after {moves} saccades" if bool(episode.hit.any()) else "target not found"
    draw_episode(
        folder / "episode.png",
        episode,
        retina,
        f"{cfg.scene.name}, {cfg.sensor.layout}, {cfg.sensor.fov_deg:g}°: {outcome}",
    )


def _print(figures: dict[str, Any]) -> None:
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in figures.items():
        table.add_row(name, "-" if value is None else f"{value:.4g}")
    Console().print(table)
