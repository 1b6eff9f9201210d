"""Gradient ascent on a tuning problem: Adam with a schedule, checkpoints, resuming, the best on validation scenes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfovea.files import write_tensors
from torchfovea.setting import SettingError, check_types, require
from torchfovea.tuning.adam import Averages, adam
from torchfovea.tuning.bias import fix_vector
from torchfovea.tuning.estimators import Gradient, counterfactual, coverage, covered, fov_difference, policy
from torchfovea.tuning.myopic import myopic
from torchfovea.tuning.pathwise import pathwise
from torchfovea.tuning.problem import Batch, Problem, evaluate_bias
from torchfovea.tuning.scenes import stream
from torchfovea.untrusted import read_tensors

__all__ = ["ESTIMATORS", "Progress", "Schedule", "State", "gradient", "train"]

ESTIMATORS: dict[str, Callable[..., Gradient]] = {
    "covered": covered,
    "counterfactual": counterfactual,
    "coverage": coverage,
    "myopic": myopic,
    "pathwise": pathwise,
    "policy": policy,
}


def gradient(problem: Problem, estimator: str, vector: Tensor, batch: Batch, alpha_share: float) -> Gradient:
    """An estimator's gradient, with the slope in the field of view where that is tuned."""
    found = ESTIMATORS[estimator](problem.at(vector), vector, batch, alpha_share=alpha_share)
    if problem.shape.fov_deg is not None:
        slope, spent = fov_difference(problem, vector, batch, alpha_share)
        found.vector[-1] = slope
        found = found._replace(episodes=found.episodes + spent, runs=found.runs + round(spent))
    return found


@dataclass(frozen=True)
class Schedule:
    """How to climb.

    Attributes:
        episodes: budget of simulated episodes, counterfactual runs included; validation is apart.
        scenes: of a minibatch.
        estimator: of the gradient.
        warm_episodes: spent on `warm_estimator` first.
        warm_estimator: a cheaper one.
        rate: Adam's first step size; it falls linearly to `last_rate`.
        last_rate: at the end of the budget.
        alpha_share: of a minibatch's scenes, for the derivatives in log α and the other weights.
        validations: how many times the vector is judged, evenly spread over the budget, besides the start.
        validation_scenes: the same ones each time.
        seed: of the training scenes; validation scenes are the same for all seeds.
    """

    episodes: int = 2048
    scenes: int = 8
    estimator: str = "covered"
    warm_episodes: int = 512
    warm_estimator: str = "coverage"
    rate: float = 0.1
    last_rate: float = 0.02
    alpha_share: float = 0.25
    validations: int = 8
    validation_scenes: int = 256
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise SettingError for values out of range."""
        check_types(self)
        for name in ("estimator", "warm_estimator"):
            require(getattr(self, name) in ESTIMATORS, name, getattr(self, name), "one of " + ", ".join(ESTIMATORS))
        for name in ("episodes", "scenes", "validations", "validation_scenes"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(0 < self.last_rate <= self.rate <= 10, "rate", self.rate, "positive, and no less than last_rate")
        require(0 <= self.alpha_share <= 1, "alpha_share", self.alpha_share, "between 0 and 1")
        require(self.warm_episodes >= 0, "warm_episodes", self.warm_episodes, "at least 0")


@dataclass
class State:
    """Everything that a checkpoint holds.

    Attributes:
        vector: now.
        first: Adam's moments.
        second: of squares.
        step: minibatches done.
        episodes: spent.
        runs: begun, each counted whole.
        best: vector on validation.
        best_value: its validation score.
        history: (episodes, validation score, vector) of every validation.
        curve: (episodes, objective on the minibatch) of every step.
    """

    vector: Tensor
    first: Tensor
    second: Tensor
    best: Tensor
    best_value: float
    history: list[tuple[float, float, list[float]]]
    curve: list[tuple[float, float]]
    step: int = 0
    episodes: float = 0.0
    runs: int = 0


Progress = Callable[[State, float], None]


def train(
    problem: Problem,
    start: Tensor,
    schedule: Schedule,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> State:
    """Climb from a start.

    Args:
        problem: what is tuned.
        start: vector (K,).
        schedule: how.
        checkpoint: a file that is written whole after each validation; if it exists, the run goes on from it as if it
            had never stopped.
        progress: called after each step with the state and the minibatch's objective.

    Returns:
        The last state. Its `best` is never below the start on the validation scenes.

    Raises:
        SettingError: for a checkpoint of other settings, a start without reachable cells, and a step that is not
            finite; the last checkpoint is then the last good one.
    """
    state = _begin(problem, start, schedule, checkpoint)
    while state.episodes < schedule.episodes:
        state, value = _step(problem, schedule, state)
        due = len(state.history) - 1 < int(schedule.validations * min(state.episodes / schedule.episodes, 1))
        if due:
            _validate(problem, schedule, state)
            _save(state, schedule, problem, checkpoint)
        if progress is not None:
            progress(state, value)
    return state


def _begin(problem: Problem, start: Tensor, schedule: Schedule, checkpoint: Path | None) -> State:
    if checkpoint is not None and checkpoint.is_file():
        return _load(problem, schedule, checkpoint)
    require(bool(torch.isfinite(start).all()), "start", start.tolist(), "finite numbers")
    require(len(start) == problem.shape.size, "start", len(start), f"{problem.shape.size} numbers")
    vector = fix_vector(problem.shape, start.double())
    state = State(vector, torch.zeros_like(vector), torch.zeros_like(vector), vector, -1.0, [], [])
    _validate(problem, schedule, state)
    _save(state, schedule, problem, checkpoint)
    return state


def _step(problem: Problem, schedule: Schedule, state: State) -> tuple[State, float]:
    warm = state.episodes < min(schedule.warm_episodes, schedule.episodes / 2)
    name = schedule.warm_estimator if warm else schedule.estimator
    batch = problem.batch(schedule.scenes, stream("training", schedule.seed, state.step))
    found = gradient(problem, name, state.vector, batch, 0.0 if warm else schedule.alpha_share)
    if not bool(torch.isfinite(found.vector).all()):
        raise SettingError(
            f"gradient = not finite at step {state.step}: expected finite numbers; stopped at the last checkpoint, "
            f"{state.best_value:.4f} on validation"
        )
    share = min(state.episodes / schedule.episodes, 1.0)
    rate = schedule.rate + (schedule.last_rate - schedule.rate) * share
    (first, second, step), move = adam(Averages(state.first, state.second, state.step), found.vector, rate)
    # one scale for all numbers of a mixture would be the natural step; Adam's own keeps the small ones moving
    vector = fix_vector(problem.shape, state.vector + move)
    if not bool(torch.isfinite(vector).all()):
        raise SettingError(f"step {step} = not finite: expected finite numbers; stopped at the last checkpoint")
    episodes = state.episodes + found.episodes
    fresh = State(
        vector, first, second, state.best, state.best_value, state.history, [*state.curve, (episodes, found.value)],
        step, episodes, state.runs + found.runs,
    )  # fmt: skip
    return fresh, found.value


def _validate(problem: Problem, schedule: Schedule, state: State) -> None:
    exam = problem.exam("validation", 0, schedule.validation_scenes)
    value = float(evaluate_bias(problem, state.vector, exam).mean())
    state.history.append((state.episodes, value, state.vector.tolist()))
    if value > state.best_value:
        state.best, state.best_value = state.vector.clone(), value


def _signature(schedule: Schedule, problem: Problem) -> dict[str, Any]:
    observer, task = problem.task.observer, problem.task._asdict()
    del task["observer"]
    parts = {f.name: repr(getattr(observer, f.name)) for f in fields(observer)}
    return {"schedule": asdict(schedule), "shape": repr(problem.shape), "cells": problem.cells,
            "distribution": asdict(problem.distribution), **task, **parts}  # fmt: skip


def _save(state: State, schedule: Schedule, problem: Problem, path: Path | None) -> None:
    if path is not None:
        write_tensors(path, {"state": state.__dict__, "made_with": _signature(schedule, problem)})


def _load(problem: Problem, schedule: Schedule, path: Path) -> State:
    expected = "a checkpoint of torchfovea tune"
    try:
        content = read_tensors(path)
        made_with, state = dict(content["made_with"]), State(**content["state"])
        whole = _is_whole(state)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise SettingError(f"checkpoint = {os.fspath(path)}: expected {expected} ({error})") from error
    require(whole, "checkpoint", os.fspath(path), f"{expected}, whose numbers are finite and belong together")
    now = _signature(schedule, problem)
    for name, value in now.items():
        require(made_with.get(name) == value, f"checkpoint {name}", made_with.get(name), f"the run's own, {value}")
    fits = len(state.vector) == problem.shape.size
    require(fits, "checkpoint", os.fspath(path), f"a vector of {problem.shape.size} numbers")
    return state


def _is_whole(state: State) -> bool:
    vectors = (state.vector, state.first, state.second, state.best)
    counts = (state.episodes, state.best_value, state.step, state.runs)
    return (
        all(v.shape == state.vector.shape and v.dim() == 1 and bool(torch.isfinite(v).all()) for v in vectors)
        and all(v.dtype == torch.float64 for v in vectors)
        and all(math.isfinite(number) for number in counts)
        and len(state.curve) == state.step
        and len(state.history) > 0
        and all(len(point) == 3 and len(point[2]) == len(state.vector) for point in state.history)
    )
