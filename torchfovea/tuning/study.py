"""Learning curves of gradient tuning and of searches without gradients, at equal simulated episodes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchfovea.setting import SettingError, require
from torchfovea.tuning.baselines import SEARCHES
from torchfovea.tuning.problem import Problem, evaluate_bias
from torchfovea.tuning.rivals import RIVALS
from torchfovea.tuning.train import ESTIMATORS, Schedule, train

__all__ = [
    "Heldout",
    "Row",
    "budgets_up_to",
    "check_methods",
    "curves",
    "episodes_to_reach",
    "mean_curves",
    "reads_scenes",
    "student",
]

_FIRST = 64
# two-sided 95% quantiles of Student's t by degrees of freedom, for intervals over few seeds
_STUDENT = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 7: 2.36, 8: 2.31, 9: 2.26}


class Heldout(NamedTuple):
    """The scenes that judge: how many, and the number of their stream."""

    scenes: int = 512
    seed: int = 0


class Row(NamedTuple):
    """One point of a curve.

    Attributes:
        method: its name.
        seed: of its training scenes and draws.
        episodes: budget.
        validation: best score so far on validation scenes.
        heldout: held-out score of the vector with that score.
        heldout_last: held-out score of the method's own incumbent, whatever validation says.
    """

    method: str
    seed: int
    episodes: int
    validation: float
    heldout: float
    heldout_last: float


def budgets_up_to(episodes: int) -> list[int]:
    """64, 128, 256, … up to a number, which is the last."""
    return [*(_FIRST * 2**k for k in range(20) if _FIRST * 2**k < episodes), episodes]


def check_methods(methods: Collection[str]) -> None:
    """Raise SettingError for a name that is no ESTIMATOR or ESTIMATOR+WARM, no SEARCH or SEARCH@EPISODES, no rival."""
    words = (
        "any of "
        + ", ".join([*ESTIMATORS, *SEARCHES, *RIVALS])
        + "; ESTIMATOR+WARM or SEARCH@EPISODES of an evaluation"
    )
    for method in methods:
        name, _, warm = method.partition("+")
        search, at, each = method.partition("@")
        a_search = search in SEARCHES and (not at or (each.isdecimal() and int(each) > 0))
        require(
            method in RIVALS or a_search or (name in ESTIMATORS and warm in (*ESTIMATORS, "none", "")),
            "methods",
            method,
            words,
        )


def reads_scenes(method: str) -> bool:
    """Whether a method reads the geometry of training scenes; else it sees its own episodes alone.

    An estimator's warm start is `coverage`, which does, unless another is named.
    """
    name, _, warm = method.partition("+")
    blind = ("counterfactual", "policy", "none")
    return method == "fitted" or (name in ESTIMATORS and (name not in blind or warm not in blind))


def curves(
    problem: Problem,
    start: Tensor,
    methods: Sequence[str],
    seeds: int,
    schedule: Schedule,
    heldout: Heldout,
    done: Collection[tuple[str, int]] = (),
    progress: Callable[[str, int], None] | None = None,
) -> Iterator[list[Row]]:
    """Held-out score of each method's incumbent as its episodes are spent.

    Every method starts at the same vector. At 64, 128, 256, … episodes its incumbent, found with no more than that
    many, is validated (not counted, the same for all), and the best so far on validation is what the held-out scenes
    judge.

    Args:
        problem: what is tuned.
        start: vector.
        methods: names of estimators or searches; ESTIMATOR+WARM for another warm start, `none` for none;
            SEARCH@EPISODES for another number of episodes of one evaluation.
        seeds: how many.
        schedule: of the estimators; its episodes are the budget of all.
        heldout: the same for all.
        done: (method, seed) pairs to leave out.
        progress: called with each method and seed when it begins.

    Yields:
        The whole curve of one method and seed.
    """
    check_methods(methods)
    scored: dict[tuple[bytes, str], float] = {}

    def score(vector: Tensor, split: str) -> float:
        key = (vector.numpy().tobytes(), split)
        if key not in scored:
            scenes, seed = (schedule.validation_scenes, 0) if split == "validation" else heldout
            scored[key] = float(evaluate_bias(problem, vector, problem.exam(split, seed, scenes), strict=False).mean())
        return scored[key]

    budgets = budgets_up_to(schedule.episodes)
    for method in methods:
        for seed in range(seeds):
            if (method, seed) in done:
                continue
            if progress is not None:
                progress(method, seed)
            best, now = start, start
            rows: list[Row] = []
            incumbents = _incumbents(problem, start, method, seed, schedule)
            while len(rows) < len(budgets):
                spent, vector = next(incumbents, (math.inf, now))
                while len(rows) < len(budgets) and spent > budgets[len(rows)]:
                    best = max(best, now, key=lambda x: score(x, "validation"))
                    judged = (score(best, "validation"), score(best, "heldout"), score(now, "heldout"))
                    rows.append(Row(method, seed, budgets[len(rows)], *judged))
                now = vector
            yield rows


def _incumbents(
    problem: Problem, start: Tensor, method: str, seed: int, schedule: Schedule
) -> Iterator[tuple[float, Tensor]]:
    search, at, each = method.partition("@")
    if search in SEARCHES:
        options = {"per_evaluation": int(each)} if at else {}
        yield from SEARCHES[search](problem, start, schedule.episodes, seed, **options)
        return
    if method in RIVALS:
        yield from RIVALS[method](problem, start, schedule.episodes, seed)
        return
    name, _, warm = method.partition("+")
    own = replace(schedule, estimator=name, seed=seed, validations=1, validation_scenes=1)
    if warm == "none":
        own = replace(own, warm_episodes=0)
    elif warm:
        own = replace(own, warm_estimator=warm)
    seen: list[tuple[float, Tensor]] = []
    with suppress(SettingError):  # one that diverges ends there
        train(problem, start, own, None, lambda state, _: seen.append((state.episodes, state.vector)))
    yield from seen


def student(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean over seeds with its 95% interval by Student's t; of no width for one seed."""
    n, mean = len(values), float(np.mean(values))
    half = _STUDENT.get(n - 1, 1.96) * float(np.std(values, ddof=1)) / math.sqrt(n) if n > 1 else 0.0
    return mean, mean - half, mean + half


def mean_curves(rows: Sequence[Row]) -> dict[str, dict[int, list[float]]]:
    """Held-out scores of all seeds, by method and budget."""
    scores: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in sorted(rows, key=lambda row: (row.episodes, row.seed)):
        scores[row.method][row.episodes].append(row.heldout)
    return scores


def episodes_to_reach(by_budget: dict[int, list[float]], level: float, resamples: int = 2000) -> dict[str, Any]:
    """Episodes at which a method's mean curve first reaches a level, between budgets by log-linear interpolation.

    Args:
        by_budget: held-out scores of the same seeds at each budget.
        level: to reach.
        resamples: of the seeds.

    Returns:
        `episodes` with its bootstrap interval over seeds, `low` and `high` (infinite: not within the largest budget; at
        the smallest budget: there or before), and `samples` that were drawn for it.
    """
    budgets = sorted(by_budget)
    values = np.array([by_budget[b] for b in budgets])

    def crossing(mean: np.ndarray) -> float:
        above = np.flatnonzero(mean >= level)
        if len(above) == 0:
            return math.inf
        k = int(above[0])
        if k == 0:
            return float(budgets[0])
        share = (level - mean[k - 1]) / (mean[k] - mean[k - 1])
        return float(budgets[k - 1] * (budgets[k] / budgets[k - 1]) ** share)

    rng = np.random.default_rng(0)
    drawn = rng.integers(values.shape[1], size=(resamples, values.shape[1]))
    samples = np.sort([crossing(values[:, seeds].mean(1)) for seeds in drawn])
    low, high = samples[int(0.025 * resamples)], samples[int(0.975 * resamples)]
    return {"episodes": crossing(values.mean(1)), "low": float(low), "high": float(high), "samples": samples}
