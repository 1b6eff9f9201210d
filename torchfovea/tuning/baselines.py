"""What gradient tuning is measured against: hand-made biases, and searches without gradients at equal episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.memory.sphere import direction_mixture
from torchfovea.tuning.adam import adam, at_rest
from torchfovea.tuning.bias import Shape, encode, features, fix_vector
from torchfovea.tuning.problem import Problem, evaluate_bias, play_each
from torchfovea.tuning.rivals import best_alpha
from torchfovea.tuning.scenes import Distribution, stream

__all__ = ["SEARCHES", "TABLE_1", "hand", "table_1"]

# Table 1, with Target in x forward, y left, z up (see conf/memory/target.yaml): means and isotropic variances
TABLE_1 = {
    "unbiased": ([0.0, 0.0, 0.0], 0.5),
    "top": ([0.0, 0.0, 1.0], 0.5),
    "down": ([0.0, 0.0, -1.0], 0.5),
    "target": ([0.61, 0.67, -0.43], 0.05),
}
_SIGMAS = (0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.32)

Incumbents = Iterator[tuple[float, Tensor]]


def table_1(shape: Shape, name: str, alpha: float = 1.0) -> Tensor:
    """The vector of one of Table 1's biases."""
    mean, variance = TABLE_1[name]
    return encode(shape, direction_mixture([1.0], [mean], [[variance] * 3], dtype=torch.float64), alpha)


def _centre(azimuth_deg: Tensor, elevation_deg: Tensor) -> Tensor:
    a, e = azimuth_deg.deg2rad(), elevation_deg.deg2rad()
    return torch.stack((a.cos() * e.cos(), a.sin() * e.cos(), e.sin()), -1)


def hand(
    problem: Problem, alpha: float = 1.0, scenes: int = 512, sigmas: tuple[float, ...] = _SIGMAS
) -> tuple[Tensor, float]:
    """One isotropic Gaussian on each region's centre, with the σ and then the α that are best on validation scenes.

    `alpha` is what σ is chosen with. It knows the distribution's own definition; for a conditioned one its means follow
    the task, by least squares.

    Returns:
        The vector and its σ.

    Raises:
        SettingError: for a shape with fewer components than the distribution has regions.
    """
    shape, distribution = problem.shape, problem.distribution
    scored = []
    for sigma in sigmas:
        vector = (
            _conditioned_hand(shape, distribution, sigma, alpha)
            if shape.conditioned
            else _plain_hand(shape, distribution, sigma, alpha)
        )
        scored.append(
            (float(evaluate_bias(problem, vector, problem.exam("validation", 0, scenes)).mean()), sigma, vector)
        )
    _, sigma, vector = max(scored, key=lambda item: item[0])
    return best_alpha(problem, vector, scenes)[0], sigma


def _plain_hand(shape: Shape, distribution: Distribution, sigma: float, alpha: float) -> Tensor:
    bounds = torch.tensor(distribution.regions, dtype=torch.float64)
    if shape.components < len(bounds):
        bounds = bounds.mean(0, keepdim=True)
    repeat = torch.arange(shape.components) % len(bounds)
    bounds = bounds[repeat]
    means = _centre(bounds[:, :2].mean(1), bounds[:, 2:].mean(1))
    covariances = torch.full((len(means), 3), sigma**2, dtype=torch.float64)
    return encode(shape, direction_mixture([1.0] * len(means), means, covariances), alpha)


def _conditioned_hand(shape: Shape, distribution: Distribution, sigma: float, alpha: float) -> Tensor:
    a0, a1, e0, e1 = distribution.regions[0]
    side = torch.linspace(-1, 1, 9, dtype=torch.float64)
    task = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, shape.task_numbers - 2))
    centre = _centre((a0 + a1) / 2 + task[:, 0] * (a1 - a0) / 2, (e0 + e1) / 2 + task[:, 1] * (e1 - e0) / 2)
    coefficients = torch.linalg.lstsq(features(task), centre, driver="gelsd").solution  # some features are 0
    body = torch.zeros(shape.monomials, shape.numbers, dtype=torch.float64)
    m = shape.components
    body[:, : 3 * m] = coefficients.repeat(1, m)
    body[0, 3 * m : 6 * m] = math.log(sigma)
    return torch.cat([body.flatten(), shape.tail(alpha, shape.fov_deg)])


def _objective(problem: Problem, seed: int, per_evaluation: int) -> Callable[[Sequence[Tensor], int], list[float]]:
    """Of several vectors on the same scenes; −1 for a bias that never falls within reach."""

    def objective(vectors: Sequence[Tensor], key: int) -> list[float]:
        return play_each(problem, vectors, problem.batch(per_evaluation, stream("training", seed, key)))

    return objective


def _ranges(problem: Problem, start: Tensor) -> tuple[Tensor, Tensor]:
    """Sensible bounds of every number for searches that need them."""
    shape, m = problem.shape, problem.shape.components
    low, high = torch.full((shape.numbers,), -0.5), torch.full((shape.numbers,), 0.5)
    low[: 3 * m], high[: 3 * m] = -1.0, 1.0
    low[3 * m : 6 * m], high[3 * m : 6 * m] = -2.5, 0.0
    low[9 * m :], high[9 * m :] = -2.0, 2.0
    if shape.conditioned:
        narrow = torch.full(((shape.monomials - 1) * shape.numbers,), 0.5)
        low, high = torch.cat((low, -narrow)), torch.cat((high, narrow))
    if shape.tune_alpha:
        low, high = torch.cat((low, torch.tensor([-2.0]))), torch.cat((high, torch.tensor([1.0])))
    if shape.tuned:
        low, high = (torch.cat((ends, sign * torch.ones(len(shape.tuned)))) for ends, sign in ((low, -1), (high, 1)))
    if shape.fov_deg is not None:
        low, high = torch.cat((low, torch.tensor([-1.0]))), torch.cat((high, torch.tensor([1.3])))
    return low.double(), high.double()


def random_search(problem: Problem, start: Tensor, episodes: int, seed: int, per_evaluation: int = 32) -> Incumbents:
    """Uniform draws within sensible ranges; the best observed so far."""
    low, high = _ranges(problem, start)
    rng = torch.Generator().manual_seed(seed)
    objective, best, spent, key = _objective(problem, seed, per_evaluation), (-math.inf, start), 0, 0
    while spent < episodes:
        vector = start if key == 0 else low + (high - low) * torch.rand(len(low), generator=rng, dtype=torch.float64)
        (value,) = objective([vector], key)
        best = max(best, (value, vector), key=lambda item: item[0])
        spent, key = spent + per_evaluation, key + 1
        yield spent, best[1]


def cma_es(problem: Problem, start: Tensor, episodes: int, seed: int, per_evaluation: int = 16) -> Incumbents:
    """CMA-ES of the library cma from the start, all of a generation on the same scenes; its mean is the incumbent."""
    import cma

    options = {"seed": seed + 1, "verbose": -9, "maxiter": 10**9, "tolfun": 0, "tolx": 0, "tolstagnation": 10**9}
    strategy = cma.CMAEvolutionStrategy(start.tolist(), 0.4, options)
    objective, spent, key = _objective(problem, seed, per_evaluation), 0, 0
    while spent < episodes:
        asked = strategy.ask()
        strategy.tell(asked, [-value for value in objective([torch.tensor(np.asarray(x)) for x in asked], key)])
        spent, key = spent + per_evaluation * len(asked), key + 1
        yield spent, torch.tensor(np.asarray(strategy.result.xfavorite))


def tpe(problem: Problem, start: Tensor, episodes: int, seed: int, per_evaluation: int = 32) -> Incumbents:
    """Tree-structured Parzen estimator of the library optuna; the best observed so far."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    low, high = _ranges(problem, start)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed, multivariate=False))
    inside = start.clamp(min=low, max=high)
    study.enqueue_trial({f"x{i}": float(v) for i, v in enumerate(inside)})
    objective, spent, key = _objective(problem, seed, per_evaluation), 0, 0
    while spent < episodes:
        trial = study.ask()
        bounds = zip(low.tolist(), high.tolist(), strict=True)
        vector = torch.tensor(
            [trial.suggest_float(f"x{i}", a, b) for i, (a, b) in enumerate(bounds)], dtype=torch.float64
        )
        study.tell(trial, objective([vector], key)[0])
        spent, key = spent + per_evaluation, key + 1
        best = study.best_params
        yield spent, torch.tensor([best[f"x{i}"] for i in range(len(low))], dtype=torch.float64)


def finite_differences(
    problem: Problem, start: Tensor, episodes: int, seed: int, per_evaluation: int = 4
) -> Incumbents:
    """Adam on central differences with common random numbers, one number after the other."""
    vector = fix_vector(problem.shape, start)
    objective, spent, key = _objective(problem, seed, per_evaluation), 0, 0
    moments = at_rest(vector)
    cost, h = 2 * per_evaluation * len(vector), 0.2
    offsets = h * torch.eye(len(vector), dtype=torch.float64)
    while spent < episodes:
        sides = objective([*(vector + offsets), *(vector - offsets)], key)
        ahead, behind = torch.tensor(sides, dtype=torch.float64).chunk(2)
        slope = (ahead - behind) / (2 * h)
        spent, key = spent + cost, key + 1
        moments, move = adam(moments, slope, 0.1 - 0.08 * min(spent / episodes, 1))
        vector = fix_vector(problem.shape, vector + move)
        yield spent, vector


SEARCHES: dict[str, Callable[..., Any]] = {
    "random": random_search,
    "cma_es": cma_es,
    "tpe": tpe,
    "finite_differences": finite_differences,
}
