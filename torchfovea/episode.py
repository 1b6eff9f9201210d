"""Episodes: searches beside a judge, who knows the truth at every saccade (Sec. 7.2).

B episodes advance together as tensors, one generator each, so that a batch is what its episodes are one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.arena import Arena, Arenas, Truth
from torchfovea.deciding.strategies import Strategy, upper_confidence_bound
from torchfovea.memory.egosphere import Memory
from torchfovea.metrics import gap, global_information, local_information, near_target, regret, saccades_to_target
from torchfovea.perception import Observer, Step
from torchfovea.rows import row, stack
from torchfovea.search import Glance, Look, StopRule, search
from torchfovea.sensing.head import Gaze, gaze_point
from torchfovea.setting import check_types, require

__all__ = ["Each", "Episode", "Rules", "run_episode", "run_episodes"]

Each = Callable[[int, Glance], None]

_JOINED = 64  # saccades


class Episode(NamedTuple):
    """An episode's course; every tensor is (T,), the first entry the initial gaze.

    Attributes:
        gaze: executed.
        direction: unit direction in E of the true point at the fixation, (T, 3).
        range_m: true range at the fixation.
        aimed_m: range of the point that both eyes turned to.
        reward: −range; floor, a miss or what is not of the class that is sought −far_m.
        gap: Eq. 46; of a base that moves, r* is the best reward that was within reach anywhere on its way.
        regret: Eq. 50; of a base that moves, r* is that of the moment.
        global_information: Eq. 52 [nats].
        local_information: Eq. 54 [nats]; None where no cell lies near the nearest point.
        hit: bool, whether the fixation is on the target.
        moves: saccades until the target was first fixated; T if never.
        target_error_m: distance from the best eligible cell's mean to the nearest point, at the end.
        degrees: travelled in all.
        motor_seconds: by the motor model, in all.
        compute_seconds: wall time of sensing and deciding, a saccade.
        step: the last decision, with the memory.
        look: the last look.
        looks: how many looks were taken; fewer than T where the stop rule ended the search.
    """

    gaze: Gaze
    direction: Tensor
    range_m: Tensor
    aimed_m: Tensor
    reward: Tensor
    gap: Tensor
    regret: Tensor
    global_information: Tensor
    local_information: Tensor | None
    hit: Tensor
    moves: int
    target_error_m: float | None
    degrees: float
    motor_seconds: float
    compute_seconds: float
    step: Step
    look: Look
    looks: int


@dataclass(frozen=True)
class Rules:
    """Of an episode.

    Attributes:
        saccades: T ≥ 1, the initial gaze included.
        strategy: see `torchfovea.search.search`; for B episodes together its settings may be (B,).
        stop: see `torchfovea.search.search`; the head then stays where it is until T.
        far_m: what a fixation on the floor or on nothing counts as.
        near_target_m: R_NN of Eq. 54.
    """

    saccades: int
    strategy: Strategy = upper_confidence_bound
    stop: StopRule | None = None
    far_m: float = 6.0
    near_target_m: float = 0.1

    def __post_init__(self) -> None:
        """Raise SettingError for no saccades, or distances that are none."""
        check_types(self)
        require(self.saccades >= 1, "saccades", self.saccades, "at least 1")
        for name in ("far_m", "near_target_m"):
            require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "a positive distance in metres")


def run_episode(
    observer: Observer,
    memory: Memory,
    arena: Arena,
    truth: Truth,
    generator: torch.Generator,
    rules: Rules,
    each: Each | None = None,
) -> Episode:
    """Run one episode from straight ahead; see `run_episodes`.

    Args:
        observer: the fixed parts.
        memory: what is known at the start, see `torchfovea.perception.new_memory`; its dtype is the episode's.
        arena: where.
        truth: for the metrics only.
        generator: draws sensor noise and breaks ties; the same seed gives the same episode.
        rules: how long, by which strategy, and what counts.
        each: called after every decision with t (from 0) and the glance.

    Raises:
        SettingError: for a nearest range that is not between 0 and far_m.
    """

    def show(t: int, glance: Glance) -> None:
        if each is not None and glance.look is not None:
            look, step = glance.look, glance.step._replace(state=None)
            alone = row(glance._replace(look=None, step=step), 0)
            each(t, alone._replace(look=Look(row(look.matches, 0), look.pictures[0])))

    episode = run_episodes(observer, stack([memory]), Arenas([arena]), [truth], [generator], rules, show)[0]
    return episode._replace(look=Look(episode.look.matches, episode.look.pictures[0]))


def run_episodes(
    observer: Observer,
    memory: Memory,
    arena: Arena,
    truths: Sequence[Truth],
    generators: Sequence[torch.Generator],
    rules: Rules,
    each: Each | None = None,
) -> list[Episode]:
    """Judge a search of B robots from straight ahead, on the device of the memories.

    Args:
        observer: the fixed parts, alike for all.
        memory: B memories, see `torchfovea.arena.stack`.
        arena: of B robots, see `torchfovea.arena.Arenas`.
        truths: for the metrics only, B; of bases that move at the start, `Arenas.truths` tells the others.
        generators: one for each episode; the same seed gives the same episode, whatever the batch.
        rules: how long, by which strategy, and what counts.
        each: called after every decision with t (from 0) and the glances as one.

    Raises:
        SettingError: for a nearest range that is not between 0 and far_m.
    """
    saccades, far_m = rules.saccades, rules.far_m
    for truth in truths:
        require(0 < truth.nearest_m < far_m, "far_m", far_m, f"more than the nearest range, {truth.nearest_m:.3f} m")
    near, best_m = _near(truths, memory, rules), _best(truths, far_m)
    known = torch.ones(len(truths), dtype=torch.bool)
    course, informed = _Course(len(truths)), _Course(len(truths))
    looks, compute = torch.zeros(len(truths), device=memory.cells.device), 0.0
    for t, glance in enumerate(search(arena, observer, memory, saccades, generators, rules.strategy, rules.stop)):
        if glance.move.base is not None:
            require(hasattr(arena, "truths"), "arena", type(arena).__name__, "one with truths(cells): its base moves")
            truths = arena.truths(memory.cells)  # type: ignore[attr-defined]
            near, best_m = _near(truths, memory, rules), _best(truths, far_m)
        known &= near.any(-1).cpu()
        move, at = glance.move, arena.fixation(glance.move.gaze)
        course.add(*move.gaze, move.seconds, move.degrees, at.range_m, at.is_floor, at.is_target, best_m, at.point)
        if glance.look is None:
            break
        look, step = glance.look, glance.step
        looks, compute = looks + glance.looked, compute + glance.seconds
        informed.add(global_information(step.points.cov), local_information(step.points.cov, near)[0])
        if each is not None:
            each(t, glance)
    numbers = course.until(saccades)
    *angles, seconds, degrees, ranges, floor, target, best_now = numbers[..., :9].unbind(-1)
    points, gazes = numbers[..., 9:], Gaze(*angles)
    hit = target > 0
    # where a class is sought, whatever is not of it is worth no more than the floor
    nothing = floor > 0 if observer.classes is None else ~hit
    reward = -torch.where(nothing, torch.inf, ranges).clamp(max=far_m)
    aimed = gaze_point(observer.head, gazes).norm(dim=-1)
    globally, locally = informed.until(saccades).unbind(-1)
    moved = bool((best_now != best_now[:, :1]).any())
    # after the search the heads stay where they are
    far_travelled, took = (part[:, : course.count].sum(-1) for part in (degrees, seconds))
    episodes = []
    for b, truth in enumerate(truths):
        best = best_now[b].max()
        own = row(step._replace(state=None), b)
        episodes.append(
            Episode(
                gaze=Gaze(*(angle[b] for angle in gazes)),
                direction=torch.nn.functional.normalize(points[b], dim=-1),
                range_m=ranges[b],
                aimed_m=aimed[b],
                reward=reward[b],
                gap=gap(reward[b], best),
                regret=regret(reward[b] - best_now[b], 0 * best) if moved else regret(reward[b], best),
                global_information=globally[b],
                local_information=locally[b] if bool(known[b]) else None,
                hit=hit[b],
                moves=int(saccades_to_target(hit[b])),
                target_error_m=_target_error(own, truth),
                degrees=float(far_travelled[b]),
                motor_seconds=float(took[b]),
                compute_seconds=compute / (saccades * len(truths)),
                step=own,
                look=Look(row(look.matches, b), look.pictures),
                looks=int(looks[b]),
            )
        )
    return episodes


class _Course:
    """Numbers of every saccade of B episodes, (B, T, k) float64 in the end.

    They are joined now and then: a small tensor is a hundred times as large as the number in it.
    """

    def __init__(self, episodes: int) -> None:
        self.episodes, self.count = episodes, 0
        self.rows: list[Tensor] = []
        self.blocks: list[Tensor] = []

    def add(self, *parts: Any) -> None:
        """One saccade's numbers, (B,) each or one for all, and vectors (B, m)."""
        device = next((part.device for part in parts if isinstance(part, Tensor)), None)
        numbers = [torch.as_tensor(part, dtype=torch.float64, device=device) for part in parts]
        flat = [n if n.dim() == 2 else n.expand(self.episodes)[:, None] for n in numbers]
        self.rows.append(torch.cat(flat, -1))
        self.count += 1
        if len(self.rows) == _JOINED:
            self.blocks.append(torch.stack(self.rows, 1))
            self.rows = []

    def until(self, saccades: int) -> Tensor:
        """The course on the CPU, its last numbers repeated up to T."""
        rows = [torch.stack(self.rows, 1)] if self.rows else []
        course = torch.cat([*self.blocks, *rows], 1).cpu()
        return torch.cat([course, course[:, -1:].expand(-1, saccades - self.count, -1)], 1)


def _near(truths: Sequence[Truth], memory: Memory, rules: Rules) -> Tensor:
    """Which cells' true points are near the nearest one, (B, Nx)."""
    close = [near_target(t.cell_points, t.nearest_point, rules.near_target_m) for t in truths]
    return torch.stack(close).to(memory.cells.device)


def _best(truths: Sequence[Truth], far_m: float) -> Tensor:
    """The best reward within reach, (B,)."""
    return -torch.tensor([min(truth.nearest_m, far_m) for truth in truths], dtype=torch.float64)


def _target_error(step: Step, truth: Truth) -> float | None:
    """Distance from the best seen eligible cell's mean to the truth; None if nothing eligible was seen."""
    eligible = step.eligible & (step.memory.looks > 0)
    if not bool(eligible.any()):
        return None
    best = torch.where(eligible, step.reward.mean, torch.full_like(step.reward.mean, -torch.inf)).argmax()
    return float((step.points.mean[best].cpu() - truth.nearest_point.to(step.points.mean.dtype).cpu()).norm())
