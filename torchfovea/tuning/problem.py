"""A tuning problem: episodes on a scene distribution as a function of a vector, with common random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.weighted import joined
from torchfovea.memory.sphere import Quadrature, sphere_quadrature
from torchfovea.sensing.camera import Pinhole
from torchfovea.setting import SettingError, require
from torchfovea.tuning.bias import Bias, Shape, decode, fov_of
from torchfovea.tuning.cells import draw_cells, reachable
from torchfovea.tuning.prior_field import PriorField, look_up
from torchfovea.tuning.scenes import Distribution, Scenes, draw_scenes, stream
from torchfovea.tuning.simulator import Run, simulate
from torchfovea.tuning.worlds import Task, Worlds, check_observer, world_of

__all__ = ["Batch", "Problem", "evaluate_bias", "evaluate_policies", "play", "play_each", "prepare"]

_QUADRATURE = 12000  # directions on the whole sphere
_AT_ONCE = 256  # episodes of an exam


class Batch(NamedTuple):
    """Random inputs of B episodes.

    Attributes:
        scenes: B of them.
        noise: (T, B, N).
        seed: of the cells.
    """

    scenes: Scenes
    noise: Tensor
    seed: int


class Problem:
    """What is tuned, on what.

    Args:
        task: what an episode is.
        distribution: of scenes.
        shape: how a vector is read.
        cells: N, of each episode's memory.
        dtype: of the episodes.
        field: what cells believe before they are seen; None: the observer's prior.

    Raises:
        SettingError: for no cells, fewer than two saccades, or an observer that the simulator does not model.
    """

    def __init__(
        self, task: Task, distribution: Distribution, shape: Shape, cells: int = 100,
        dtype: torch.dtype = torch.float32, field: PriorField | None = None,
    ) -> None:  # fmt: skip
        require(cells >= 2, "memory.cells", cells, "at least 2")
        names = ("gap_per_saccade", "gap_final")
        require(task.metric in names, "metric", task.metric, "one of " + ", ".join(names))
        require(task.saccades >= 2, "saccades", task.saccades, "at least 2")
        check_observer(task.observer)
        self.task, self.distribution, self.shape, self.cells, self.dtype = task, distribution, shape, cells, dtype
        self.field = field
        self._exams: dict[tuple[str, int, int], list[Batch]] = {}

    @cached_property
    def quadrature(self) -> Quadrature:
        """Directions within reach, for normalizers."""
        return sphere_quadrature(_QUADRATURE, lambda d: reachable(self.task.observer.head, d), self.dtype)

    def batch(self, scenes: int, generator: torch.Generator) -> Batch:
        """Draw the random inputs of some episodes."""
        drawn = draw_scenes(self.distribution, self.task.observer.head, scenes, generator, self.dtype)
        noise = torch.randn(self.task.saccades, scenes, self.cells, generator=generator, dtype=self.dtype)
        return Batch(drawn, noise, int(torch.randint(2**62, (), generator=generator)))

    def exam(self, split: str, seed: int, scenes: int) -> list[Batch]:
        """The episodes of a stream on which vectors are compared, drawn once.

        Args:
            split: see `torchfovea.tuning.scenes.stream`.
            seed: likewise.
            scenes: how many.
        """
        key = split, seed, scenes
        if key not in self._exams:
            generator = stream(split, seed)
            sizes = [min(_AT_ONCE, scenes - begin) for begin in range(0, scenes, _AT_ONCE)]
            self._exams[key] = [self.batch(size, generator) for size in sizes]
        return self._exams[key]

    def bias(self, vector: Tensor, scenes: Scenes) -> Bias:
        """The vector's mixtures for some scenes. Differentiable in the vector."""
        return decode(self.shape, vector.to(self.dtype), scenes.task)

    def at(self, vector: Tensor) -> Problem:
        """The problem with the field of view that a vector stands for, where that is tuned."""
        if self.shape.fov_deg is None:
            return self
        observer, other = self.task.observer, copy(self)
        camera = Pinhole.from_fov(fov_of(self.shape, vector), observer.retina.radius_px)
        other.task = self.task._replace(observer=replace(observer, camera=camera))
        return other


def prepare(problem: Problem, bias: Bias, batch: Batch, strict: bool = True) -> Worlds:
    """Draw the cells of a batch and put them into its scenes; unless strict, cells out of reach do not exist."""
    n, rng = len(batch.scenes.nearest_m), torch.Generator().manual_seed(batch.seed)
    cells = draw_cells(bias, n, problem.cells, problem.task.observer.head, rng, strict)
    made = (cells != 0).any(-1)
    cells = torch.where(made[..., None], cells, cells.new_tensor([1.0, 0.0, 0.0]))
    world = world_of(problem.task, batch.scenes, cells, batch.noise)._replace(allowed=made)
    if problem.field is not None:
        mean, std = look_up(problem.field, cells)
        world = world._replace(prior_mean=mean, prior_precision=std**-2)
    return world


def play(problem: Problem, vector: Tensor, batch: Batch, strict: bool = True) -> Run:
    """The episodes of a batch with the hard policy; the same batch gives the same episodes. See `prepare`."""
    problem = problem.at(vector)
    bias = problem.bias(vector.detach(), batch.scenes)
    return simulate(problem.task, batch.scenes, prepare(problem, bias, batch, strict), bias.weights)


def play_each(problem: Problem, vectors: Sequence[Tensor], batch: Batch) -> list[float]:
    """Mean value of a batch for each of several vectors, as `play` has it, all at once; −1 for one out of reach."""
    if problem.shape.fov_deg is not None:  # every vector has a sensor of its own
        return [_value(problem, vector, batch) for vector in vectors]
    worlds, weights, found = [], [], [-1.0] * len(vectors)
    inside = []
    n = len(batch.scenes.nearest_m)
    for k, vector in enumerate(vectors):
        bias = problem.bias(vector.detach(), batch.scenes)
        with suppress(SettingError):
            worlds.append(prepare(problem, bias, batch))
            weights.append(bias.weights.each(lambda weight: weight.expand(n)))
            inside.append(k)
    if inside:
        together = Worlds(*(torch.cat(parts, 1 if i == 2 else 0) for i, parts in enumerate(zip(*worlds, strict=True))))
        scenes = batch.scenes.take(torch.arange(n).repeat(len(inside)))
        value = simulate(problem.task, scenes, together, joined(weights)).value
        for k, mean in zip(inside, value.reshape(-1, n).mean(1).tolist(), strict=True):
            found[k] = mean
    return found


def _value(problem: Problem, vector: Tensor, batch: Batch) -> float:
    with suppress(SettingError):
        return float(play(problem, vector, batch).value.mean())
    return -1.0


def evaluate_bias(problem: Problem, vector: Tensor, exam: Sequence[Batch], strict: bool = True) -> Tensor:
    """The metric in the episodes of an exam (`Problem.exam`), (scenes,), with the hard policy. See `prepare`."""
    return evaluate_policies(problem, [vector], exam, strict)[0]


def evaluate_policies(
    problem: Problem, vectors: Sequence[Tensor], exam: Sequence[Batch], strict: bool = True
) -> Tensor:
    """As `evaluate_bias` of vectors with the same bias, whose weights of the acquisition alone differ: (K, scenes)."""
    problem, parts = problem.at(vectors[0]), []
    for batch in exam:
        each = [problem.bias(vector.detach(), batch.scenes) for vector in vectors]
        world = prepare(problem, each[0], batch, strict)
        parts.append(torch.stack([simulate(problem.task, batch.scenes, world, bias.weights).value for bias in each]))
    return torch.cat(parts, 1)
