"""Gradient estimators against finite differences of the hard objective with common random numbers."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.tuning.problem import Problem, play
from torchfovea.tuning.scenes import stream
from torchfovea.tuning.train import gradient

__all__ = ["Sample", "agreement", "estimate_gradient", "finite_differences", "slope_along"]

_SIZE = 128  # scenes of a batch


class Sample(NamedTuple):
    """A gradient from independent batches, (K, P), and the simulated episodes that a batch cost."""

    parts: Tensor
    episodes: float = 0.0

    @property
    def mean(self) -> Tensor:
        """(P,)."""
        return self.parts.mean(0)

    @property
    def square(self) -> float:
        """The squared norm, without what noise adds to it; at least 0."""
        noise = self.parts.var(0).sum() / len(self.parts) if len(self.parts) > 1 else 0.0
        return max(float(self.mean.square().sum() - noise), 0.0)

    def error_along(self, unit: Tensor) -> float:
        """Standard error of the component along a unit vector."""
        return float((self.parts @ unit).std() / math.sqrt(len(self.parts))) if len(self.parts) > 1 else math.nan


def _batches(episodes: int) -> tuple[int, int]:
    return max(1, episodes // _SIZE), min(_SIZE, episodes)


def _difference(problem: Problem, vector: Tensor, offset: Tensor, size: int, key: tuple[int, int]) -> float:
    """Mean of R(x + offset) − R(x − offset) over one batch of scenes, cells and noise."""
    batch = problem.batch(size, stream("validation", *key))
    return float((play(problem, vector + offset, batch).value - play(problem, vector - offset, batch).value).mean())


def finite_differences(problem: Problem, vector: Tensor, episodes: int, step: float = 0.1, seed: int = 1) -> Sample:
    """Central differences in every number, with common random numbers; `episodes` a side of each."""
    count, size = _batches(episodes)
    offsets = step * torch.eye(len(vector), dtype=torch.float64)
    rows = [[_difference(problem, vector, o, size, (seed, k)) / (2 * step) for o in offsets] for k in range(count)]
    return Sample(torch.tensor(rows, dtype=torch.float64), 2.0 * size * len(vector))


def slope_along(
    problem: Problem, vector: Tensor, unit: Tensor, episodes: int, step: float = 0.1, seed: int = 3
) -> Sample:
    """The objective's slope in one direction, (K, 1): far more exact at equal cost than one number after the other."""
    count, size = _batches(episodes)
    rows = [[_difference(problem, vector, step * unit, size, (seed, k)) / (2 * step)] for k in range(count)]
    return Sample(torch.tensor(rows, dtype=torch.float64), 2.0 * size)


def estimate_gradient(problem: Problem, vector: Tensor, estimator: str, episodes: int, seed: int = 2) -> Sample:
    """An estimator on `episodes` base scenes of its own, other than those of the differences."""
    count, size = _batches(episodes)
    found = [
        gradient(problem, estimator, vector, problem.batch(size, stream("validation", seed, k)), 1.0)
        for k in range(count)
    ]
    return Sample(torch.stack([f.vector for f in found]), sum(f.episodes for f in found) / count)


def agreement(estimate: Sample, difference: Sample, along: tuple[Tensor, Sample] | None = None) -> dict[str, Any]:
    """How an estimate compares with differences.

    Args:
        estimate: of an estimator.
        difference: the reference.
        along: a unit vector and the reference's slope along it, which then replaces that component of the reference's
            norm.

    Returns:
        `cosine` of the means, which noise lowers, and `cosine_without_noise` (above 1 by chance); `norm_ratio`,
        estimate over differences, both without what noise adds, and its standard error `norm_ratio_error`; the
        reference's `norm` and its error; `snr_32_episodes`, the estimate's norm over its standard deviation at 32
        episodes; and both gradients.
    """
    mean, reference = estimate.mean, difference.mean
    combined = reference
    square, unit = difference.square, torch.nn.functional.normalize(reference, dim=0)
    error = difference.error_along(unit)
    if along is not None:
        unit, slope = along
        across = Sample(difference.parts - (difference.parts @ unit)[:, None] * unit)
        square = float(slope.mean[0]) ** 2 + across.square
        combined = slope.mean * unit + across.mean
        error = slope.error_along(torch.ones(1, dtype=torch.float64))
    norm, own = math.sqrt(square), math.sqrt(estimate.square)
    own_error = estimate.error_along(torch.nn.functional.normalize(mean, dim=0))
    ratio = own / norm if norm > 0 else math.nan
    relative = math.hypot(own_error / own, error / norm) if own > 0 and norm > 0 else math.nan
    spread = math.nan
    if len(estimate.parts) > 1:
        spread = math.sqrt(float(estimate.parts.var(0).sum()) * estimate.episodes / 32)
    return {
        "cosine": float(torch.nn.functional.cosine_similarity(mean, reference, dim=0)),
        "cosine_without_noise": float(mean @ combined) / (own * norm) if own > 0 and norm > 0 else math.nan,
        "norm_ratio": ratio,
        "norm_ratio_error": ratio * relative,
        "norm": norm,
        "norm_error": error,
        "snr_32_episodes": own / spread if spread > 0 else math.nan,
        "estimate": mean.tolist(),
        "difference": reference.tolist(),
    }
