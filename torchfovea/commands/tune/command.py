"""`torchfovea tune`: the memory's bias and α by gradient on simulated episodes, judged on held-out scenes."""

from __future__ import annotations

import math
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.manifest import complete, finished
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.screen import progress_bar
from torchfovea.commands.shared.settings import construct, number, plain, whole, within
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.commands.tune.files import write_memory, write_scenes
from torchfovea.commands.tune.judge import build_start, judge_policies, move_start
from torchfovea.commands.tune.study import check_study, study_curves, study_gradients
from torchfovea.compiling import compiling
from torchfovea.deciding.weighted import Weighting
from torchfovea.files import write_csv
from torchfovea.setting import require
from torchfovea.tuning.bias import Shape, fov_of
from torchfovea.tuning.problem import Problem
from torchfovea.tuning.scenes import Distribution
from torchfovea.tuning.study import Heldout, Row
from torchfovea.tuning.train import Schedule, State, train
from torchfovea.tuning.worlds import Task

__all__ = ["build_problem", "run"]

# what is null in the configuration
PROFILES = {
    "quick": {"episodes": 512, "validation_scenes": 128, "heldout_scenes": 256, "check_episodes": 256},
    "reduced": {"episodes": 2048, "validation_scenes": 256, "heldout_scenes": 1024, "check_episodes": 4096},
    "paper": {"episodes": 8192, "validation_scenes": 512, "heldout_scenes": 4096, "check_episodes": 16384},
}
# of groups that are shared with search: the simulator of tuning has exact encoders, no matcher and no fusion of patches
UNREAD = (
    "head.encoder_deg", "sensor.sample", "budget.bend", "budget.gap", "budget.claim", "fusion.gate_deg",
    "fusion.gate_spacing", "fusion.fill", "fusion.conflict", "fusion.erode", "fusion.half_life", "prior.slope_std",
    "prior.bearing_std",
)  # fmt: skip


def build_problem(cfg: DictConfig) -> Problem:
    """What is tuned, from a configuration."""
    node = plain(cfg.distribution)
    unknown = sorted(set(node) - set(Distribution.__dataclass_fields__))
    require(not unknown, "distribution", unknown, "settings of a scene distribution only")
    distribution = construct(Distribution, node, "distribution")
    cost = within(cfg, "saccade_cost", 0, math.inf, "worth per degree, at least 0")
    task = Task(build_observer(cfg), whole(cfg, "saccades", 2), number(cfg, "far_m"), str(cfg.metric), cost)
    known = name_of(cfg, "acquisition") in ("ucb", "weighted")
    require(known, "acquisition", cfg.acquisition.name, "ucb, whose alpha is tuned, or weighted")
    weights, tuned = _weights(cfg)
    alpha = within(cfg, "acquisition.alpha", 0, math.inf, "a number of at least 0")
    fov_deg = float(cfg.sensor.fov_deg) if cfg.tune_fov else None
    components = whole(cfg, "components")
    task_numbers = distribution.task_numbers
    shape = Shape(components, distribution.conditioned, cfg.tune_alpha, alpha, fov_deg, weights, tuned, task_numbers)
    return Problem(task, distribution, shape, whole(cfg, "memory.cells", 2))


def _weights(cfg: DictConfig) -> tuple[Weighting, tuple[str, ...]]:
    """The acquisition's weights besides α, and which of them are tuned."""
    tuned = tuple(str(name) for name in cfg.tune_weights)
    if cfg.acquisition.name == "ucb":
        require(not tuned, "tune_weights", list(tuned), "[] without acquisition=weighted")
        return Weighting(), ()
    names = [field.name for field in fields(Weighting)]
    return replace(Weighting(**{name: cfg.acquisition[name] for name in names}), alpha=1.0), tuned


def run(cfg: DictConfig) -> float:
    """Tune, judge and draw; the held-out gap per saccade of the tuned policy is what a sweeper sees."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # minibatches are small: more threads would only wait for each other
    try:
        with compiling(str(cfg.compile)):
            return _run(cfg)
    finally:
        torch.set_num_threads(threads)


def _run(cfg: DictConfig) -> float:
    profile = PROFILES[str(HydraConfig.get().runtime.choices["profile"])]
    sizes = {name: value if cfg[name] is None else whole(cfg, name) for name, value in profile.items()}
    refuse_unread(*UNREAD)
    check_study(cfg)
    whole(cfg, "seed", 0)
    problem = build_problem(cfg)
    schedule = construct(Schedule, plain(cfg) | sizes, "tune")
    heldout = Heldout(sizes["heldout_scenes"], whole(cfg, "heldout_seed", 0))
    start = build_start(cfg, problem.shape)
    if cfg.resume is not None:
        require(Path(cfg.resume).is_file(), "resume", cfg.resume, "a checkpoint.pt that exists")
    folder = run_folder()
    checkpoint = folder / "checkpoint.pt"
    before = finished(cfg, folder, "heldout.tuned.gap_per_saccade")
    if before is not None:
        return before
    if cfg.resume is not None and not checkpoint.exists():
        shutil.copyfile(cfg.resume, checkpoint)
    start, spent = move_start(cfg, problem, schedule, start)
    with progress_bar() as progress:
        bar = progress.add_task("tune", total=schedule.episodes)

        def show(state: State, value: float) -> None:
            recent = [v for _, v in state.curve[-16:]]
            mean = sum(recent) / len(recent)
            text = f"tune  objective {mean:.3f}  best on validation {state.best_value:.3f}"
            progress.update(bar, completed=min(int(state.episodes), schedule.episodes), description=text)

        state = train(problem, start, schedule, checkpoint, show)
    figures: dict[str, Any] = {
        "episodes_used": state.episodes + spent,
        "runs_begun": state.runs,
        "parameters": problem.shape.size,
    }
    if problem.shape.fov_deg is not None:
        figures["fov_deg"] = fov_of(problem.shape, state.best)
    write_memory(problem, state.best, folder)
    write_scenes(problem.distribution, folder)
    table, best = judge_policies(cfg, problem, start, state, schedule, heldout, figures, folder)
    rows: list[Row] = []
    checks: list[dict[str, Any]] = []
    if cfg.study == "curves":
        rows = study_curves(cfg, problem, start, schedule, heldout, folder, figures)
    if cfg.study == "gradients":
        checks = study_gradients(cfg, problem, start, state, sizes["check_episodes"], folder)
    from torchfovea.commands.tune.pictures import draw_tuning

    draw_tuning(folder, problem, start, state, checks, rows)
    write_csv(folder / "tuning.csv", ("episodes", "validation"), [(e, v) for e, v, _ in state.history])
    complete(folder, figures)
    Console().print(table)
    return best
