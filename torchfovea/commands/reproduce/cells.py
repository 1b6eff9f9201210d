"""The cells of a reproduction: which episodes, by which settings of `search`, and how they are run."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from hydra.core.global_hydra import GlobalHydra

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.composed import compose_search
from torchfovea.commands.shared.figures import EPISODE_COLUMNS, episode_row
from torchfovea.commands.shared.rollout import batched, one_episode, roll_out
from torchfovea.commands.shared.settings import whole
from torchfovea.deciding.strategies import upper_confidence_bound
from torchfovea.episode import Episode
from torchfovea.setting import require

__all__ = ["METRICS", "CellTask", "cells_of", "in_family", "regret_convergence", "run_task", "task_name"]

METRICS = (
    "gap_final", "gap_per_saccade", "regret_per_saccade", "global_information_per_saccade",
    "local_information_per_saccade", "saccades_to_target", "found", "target_error_m", "degrees_travelled",
    "regret_convergence",
)  # fmt: skip
CURVES = ("gap", "regret", "global_information", "local_information")


class CellTask(NamedTuple):
    """Episodes that one process runs; it is plain data.

    Attributes:
        labels: what its rows are called by: fig, scene, reading, sensor, fov_deg, bias, variant.
        overrides: settings of `search`, the arm's left out.
        arm: settings of the arm, such as acquisition=ei; empty for several α.
        alphas: those of the upper confidence bound that run together; empty otherwise.
        name: of the arm; `ucb_` and α for several.
        seeds: scenes.
        curves: arms whose course is kept.
    """

    labels: dict[str, Any]
    overrides: tuple[str, ...]
    arm: tuple[str, ...]
    alphas: tuple[float, ...]
    name: str
    seeds: tuple[int, ...]
    curves: tuple[str, ...]


def task_name(task: CellTask) -> str:
    """A file's name that only the same task has."""
    text = json.dumps(task, sort_keys=True, default=str)
    words = [str(task.labels[key]) for key in ("fig", "scene", "reading", "sensor", "fov_deg", "bias")]
    arm = task.name if not task.alphas else "ucb"
    return "-".join([*words, arm, f"{task.seeds[0]}", hashlib.sha256(text.encode()).hexdigest()[:10]])


def regret_convergence(regret: torch.Tensor) -> int:
    """The saccade (from 1) from which the regret stays within 5% of its whole range of its last value."""
    width = 0.05 * float(regret.max() - regret.min())
    outside = ((regret - regret[-1]).abs() > width).nonzero()
    return 1 if len(outside) == 0 else int(outside[-1]) + 2


def _alpha_name(alpha: float) -> str:
    return "ucb_inf" if math.isinf(alpha) else f"ucb_{alpha:g}"


def in_family(plain: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with `in_family` as the only scene there is, and the one that counts; as they are without it.

    Raises:
        SettingError: for a family that there is none of.
    """
    family = plain["in_family"]
    if family is None:
        return dict(plain)
    known = GlobalHydra.instance().config_loader().get_group_options("family")
    require(family in known, "in_family", family, "null, or one of " + ", ".join(known))
    counts = {**plain["counts"], "scene": family}
    only = {fig: {**plain[fig], "conditions": [counts]} for fig in ("fig8", "fig9")}
    return {**plain, **only, "counts": counts}


def cells_of(plain: Mapping[str, Any]) -> list[CellTask]:
    """All tasks of a reproduction with these settings, those that count first."""
    require(plain["arms"] in plain["fig8"]["alphas"], "arms", plain["arms"], ", ".join(plain["fig8"]["alphas"]))
    tasks = []
    fig8, wanted = plain["fig8"], plain["conditions"]
    require(wanted in ("all", "counting"), "conditions", wanted, "all or counting")
    for condition in fig8["conditions"]:
        if wanted == "counting" and condition != plain["counts"]:
            continue
        counts = condition == plain["counts"]
        alphas = fig8["alphas"][plain["arms"] if counts or plain["arms"] == "few" else "paper"]
        for sensor in fig8["sensors"]:
            for fov in fig8["fov_deg"]:
                labels = {"fig": 8, **condition, "sensor": sensor, "fov_deg": fov, "bias": "unbiased"}
                extra = counts and plain["arms"] == "all" and sensor == "log_polar" and fov == 135
                others = fig8["others"] + (fig8["extra"] if extra else [])
                tasks += _tasks(plain, labels, alphas, others, ("ucb_100",))
    for condition in plain["fig9"]["conditions"]:
        if wanted == "counting" and condition != plain["counts"]:
            continue
        for bias in plain["fig9"]["biases"]:
            labels = {"fig": 9, **condition, "sensor": "log_polar", "fov_deg": 135, "bias": bias}
            names = tuple(_alpha_name(a) for a in plain["fig9"]["alphas"])
            tasks += _tasks(plain, labels, plain["fig9"]["alphas"], [], names)
    base = {**plain["counts"], "sensor": "log_polar", "fov_deg": 135, "bias": "unbiased"}
    if plain["ablation"]:
        for name, changes in {"as it is": [], **plain["ablations"]}.items():
            tasks += _tasks(plain, {"fig": "ablation", **base, "variant": name}, [1.0], [], (), changes)
    if plain["photometric"]:
        for sensor in fig8["sensors"]:
            labels = {"fig": "photometric", **base, "sensor": sensor}
            tasks += _tasks(plain, labels, [], ["ucb"], (), ["fidelity=photometric"])
    return tasks


def _tasks(
    plain: Mapping[str, Any], labels: dict[str, Any], alphas: Sequence[float], others: Sequence[str],
    curves: tuple[str, ...], changes: Sequence[str] = (),
) -> list[CellTask]:  # fmt: skip
    scene, bias, sizes = labels["scene"], labels["bias"], plain["sensor"]
    group = "scene" if plain["in_family"] is None else "family"
    sample = "null" if sizes["sample"] is None else sizes["sample"]
    memory = "aimed" if bias == "target" and scene != "attention_world" else bias
    overrides = (
        f"{group}={scene}", *plain["scene_overrides"].get(scene, ()), f"reading={labels['reading']}",
        f"sensor={labels['sensor']}", f"sensor.fov_deg={labels['fov_deg']}", f"memory={memory}",
        f"memory.cells={plain['memory']['cells']}", f"sensor.receptive_fields={sizes['receptive_fields']}",
        f"sensor.sample={sample}", "fidelity=geometric",
        f"saccades={plain['saccades']}", f"device={plain['device']}", *plain["overrides"], *changes,
        *(["trust=true"] if plain["trust"] else []),
    )  # fmt: skip
    labels = {"variant": None, **labels}
    seeds = [plain["seed"] + k for k in range(plain["episodes"])]
    tasks = []
    if alphas:
        size = max(1, plain["batch"] // len(alphas))
        tasks += [
            CellTask(labels, overrides, (), tuple(float(a) for a in alphas), "ucb", tuple(part), curves)
            for part in _parts(seeds, size)
        ]
    for other in others:
        tasks += [
            CellTask(labels, overrides, (f"acquisition={other}",), (), other, tuple(part), curves)
            for part in _parts(seeds, plain["batch"])
        ]
    return tasks


def _parts(seeds: Sequence[int], size: int) -> list[Sequence[int]]:
    return [seeds[start : start + size] for start in range(0, len(seeds), size)]


def run_task(task: CellTask, folders: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """A row for each of a task's episodes: labels, arm, seed, metrics, and the course where it is kept.

    Args:
        task: what to run.
        folders: of configurations beside ours, see `torchfovea.commands.shared.composed.config_folders`.
    """
    cfg = compose_search((*task.overrides, *task.arm), folders)
    observer = build_observer(cfg)
    whole(cfg, "saccades")
    if not batched(cfg):
        episodes = [one_episode(cfg, observer, seed) for seed in task.seeds]
        return [_row(task, task.name, seed, e) for seed, e in zip(task.seeds, episodes, strict=True)]
    if not task.alphas:
        episodes = roll_out(cfg, observer, task.seeds)
        return [_row(task, task.name, seed, e) for seed, e in zip(task.seeds, episodes, strict=True)]
    pairs = [(seed, alpha) for seed in task.seeds for alpha in task.alphas]
    alphas = torch.tensor([alpha for _, alpha in pairs], device=cfg.device)
    strategy = partial(upper_confidence_bound, alpha=alphas)
    episodes = roll_out(cfg, observer, [seed for seed, _ in pairs], lambda truths: strategy)
    return [_row(task, _alpha_name(alpha), seed, e) for (seed, alpha), e in zip(pairs, episodes, strict=True)]


def _row(task: CellTask, arm: str, seed: int, episode: Episode) -> dict[str, Any]:
    figures = dict(zip(EPISODE_COLUMNS[2:], episode_row(episode), strict=True))
    figures["regret_convergence"] = regret_convergence(episode.regret)
    row = {**task.labels, "arm": arm, "seed": seed, **{name: figures[name] for name in METRICS}}
    if arm in task.curves:
        course = {name: getattr(episode, name) for name in CURVES}
        row["curves"] = {k: None if c is None else [round(float(v), 5) for v in c] for k, c in course.items()}
    return row
