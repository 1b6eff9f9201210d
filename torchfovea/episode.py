"""An episode: look, remember, decide, move, and be judged against the truth at every saccade (Sec. 7.2)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfovea.correspondence import Correspondences
from torchfovea.head import Gaze, eyes
from torchfovea.metrics import gap, global_information, local_information, near_target, regret, saccades_to_target
from torchfovea.perception import Mind, Observer, Step, decide, perceive
from torchfovea.setting import require

__all__ = ["Arena", "Episode", "Fixation", "Look", "Move", "Truth", "run_episode"]


class Move(NamedTuple):
    """A saccade as executed.

    Attributes:
        gaze: where the head settled, as its encoders tell.
        seconds: duration by the motor model.
        degrees: travelled.
    """

    gaze: Gaze
    seconds: float
    degrees: float


class Fixation(NamedTuple):
    """The truth at a fixation: the first surface on the cyclopean ray.

    Attributes:
        point: where, in E, (3,); far along the ray for a miss.
        range_m: its distance from the ego frame's origin; infinite for a miss.
        is_floor: whether it is the floor.
        is_target: whether it belongs to the target.
    """

    point: Tensor
    range_m: float
    is_floor: bool
    is_target: bool


class Look(NamedTuple):
    """What the eyes bring home from one fixation.

    Attributes:
        matches: correspondences in both retinas.
        pictures: whatever the sensor wants drawn (images, disparity), or nothing.
    """

    matches: Correspondences
    pictures: Any = None


class Truth(NamedTuple):
    """What the judge knows and the observer does not.

    Attributes:
        nearest_m: range of the nearest reachable point that is not floor.
        nearest_point: that point in E, (3,).
        cell_points: the true surface point of each memory cell, (Nx, 3); infinite where there is none.
    """

    nearest_m: float
    nearest_point: Tensor
    cell_points: Tensor


class Arena(Protocol):
    """A place to look around in: simulated, or a robot's."""

    def saccade(self, gaze: Gaze) -> Move:
        """Move the head and wait until it rests."""
        ...

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        """Sense at a gaze."""
        ...

    def fixation(self, gaze: Gaze) -> Fixation:
        """The truth at a gaze."""
        ...


class Episode(NamedTuple):
    """An episode's course; every tensor is (T,), the first entry the initial gaze.

    Attributes:
        gaze: executed.
        direction: unit direction in E of the true point at the fixation, (T, 3).
        range_m: true range at the fixation.
        reward: −range, floor or a miss −far_m.
        gap: Eq. 46.
        regret: Eq. 50.
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
    """

    gaze: Gaze
    direction: Tensor
    range_m: Tensor
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


def run_episode(
    observer: Observer,
    mind: Mind,
    arena: Arena,
    truth: Truth,
    saccades: int,
    generator: torch.Generator,
    far_m: float = 6.0,
    near_target_m: float = 0.1,
    each: Callable[[int, Look, Step], None] | None = None,
) -> Episode:
    """Run one episode from straight ahead.

    Args:
        observer: the fixed parts.
        mind: an empty memory, see `new_mind`; its dtype is the episode's.
        arena: where.
        truth: for the metrics only.
        saccades: T ≥ 1, the initial gaze included.
        generator: draws sensor noise and breaks ties; the same seed gives the same episode.
        far_m: what a fixation on the floor or on nothing counts as.
        near_target_m: R_NN of Eq. 54.
        each: called after every decision with t (from 0), the look and the step.

    Raises:
        SettingError: for no saccades or a nearest range that is not between 0 and far_m.
    """
    require(saccades >= 1, "saccades", saccades, "at least 1")
    require(0 < truth.nearest_m < far_m, "far_m", far_m, f"more than the nearest range, {truth.nearest_m:.3f} m")
    zero = torch.zeros((), dtype=mind.memory.cells.dtype)
    gaze = Gaze(zero, zero, zero)
    gazes, fixations, gathered, local = [], [], [], []
    near = near_target(truth.cell_points, truth.nearest_point, near_target_m)
    degrees = motor = compute = 0.0
    for t in range(saccades):
        move = arena.saccade(gaze)
        move = move._replace(gaze=Gaze(*(angle.to(zero) for angle in move.gaze)))
        degrees, motor = degrees + move.degrees, motor + move.seconds
        gazes.append(move.gaze)
        fixations.append(arena.fixation(move.gaze))
        start = time.perf_counter()
        look = arena.look(move.gaze, generator)
        mind = perceive(observer, mind, look.matches, eyes(observer.head, move.gaze))
        step = decide(observer, mind, generator)
        compute += time.perf_counter() - start
        gathered.append(global_information(step.points.cov))
        local.append(local_information(step.points.cov, near)[0])
        gaze = step.gaze
        if each is not None:
            each(t, look, step)
    ranges = torch.tensor([f.range_m for f in fixations], dtype=torch.float64)
    reward = -torch.where(torch.tensor([f.is_floor for f in fixations]), torch.inf, ranges).clamp(max=far_m)
    hit = torch.tensor([f.is_target for f in fixations])
    best = torch.tensor(-truth.nearest_m, dtype=torch.float64)
    return Episode(
        gaze=Gaze(*(torch.stack(angle).double() for angle in zip(*gazes, strict=True))),
        direction=torch.nn.functional.normalize(torch.stack([f.point.double() for f in fixations]), dim=-1),
        range_m=ranges,
        reward=reward,
        gap=gap(reward, best),
        regret=regret(reward, best),
        global_information=torch.stack(gathered).double(),
        local_information=torch.stack(local).double() if bool(near.any()) else None,
        hit=hit,
        moves=int(saccades_to_target(hit)),
        target_error_m=_target_error(step, truth),
        degrees=degrees,
        motor_seconds=motor,
        compute_seconds=compute / saccades,
        step=step,
        look=look,
    )


def _target_error(step: Step, truth: Truth) -> float | None:
    """Distance from the best seen eligible cell's mean to the truth; None if nothing eligible was seen."""
    eligible = step.eligible & (step.mind.memory.looks > 0)
    if not bool(eligible.any()):
        return None
    best = torch.where(eligible, step.reward.mean, torch.full_like(step.reward.mean, -torch.inf)).argmax()
    return float((step.points.mean[best] - truth.nearest_point).norm())
