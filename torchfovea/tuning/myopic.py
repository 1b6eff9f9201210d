"""The density-weighted gradient of the next fixation's gain: of low variance, right at first, and wrong in the end."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.deciding.weighted import Weighting
from torchfovea.metrics import gap
from torchfovea.sensing.head import Gaze, eyes, fixate
from torchfovea.setting import require
from torchfovea.tuning.cells import draw_cells
from torchfovea.tuning.density import log_density_each, log_normalizer_each
from torchfovea.tuning.estimators import Credit, Gradient, finish
from torchfovea.tuning.problem import Batch, Problem, prepare
from torchfovea.tuning.simulator import score, simulate
from torchfovea.tuning.worlds import Known, empty, glance, world_of

__all__ = ["myopic"]

_TEMPERATURE = 0.1


def myopic(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.5, candidates: int = 200) -> Gradient:
    """The next fixation's gain under a softmax over density-weighted candidates, as if it lasted to the end.

    Σ_t (T − t)/T ∇ E_π[Δg], π ∝ p̃(u) exp(score/τ). N − 1 cells are played; then candidate directions, half of them from
    p̃ and half uniform, are each played against that run, with all other cells frozen: a candidate's belief and its own
    looks are followed. A gain now is not charged for the gains that it makes impossible later, and the softmax hardly
    ever lacks a good cell, which is why the fixed point is wrong.

    Args:
        problem: what is tuned.
        vector: where.
        batch: scenes and noise.
        alpha_share: of the scenes, for the derivative in log α.
        candidates: Q, of each scene; they are charged as Q/N episodes.
    """
    require(candidates >= 2, "candidates", candidates, "at least 2")
    task, observer = problem.task, problem.task.observer
    n, steps = len(batch.scenes.nearest_m), problem.task.saccades
    bias = problem.bias(vector.detach(), batch.scenes)
    rng = torch.Generator().manual_seed(batch.seed ^ 0x5EED)
    base_world = prepare(problem, bias, batch)
    slot = torch.randint(problem.cells, (n,), generator=rng)
    base_world.allowed[torch.arange(n), slot] = False
    alone = Weighting(bias.weights.alpha)  # a candidate is weighed by α, whatever else counts
    base = simulate(task, batch.scenes, base_world, bias.weights)

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
    seen = [glance(observer, eyes(observer.head, g), direction, world.range_m) for g in looks]
    visible, variance = (torch.stack(parts, -1) for parts in zip(*seen, strict=True))
    pose = eyes(observer.head, fixate(observer.head, point.reshape(-1, 3))[0])
    self_visible, self_variance = (
        part.reshape(n, candidates)
        for part in glance(observer, pose, direction.reshape(-1, 1, 3), world.range_m.reshape(-1, 1))
    )
    floor = point[..., 2] + observer.head.ego_height_m < 1e-3
    reward = -torch.where(floor, torch.full_like(world.range_m, task.far_m), world.range_m).clamp(max=task.far_m)

    best, first = gap(base.reward, -batch.scenes.nearest_m), base.reward[:, :1]
    room = (first + batch.scenes.nearest_m[:, None]).clamp(max=-1e-6)
    reached = ((reward - first) / -room).clamp(0, 1)
    memory = empty(world)
    pointer = torch.zeros(n, candidates, dtype=torch.long)
    at_self = torch.zeros(n, candidates, dtype=torch.bool)
    total = torch.zeros_like(reached)
    for t in range(steps - 1):
        now = pointer[..., None]
        shown = torch.where(at_self, self_visible, visible.gather(-1, now)[..., 0])
        spread = torch.where(at_self, self_variance, variance.gather(-1, now)[..., 0])
        gained = shown / spread
        measured = 1 / world.range_m + spread.sqrt() * noise[t]
        memory = Known(memory.precision + gained, memory.vector + gained * measured, memory.seen | shown)
        value = score(task, world, memory, alone)[0]
        rival, cell = base.score.gather(1, pointer + 1), base.cell.gather(1, pointer + 1)
        at_self = (value > rival) | ((value == rival) & torch.isfinite(value) & (slot[:, None] < cell))
        pointer = pointer + (~at_self).long()
        policy = (value / _TEMPERATURE + weight.log()).softmax(-1)
        gain = (reached - best[:, t : t + 1]).clamp(min=0) * (steps - 1 - t) / steps
        total = total + policy * (gain - (policy * gain).sum(-1, keepdim=True))
    scene = torch.arange(n).repeat_interleave(candidates)
    credit = Credit(scene, direction.flatten(0, 1), total.flatten())
    spent = n * (1 + candidates / problem.cells)
    return finish(problem, vector, batch, base_world, [credit], base.value, spent, n, alpha_share)
