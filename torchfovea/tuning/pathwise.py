"""The gradient through the whole stack: reparameterized cells, sensor, fusion and a soft fixation, over all saccades.

An argmax has no gradient and a scene has edges; both are smoothed. A cell's true inverse range is read from the scene
blurred by a kernel, differentiable in its direction, and a fixation is a softmax over the scores, whose expected
reward and expected gaze go on. What results is an honest derivative of another objective.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.deciding.weighted import Weighting
from torchfovea.sensing.head import eyes, fixate
from torchfovea.tuning.cells import draw_cells, reachable
from torchfovea.tuning.estimators import Gradient, policy_difference
from torchfovea.tuning.problem import Batch, Problem, prepare
from torchfovea.tuning.scenes import Scenes, first_surfaces
from torchfovea.tuning.simulator import blank, score
from torchfovea.tuning.worlds import Known, Worlds, empty, look, world_of

__all__ = ["panorama", "pathwise"]

_TEMPERATURE = 0.05  # of the softmax over scores [1/m or m]
_BLUR_DEG = 6.0
_TAPS = 7


def panorama(scenes: Scenes, direction: Tensor, blur_deg: float = _BLUR_DEG) -> tuple[Tensor, Tensor]:
    """Blurred true inverse range and floor share along directions (B, N, 3), differentiable in them.

    The blur is a tangent-plane kernel of fixed taps; its gradient comes from the taps' weights (a likelihood ratio on
    fixed rays), for the scene itself is piecewise smooth and its edges would be missed.
    """
    with torch.no_grad():
        centre = direction
        up = torch.zeros_like(centre)
        up[..., 2] = 1
        side = torch.nn.functional.normalize(torch.linalg.cross(up, centre), dim=-1)
        rise = torch.linalg.cross(centre, side)
        width = math.radians(blur_deg)
        grid = torch.linspace(-2, 2, _TAPS, dtype=direction.dtype) * width
        u, v = (o.reshape(-1) for o in torch.meshgrid(grid, grid, indexing="ij"))
        taps = centre[..., None, :] + u[:, None] * side[..., None, :] + v[:, None] * rise[..., None, :]
        taps = torch.nn.functional.normalize(taps, dim=-1)
        hits = first_surfaces(scenes, torch.zeros_like(direction[:, :1]), taps.flatten(1, 2))
        rho = (1 / hits.range_m).reshape(taps.shape[:-1])
        floor = hits.floor.reshape(taps.shape[:-1]).to(direction.dtype)
    cosine = (taps * direction[..., None, :]).sum(-1)
    weight = ((cosine - 1) / width**2).softmax(-1)
    return (weight * rho).sum(-1), (weight * floor).sum(-1)


def pathwise(problem: Problem, vector: Tensor, batch: Batch, alpha_share: float = 0.25) -> Gradient:
    """Back-propagate one smoothed episode a scene.

    Components are drawn, so that a mixture's weights get no gradient; α's comes from a hard common-random-number
    difference, as for the others. Where no soft fixation is worth more than the first gaze, as among many small
    look-alikes, the derivative is 0.
    """
    task, n = problem.task, len(batch.scenes.nearest_m)
    x = vector.detach().to(problem.dtype).requires_grad_()
    bias = problem.bias(x, batch.scenes)
    hard = draw_cells(bias, n, problem.cells, task.observer.head, torch.Generator().manual_seed(batch.seed))
    with torch.no_grad():
        each = [t.detach().expand(n, *t.shape[1:]) for t in (bias.logits, bias.means, bias.cholesky)]
        inverse = torch.linalg.inv(each[2])[:, None]
        # the noise that made a direction: v = |v| p with |v| at its conditional mode, and the likeliest component
        y = (inverse @ each[1][:, None, ..., None])[..., 0]
        w = (inverse @ hard[:, :, None, :, None])[..., 0]
        d = (w * y).sum(-1) / w.square().sum(-1)
        length = (d + (d * d + 8 / w.square().sum(-1)).sqrt()) / 2
        component = (each[0][:, None] - 0.5 * (length[..., None] * w - y).square().sum(-1)).argmax(-1)
        pick = component[..., None, None].expand(-1, -1, 1, 3)
        noise = (length[..., None] * w - y).gather(2, pick)[:, :, 0]
    means, factor = bias.means.expand(n, -1, -1), bias.cholesky.expand(n, -1, -1, -1)
    rows = torch.arange(n)[:, None]
    v = means[rows, component] + (factor[rows, component] @ noise[..., None])[..., 0]
    cells = torch.nn.functional.normalize(v, dim=-1)
    rho, floor = panorama(batch.scenes, cells)
    inside = reachable(task.observer.head, cells.detach())
    prior = world_of(task, batch.scenes, hard, batch.noise)
    world = Worlds(cells, 1 / rho, batch.noise, inside, prior.prior_mean, prior.prior_precision)
    reward = -(1 - floor) / rho - floor * task.far_m
    value = _soft_episode(problem, batch, world, reward, Weighting(torch.as_tensor(bias.weights.alpha).detach()))
    slope = torch.autograd.grad(value.mean(), x)[0].double()
    plain = prepare(problem, problem.bias(vector.detach(), batch.scenes), batch)
    slope[problem.shape.policy], spent, _ = policy_difference(problem, vector, batch, plain, alpha_share)
    return Gradient(slope, float(value.detach().mean()), n + spent, n + round(spent))


def _soft_episode(problem: Problem, batch: Batch, world: Worlds, reward: Tensor, weights: Weighting) -> Tensor:
    """Value of an episode whose fixations are expectations, (B,)."""
    task = problem.task
    gaze, best = blank(task, batch.scenes)
    first, memory = best, empty(world)
    room = (-batch.scenes.nearest_m - first).clamp(min=1e-6)
    course = [torch.zeros_like(best)]
    for t in range(task.saccades - 1):
        memory = Known(*look(task, world, memory, eyes(task.observer.head, gaze), t))
        value, point = score(task, world, memory, weights)
        some = torch.isfinite(value).any(-1, keepdim=True)
        policy = torch.where(some, value, torch.zeros_like(value)).div(_TEMPERATURE).softmax(-1)
        gaze = fixate(task.observer.head, (policy[..., None] * point).sum(1))[0]
        expected = (policy * reward).sum(-1)
        best = torch.maximum(best, expected)
        course.append((best - first) / room)
    stacked = torch.stack(course, -1)
    return stacked[..., -1] if task.metric == "gap_final" else stacked.mean(-1)
