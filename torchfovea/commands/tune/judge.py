"""The policies of a tuning run: where it starts, what it is compared with, and all on the held-out scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.table import Table
from torch import Tensor

from torchfovea.commands.shared.settings import plain, whole
from torchfovea.commands.tune.files import write_memory
from torchfovea.memory.sphere import direction_mixture, sphere_quadrature
from torchfovea.setting import require
from torchfovea.studies.significance import bootstrap_interval
from torchfovea.tuning.baselines import TABLE_1, hand, table_1
from torchfovea.tuning.bias import Shape, encode
from torchfovea.tuning.cells import reachable
from torchfovea.tuning.prior_field import fit_by_gradient, fit_closed_form
from torchfovea.tuning.problem import Problem, evaluate_bias, evaluate_policies
from torchfovea.tuning.rivals import fitted_bias, remembered_bias
from torchfovea.tuning.scenes import draw_scenes, stream
from torchfovea.tuning.study import Heldout
from torchfovea.tuning.train import Schedule, State

__all__ = ["STARTS", "build_start", "judge_policies", "move_start"]

STARTS = ("memory", "hand", "fitted", "remembered")
RIVALS_HOW = {"fitted": "Fitted to the targets of", "remembered": "Refitted to its own best fixations on"}
_FIELD_SCENES = 512
_FIELD_DIRECTIONS = 4000  # on the whole sphere
_FIELD_ALPHAS = (0.1, 0.3, 1.0)


def build_start(cfg: DictConfig, shape: Shape) -> Tensor:
    """The vector of the bias `memory=...` with `acquisition.alpha`."""
    memory = plain(cfg.memory)
    complete = all(key in memory for key in ("weights", "means", "covariances"))
    require(complete, "memory", memory.get("name"), "a bias with weights, means and covariances to start from")
    require(cfg.start in STARTS, "start", cfg.start, "one of " + ", ".join(STARTS))
    whole(cfg, "start_episodes", 32)
    mixture = direction_mixture(memory["weights"], memory["means"], memory["covariances"], dtype=torch.float64)
    return encode(shape, mixture, float(cfg.acquisition.alpha))


def move_start(cfg: DictConfig, problem: Problem, schedule: Schedule, start: Tensor) -> tuple[Tensor, int]:
    """Where the gradient starts by `start=...`, and the episodes that this has cost."""
    scenes, episodes = schedule.validation_scenes, whole(cfg, "start_episodes", 32)
    if cfg.start == "memory":
        return start, 0
    if cfg.start == "hand":
        return hand(problem, float(cfg.acquisition.alpha), scenes)[0], 0
    bias = fitted_bias if cfg.start == "fitted" else remembered_bias
    return bias(problem, start, episodes, schedule.seed, scenes), episodes


def judge_policies(
    cfg: DictConfig,
    problem: Problem,
    start: Tensor,
    state: State,
    schedule: Schedule,
    heldout: Heldout,
    figures: dict[str, Any],
    folder: Path,
) -> tuple[Table, float]:
    """Every policy on the held-out scenes, and how far the tuned one is ahead of others, paired over scenes.

    All choose what they choose (which step of the tuning, σ, α) on the same validation scenes, and `fitted` and
    `remembered` have as many episodes as the tuned one.
    """
    alpha, checked = float(cfg.acquisition.alpha), schedule.validation_scenes
    policies = {name: (table_1(problem.shape, name, alpha), problem) for name in TABLE_1}
    policies["start"] = (start, problem)
    by_hand, sigma = hand(problem, alpha, checked)
    policies["hand"] = (by_hand, problem)
    write_memory(problem, by_hand, folder, "hand", f"One Gaussian a region by hand, σ = {sigma}, for")
    for name, rival in (("fitted", fitted_bias), ("remembered", remembered_bias)):
        begin = table_1(problem.shape, "unbiased", alpha)
        vector = rival(problem, begin, schedule.episodes, schedule.seed, checked)
        policies[name] = (vector, problem)
        write_memory(problem, vector, folder, name, RIVALS_HOW[name])
    policies["tuned"] = (state.best, problem)
    if cfg.prior_field:
        head, dtype = problem.task.observer.head, problem.dtype
        own = stream("training", int(cfg.seed), 10**8)
        scenes_seen = draw_scenes(problem.distribution, head, _FIELD_SCENES, own, dtype)
        grid = sphere_quadrature(_FIELD_DIRECTIONS, lambda d: reachable(head, d), dtype).directions
        for name, fit in (("prior_field", fit_closed_form), ("prior_field_gradient", fit_by_gradient)):
            field = fit(scenes_seen, grid, problem.task.far_m)
            informed = Problem(problem.task, problem.distribution, problem.shape, problem.cells, problem.dtype, field)
            tried = [table_1(problem.shape, "unbiased", a) for a in _FIELD_ALPHAS]
            exam = informed.exam("validation", 0, min(checked, 256))
            scores = evaluate_policies(informed, tried, exam).mean(1).tolist()
            policies[name] = (tried[scores.index(max(scores))], informed)
            if name == "prior_field":
                policies["tuned_with_prior_field"] = (state.best, informed)
    table = Table("policy", "gap per saccade", "95% CI", box=None, padding=(0, 2, 0, 0))
    values = {}

    def note(name: str, sample: Tensor) -> float:
        interval = bootstrap_interval(sample, torch.Generator().manual_seed(0), resamples=2000)
        for key, value in zip(("gap_per_saccade", "ci_low", "ci_high"), interval, strict=True):
            figures[f"heldout.{name}.{key}"] = float(value)
        table.add_row(name, f"{interval.estimate:.4f}", f"{interval.low:.4f} to {interval.high:.4f}")
        return float(interval.estimate)

    for name, (vector, judged) in policies.items():
        values[name] = evaluate_bias(judged, vector, problem.exam("heldout", heldout.seed, heldout.scenes))
        note(name, values[name])
    best = max(TABLE_1, key=lambda name: float(values[name].mean()))
    for other in (best, "hand", "fitted", "remembered", *(["prior_field"] if cfg.prior_field else [])):
        note(f"tuned minus {other}", values["tuned"] - values[other])
    return table, float(values["tuned"].mean())
