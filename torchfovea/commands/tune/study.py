"""The studies of `torchfovea tune`: learning curves at equal episodes, and gradients against finite differences.

Both go on where they stopped: whatever a table in the run's folder holds whole is not made again.
"""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.shared.screen import progress_bar
from torchfovea.commands.shared.settings import whole
from torchfovea.files import write_csv, write_tensors
from torchfovea.setting import SettingError, require
from torchfovea.tuning.baselines import TABLE_1, table_1
from torchfovea.tuning.check import Sample, agreement, estimate_gradient, finite_differences, slope_along
from torchfovea.tuning.problem import Problem
from torchfovea.tuning.study import (
    Heldout,
    Row,
    budgets_up_to,
    check_methods,
    curves,
    episodes_to_reach,
    mean_curves,
    student,
)
from torchfovea.tuning.train import ESTIMATORS, Schedule, State
from torchfovea.untrusted import read_tensors

__all__ = ["check_study", "study_curves", "study_gradients"]

_MARGIN = 0.03  # above the best of Table 1: the level whose episodes are compared
_SUMMARY_COLUMNS = (
    "method", "episodes", "seeds", "heldout", "low", "high", "gap_closed", "closed_low", "closed_high",
)  # fmt: skip
# `ratio`: of the first method's episodes to this one's, the median and ends of its bootstrap over seeds
_REACH_COLUMNS = ("method", "level", "episodes", "low", "high", "ratio_low", "ratio", "ratio_high")
_GRADIENT_COLUMNS = (
    "point", "estimator", "cosine", "cosine_without_noise", "norm_ratio", "norm_ratio_error", "norm", "norm_error",
    "snr_32_episodes",
)  # fmt: skip


def _read(path: Path, columns: tuple[str, ...]) -> list[list[str]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    good = bool(rows) and tuple(rows[0]) == columns and all(len(row) == len(columns) for row in rows)
    require(good, str(path), "another table", "the columns " + ", ".join(columns) + "; remove it to begin anew")
    return rows[1:]


def check_study(cfg: DictConfig) -> None:
    """Raise SettingError for a study, a method or an estimator that there is none of."""
    require(cfg.study in (None, "curves", "gradients"), "study", cfg.study, "null, curves or gradients")
    whole(cfg, "seeds")
    check_methods([str(method) for method in cfg.methods])
    for name in cfg.estimators:
        require(name in ESTIMATORS, "estimators", name, "any of " + ", ".join(ESTIMATORS))


def study_curves(
    cfg: DictConfig, problem: Problem, start: Tensor, schedule: Schedule, heldout: Heldout, folder: Path,
    figures: dict[str, Any],
) -> list[Row]:  # fmt: skip
    """Curves of the methods asked for; adds what they come to, to the figures, which hold the hand-made biases'."""
    methods, seeds = [str(method) for method in cfg.methods], whole(cfg, "seeds")
    path, budgets = folder / "curves.csv", budgets_up_to(schedule.episodes)
    try:
        kept = [Row(m, int(s), int(e), *map(float, rest)) for m, s, e, *rest in _read(path, Row._fields)]
    except ValueError as error:
        raise SettingError(f"{path} = {error}: expected numbers; remove it to begin anew") from None
    whole_ones = Counter((row.method, row.seed) for row in kept)
    done = {pair for pair, count in whole_ones.items() if count == len(budgets)}
    rows = [row for row in kept if (row.method, row.seed) in done]
    with progress_bar() as bar:
        job = bar.add_task("study", total=len(methods) * seeds, completed=len(done))

        def show(method: str, seed: int) -> None:
            bar.update(job, description=f"study  {method}, seed {seed + 1} of {seeds}")

        for curve in curves(problem, start, methods, seeds, schedule, heldout, done, show):
            rows += curve
            write_csv(path, Row._fields, rows)
            bar.update(job, advance=1)
    _summarize([row for row in rows if row.method in methods and row.seed < seeds], methods, folder, figures)
    return rows


def _summarize(rows: list[Row], methods: list[str], folder: Path, figures: dict[str, Any]) -> None:
    """Write curves_summary.csv and reach.csv: mean curves, and episodes to the best of Table 1 plus a margin."""
    scored = {name: float(figures[f"heldout.{name}.gap_per_saccade"]) for name in (*TABLE_1, "hand")}
    best, hand = max(scored[name] for name in TABLE_1), scored["hand"]
    level, by_method = best + _MARGIN, mean_curves(rows)
    summary, reach, samples = [], [], {}
    for method in methods:
        for budget, values in by_method[method].items():
            mean, low, high = student(values)
            closed = student([(v - best) / (hand - best) for v in values]) if hand > best else (None,) * 3
            summary.append((method, budget, len(values), mean, low, high, *closed))
        found = episodes_to_reach(by_method[method], level)
        samples[method] = found["samples"]
        with np.errstate(invalid="ignore"):
            ratio = np.sort(samples[methods[0]] / np.random.default_rng(1).permutation(samples[method]))
        ends = [float(ratio[int(q * len(ratio))]) for q in (0.025, 0.5, 0.975)]
        reach.append((method, level, found["episodes"], found["low"], found["high"], *ends))
        figures[f"curves.{method}.heldout"], figures[f"curves.{method}.gap_closed"] = summary[-1][3], summary[-1][6]
        figures[f"curves.{method}.episodes_to_best_of_table_1_plus_{_MARGIN}"] = found["episodes"]
    write_csv(folder / "curves_summary.csv", _SUMMARY_COLUMNS, summary)
    write_csv(folder / "reach.csv", _REACH_COLUMNS, reach)


def study_gradients(
    cfg: DictConfig, problem: Problem, start: Tensor, state: State, episodes: int, folder: Path
) -> list[dict[str, Any]]:
    """Estimators against differences at the start, at Table 1's Target and in the middle of the tuning run.

    The reference's component along the first estimator is measured with twelve times as many episodes a side, in one
    go, so that a ratio of norms can be told from 1.
    """
    names = [str(name) for name in cfg.estimators]
    middle = torch.tensor(state.history[len(state.history) // 2][2], dtype=torch.float64)
    target = table_1(problem.shape, "target", float(cfg.acquisition.alpha))
    checks = []
    with progress_bar() as bar:
        job = bar.add_task("gradients", total=3 * (len(names) + 2))

        def made(name: str, make: Any) -> Sample:
            path = folder / "gradients" / f"{name}.pt"
            bar.update(job, advance=1, description=f"gradients  {name}")
            if not path.exists():
                write_tensors(path, tuple(make()))
            try:
                parts, spent = read_tensors(path)
                return Sample(parts.double(), float(spent))
            except (ValueError, TypeError, AttributeError) as error:
                expected = f"a gradient; remove it to estimate it again ({error})"
                raise SettingError(f"gradients = {path}: expected {expected}") from error

        for point, x in (("start", start), ("target", target), ("middle", middle)):
            difference = made(f"{point}_differences", lambda x=x: finite_differences(problem, x, episodes))
            found = {
                name: made(f"{point}_{name}", lambda x=x, name=name: estimate_gradient(problem, x, name, episodes))
                for name in names
            }
            unit = torch.nn.functional.normalize(found[names[0]].mean, dim=0)
            slope = made(f"{point}_along", lambda x=x, unit=unit: slope_along(problem, x, unit, 12 * episodes))
            for name, sample in found.items():
                judged = agreement(sample, difference, (unit, slope))
                checks.append({"point": point, "estimator": name} | judged)
    write_csv(
        folder / "gradients.csv", _GRADIENT_COLUMNS, [tuple(check[c] for c in _GRADIENT_COLUMNS) for check in checks]
    )
    return checks
