"""Studies of a memory that is carried around, and of one whose cells are drawn anew."""

from __future__ import annotations

import math
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.memory.study import COLUMNS, Rows, figures_of
from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.judge import estimate, fixation_course, judge_cells
from torchfovea.commands.shared.settings import number, whole
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.moving import move, resample
from torchfovea.metrics import gap
from torchfovea.perception import Observer, decide, new_memory, perceive
from torchfovea.sensing.head import Gaze, eyes, fixate
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.model import EgoPose
from torchfovea.sim.walk import Odometry

__all__ = ["study_moving", "study_resampling"]

FIRST_LOOKS = 5  # before the first move, or before the cells are drawn anew
ODOMETRY = Odometry()


def _look(observer: Observer, memory: Memory, arena: SimulatedArena, gaze: Gaze, generator: torch.Generator) -> Memory:
    told = Gaze(*(a.to(memory.cells) for a in arena.saccade(gaze).gaze))
    return perceive(observer, memory, arena.look(told, generator).matches, eyes(observer.head, told))


def _walk(pose: EgoPose) -> EgoPose:
    """One step on a slalom of half a metre around the origin."""
    radius, ahead = 0.25, 0.08
    around = math.atan2(pose.y_m, pose.x_m - radius) if (pose.x_m, pose.y_m) != (0.0, 0.0) else math.pi
    around += ahead / radius
    return EgoPose(radius + radius * math.cos(around), radius * math.sin(around), 0.35 * math.sin(2 * around))


def study_moving(cfg: DictConfig, rows: Rows) -> None:
    """Five looks, then moves of 8 cm and a few degrees, with looks on the way and without; errors after 1, 10, all."""
    rows.labels, rows.names = ("looks_per_move", "moves"), COLUMNS
    observer = build_observer(cfg)
    moves, seed = whole(cfg, "saccades"), whole(cfg, "seed", 0)
    marks = sorted({0, 1, min(10, moves), moves})
    for looks in sorted({0, whole(cfg, "looks_per_move", 0)}):
        found: dict[int, list[Any]] = {t: [] for t in marks}
        for k in range(seed, seed + whole(cfg, "episodes")):
            arena = build_arena(cfg, observer, k)
            generator = torch.Generator().manual_seed(k)
            memory = new_memory(observer, build_cells(cfg, observer.head, generator))
            cells, pose = memory.cells, EgoPose()
            for gaze in fixation_course(arena, cells, FIRST_LOOKS, k):
                memory = _look(observer, memory, arena, gaze, generator)
            for t in range(moves + 1):
                if t > 0:
                    before, pose = pose, _walk(pose)
                    step = ODOMETRY.tell(before, pose, generator)
                    memory = move(memory, step, observer.fusion)
                    arena.world.stand(pose)
                    for gaze in list(fixation_course(arena, cells, looks + 1, 1000 * t + k))[1:]:
                        memory = _look(observer, memory, arena, gaze, generator)
                if t in marks:
                    found[t].append((*estimate(memory), judge_cells(arena.world, cells)))
        rows.rows += [(looks, t, *figures_of(parts)) for t, parts in found.items()]


def study_resampling(cfg: DictConfig, rows: Rows) -> None:
    """A search in which half of the cells are drawn anew around the best ones after five fixations, or not."""
    rows.labels = ("cells drawn anew",)
    rows.names = ("gap_final", "gap_per_saccade", "found", "target_error_m", "cells_near_target")
    observer = build_observer(cfg)
    saccades, seed, far_m = whole(cfg, "saccades"), whole(cfg, "seed", 0), number(cfg, "far_m")
    for name in ("never", "what was known kept", "what was known lost"):
        parts = []
        for k in range(seed, seed + whole(cfg, "episodes")):
            arena, generator = build_arena(cfg, observer, k), torch.Generator().manual_seed(k)
            memory = new_memory(observer, build_cells(cfg, observer.head, generator))
            zero = torch.zeros((), dtype=memory.cells.dtype)
            gaze, rewards, hit, step = Gaze(zero, zero, zero), [], False, None
            for t in range(saccades):
                told = Gaze(*(a.to(zero) for a in arena.saccade(gaze).gaze))
                seen = arena.fixation(told)
                rewards.append(-far_m if seen.is_floor else -min(float(seen.range_m), far_m))
                hit = hit or bool(seen.is_target)
                memory = perceive(observer, memory, arena.look(told, generator).matches, eyes(observer.head, told))
                step = decide(observer, memory, generator, told, step)
                if t == FIRST_LOOKS - 1 and name != "never":
                    memory = _sharpen(
                        observer, memory, step.reward.mean, step.eligible, name.endswith("kept"), generator
                    )
                    step = decide(observer, memory, generator, told)
                gaze = step.gaze
            assert step is not None
            truth = arena.truth(memory.cells)
            best = torch.tensor(-truth.nearest_m, dtype=torch.float64)
            course = gap(torch.tensor(rewards, dtype=torch.float64), best)
            score = torch.where(step.eligible & (memory.looks > 0), step.reward.mean, -torch.inf)
            error = float((step.points.mean[score.argmax()] - truth.nearest_point).norm())
            near = (truth.cell_points - truth.nearest_point).norm(dim=-1) < number(cfg, "near_target_m")
            parts.append((float(course[-1]), float(course.mean()), float(hit), error, float(near.sum())))
        rows.rows.append((name, *(sum(column) / len(parts) for column in zip(*parts, strict=True))))


def _sharpen(
    observer: Observer, memory: Memory, reward: Tensor, eligible: Tensor, keep: bool, generator: torch.Generator
) -> Memory:
    """Every second cell is drawn anew within about eight degrees of one of the ten best seen cells."""
    cells = memory.cells
    score = torch.where(eligible & (memory.looks > 0), reward, -torch.inf)
    best = cells[score.topk(min(10, len(cells))).indices]
    fresh = best[torch.randint(len(best), (4 * len(cells),), generator=generator)]
    fresh = fresh + 0.14 * torch.randn(fresh.shape, generator=generator, dtype=cells.dtype)
    fresh = torch.nn.functional.normalize(fresh, dim=-1)
    fresh = fresh[fixate(observer.head, fresh)[1]][: len(cells) // 2]
    new = torch.cat([cells[torch.randperm(len(cells), generator=generator)[: len(cells) - len(fresh)]], fresh])
    return resample(memory, new, observer.fusion) if keep else new_memory(observer, new)
