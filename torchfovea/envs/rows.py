"""B searches that advance row by row, as tensors: what the environments are made of."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.commands.shared.build import build_cells, build_observer
from torchfovea.commands.shared.rollout import sample_of
from torchfovea.commands.shared.settings import number
from torchfovea.commands.shared.strategy import build_stop
from torchfovea.deciding.acquisition import known_well_enough
from torchfovea.deciding.strategies import Strategy, View
from torchfovea.envs.places import CellPlaces, GeometricPlaces, PhotometricPlaces, RobotPlaces, SearchPlaces
from torchfovea.envs.settings import EnvSettings, search_settings
from torchfovea.memory.cell_index import CellIndex
from torchfovea.memory.egosphere import Memory, trust
from torchfovea.memory.nearest import join_indices
from torchfovea.metrics import gap, information, near_target
from torchfovea.perception import Step, decide, gaze_at, new_memory
from torchfovea.rows import each
from torchfovea.search import Look, Robot
from torchfovea.sensing.head import Gaze, fixate
from torchfovea.setting import require

__all__ = ["Outcome", "SearchRows"]

CELLS_SEED = 0


class Outcome(NamedTuple):
    """What a saccade of K rows came to.

    Attributes:
        reward: (K,), as the settings weigh it.
        terminated: bool (K,), by the stop rule or by naming the target.
        truncated: bool (K,), by the last saccade.
    """

    reward: Tensor
    terminated: Tensor
    truncated: Tensor


def _mean(view: View) -> Tensor:
    return view.mean


class SearchRows:
    """B searches with memories over the same cells; each begins and ends by itself.

    What a row does depends on its own seed and actions only, and not on the others.

    Args:
        settings: of the environment.
        count: B.
        device: of the memories and of the geometric sensor's rays.
        robots: B of them in place of simulated scenes; see `torchfovea.envs.places.RobotPlaces`.

    Attributes:
        observer: the fixed parts.
        cells: unit directions (Nx, 3).
        step: of all rows, what is known: the last decision's beliefs.
        nats: of all rows, each cell's information −log|Σ| (B, Nx).
        near: of all rows, which cells' true points are near the nearest one (B, Nx); none where nobody judges.
        gaze: of all rows, where the heads are.
        looks: of each row the last look, which row of that look is its own, and the gaze; no look in fidelity `cells`.
    """

    def __init__(
        self,
        settings: EnvSettings,
        count: int,
        device: torch.device | str = "cpu",
        robots: Sequence[Robot] | None = None,
    ) -> None:
        require(isinstance(count, int) and count >= 1, "num_envs", count, "at least 1")
        require(robots is None or len(robots) == count, "robots", len(robots or ()), f"one for each of {count} rows")
        self.settings, self.count, self.device = settings, count, torch.device(device)
        cfg = search_settings(settings.overrides, settings.fidelity)
        self.observer = build_observer(cfg)
        own = torch.Generator().manual_seed(CELLS_SEED)  # the same cells in every episode: a cell's number means it
        self.cells = build_cells(cfg, self.observer.head, own).to(self.device)
        self.fields = min(sample_of(cfg) or self.observer.retina.count, self.observer.retina.count)
        self.far_m, self.near_target_m, self.stop = number(cfg, "far_m"), number(cfg, "near_target_m"), build_stop(cfg)
        self.places: SearchPlaces
        if robots is not None:
            self.places = RobotPlaces(robots, self.observer, self.cells)
        else:
            kind: dict[str, Any] = {"photometric": PhotometricPlaces, "geometric": GeometricPlaces, "cells": CellPlaces}
            self.places = kind[settings.fidelity](cfg, self.observer, self.cells, count, settings.scenes[0])
        one = new_memory(self.observer, self.cells)
        self._index = lru_cache(maxsize=count)(lambda k: join_indices([one.lookup] * k))
        self._blank = _spread(one._replace(axis=self.cells.new_zeros(3)), 1, self._index(1))
        self.memory = _spread(self._blank, count, self._index(count))
        self.generators = [torch.Generator() for _ in range(count)]
        zero = torch.zeros(count, device=self.device)
        self.gaze = Gaze(zero, zero.clone(), zero.clone())
        self.time = torch.zeros(count, dtype=torch.int64)
        self.course = torch.full((count, settings.saccades), torch.nan, dtype=torch.float64)  # true rewards
        self.nearest = torch.full((count,), torch.nan, dtype=torch.float64)
        self.known = torch.full((count, settings.saccades), torch.nan, dtype=torch.float64)  # global information
        self.locally = self.known.clone()
        self.hit = torch.zeros(count, settings.saccades, dtype=torch.bool)
        self.travelled, self.seconds = torch.zeros(2, count, dtype=torch.float64)
        self.judged = torch.zeros(count, dtype=torch.bool)
        self.near = torch.zeros(count, len(self.cells), dtype=torch.bool, device=self.device)
        self.looks: list[tuple[Look | None, int, Gaze]] = [(None, 0, self.gaze)] * count
        self.step: Step = decide(self.observer, self.memory, strategy=_mean)
        self.nats = information(self.step.points.cov)

    def begin(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Begin an episode in some rows: another scene, an empty memory, and a look straight ahead.

        Args:
            rows: their numbers.
            seeds: one for each; the same seed gives the same scene and the same noise.
        """
        some, scenes, chosen, noises = list(rows), self.settings.scenes, [], []
        for row, seed in zip(some, seeds, strict=True):
            generator = self.generators[row].manual_seed(seed)
            chosen.append(scenes[int(torch.randint(len(scenes), (), generator=generator))])
            noises.append(int(torch.randint(2**62, (), generator=generator)))
        self.places.renew(some, chosen, noises)
        for row in some:
            truth = self.places.truth(row)
            self.judged[row] = truth is not None
            self.nearest[row] = torch.nan if truth is None else truth.nearest_m
            if truth is not None:
                near = near_target(truth.cell_points, truth.nearest_point, self.near_target_m)
                self.near[row] = near.to(self.device)
        for field in (self.course, self.known, self.locally):
            field[some] = torch.nan
        self.time[some], self.hit[some], self.travelled[some], self.seconds[some] = 0, False, 0.0, 0.0
        blank = _spread(self._blank, len(some), self._index(len(some)))
        zero = torch.zeros(len(some), device=self.device)
        self._visit(some, blank, Gaze(zero, zero, zero))

    def advance(self, rows: Sequence[int], gaze: Gaze, last: Tensor) -> Outcome:
        """Turn some heads, look there, and judge.

        Args:
            rows: their numbers, K.
            gaze: (K,), clamped to the heads' limits.
            last: bool (K,), rows that name the target: their heads turn to the best cell instead, and look no more.
        """
        some = list(rows)
        before, found = self._worth(some), self.hit[some].any(-1)
        informed, travelled = self.known[some].gather(1, self.time[some][:, None])[:, 0], self.travelled[some]
        looking = [row for row, ends in zip(some, last.tolist(), strict=True) if not ends]
        if looking:
            self.time[looking] += 1
            part = (~last).nonzero()[:, 0].to(self.device)
            memory = self.memory if len(looking) == self.count else self._memory(looking)
            self._visit(looking, memory, Gaze(*(angle[part] for angle in gaze)))
        terminated = last.clone()
        ended = [row for row, ends in zip(some, last.tolist(), strict=True) if ends]
        self.time[ended] += 1
        if self.stop is not None and looking:
            step = self.step
            well = known_well_enough(step.reward.mean, step.reward.std, step.eligible, *self.stop).cpu()
            stops = [row for row in looking if bool(well[row]) and int(self.time[row]) + 1 < self.settings.saccades]
            self.time[stops] += 1
            terminated |= torch.tensor([row in stops for row in some])
            ended += stops
        if ended:
            self._fixate_best(ended)
        truncated = ~terminated & (self.time[some] + 1 >= self.settings.saccades)
        weights = self.settings
        gained = (self.known[some].gather(1, self.time[some][:, None])[:, 0] - informed).nan_to_num()
        reward = weights.information * gained - weights.degrees * (self.travelled[some] - travelled)
        judged = self.judged[some]
        reward += weights.gap * torch.where(judged, self._worth(some) - before, 0.0)
        reward += weights.found * (self.hit[some].any(-1) & ~found)
        return Outcome(reward, terminated, truncated)

    def _visit(self, rows: list[int], memory: Memory, gaze: Gaze) -> None:
        executed = self._turn(rows, gaze)
        memory, look = self.places.sense(rows, memory, executed, [self.generators[row] for row in rows])
        step = decide(self.observer, memory, gaze=executed, strategy=_mean)
        for k, row in enumerate(rows):
            self.looks[row] = look, k, executed
        whole = rows == list(range(self.count))
        self.memory = memory if whole else _put(self.memory, rows, memory)
        self.step = step._replace(memory=self.memory) if whole else _put(self.step, rows, step)
        nats = information(step.points.cov)
        self.nats = nats if whole else _put(self.nats, rows, nats)
        self.known[rows, self.time[rows]] = nats.mean(-1).double().cpu()
        near = self.near[rows]
        count = near.sum(-1)
        local = torch.where(near, nats, 0.0).sum(-1) / count
        judged = self.judged[rows].to(self.device) & (count > 0)
        self.locally[rows, self.time[rows]] = torch.where(judged, local, torch.nan).double().cpu()

    def _turn(self, rows: list[int], gaze: Gaze) -> Gaze:
        """Turn, and judge where the heads then look."""
        move = self.places.saccade(rows, gaze)
        executed = Gaze(*(torch.as_tensor(angle).to(self.cells) for angle in move.gaze))
        for all_rows, angle in zip(self.gaze, executed, strict=True):
            all_rows[rows] = angle
        if bool((self.time[rows] > 0).any()):
            self.travelled[rows] += torch.as_tensor(move.degrees).double().cpu()
            self.seconds[rows] += torch.as_tensor(move.seconds).double().cpu()
        seen = self.places.fixation(rows, executed)
        if seen is not None:
            nothing = torch.as_tensor(seen.is_floor).cpu()
            range_m = torch.where(nothing, torch.inf, torch.as_tensor(seen.range_m).double().cpu())
            self.course[rows, self.time[rows]] = -range_m.clamp(max=self.far_m)
            self.hit[rows, self.time[rows]] = torch.as_tensor(seen.is_target).cpu()
        return executed

    def _fixate_best(self, rows: list[int]) -> None:
        """The last saccade of searches that have ended: to the best eligible cell, where nobody looks any more."""
        step = self.step
        best = torch.where(step.eligible, step.reward.mean, -torch.inf)[rows].argmax(-1)
        self._turn(rows, gaze_at(fixate(self.observer.head, step.points.mean[rows])[0], best))
        now = self.time[rows]
        self.known[rows, now], self.locally[rows, now] = self.known[rows, now - 1], self.locally[rows, now - 1]

    def _memory(self, rows: list[int]) -> Memory:
        memory: Memory = each(lambda part: part[rows], self.memory, (CellIndex,))
        return memory._replace(lookup=self._index(len(rows)))

    def _worth(self, rows: list[int]) -> Tensor:
        """Gap reduction so far, (K,); NaN where nobody judges."""
        course = self.course[rows].nan_to_num(nan=-self.far_m)
        return torch.where(self.judged[rows], gap(course, -self.nearest[rows])[:, -1], torch.nan)

    def aims(self) -> Gaze:
        """The gaze at each cell's believed point, (B, Nx), as `torchfovea.perception.decide` aims."""
        step, prior = self.step, self.observer.prior.mean
        unseen = self.cells * (prior if self.memory.chart == "cartesian" else 1 / prior)
        doubted = (self.memory.looks > 0) & (trust(self.memory) < 0.5)
        return fixate(self.observer.head, torch.where(doubted[..., None], unseen, step.points.mean))[0]

    def decided(self, rows: Sequence[int], strategy: Strategy) -> Gaze:
        """Where some rows would look by a strategy, (K,)."""
        some = list(rows)
        memory = self.memory if some == list(range(self.count)) else self._memory(some)
        gaze = Gaze(*(angle[some] for angle in self.gaze))
        return decide(self.observer, memory, None, gaze, None, strategy).gaze


def _spread(memory: Memory, count: int, lookup: CellIndex) -> Memory:
    """One memory (1, Nx, ...), or one without an axis, for `count` rows."""
    lone = memory.cells.dim() == 2

    def several(part: Tensor) -> Tensor:
        part = part[None] if lone else part
        return part.expand(count, *part.shape[1:]).clone()

    spread: Memory = each(several, memory, (CellIndex,))
    return spread._replace(lookup=lookup)


def _put(whole: Any, rows: list[int], part: Any) -> Any:
    """Rows replaced, in new tensors: what was given out before stays what it was."""
    if isinstance(whole, CellIndex):
        return whole
    if isinstance(whole, tuple):
        return type(whole)(*(_put(a, rows, b) for a, b in zip(whole, part, strict=True)))
    if isinstance(whole, Tensor):
        return whole.index_copy(0, torch.tensor(rows, device=whole.device), part)
    return whole
