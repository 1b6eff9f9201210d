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

from torchfovea.arena import Arena, Arenas, Fixation, Truth
from torchfovea.deciding.strategies import Strategy, upper_confidence_bound
from torchfovea.memory.egosphere import Memory
from torchfovea.metrics import gap, global_information, local_information, near_target, regret, saccades_to_target
from torchfovea.perception import Observer, Step
from torchfovea.rows import row, stack
from torchfovea.search import Glance, Look, Move, StopRule, search
from torchfovea.sensing.head import Gaze, gaze_point
from torchfovea.setting import require

__all__ = ["Each", "Episode", "Rules", "run_episode", "run_episodes"]

Each = Callable[[int, Glance], None]


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
    bests: list[Tensor] = []
    known = torch.ones(len(truths), dtype=torch.bool)
    moves: list[Move] = []
    fixations: list[Fixation] = []
    gathered: list[Tensor] = []
    local: list[Tensor] = []
    looks, compute = torch.zeros(len(truths), device=memory.cells.device), 0.0
    for t, glance in enumerate(search(arena, observer, memory, saccades, generators, rules.strategy, rules.stop)):
        if glance.move.base is not None:
            require(hasattr(arena, "truths"), "arena", type(arena).__name__, "one with truths(cells): its base moves")
            truths = arena.truths(memory.cells)  # type: ignore[attr-defined]
            near, best_m = _near(truths, memory, rules), _best(truths, far_m)
        known &= near.any(-1).cpu()
        bests.append(best_m)
        moves.append(glance.move)
        fixations.append(arena.fixation(glance.move.gaze))
        if glance.look is None:
            break
        look, step = glance.look, glance.step
        looks, compute = looks + glance.looked, compute + glance.seconds
        gathered.append(global_information(step.points.cov))
        local.append(local_information(step.points.cov, near)[0])
        if each is not None:
            each(t, glance)
    # after the search the heads stay where they are
    still = moves[-1]._replace(seconds=0 * moves[-1].seconds, degrees=0 * moves[-1].degrees)
    moves += [still] * (saccades - len(moves))
    fixations += fixations[-1:] * (saccades - len(fixations))
    bests += bests[-1:] * (saccades - len(bests))
    gathered, local = (course + course[-1:] * (saccades - len(course)) for course in (gathered, local))

    def over_time(parts: Sequence[Any]) -> Tensor:
        return torch.stack([torch.as_tensor(part).cpu() for part in parts], -1)

    ranges = over_time([f.range_m for f in fixations]).double()
    hit = over_time([f.is_target for f in fixations])
    # where a class is sought, whatever is not of it is worth no more than the floor
    nothing = over_time([f.is_floor for f in fixations]) if observer.classes is None else ~hit
    reward = -torch.where(nothing, torch.inf, ranges).clamp(max=far_m)
    points = torch.stack([f.point.double().cpu() for f in fixations], 1)
    gazes = [over_time(angle).double() for angle in zip(*(move.gaze for move in moves), strict=True)]
    aimed = gaze_point(observer.head, Gaze(*gazes)).norm(dim=-1)
    informed = over_time(gathered).double()
    locally = over_time(local).double()
    best_now = over_time(bests)
    moved = bool((best_now != best_now[:, :1]).any())
    far_travelled, took = (over_time([m[k] for m in moves]).double().sum(-1) for k in (2, 1))
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
                global_information=informed[b],
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
