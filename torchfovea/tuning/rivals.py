"""The simplest rivals of a gradient: a bias that is fitted to directions, those of the targets or of what was found.

`fitted` reads where the targets of training scenes stand. `remembered` sees nothing but its own episodes: it plays,
notes where each one's best fixation landed, drops the farthest fifth, fits, and plays again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.memory.sphere import DirectionMixture
from torchfovea.sensing.head import cyclopean
from torchfovea.setting import SettingError, require
from torchfovea.tuning.bias import Shape, encode, features, numbers_of, with_weights
from torchfovea.tuning.problem import Problem, evaluate_policies, play, play_each
from torchfovea.tuning.scenes import Scenes, nearest_point, stream
from torchfovea.tuning.simulator import Run

__all__ = [
    "ALPHAS", "RIVALS", "Noted", "best_alpha", "fit_mixture", "fit_vector", "fitted", "fitted_bias", "nearest_share",
    "note_best", "remembered", "remembered_bias", "with_alpha",
]  # fmt: skip

ALPHAS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5)
"""Among which α is chosen where it is chosen by trying."""

_FARTHEST = 0.2  # share of the remembered fixations that is dropped
_LEAST_STD = 0.05  # of a fitted component, about the shape's own limit
_NO_LOG_OF_0 = 0.01  # of a unit vector's component
_FIRST = 32
_ROUNDS = 200
_TRIED = (0.1, 0.3, 1.0)  # α, on training episodes
_APART = math.radians(0.1)

Incumbents = Iterator[tuple[float, Tensor]]


class Noted(NamedTuple):
    """Where each of K episodes' best fixation landed.

    Attributes:
        direction: unit, from E, (K, 3).
        range_m: (K,).
        task: what the policy was told, (K, 2).
    """

    direction: Tensor
    range_m: Tensor
    task: Tensor


def fit_vector(shape: Shape, direction: Tensor, task: Tensor, alpha: float) -> Tensor:
    """The vector of the mixture that fits directions: closed form, EM for M ≥ 2, regression on the task if conditioned.

    A component's mean and covariance are those of the unit vectors (M = 1), with a standard deviation of at least 0.05
    along each axis. A conditioned shape's means are quadratic in the task by least squares; the mixture is one of the
    residuals, the same for all tasks. Where a task tells how sure it is (K = 4), the residuals' log squares are
    regressed on it as well (Harvey 1976), and a component's diagonals follow.

    Args:
        shape: how a vector is read.
        direction: unit (K, 3).
        task: (K, 2) or (K, 4); only a conditioned shape looks at it.
        alpha: of the vector.

    Raises:
        SettingError: for a degenerate fit: fewer different directions than components and one more, or than the
            regression's coefficients.
    """
    direction, task = direction.double(), task.double()
    if not shape.conditioned:
        return encode(shape, fit_mixture(direction, shape.components), alpha)
    x, m, needed = features(task), shape.components, shape.monomials
    _require_different(direction, max(m + 1, needed + 1))
    told = int(torch.linalg.matrix_rank(x)) == needed
    require(told, "tasks to fit", len(x), "tasks that tell a quadratic function apart")
    coefficients = torch.linalg.lstsq(x, direction).solution
    apart = direction - x @ coefficients
    body = torch.zeros(needed, shape.numbers, dtype=torch.float64)
    body[0] = numbers_of(_mixture(apart, m))
    if shape.task_numbers > 2:
        line = x[:, : 1 + shape.task_numbers]
        slope = torch.linalg.lstsq(line, 0.5 * (apart.square() + _NO_LOG_OF_0**2).log()).solution[1:]
        body[1 : 1 + shape.task_numbers, 3 * m : 6 * m] += slope.repeat(1, m)
        # the mean of the variances stays
        body[0, 3 * m : 6 * m] -= 0.5 * (2 * task @ slope).exp().mean(0).log().repeat(m)
    body[:, : 3 * m] += coefficients.repeat(1, m)
    return torch.cat([body.flatten(), shape.tail(alpha, shape.fov_deg)])


def fit_mixture(direction: Tensor, components: int = 1) -> DirectionMixture:
    """The mixture that fits directions, see `fit_vector`.

    Args:
        direction: unit (K, 3).
        components: M ≥ 1.

    Raises:
        SettingError: for a degenerate fit: fewer different directions than components and one more.
    """
    _require_different(direction, components + 1)
    return _mixture(direction.double(), components)


def _require_different(direction: Tensor, needed: int) -> None:
    different = len((direction / _APART).round().unique(dim=0))
    require(different >= needed, "directions to fit", different, f"at least {needed} different ones for this bias")


def _mixture(v: Tensor, components: int) -> DirectionMixture:
    """Gaussians of vectors (K, 3): moments of one; EM of several from far-apart members (Dempster et al. 1977)."""
    floor = _LEAST_STD**2 * torch.eye(3, dtype=v.dtype)
    chosen = [int((v - v.mean(0)).norm(dim=-1).argmin())]
    while len(chosen) < components:
        chosen.append(int((v[:, None] - v[chosen]).norm(dim=-1).amin(1).argmax()))
    share = torch.zeros(len(v), components, dtype=v.dtype)
    share[torch.arange(len(v)), (v[:, None] - v[chosen]).norm(dim=-1).argmin(1)] = 1
    last = -math.inf
    for _ in range(_ROUNDS):
        weight = share.sum(0).clamp(min=1e-9)
        mean = share.mT @ v / weight[:, None]
        apart = v[:, None] - mean
        covariance = torch.einsum("km,kmi,kmj->mij", share, apart, apart) / weight[:, None, None] + floor
        factor = torch.linalg.cholesky(covariance)
        whitened = torch.linalg.solve_triangular(factor, apart.permute(1, 2, 0), upper=False)
        log = (weight / len(v)).log()[:, None] - 0.5 * whitened.square().sum(1)
        log = log - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, None]
        share, total = log.softmax(0).mT, float(log.logsumexp(0).mean())
        if components == 1 or total - last < 1e-7:
            break
        last = total
    return DirectionMixture((weight / len(v)).log(), mean, factor)


def with_alpha(shape: Shape, vector: Tensor, alpha: float) -> Tensor:
    """The same bias with another α; the same vector where α is none of its numbers."""
    return with_weights(shape, vector, alpha=alpha)


def best_alpha(problem: Problem, vector: Tensor, scenes: int, alphas: Sequence[float] = ALPHAS) -> tuple[Tensor, float]:
    """The bias with the α that is best on the validation scenes, the same for all, and its score there."""
    if not problem.shape.tune_alpha:
        alphas = (problem.shape.alpha,)
    tried = [with_alpha(problem.shape, vector, alpha) for alpha in alphas]
    scores = evaluate_policies(problem, tried, problem.exam("validation", 0, scenes), strict=False).mean(1).tolist()
    best = scores.index(max(scores))
    return tried[best], scores[best]


def _targets(scenes: Scenes) -> Noted:
    point = nearest_point(*(f[:, 0] for f in scenes[:5]))
    low, high = scenes.low[:, 0], scenes.high[:, 0]
    # the target's visible middle: at the axis's height, on the near side
    point = torch.stack((point[:, 0], point[:, 1], (low + high) / 2), -1)
    return Noted(torch.nn.functional.normalize(point, dim=-1), scenes.nearest_m, scenes.task)


def note_best(problem: Problem, scenes: Scenes, run: Run) -> Noted:
    """Where the best fixation of each of an episodes' batch landed, as the robot itself can tell.

    Episodes whose best fixation is no surface nearer than far_m leave nothing.
    """
    reward, t = run.reward.max(1)
    gaze = type(run.gaze)(*(angle.gather(1, t[:, None])[:, 0] for angle in run.gaze))
    rotation, origin = cyclopean(problem.task.observer.head, gaze)
    axis, range_m = rotation[..., 2], -reward
    along = (origin * axis).sum(-1)
    ahead = (along.square() - origin.square().sum(-1) + range_m.square()).clamp(min=0).sqrt() - along
    direction = torch.nn.functional.normalize(origin + ahead[:, None] * axis, dim=-1)
    seen = range_m < problem.task.far_m
    return Noted(direction[seen], range_m[seen], scenes.task[seen])


def nearest_share(noted: Noted) -> Noted:
    """Without the farthest fifth."""
    require(len(noted.range_m) > 0, "fixations to remember", 0, "at least one episode whose gaze met a surface")
    keep = noted.range_m.argsort(stable=True)[: max(1, round((1 - _FARTHEST) * len(noted.range_m)))]
    return Noted(*(f[keep] for f in noted))


def fitted(problem: Problem, start: Tensor, episodes: int, seed: int) -> Incumbents:
    """Fits to ever more training scenes' targets.

    A scene that is read counts as an episode, and so does each that is played to choose α: half of them.
    """
    step, spent, seen = 0, 0.0, []
    while spent < episodes:
        n = max(8, int(spent / 2)) if step else 16
        batch = problem.batch(n, stream("training", seed, step))
        seen.append(_targets(batch.scenes))
        spent, step = spent + n, step + 1
        noted = Noted(*(torch.cat(parts) for parts in zip(*seen, strict=True)))
        try:
            vector = fit_vector(problem.shape, noted.direction, noted.task, _alpha_of(problem, start))
        except SettingError:
            continue  # too few as yet
        chosen, cost = _try_alphas(problem, vector, max(4, n // len(_TRIED)), seed, step)
        spent, step = spent + cost, step + 1
        yield spent, chosen


def remembered(problem: Problem, start: Tensor, episodes: int, seed: int) -> Incumbents:
    """Refits to where its own best fixations landed, in rounds of 32, 64, 64, 128, 128, ... episodes.

    From the second round on a third of the episodes, on the same scenes, has another α to either side.
    """
    vector, spent, step, n = start, 0.0, 0, _FIRST
    while spent < episodes:
        batch = problem.batch(n, stream("training", seed, step))
        with suppress(SettingError):
            run = play(problem, vector, batch, strict=False)
            noted = nearest_share(note_best(problem, batch.scenes, run))
            vector = fit_vector(problem.shape, noted.direction, noted.task, _alpha_of(problem, vector))
        spent, step = spent + n, step + 1
        yield spent, vector
        if problem.shape.tune_alpha and step >= 2 and spent < episodes:
            vector, cost = _try_alphas(problem, vector, n // 4, seed, step)
            spent, step = spent + cost, step + 1
            yield spent, vector
        n = min(2 * n, 1024) if step > 1 else n


def _alpha_of(problem: Problem, vector: Tensor) -> float:
    return math.exp(float(vector[problem.shape.body])) if problem.shape.tune_alpha else problem.shape.alpha


def _try_alphas(problem: Problem, vector: Tensor, scenes: int, seed: int, step: int) -> tuple[Tensor, float]:
    """The best of a few α on the same training episodes, and what they cost."""
    if not problem.shape.tune_alpha:
        return vector, 0.0
    tried = [with_alpha(problem.shape, vector, alpha) for alpha in _TRIED]
    values = play_each(problem, tried, problem.batch(scenes, stream("training", seed, step)))
    return tried[values.index(max(values))], float(len(tried) * scenes)


def _last(incumbents: Incumbents, start: Tensor, episodes: int) -> Tensor:
    """What stands when so many episodes are spent; the first of all that comes if that is later."""
    vector: Tensor | None = None
    for spent, fresh in incumbents:
        if vector is None or spent <= episodes:
            vector = fresh
        if spent >= episodes:
            break
    return start if vector is None else vector


def fitted_bias(problem: Problem, start: Tensor, episodes: int, seed: int, validation_scenes: int) -> Tensor:
    """`fitted` after so many episodes, with the α that is best on validation scenes."""
    return best_alpha(problem, _last(fitted(problem, start, episodes, seed), start, episodes), validation_scenes)[0]


def remembered_bias(problem: Problem, start: Tensor, episodes: int, seed: int, validation_scenes: int) -> Tensor:
    """`remembered` after so many episodes, with the α that is best on validation scenes."""
    return best_alpha(problem, _last(remembered(problem, start, episodes, seed), start, episodes), validation_scenes)[0]


RIVALS: dict[str, Callable[..., Incumbents]] = {"fitted": fitted, "remembered": remembered}
"""By name: what needs no search and no gradient, as incumbents with the episodes they have spent."""
