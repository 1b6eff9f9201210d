"""A fast, batched, cell-centric simulator of visual search, with the hard policy."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.infomax import information_gain, precision_by_eccentricity, saccade_degrees
from torchfovea.deciding.reward import RewardBelief, range_from_inverse_range
from torchfovea.deciding.strategies import inverse_range_acuity
from torchfovea.deciding.weighted import Terms, Weighting, saccades_left, weighted_score
from torchfovea.metrics import gap
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, can_fixate, cyclopean, eyes, fixate
from torchfovea.setting import require
from torchfovea.tuning.episodes import Course, episode_loops, play_by_loops
from torchfovea.tuning.scenes import Scenes, first_surfaces
from torchfovea.tuning.worlds import Known, Task, Worlds, empty, look

__all__ = ["Outlook", "Resumed", "Run", "best_cell", "blank", "score", "simulate", "true_reward", "worth"]

_FAR_M = 1000.0
_ANGLES = 512  # of the table of what a fixation brings


class Outlook(NamedTuple):
    """What a decision weighs besides the memory, as far as it has a weight.

    Attributes:
        left: share of the saccades that are left.
        axis: where the head looks, unit (B, 3).
        precision: what a fixation of each cell would bring every other, (B, N, N) [m²].
    """

    left: float = 0.5
    axis: Tensor | None = None
    precision: Tensor | None = None


class Resumed(NamedTuple):
    """Where episodes begin later.

    Attributes:
        memory: before the decision, (B, N).
        made: decisions already made t ≥ 0, (B,) int64.
        reward: so far (B, T), of which the first t + 1 count.
        gaze: so far, angles (B, T), likewise.
    """

    memory: Known
    made: Tensor
    reward: Tensor
    gaze: Gaze


class Run(NamedTuple):
    """What happened in B episodes.

    Attributes:
        value: the task's metric, (B,).
        reward: true, (B, T).
        cell: chosen for the fixation at t, (B, T); −1 for the initial gaze and where none was eligible.
        score: of the chosen cell, (B, T); −inf where there is none.
        gaze: executed, angles (B, T).
        memories: before each decision, T − 1 of them; empty unless asked for.
    """

    value: Tensor
    reward: Tensor
    cell: Tensor
    score: Tensor
    gaze: Gaze
    memories: list[Known]


def score(
    task: Task, world: Worlds, memory: Known, weights: Weighting, outlook: Outlook | None = None
) -> tuple[Tensor, Tensor]:
    """Score of every cell.

    Args:
        task: with the reward's kind.
        world: the cells.
        memory: their beliefs.
        weights: of the acquisition, numbers or (B,).
        outlook: what it weighs besides; None: half-way, without what has to be known for cost and information.

    Returns:
        Scores (B, N), −inf where not eligible, and the believed points (B, N, 3).
    """
    observer, outlook = task.observer, outlook or Outlook()
    mean, std = memory.vector / memory.precision, memory.precision.rsqrt()
    reward = RewardBelief(mean, std)
    if observer.reward == "range":
        reward = range_from_inverse_range(reward)
    range_m = 1 / mean.clamp(min=1 / _FAR_M)
    point = world.direction * range_m[..., None]
    reachable = can_fixate(observer.head, point)
    limits = observer.eligibility
    # to first order, a range of 1/ρ along a direction is unsure by σ/ρ²
    height = point[..., 2] + observer.head.ego_height_m
    height = height - limits.ground_sigmas * std * range_m * point[..., 2].abs()
    ground = memory.seen & (height < limits.ground_z_m)
    eligible = world.allowed & reachable & (range_m > limits.nearest_m) & ~ground
    lowest = torch.full_like(mean, -math.inf)
    terms = Terms(reward.mean, reward.std, reward.mean[..., 0], outlook.left)
    if weights.counts("improvement"):
        best = torch.where(eligible & memory.seen, reward.mean, lowest).amax(-1)
        best = torch.where(torch.isfinite(best), best, torch.where(eligible, reward.mean, lowest).amax(-1))
        terms = terms._replace(incumbent=torch.where(torch.isfinite(best), best, torch.zeros_like(best)))
    if weights.counts("by_unseen"):
        share = (eligible & ~memory.seen).sum(-1).to(mean) / eligible.sum(-1).clamp(min=1)
        terms = terms._replace(unseen=share)
    if weights.counts("cost_per_deg") and outlook.axis is not None:
        terms = terms._replace(degrees=saccade_degrees(outlook.axis, world.direction))
    if weights.counts("information") and outlook.precision is not None:
        gain = information_gain(1 / memory.precision, outlook.precision, eligible) / mean.shape[-1]
        terms = terms._replace(information=gain)
    value = weighted_score(weights, terms)
    return torch.where(eligible, value, lowest), point


def best_cell(value: Tensor) -> tuple[Tensor, Tensor]:
    """The best score and its cell; among equals the first: cells are drawn alike, so that this is a fair lot."""
    best, cell = value.max(-1)
    return best, torch.where(torch.isfinite(best), cell, torch.full_like(cell, -1))


def true_reward(task: Task, scenes: Scenes, gaze: Gaze) -> Tensor:
    """−range of the first surface on the cyclopean ray (from E's origin, as the metrics have it), −far_m for floor.

    Args:
        task: with the head and far_m.
        scenes: B of them.
        gaze: angles (B, K).

    Returns:
        (B, K).
    """
    rotation, origin = cyclopean(task.observer.head, gaze)
    axis = rotation[..., 2]
    hits = first_surfaces(scenes, origin, axis)
    range_m = (origin + hits.range_m[..., None] * axis).norm(dim=-1)
    return -torch.where(hits.floor, torch.full_like(range_m, task.far_m), range_m).clamp(max=task.far_m)


def blank(task: Task, scenes: Scenes) -> tuple[Gaze, Tensor]:
    """The initial gaze, straight ahead (B,), and its reward."""
    zero = torch.zeros_like(scenes.nearest_m)
    gaze = Gaze(zero, zero, zero)
    return gaze, true_reward(task, scenes, Gaze(*(a[:, None] for a in gaze)))[:, 0]


def _rows(weights: Weighting, part: slice | Tensor) -> Weighting:
    return weights.each(lambda weight: weight[part])


def worth(task: Task, reward: Tensor, nearest_m: Tensor, gaze: Gaze | None = None) -> Tensor:
    """The task's metric of rewards (..., T), the nearest point at nearest_m (...), less what the gazes cost."""
    course = gap(reward, -nearest_m)
    value = course[..., -1] if task.metric == "gap_final" else course.mean(-1)
    if task.saccade_cost == 0 or gaze is None:
        return value
    axis = cyclopean(task.observer.head, gaze)[0][..., 2]
    return value - task.saccade_cost * saccade_degrees(axis[..., :-1, :], axis[..., 1:, None, :])[..., 0].mean(-1)


def foreseen(task: Task, world: Worlds) -> Tensor:
    """What precision of inverse range a fixation of each cell would bring every other, by eccentricity: (B, N, N)."""
    observer = task.observer
    assert isinstance(observer.camera, Pinhole)
    half_view = math.atan(observer.retina.radius_px / observer.camera.focal_px)
    law = inverse_range_acuity(observer.camera, observer.retina, observer.budget, observer.head.baseline_m)
    angles = torch.linspace(0, half_view, _ANGLES, dtype=world.direction.dtype)
    table = law(angles)
    return precision_by_eccentricity(
        world.direction, world.direction, lambda a: table[(a / half_view * (_ANGLES - 1)).round().long()], half_view
    )


def simulate(
    task: Task, scenes: Scenes, world: Worlds, weights: Weighting, start: Resumed | None = None, keep: bool = False
) -> Run:
    """Run B episodes with the hard policy.

    Args:
        task: what an episode is.
        scenes: B of them.
        world: their cells.
        weights: of the acquisition; tensors are scalars or (B,).
        start: to begin at a decision; runs later in their episode wait for the others.
        keep: keep the memories before each decision.

    Same arguments, same episodes. Not differentiable: the policy is an argmax.
    """
    n, steps = len(scenes.nearest_m), task.saccades
    require(start is None or not keep, "keep", keep, "False for runs that begin later")
    weights = weights.each(lambda weight: weight.to(scenes.nearest_m).expand(n))
    angles, made = scenes.nearest_m.new_zeros(3, n, steps), None if start is None else start.made
    memory = empty(world) if start is None else start.memory
    if start is not None:
        angles = torch.stack(start.gaze) * (torch.arange(steps) <= start.made[:, None])
    library = episode_loops(task.observer, world, weights)
    if library is not None:
        course = play_by_loops(library, task.observer, world, weights, memory, made, angles, _FAR_M, keep)
    else:
        course = _play(task, world, weights, memory, made, angles, keep)
    gaze = Gaze(*course.angles)
    reward = true_reward(task, scenes, gaze)
    if start is not None:
        reward = torch.where(torch.arange(steps) > start.made[:, None], reward, start.reward)
    value = worth(task, reward, scenes.nearest_m, gaze)
    return Run(value, reward, course.cell, course.score, gaze, course.memories)


def _play(
    task: Task, world: Worlds, weights: Weighting, memory: Known, made: Tensor | None, angles: Tensor, keep: bool
) -> Course:
    """The episodes, see `torchfovea.tuning.episodes.play_by_loops`."""
    _, n, steps = angles.shape
    cells, scores = torch.full((n, steps), -1), torch.full((n, steps), -math.inf, dtype=angles.dtype)
    memories: list[Known] = []
    if made is None:
        memory = look(task, world, memory, eyes(task.observer.head, Gaze(*angles[..., 0])), 0)
        order, made = torch.arange(n), torch.zeros(n, dtype=torch.long)
    else:
        order = made.argsort(stable=True)  # those that begin first come first: the live ones are a slice
        memory, world = Known(*(m[order] for m in memory)), world.take(order)
        weights, made, angles = _rows(weights, order), made[order], angles[:, order]
    precision = foreseen(task, world) if weights.counts("information") else None
    for t in range(steps - 1):
        live = int((made <= t).sum())
        if live == 0:
            continue
        part = slice(0, live)
        w = world if live == n else Worlds(*(f[:, part] if i == 2 else f[part] for i, f in enumerate(world)))
        m = memory if live == n else Known(*(f[part] for f in memory))
        if keep:
            memories.append(m)
        axis = None
        if weights.counts("cost_per_deg"):
            axis = cyclopean(task.observer.head, Gaze(*angles[:, part, t]))[0][..., 2]
        outlook = Outlook(saccades_left(t, steps), axis, None if precision is None else precision[part])
        value, point = score(task, w, m, _rows(weights, part), outlook)
        best, cell = best_cell(value)
        chosen = point.gather(1, cell.clamp(min=0)[:, None, None].expand(-1, 1, 3))[:, 0]
        now = Gaze(*(angle * (cell >= 0) for angle in fixate(task.observer.head, chosen)[0]))
        cells[part, t + 1], scores[part, t + 1] = cell, best
        angles[:, part, t + 1] = torch.stack(now)
        if t + 2 < steps:
            m = look(task, w, m, eyes(task.observer.head, now), t + 1)
            memory = m if live == n else Known(*(torch.cat((a, b[live:])) for a, b in zip(m, memory, strict=True)))
    back = order.argsort()
    return Course(cells[back], scores[back], angles[:, back], memories)
