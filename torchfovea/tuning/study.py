"""Learning curves of gradient tuning and of searches without gradients, at equal simulated episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchfovea.tuning.baselines import SEARCHES
from torchfovea.tuning.problem import Problem, evaluate, play
from torchfovea.tuning.scenes import stream
from torchfovea.tuning.train import ESTIMATORS, Schedule, train

__all__ = ["budgets_up_to", "curves", "finite_difference_check"]

Row = tuple[str, int, int, float, float]


def budgets_up_to(episodes: int) -> list[int]:
    """128, 256, 512, … up to a number, which is the last."""
    budgets = [128 * 2**k for k in range(20) if 128 * 2**k < episodes]
    return [*budgets, episodes]


def curves(
    problem: Problem,
    start: Tensor,
    methods: list[str],
    seeds: int,
    schedule: Schedule,
    heldout_scenes: int = 512,
    progress: Callable[[str, int], None] | None = None,
) -> Iterator[Row]:
    """Held-out score of each method's incumbent as its episodes are spent.

    Every method starts at the same vector. Its incumbent is validated at 128, 256, 512, … episodes (not counted, the
    same for all), and the best so far on validation is what the held-out scenes judge.

    Args:
        problem: what is tuned.
        start: vector.
        methods: names of estimators, of searches, or ESTIMATOR+WARM for another warm start, `none` for none.
        seeds: how many.
        schedule: of the estimators; its episodes are the budget of all.
        heldout_scenes: the same for all.
        progress: called with each method and seed when it begins.

    Yields:
        (method, seed, episodes, validation score, held-out score).
    """
    budgets = budgets_up_to(schedule.episodes)
    for method in methods:
        for seed in range(seeds):
            if progress is not None:
                progress(method, seed)
            best, best_value, reached = start, -1.0, 0
            for spent, vector in _incumbents(problem, start, method, seed, schedule):
                while reached < len(budgets) and (spent >= budgets[reached]):
                    value = float(evaluate(problem, vector, schedule.validation_scenes, stream("validation", 0)).mean())
                    if value > best_value:
                        best, best_value = vector, value
                    final = float(evaluate(problem, best, heldout_scenes, stream("heldout", 0)).mean())
                    yield method, seed, budgets[reached], best_value, final
                    reached += 1


def _incumbents(
    problem: Problem, start: Tensor, method: str, seed: int, schedule: Schedule
) -> Iterator[tuple[float, Tensor]]:
    if method in SEARCHES:
        yield from SEARCHES[method](problem, start, schedule.episodes, seed)
        return
    name, _, warm = method.partition("+")
    assert name in ESTIMATORS
    own = replace(schedule, estimator=name, seed=seed, validations=1, validation_scenes=1)
    if warm == "none":
        own = replace(own, warm_episodes=0)
    elif warm:
        own = replace(own, warm_estimator=warm)
    seen: list[tuple[float, Tensor]] = []
    train(problem, start, own, None, lambda state, _: seen.append((state.episodes, state.vector)))
    yield from seen


def finite_difference_check(
    problem: Problem, vector: Tensor, estimator: str, episodes: int, step: float = 0.1, seed: int = 0
) -> dict[str, float | list[float]]:
    """An estimator against central differences of the hard objective with common random numbers.

    Args:
        problem: what is tuned.
        vector: where.
        estimator: its name.
        episodes: a side for each difference, and scenes for the estimate, on other seeds.
        step: of the differences.
        seed: of both.

    Returns:
        cosine, norm_ratio (estimate over differences), and both gradients.
    """
    size = 128
    batches = max(1, episodes // size)
    difference, estimate = torch.zeros_like(vector), torch.zeros_like(vector)
    for k in range(batches):
        batch = problem.batch(min(size, episodes), stream("validation", seed + 1, k))
        for i in range(len(vector)):
            offset = torch.zeros_like(vector)
            offset[i] = step
            slope = (play(problem, vector + offset, batch).value - play(problem, vector - offset, batch).value).mean()
            difference[i] += float(slope) / (2 * step * batches)
        other = problem.batch(min(size, episodes), stream("validation", seed + 2, k))
        estimate += ESTIMATORS[estimator](problem, vector, other, alpha_share=1.0).vector / batches
    cosine = float(torch.nn.functional.cosine_similarity(estimate, difference, dim=0))
    return {
        "cosine": cosine,
        "norm_ratio": float(estimate.norm() / difference.norm()),
        "estimate": estimate.tolist(),
        "difference": difference.tolist(),
    }
