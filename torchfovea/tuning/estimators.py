"""Estimators of the gradient of the expected gap per saccade with respect to the tuned vector.

A gradient credits directions: Σ_j w_j ∇ log p̃(u_j), with p̃ the cells' density restricted to the reachable set. Cells
are drawn independently, so that E[∇ log p̃(p_i) f] = 0 for any f that does not look at cell i.

- `counterfactual`: w_i = R(P) − R(P∖p_i) for every fixated cell. *Unbiased* for the hard argmax policy, for removing a
  cell changes no other cell's observations here, and a cell that is never fixated has w_i = 0 exactly. Each fixated
  cell costs a run from its first fixation on.
- `covered`: the same with an analytic control variate. Let f(P) be the value of the best can that any cell falls on.
  Its expectation over cells, F = Σ_c v_c [(1 − m_1 − … − m_{c−1})^N − (1 − m_1 − … − m_c)^N] with m_c = ∫_can p̃, has
  an exact gradient without any luck of the draw, and f has counterfactuals without any run, so that ∇F plus the
  counterfactual of R − f is unbiased too (but for the quadrature of m).
- `coverage`: ∇F alone: no run at all. Biased, for F knows cells but no saccades; a warm start.

α, the acquisition's other weights and the field of view are not in p̃: their derivatives are central differences with
common random numbers, of the policy's numbers all at once, each scene with signs of its own (Spall 1992), so that many
cost no more than one. `policy` is these alone, and leaves the bias as it is.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.head import Gaze
from torchfovea.setting import require
from torchfovea.tuning.bias import Bias, nudged
from torchfovea.tuning.density import log_density_each, log_normalizer_each
from torchfovea.tuning.problem import Batch, Problem, play, prepare
from torchfovea.tuning.scenes import Scenes, first_surfaces, nearest_point
from torchfovea.tuning.simulator import Resumed, blank, simulate
from torchfovea.tuning.worlds import Known, Worlds

__all__ = [
    "Credit",
    "Gradient",
    "counterfactual",
    "coverage",
    "covered",
    "finish",
    "fov_difference",
    "policy",
    "policy_difference",
    "pull",
]

_ALPHA_STEP = 0.05  # of log α, to either side: at a kink a wider one averages slopes of both sides
_WEIGHT_STEP = 0.1  # of the other weights' numbers
_FOV_STEP = 0.15  # of log tan(fov/2)


class Gradient(NamedTuple):
    """An estimate.

    Attributes:
        vector: ascent direction, the size of the tuned vector, float64.
        value: the objective on this batch.
        episodes: simulated episodes spent, in saccades of N cells over T.
        runs: simulated runs begun, each counted whole.
    """

    vector: Tensor
    value: float
    episodes: float
    runs: int


class Credit(NamedTuple):
    """Directions (J, 3) in scenes (J,) and their weights (J,)."""

    scene: Tensor
    direction: Tensor
    weight: Tensor


def pull(problem: Problem, vector: Tensor, batch: Batch, credits: list[Credit]) -> Tensor:
    """Σ_j w_j ∇ log p̃(u_j), averaged over the batch's scenes."""
    n = len(batch.scenes.nearest_m)
    x = vector.detach().to(problem.dtype).requires_grad_()
    bias = problem.bias(x, batch.scenes)
    shared = len(bias.means) == 1
    total = torch.zeros((), dtype=problem.dtype)
    per_scene = torch.zeros(n, dtype=problem.dtype)
    for scene, direction, weight in credits:
        if shared:
            density = log_density_each(bias, direction[None])[0]
        else:
            each = Bias(bias.logits[scene], bias.means[scene], bias.cholesky[scene], bias.weights)
            density = log_density_each(each, direction[:, None])[:, 0]
        total = total + (weight * density).sum()
        per_scene = per_scene.index_add(0, scene, weight)
    normalizer = log_normalizer_each(bias, problem.quadrature)
    total = total - (per_scene * normalizer).sum()
    return torch.autograd.grad(total / n, x)[0].double()


def policy_offsets(problem: Problem, batch: Batch, scenes: int) -> Tensor:
    """Steps of the policy's numbers, with signs of its own for each of the first few scenes, (scenes, P)."""
    shape = problem.shape
    steps = [_ALPHA_STEP] * int(shape.tune_alpha) + [_WEIGHT_STEP] * len(shape.tuned)
    sign = torch.randint(2, (scenes, len(steps)), generator=torch.Generator().manual_seed(batch.seed ^ 0x51B))
    return (2 * sign - 1).double() * torch.tensor(steps, dtype=torch.float64)


def slopes(offsets: Tensor, more: Tensor, less: Tensor) -> Tensor:
    """What differences (n,) say of each number, moved by offsets (n, P) to either side: (P,)."""
    return ((more - less).double()[:, None] / (2 * offsets)).mean(0)


def policy_difference(
    problem: Problem, vector: Tensor, batch: Batch, world: Worlds, share: float = 1.0
) -> tuple[Tensor, float, float]:
    """Central differences of the policy's numbers on the same cells, scenes and noise.

    Returns:
        Slopes (P,), the episodes spent, and the mean value of these.
    """
    shape = problem.shape
    numbers = shape.policy.stop - shape.policy.start
    if numbers == 0 or share <= 0:
        return torch.zeros(numbers, dtype=torch.float64), 0.0, 0.0
    n = max(1, round(share * len(batch.scenes.nearest_m)))
    part = torch.arange(n)
    scenes, world = batch.scenes.take(part), world.take(part)
    weights, offsets = problem.bias(vector.detach(), batch.scenes).weights, policy_offsets(problem, batch, n)
    both = torch.cat((part, part))
    moved = nudged(shape, weights, torch.cat((offsets, -offsets)))
    value = simulate(problem.task, scenes.take(both), world.take(both), moved).value
    return slopes(offsets, value[:n], value[n:]), 2.0 * n, float(value.mean())


def policy(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 1.0) -> Gradient:
    """The acquisition's numbers alone, on all scenes; the bias stays."""
    numbers = problem.shape.policy.stop - problem.shape.policy.start
    require(numbers > 0, "estimator", "policy", "tune_alpha=true or tune_weights, for it tunes nothing else")
    gradient = torch.zeros(problem.shape.size, dtype=torch.float64)
    world = prepare(problem, problem.bias(vector.detach(), batch.scenes), batch)
    if alpha_share <= 0:  # in a warm start
        return Gradient(gradient, 0.0, len(batch.scenes.nearest_m), len(batch.scenes.nearest_m))
    gradient[problem.shape.policy], spent, value = policy_difference(problem, vector, batch, world)
    return Gradient(gradient, value, spent, round(spent))


def fov_difference(problem: Problem, vector: Tensor, batch: Batch, share: float = 1.0) -> tuple[float, float]:
    """Slope in log tan(fov/2), in α's way; and the episodes spent."""
    n = round(share * len(batch.scenes.nearest_m))
    if problem.shape.fov_deg is None or n < 1:
        return 0.0, 0.0
    part = Batch(batch.scenes.take(torch.arange(n)), batch.noise[:, :n], batch.seed)
    offset = torch.zeros_like(vector)
    offset[-1] = _FOV_STEP
    value = play(problem, vector + offset, part).value - play(problem, vector - offset, part).value
    return float(value.mean() / (2 * _FOV_STEP)), 2.0 * n


def finish(
    problem: Problem, vector: Tensor, batch: Batch, world: Worlds, credits: list[Credit], value: Tensor,
    episodes: float, runs: int, alpha_share: float,
) -> Gradient:  # fmt: skip
    """Turn credits into a gradient, and add the slopes of the policy's numbers."""
    gradient = pull(problem, vector, batch, credits)
    gradient[problem.shape.policy], spent, _ = policy_difference(problem, vector, batch, world, alpha_share)
    return Gradient(gradient, float(value.mean()), episodes + spent, runs + round(spent))


class _Removals(NamedTuple):
    """What the cells of B episodes were worth.

    world: of the episodes; value: of them (B,); credit: of every fixated cell; slope: of the policy's numbers (P,);
    episodes and runs: spent.
    """

    world: Worlds
    value: Tensor
    credit: Credit
    slope: Tensor
    episodes: float
    runs: int


def counterfactual(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.25) -> Gradient:
    """Leave one fixated cell out: unbiased for the hard policy; runs restart at the cell's first fixation."""
    found = _removals(problem, problem.bias(vector.detach(), batch.scenes), batch, alpha_share)
    return _gradient(problem, pull(problem, vector, batch, [found.credit]), found)


def _gradient(problem: Problem, vector: Tensor, found: _Removals) -> Gradient:
    vector[problem.shape.policy] = found.slope
    return Gradient(vector, float(found.value.mean()), found.episodes, found.runs)


def _removals(problem: Problem, bias: Bias, batch: Batch, alpha_share: float = 0.0) -> _Removals:
    """Play the batch, then all that is compared with it at once: without each fixated cell, and with other weights."""
    task, n = problem.task, len(batch.scenes.nearest_m)
    world = prepare(problem, bias, batch)
    run = simulate(task, batch.scenes, world, bias.weights, keep=True)
    first = torch.full((n, problem.cells + 1), task.saccades)
    times = torch.arange(task.saccades).expand(n, -1)
    # a cell of −1 counts as a last one, dropped
    first = first.scatter_reduce(1, run.cell % (problem.cells + 1), times, "amin")[:, :-1]
    scene, cell = (first < task.saccades).nonzero(as_tuple=True)
    numbers = problem.shape.policy.stop - problem.shape.policy.start
    k, m = len(scene), max(1, round(alpha_share * n)) if numbers and alpha_share > 0 else 0
    part = torch.arange(m)
    of = torch.cat((scene, part, part))
    made = torch.cat((first[scene, cell] - 1, torch.zeros(2 * m, dtype=torch.long)))
    offsets = policy_offsets(problem, batch, m)
    weights = nudged(problem.shape, bias.weights, torch.cat((offsets.new_zeros(k, numbers), offsets, -offsets)))
    memory = Known(*(torch.stack(parts)[made, of] for parts in zip(*run.memories, strict=True)))
    other = world.take(of)
    other.allowed[torch.arange(k), cell] = False
    start = Resumed(memory, made, run.reward[of], Gaze(*(angle[of] for angle in run.gaze)))
    value = simulate(task, batch.scenes.take(of), other, weights, start).value
    slope = slopes(offsets, value[k : k + m], value[k + m :]) if m else offsets.new_zeros(numbers)
    credit = Credit(scene, world.direction[scene, cell], run.value[scene] - value[:k])
    spent = n + float((task.saccades - 1 - made).sum()) / (task.saccades - 1)
    return _Removals(world, run.value, credit, slope, spent, n + k + 2 * m)


def coverage(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.0) -> Gradient:
    """Gradient of the probability-weighted value of the best can that a cell falls on; plays only what weights need.

    A scene counts as an episode though none is played.
    """
    n = len(batch.scenes.nearest_m)
    value = _values(problem, batch.scenes)
    gradient, total = _coverage(problem, vector, batch.scenes, value)
    if alpha_share > 0:
        world = prepare(problem, problem.bias(vector.detach(), batch.scenes), batch)
        gradient[problem.shape.policy], spent, _ = policy_difference(problem, vector, batch, world, alpha_share)
        return Gradient(gradient, total, n + spent, n + round(spent))
    return Gradient(gradient, total, n, n)


def covered(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.25) -> Gradient:
    """`counterfactual` with coverage as control variate."""
    found = _removals(problem, problem.bias(vector.detach(), batch.scenes), batch, alpha_share)
    cells, value = found.world.direction, _values(problem, batch.scenes)
    # f(P) − f(P∖p_i) is not zero only for the one cell on the best can that is covered
    on = first_surfaces(batch.scenes, torch.zeros_like(cells[:, :1]), cells).can
    worth = torch.cat((value, torch.zeros_like(value[:, :1])), 1).gather(1, on % (value.shape[1] + 1))
    (best, second), which = worth.topk(2, 1).values.unbind(1), worth.argmax(1)
    scene = torch.arange(len(value))
    luck = Credit(scene, cells[scene, which], second - best)
    slope, _ = _coverage(problem, vector, batch.scenes, value)
    return _gradient(problem, pull(problem, vector, batch, [found.credit, luck]) + slope, found)


def _values(problem: Problem, scenes: Scenes) -> Tensor:
    """What finding each can is worth, (B, S): its gap, for all saccades but two."""
    steps = problem.task.saccades
    first = blank(problem.task, scenes)[1][:, None]
    reach: Tensor = nearest_point(*(f for f in scenes[:5])).norm(dim=-1)
    room = (-scenes.nearest_m[:, None] - first).clamp(min=1e-6)
    lasting = 1.0 if problem.task.metric == "gap_final" else max(steps - 2, 1) / steps
    return ((-reach - first) / room).clamp(0, 1) * lasting


def _coverage(problem: Problem, vector: Tensor, scenes: Scenes, value: Tensor) -> tuple[Tensor, float]:
    """∇F and F, averaged over scenes."""
    x = vector.detach().to(problem.dtype).requires_grad_()
    bias = problem.bias(x, scenes)
    direction, solid, can = _on_cans(scenes)
    density = log_density_each(bias, direction) - log_normalizer_each(bias, problem.quadrature)[:, None]
    mass = torch.zeros_like(value).scatter_add(1, can.clamp(min=0), density.exp() * solid * (can >= 0))
    order = value.argsort(1, descending=True)
    missed = (1 - mass.gather(1, order).cumsum(1)).clamp(0, 1)
    missed = torch.cat((torch.ones_like(missed[:, :1]), missed), 1) ** problem.cells
    total = (value.gather(1, order) * (missed[:, :-1] - missed[:, 1:])).sum(1).mean()
    return torch.autograd.grad(total, x)[0].double(), float(total.detach())


def _on_cans(scenes: Scenes, columns: int = 6, rows: int = 9) -> tuple[Tensor, Tensor, Tensor]:
    """Directions (B, K, 3) that tile each can's box of azimuth and height, their solid angles, the can seen (or −1)."""
    away = torch.hypot(scenes.x, scenes.y)
    azimuth = torch.atan2(scenes.y, scenes.x)
    half = torch.asin((scenes.radius / away).clamp(max=0.99))
    near, far = away - scenes.radius, away + scenes.radius
    low = torch.minimum(scenes.low / near, scenes.low / far).atan().sin()
    high = torch.maximum(scenes.high / near, scenes.high / far).atan().sin()
    u = ((torch.arange(columns) + 0.5) / columns).to(away)
    v = ((torch.arange(rows) + 0.5) / rows).to(away)
    a = azimuth[..., None, None] + half[..., None, None] * (2 * u[:, None] - 1)
    z = low[..., None, None] + (high - low)[..., None, None] * v
    a, z = torch.broadcast_tensors(a, z)
    flat = (1 - z * z).sqrt()
    direction = torch.stack((flat * a.cos(), flat * a.sin(), z), -1).flatten(1, 3)
    solid = (2 * half * (high - low) / (columns * rows))[..., None].expand(*away.shape, columns * rows).flatten(1)
    seen = first_surfaces(scenes, torch.zeros_like(direction[:, :1]), direction).can
    own = torch.arange(away.shape[1]).repeat_interleave(columns * rows)
    return direction, solid, torch.where(seen == own, seen, torch.full_like(seen, -1))
