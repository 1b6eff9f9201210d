"""Gradients from candidate directions that are played against a finished run, with all other cells frozen.

- `insertion`: N − 1 cells are played; then candidate directions, drawn from a mixture of p̃ and the uniform density,
  are each played against that run: the candidate's belief, its fixations and the delay that they cause are followed;
  only what its own looks teach about *other* cells is left out. Nearly exact and cheap, but not unbiased.
- `corrected`: `insertion` plus exact runs of a few candidates, importance-sampled, with the frozen value as control
  variate. Unbiased.
- `myopic`: density-weighted, all-action, through a softmax policy; its fixed point is wrong.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.head import Gaze, eyes, fixate
from torchfovea.metrics import gap
from torchfovea.setting import require
from torchfovea.tuning.bias import Bias, draw_cells, log_density_each, log_normalizer_each
from torchfovea.tuning.estimators import Credit, Gradient, finish
from torchfovea.tuning.problem import Batch, Problem, prepare
from torchfovea.tuning.simulator import Memory, Run, World, empty, glance, score, simulate, world_of, worth

__all__ = ["corrected", "insertion", "myopic"]

_TEMPERATURE = 0.1


class _Frozen(NamedTuple):
    """Candidates (B, Q) played against a base run.

    weight: importance weight times N/Q; advantage: frozen gain; made: decisions before the first fixation (T − 1:
    never);
    memory: at that decision.
    """

    world: World
    base: Run
    base_world: World
    slot: Tensor
    weight: Tensor
    advantage: Tensor
    made: Tensor
    memory: Memory
    scores: Tensor
    reward: Tensor


def _freeze(problem: Problem, bias: Bias, batch: Batch, candidates: int) -> _Frozen:
    task, observer = problem.task, problem.task.observer
    n, steps = len(batch.scenes.nearest_m), problem.task.saccades
    rng = torch.Generator().manual_seed(batch.seed ^ 0x5EED)
    base_world = prepare(problem, bias, batch)
    slot = torch.randint(problem.cells, (n,), generator=rng)
    base_world.allowed[torch.arange(n), slot] = False
    base = simulate(task, batch.scenes, base_world, bias.alpha, keep=True)

    # half of the candidates from the bias, half uniform: the importance weight is at most twice N/Q
    q = problem.quadrature.directions
    own = candidates // 2
    drawn = draw_cells(bias, n, own, observer.head, rng)
    flat = q[torch.randint(len(q), (n, candidates - own), generator=rng)]
    jitter = torch.randn(flat.shape, generator=rng, dtype=torch.float32).to(flat) * (1.2 / math.sqrt(len(q)))
    flat = torch.nn.functional.normalize(flat + jitter, dim=-1)
    direction = torch.cat((drawn, flat), 1)
    solid = float(problem.quadrature.solid_angle_sr.sum())
    with torch.no_grad():
        density = (log_density_each(bias, direction) - log_normalizer_each(bias, problem.quadrature)[:, None]).exp()
    share = own / candidates
    weight = density / (share * density + (1 - share) / solid) * (problem.cells / candidates)

    noise = torch.randn(steps, n, candidates, generator=rng, dtype=problem.dtype)
    world = world_of(task, batch.scenes, direction, noise)
    looks = [Gaze(*(a[:, k] for a in base.gaze)) for k in range(steps - 1)]
    point = direction * world.range_m[..., None]
    seen = [glance(observer, eyes(observer.head, g), point, direction, world.range_m) for g in looks]
    visible, variance = (torch.stack(parts, -1) for parts in zip(*seen, strict=True))
    each = point.reshape(-1, 1, 3)
    pose = eyes(observer.head, fixate(observer.head, each[:, 0])[0])
    self_visible, self_variance = (
        part.reshape(n, candidates)
        for part in glance(observer, pose, each, direction.reshape(-1, 1, 3), world.range_m.reshape(-1, 1))
    )
    floor = point[..., 2] + observer.head.ego_height_m < 1e-3
    reward = -torch.where(floor, torch.full_like(world.range_m, task.far_m), world.range_m).clamp(max=task.far_m)

    memory, kept = empty(world), empty(world)
    pointer = torch.zeros(n, candidates, dtype=torch.long)
    at_self = torch.zeros(n, candidates, dtype=torch.bool)
    made = torch.full((n, candidates), steps - 1)
    rewards = [base.reward[:, :1].expand(n, candidates)]
    scores = []
    for t in range(steps - 1):
        now = pointer[..., None]
        shown = torch.where(at_self, self_visible, visible.gather(-1, now)[..., 0])
        spread = torch.where(at_self, self_variance, variance.gather(-1, now)[..., 0])
        weight_t = shown / spread
        measured = 1 / world.range_m + spread.sqrt() * noise[t]
        memory = Memory(memory.precision + weight_t, memory.vector + weight_t * measured, memory.seen | shown)
        value = score(task, world, memory, bias.alpha)[0]
        scores.append(value)
        rival, cell = base.score.gather(1, pointer + 1), base.cell.gather(1, pointer + 1)
        tie = (value == rival) & torch.isfinite(value) & (slot[:, None] < cell)
        at_self = (value > rival) | tie
        new = at_self & (made == steps - 1)
        kept = Memory(*(torch.where(new, a, b) for a, b in zip(memory, kept, strict=True)))
        made = torch.where(new, torch.full_like(made, t), made)
        pointer = pointer + (~at_self).long()
        rewards.append(torch.where(at_self, reward, base.reward.gather(1, pointer)))
    achieved = worth(task, torch.stack(rewards, -1), batch.scenes.nearest_m[:, None].expand(n, candidates))
    advantage = torch.where(made < steps - 1, achieved - base.value[:, None], torch.zeros_like(achieved))
    return _Frozen(world, base, base_world, slot, weight, advantage, made, kept, torch.stack(scores), reward)


def insertion(
    problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.5, candidates: int = 200, exact: float = 0.0
) -> Gradient:
    """Play candidates against a frozen run; with `exact` runs a scene, correct the rest (then unbiased).

    Args:
        problem: what is tuned.
        vector: where.
        batch: scenes and noise.
        alpha_share: of the scenes, for the derivative in log α.
        candidates: Q, of each scene; they are charged as Q/N episodes.
        exact: mean number of exactly simulated candidates a scene.
    """
    require(candidates >= 2, "candidates", candidates, "at least 2")
    task, n = problem.task, len(batch.scenes.nearest_m)
    bias = problem.bias(vector.detach(), batch.scenes)
    frozen = _freeze(problem, bias, batch, candidates)
    scene, which = (frozen.made < task.saccades - 1).nonzero(as_tuple=True)
    weight, advantage = frozen.weight[scene, which], frozen.advantage[scene, which]
    direction = frozen.world.direction[scene, which]
    credits = [Credit(scene, direction, weight * advantage)]
    spent, runs = n * (1 + candidates / problem.cells), n
    count = round(exact * n)
    if count > 0 and len(scene) > 0:
        rng = torch.Generator().manual_seed(batch.seed ^ 0xE7AC7)
        odds = weight * (advantage.abs() + 0.02)
        odds = odds / odds.sum()
        # systematic sampling: item j is drawn count·odds_j times on average
        marks = (torch.arange(count) + torch.rand((), generator=rng)) / count
        drawn = torch.searchsorted(odds.double().cumsum(0), marks.double()).clamp(max=len(odds) - 1)
        result = _exact(problem, bias, batch, frozen, scene[drawn], which[drawn])
        rest = result - frozen.base.value[scene[drawn]] - advantage[drawn]
        credits.append(Credit(scene[drawn], direction[drawn], weight[drawn] * rest / (count * odds[drawn])))
        spent += float((task.saccades - 1 - frozen.made[scene, which][drawn]).sum()) / (task.saccades - 1)
        runs += count
    value = frozen.base.value
    return finish(problem, vector, batch, frozen.base_world, credits, value, spent, runs, alpha_share)


def corrected(
    problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.5, candidates: int = 200, exact: float = 1.0
) -> Gradient:
    """`insertion` with exact runs: unbiased for the hard policy."""
    return insertion(problem, vector, batch, alpha_share, candidates, exact)


def _exact(problem: Problem, bias: Bias, batch: Batch, frozen: _Frozen, scene: Tensor, which: Tensor) -> Tensor:
    """Gap per saccade of whole runs in which a candidate takes the empty slot, (K,)."""
    rows, slot, made = torch.arange(len(scene)), frozen.slot[scene], frozen.made[scene, which]
    world = frozen.base_world.take(scene)
    for mine, its in ((world.direction, frozen.world.direction), (world.range_m, frozen.world.range_m)):
        mine[rows, slot] = its[scene, which]
    world.noise[:, rows, slot] = frozen.world.noise[:, scene, which]
    world.allowed[rows, slot] = True
    memory = Memory(*(torch.stack(parts)[made, scene] for parts in zip(*frozen.base.memories, strict=True)))
    for mine, its in zip(memory, frozen.memory, strict=True):
        mine[rows, slot] = its[scene, which]
    start = (memory, made, frozen.base.reward[scene])
    return simulate(problem.task, batch.scenes.take(scene), world, bias.alpha, start).value


def myopic(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.5, candidates: int = 200) -> Gradient:
    """The next fixation's gain under a softmax over density-weighted candidates, as if it lasted to the end.

    Σ_t (T − t)/T ∇ E_π[Δg], π ∝ p̃(u) exp(score/τ): of low variance and right at first, but a gain now is not charged
    for the gains that it makes impossible later, and the softmax hardly ever lacks a good cell.
    """
    task, n = problem.task, len(batch.scenes.nearest_m)
    bias = problem.bias(vector.detach(), batch.scenes)
    frozen = _freeze(problem, bias, batch, candidates)
    best = gap(frozen.base.reward, -batch.scenes.nearest_m)
    first = frozen.base.reward[:, :1]
    room = (first + batch.scenes.nearest_m[:, None]).clamp(max=-1e-6)
    reached = ((frozen.reward - first) / -room).clamp(0, 1)
    total = torch.zeros_like(reached)
    for t in range(task.saccades - 1):
        value = frozen.scores[t] / _TEMPERATURE + frozen.weight.log()
        policy = value.softmax(-1)
        gain = (reached - best[:, t : t + 1]).clamp(min=0) * (task.saccades - 1 - t) / task.saccades
        total = total + policy * (gain - (policy * gain).sum(-1, keepdim=True))
    scene, which = torch.ones_like(total, dtype=torch.bool).nonzero(as_tuple=True)
    credit = Credit(scene, frozen.world.direction[scene, which], total[scene, which])
    spent = n * (1 + candidates / problem.cells)
    return finish(problem, vector, batch, frozen.base_world, [credit], frozen.base.value, spent, n, alpha_share)
