"""`torchfovea tune`: the memory's bias and α by gradient on simulated episodes, judged on held-out scenes."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchfovea.commands.shared.build import build_observer, construct, number, whole
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.manifest import complete, finished
from torchfovea.commands.shared.progress import progress_bar
from torchfovea.commands.shared.strategy import read_number
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.commands.tune.study import check_study, study_curves, study_gradients
from torchfovea.files import replacing, write_csv
from torchfovea.memory.sphere import direction_mixture, sphere_quadrature
from torchfovea.setting import require
from torchfovea.studies.significance import bootstrap_interval
from torchfovea.tuning.baselines import TABLE_1, hand, table_1
from torchfovea.tuning.bias import Shape, decode, encode, fov_of, mixture_of, reachable
from torchfovea.tuning.prior_field import fit_by_gradient, fit_closed_form
from torchfovea.tuning.problem import Problem, evaluate_bias
from torchfovea.tuning.scenes import Distribution, draw_scenes, stream
from torchfovea.tuning.simulator import Task
from torchfovea.tuning.study import Heldout, Row
from torchfovea.tuning.train import Schedule, State, train

__all__ = ["build_problem", "build_start", "memory_yaml", "run", "scene_yaml"]

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
_FIELD_SCENES = 512
_FIELD_DIRECTIONS = 4000  # on the whole sphere
_FIELD_ALPHAS = (0.1, 0.3, 1.0)


def build_problem(cfg: DictConfig) -> Problem:
    """What is tuned, from a configuration."""
    node: Any = OmegaConf.to_container(cfg.distribution, resolve=True)
    regions = node.pop("regions", None)
    rows = isinstance(regions, list) and all(isinstance(row, list) and len(row) == 4 for row in regions)
    require(rows, "distribution.regions", regions, "a list of [azimuth low, high, elevation low, high]")
    unknown = sorted(set(node) - set(Distribution.__dataclass_fields__))
    require(not unknown, "distribution", unknown, "settings of a scene distribution only")
    for region in regions:
        for value in region:
            known = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            require(known, "distribution.regions", region, "four numbers of degrees")
    distribution = replace(construct(Distribution, node, "distribution"), regions=tuple(map(tuple, regions)))
    task = Task(build_observer(cfg), whole(cfg, "saccades", 2), number(cfg, "far_m"), str(cfg.metric))
    require(cfg.acquisition.name == "ucb", "acquisition", cfg.acquisition.name, "ucb, whose alpha is tuned")
    alpha = read_number(cfg, "acquisition.alpha", "a number of at least 0", 0.0)
    for setting in ("tune_alpha", "tune_fov", "prior_field"):
        require(isinstance(cfg[setting], bool), setting, cfg[setting], "true or false")
    fov_deg = float(cfg.sensor.fov_deg) if cfg.tune_fov else None
    shape = Shape(whole(cfg, "components"), distribution.conditioned, cfg.tune_alpha, alpha, fov_deg)
    return Problem(task, distribution, shape, whole(cfg, "memory.cells", 2))


def build_start(cfg: DictConfig, shape: Shape) -> Tensor:
    """The vector of the bias `memory=...` with `acquisition.alpha`."""
    memory = OmegaConf.to_container(cfg.memory, resolve=True)
    assert isinstance(memory, dict)
    complete = all(key in memory for key in ("weights", "means", "covariances"))
    require(complete, "memory", memory.get("name"), "a bias with weights, means and covariances to start from")
    mixture = direction_mixture(memory["weights"], memory["means"], memory["covariances"], dtype=torch.float64)
    return encode(shape, mixture, float(cfg.acquisition.alpha))


def memory_yaml(problem: Problem, vector: Tensor, task: Tensor | None, note: str, name: str = "tuned") -> str:
    """A bias in the form of conf/memory/*.yaml."""
    mixture = mixture_of(problem.shape, vector.double(), task)
    covariance = mixture.cholesky @ mixture.cholesky.mT
    content = {
        "name": name,
        "cells": 20000,
        "weights": [round(v, 6) for v in mixture.logits.softmax(-1).tolist()],
        "means": [[round(v, 6) for v in row] for row in mixture.means.tolist()],
        "covariances": [[[round(v, 8) for v in row] for row in matrix] for matrix in covariance.tolist()],
    }
    return f"# {note}\n" + OmegaConf.to_yaml(OmegaConf.create(content))


def run(cfg: DictConfig) -> float:
    """Tune, judge and draw; the held-out gap per saccade of the tuned policy is what a sweeper sees."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # minibatches are small: more threads would only wait for each other
    try:
        return _run(cfg)
    finally:
        torch.set_num_threads(threads)


def _run(cfg: DictConfig) -> float:
    profile = PROFILES[str(HydraConfig.get().runtime.choices["profile"])]
    sizes = {name: value if cfg[name] is None else whole(cfg, name) for name, value in profile.items()}
    refuse_unread(*UNREAD)
    check_study(cfg)
    problem = build_problem(cfg)
    start, folder = build_start(cfg, problem.shape), run_folder()
    settings = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(settings, dict)
    merged = {str(name): value for name, value in settings.items()} | sizes
    schedule = construct(Schedule, merged, "tune")
    checkpoint = folder / "checkpoint.pt"
    if cfg.resume is not None:
        there = isinstance(cfg.resume, str) and Path(cfg.resume).is_file()
        require(there, "resume", cfg.resume, "a checkpoint.pt that exists")
    before = finished(cfg, folder, "heldout.tuned.gap_per_saccade")
    if before is not None:
        return before
    if cfg.resume is not None and not checkpoint.exists():
        shutil.copyfile(cfg.resume, checkpoint)
    with progress_bar() as progress:
        bar = progress.add_task("tune", total=schedule.episodes)

        def show(state: State, value: float) -> None:
            recent = [v for _, v in state.curve[-16:]]
            mean = sum(recent) / len(recent)
            text = f"tune  objective {mean:.3f}  best on validation {state.best_value:.3f}"
            progress.update(bar, completed=min(int(state.episodes), schedule.episodes), description=text)

        state = train(problem, start, schedule, checkpoint, show)
    figures: dict[str, Any] = {
        "episodes_used": state.episodes,
        "runs_begun": state.runs,
        "parameters": problem.shape.size,
    }
    if problem.shape.fov_deg is not None:
        figures["fov_deg"] = fov_of(problem.shape, state.best)
    _write_memory(problem, state.best, folder)
    _write_scenes(problem.distribution, folder)
    heldout = Heldout(sizes["heldout_scenes"], whole(cfg, "heldout_seed", 0))
    table, best = _judge(cfg, problem, start, state, heldout, figures, folder)
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


_CORNERS = [(float(a), float(e)) for a in (-1, 0, 1) for e in (-1, 0, 1)]


def _write_memory(problem: Problem, vector: Tensor, folder: Path, name: str = "tuned", how: str = "Tuned on") -> None:
    """A vector as files for `search --config-dir FOLDER memory=NAME`; a conditioned one for nine tasks."""
    alpha = float(decode(problem.shape, vector, torch.zeros(1, 2, dtype=torch.float64)).alpha)
    own, observer = problem.distribution, problem.at(vector).task.observer
    fov_deg = 2 * math.degrees(math.atan(observer.retina.radius_px / observer.camera.focal_px))
    tasks: dict[str, Tensor | None] = {"": None}
    if problem.shape.conditioned:
        tasks = {f"_task_{a:+.0f}_{e:+.0f}": torch.tensor([a, e]) for a, e in _CORNERS}
    for suffix, task in tasks.items():
        use = f"search --config-dir THIS_RUNS_FOLDER memory={name}{suffix} scene={own.name}{suffix}"
        note = f"{how} {own.name}: torchfovea {use} acquisition.alpha={alpha:.4g} sensor.fov_deg={fov_deg:.4g}"
        with replacing(folder / "memory" / f"{name}{suffix}.yaml") as temporary:
            temporary.write_text(memory_yaml(problem, vector, task, note, f"{name}{suffix}"), encoding="utf-8")


def _write_scenes(own: Distribution, folder: Path) -> None:
    """A distribution as files for `search --config-dir FOLDER scene=...`: a file for each region or task."""
    regions = {f"_{k}" if len(own.regions) > 1 else "": region for k, region in enumerate(own.regions)}
    if own.conditioned:
        regions = {f"_task_{a:+.0f}_{e:+.0f}": own.region_of(a, e) for a, e in _CORNERS}
    for suffix, region in regions.items():
        with replacing(folder / "scene" / f"{own.name}{suffix}.yaml") as temporary:
            temporary.write_text(scene_yaml(own, region), encoding="utf-8")


def scene_yaml(distribution: Distribution, region: tuple[float, float, float, float]) -> str:
    """A distribution's scenes with the target in one region, in the form of conf/scene/cans.yaml.

    The cans then stand on poles, amid furniture.
    """
    d = distribution
    fields = ("cans", "target_range_m", "azimuth_deg", "elevation_deg", "range_m", "can_radius_m", "can_height_m",
              "margin_m", "tries")  # fmt: skip
    same = {name: getattr(d, name) for name in fields}
    content = {
        "name": "cans",
        "_target_": "torchfovea.sim.scene.Cans",
        "target_azimuth_deg": region[:2],
        "target_elevation_deg": region[2:],
        **same,
    }
    walls = {name: getattr(d, name) for name in ("front_m", "back_m", "side_m", "height_m")}
    content |= {
        "pole_radius_m": 0.012,
        "reach_margin_deg": 1.5,
        "room": {"_target_": "torchfovea.sim.room.Room", **walls, "furniture": True},
    }
    content |= {"outside_first_view": False, "first_view_deg": 90.0}
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in content.items()}
    return f"# The scenes of distribution={d.name}, for search scene=...\n" + OmegaConf.to_yaml(OmegaConf.create(plain))


def _judge(
    cfg: DictConfig,
    problem: Problem,
    start: Tensor,
    state: State,
    heldout: Heldout,
    figures: dict[str, Any],
    folder: Path,
) -> tuple[Table, float]:
    """Every policy on the held-out scenes, and how far the tuned one is ahead of others, paired over scenes."""
    alpha, checked = float(cfg.acquisition.alpha), min(heldout.scenes, 512)
    policies = {name: (table_1(problem.shape, name, alpha), problem) for name in TABLE_1}
    policies["start"] = (start, problem)
    by_hand, sigma = hand(problem, alpha, checked)
    policies["hand"] = (by_hand, problem)
    _write_memory(problem, by_hand, folder, "hand", f"One Gaussian a region by hand, σ = {sigma}, for")
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
            scores = [
                float(evaluate_bias(informed, v, min(checked, 256), stream("validation", 0)).mean()) for v in tried
            ]
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
        values[name] = evaluate_bias(judged, vector, heldout.scenes, stream("heldout", heldout.seed))
        note(name, values[name])
    best = max(TABLE_1, key=lambda name: float(values[name].mean()))
    for other in (best, "hand", *(["prior_field"] if cfg.prior_field else [])):
        note(f"tuned minus {other}", values["tuned"] - values[other])
    return table, float(values["tuned"].mean())
