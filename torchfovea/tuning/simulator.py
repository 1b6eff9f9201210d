"""A fast, batched, cell-centric simulator of visual search, with the hard policy.

In a saccade each cell that both retinas see gets *one* noisy inverse range, measured on its own direction, and keeps a
scalar Gaussian belief of it. Removing or adding a cell changes no other cell's observations, which is what makes the
counterfactual gradient exact here. Against the full simulator there is no occlusion between the eyes, no poles and no
furniture, no pooling of receptive fields and no patch scatter; the standard deviation of an observation is that of
`torchfovea.sensing.triangulation.observe` to first order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import upper_confidence_bound
from torchfovea.deciding.reward import RewardBelief, range_from_inverse_range
from torchfovea.gaussian import columns
from torchfovea.metrics import gap
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import eye_sigma_px
from torchfovea.sensing.head import Eyes, Gaze, cyclopean, eyes, fixate, rig_frame
from torchfovea.setting import require
from torchfovea.tuning.scenes import Scenes, first_surfaces

__all__ = [
    "Known", "Run", "Task", "Worlds", "best_cell", "blank", "check_observer", "empty", "glance", "look", "score",
    "simulate", "true_reward", "world_of", "worth",
]  # fmt: skip

_FAR_M = 1000.0


class Task(NamedTuple):
    """What an episode is made of besides the cells.

    Attributes:
        observer: the fixed parts; its acquisition is not used.
        saccades: T, the initial gaze included.
        far_m: what a fixation on the floor counts as.
        metric: what an episode is worth: gap_per_saccade or gap_final.
    """

    observer: Observer
    saccades: int = 10
    far_m: float = 6.0
    metric: str = "gap_per_saccade"


class Worlds(NamedTuple):
    """Cells in their scenes.

    Attributes:
        direction: unit (B, N, 3).
        range_m: true range from E, (B, N).
        noise: standard normal draws of every cell's observation in every saccade, (T, B, N).
        allowed: cells that exist, bool (B, N); the others are never fixated.
        prior_mean: inverse range believed before the cell is seen, (B, N) [1/m].
        prior_precision: (B, N) [m²].
    """

    direction: Tensor
    range_m: Tensor
    noise: Tensor
    allowed: Tensor
    prior_mean: Tensor
    prior_precision: Tensor

    def take(self, index: Tensor) -> Worlds:
        """The episodes of an index (K,), copied."""
        d, r, n, a, m, p = self
        return Worlds(d[index], r[index], n[:, index], a[index], m[index], p[index])


class Known(NamedTuple):
    """Scalar information filters of inverse range.

    Attributes:
        precision: (B, N).
        vector: precision times mean, (B, N).
        seen: bool (B, N).
    """

    precision: Tensor
    vector: Tensor
    seen: Tensor


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


def check_observer(observer: Observer) -> None:
    """Raise SettingError for an observer that this simulator does not model."""
    pinhole = isinstance(observer.camera, Pinhole)
    require(pinhole, "sensor.camera", type(observer.camera).__name__, "pinhole, in tuning")
    require(observer.fusion.chart == "inverse_range", "fusion", observer.fusion.name, "inverse_range, in tuning")


def empty(world: Worlds) -> Known:
    """Nothing seen yet."""
    none = torch.zeros_like(world.allowed)
    return Known(world.prior_precision, world.prior_precision * world.prior_mean, none)


def world_of(task: Task, scenes: Scenes, cells: Tensor, noise: Tensor) -> Worlds:
    """Put cells (B, N, 3) into B scenes, with noise (T, B, N)."""
    hits = first_surfaces(scenes, torch.zeros_like(cells[:, :1]), cells)
    prior = task.observer.prior
    mean = torch.full_like(hits.range_m, prior.mean)
    precision = torch.full_like(mean, prior.std**-2)
    return Worlds(cells, hits.range_m, noise, torch.ones_like(hits.floor), mean, precision)


def glance(observer: Observer, pose: Eyes, point: Tensor, direction: Tensor, range_m: Tensor) -> tuple[Tensor, Tensor]:
    """Which points both retinas see, and the variance of their inverse range, to first order.

    In the rig's frame, with slopes u = x/z and v = y/z of the eyes' rays, the point is Z ((u + u')/2, (v + v')/2, 1)
    about the baseline's middle with Z = b/(u − u'), as in `torchfovea.sensing.triangulation.triangulate_rectified`; the
    noise of each retina reaches the slopes through its eye's rotation.

    Args:
        observer: camera, retina and error budget.
        pose: of the eyes, (B, ...).
        point: (B, N, 3) in E [m].
        direction: of the points from E, unit (B, N, 3).
        range_m: (B, N).

    Returns:
        bool (B, N) and (B, N) [1/m²], finite everywhere. Differentiable.
    """
    focal, retina = observer.camera.focal_px, observer.retina
    frame, middle, baseline = rig_frame(pose)
    half = baseline[..., None] / 2
    x, y, z = ((point - middle.unsqueeze(-2)) @ frame).unbind(-1)
    ux, uy, uz = (direction @ frame).unbind(-1)
    ahead = z > 1e-3
    depth = torch.where(ahead, z, torch.ones_like(z))
    v = y / depth
    # of the range: by the slopes' mean and by their difference
    along = ux * x + uy * y + uz * depth
    by_mean, by_disparity, by_v = depth * ux / 2, depth * along / (2 * half), depth * uy / 2
    visible = ahead
    spread = torch.zeros_like(range_m)
    for rotation, centre, sign in ((pose.R_left, pose.t_left, 1.0), (pose.R_right, pose.t_right, -1.0)):
        cx, cy, cz = ((point - centre.unsqueeze(-2)) @ rotation).unbind(-1)
        forward = cz > 1e-3
        distance = torch.where(forward, cz, torch.ones_like(cz))
        px = focal * columns(cx / distance, cy / distance)
        visible = visible & forward & retina.inside(px)
        sigma = eye_sigma_px(observer.budget, retina, px) / focal * (distance / depth)
        u, by_u = (x + sign * half) / depth, by_mean - sign * by_disparity
        turned = frame.mT @ rotation
        for axis in (0, 1):
            ax, ay, az = (turned[..., k, axis, None] for k in range(3))
            spread = spread + (sigma * (by_u * (ax - u * az) + by_v * (ay - v * az))).square()
    return visible, (spread / range_m.square().square()).clamp(min=1e-12)


def look(task: Task, world: Worlds, memory: Known, pose: Eyes, t: int) -> Known:
    """Fuse one saccade's observations into the memory."""
    point = world.direction * world.range_m[..., None]
    visible, variance = glance(task.observer, pose, point, world.direction, world.range_m)
    weight = visible / variance
    measured = 1 / world.range_m + variance.sqrt() * world.noise[t]
    return Known(memory.precision + weight, memory.vector + weight * measured, memory.seen | visible)


def score(task: Task, world: Worlds, memory: Known, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Upper confidence bound of every cell.

    Args:
        task: with the reward's kind.
        world: the cells.
        memory: their beliefs.
        alpha: (B,) or a scalar.

    Returns:
        Scores (B, N), −inf where not eligible, and the believed points (B, N, 3).
    """
    observer = task.observer
    mean, std = memory.vector / memory.precision, memory.precision.rsqrt()
    reward = RewardBelief(mean, std)
    if observer.reward == "range":
        reward = range_from_inverse_range(reward)
    range_m = 1 / mean.clamp(min=1 / _FAR_M)
    point = world.direction * range_m[..., None]
    reachable = fixate(observer.head, point)[1]
    limits = observer.eligibility
    # to first order, a range of 1/ρ along a direction is unsure by σ/ρ²
    height = point[..., 2] + observer.head.ego_height_m
    height = height - limits.ground_sigmas * std * range_m * point[..., 2].abs()
    ground = memory.seen & (height < limits.ground_z_m)
    eligible = world.allowed & reachable & (range_m > limits.nearest_m) & ~ground
    value = upper_confidence_bound(reward.mean, reward.std, alpha.to(mean).expand(mean.shape[:1]))
    return torch.where(eligible, value, torch.full_like(value, -math.inf)), point


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


def worth(task: Task, reward: Tensor, nearest_m: Tensor) -> Tensor:
    """The task's metric of rewards (..., T) in scenes whose nearest point is at nearest_m (...)."""
    course = gap(reward, -nearest_m)
    return course[..., -1] if task.metric == "gap_final" else course.mean(-1)


def simulate(
    task: Task,
    scenes: Scenes,
    world: Worlds,
    alpha: Tensor,
    start: tuple[Known, Tensor, Tensor] | None = None,
    keep: bool = False,
) -> Run:
    """Run B episodes with the hard policy.

    Args:
        task: what an episode is.
        scenes: B of them.
        world: their cells.
        alpha: exploration, (B,) or a scalar.
        start: to begin at a decision: memory before it, (B, N); decisions already made t ≥ 0, (B,) int64; rewards so
            far (B, T), of which the first t + 1 count. Runs later in their episode wait for the others.
        keep: keep the memories before each decision.

    Same arguments, same episodes. Not differentiable: the policy is an argmax.
    """
    n, steps = len(scenes.nearest_m), task.saccades
    require(start is None or not keep, "keep", keep, "False for runs that begin later")
    zero = torch.zeros_like(scenes.nearest_m)
    cells = torch.full((n, steps), -1)
    scores = torch.full((n, steps), -math.inf, dtype=zero.dtype)
    angles = torch.zeros(3, n, steps, dtype=zero.dtype)
    memories: list[Known] = []
    alpha = alpha.to(zero).expand(n)
    if start is None:
        memory = look(task, world, empty(world), eyes(task.observer.head, Gaze(zero, zero, zero)), 0)
        order, made = torch.arange(n), torch.zeros(n, dtype=torch.long)
    else:
        memory, made, earlier = start
        order = made.argsort(stable=True)  # those that begin first come first: the live ones are a slice
        memory, world = Known(*(m[order] for m in memory)), world.take(order)
        alpha, made = alpha[order], made[order]
    for t in range(steps - 1):
        live = int((made <= t).sum())
        if live == 0:
            continue
        part = slice(0, live)
        w = world if live == n else Worlds(*(f[:, part] if i == 2 else f[part] for i, f in enumerate(world)))
        m = memory if live == n else Known(*(f[part] for f in memory))
        if keep:
            memories.append(m)
        value, point = score(task, w, m, alpha[part])
        best, cell = best_cell(value)
        chosen = point.gather(1, cell.clamp(min=0)[:, None, None].expand(-1, 1, 3))[:, 0]
        now = Gaze(*(angle * (cell >= 0) for angle in fixate(task.observer.head, chosen)[0]))
        cells[part, t + 1], scores[part, t + 1] = cell, best
        angles[:, part, t + 1] = torch.stack(now)
        if t + 2 < steps:
            m = look(task, w, m, eyes(task.observer.head, now), t + 1)
            memory = m if live == n else Known(*(torch.cat((a, b[live:])) for a, b in zip(m, memory, strict=True)))
    back = order.argsort()
    cells, scores, gaze, made = cells[back], scores[back], Gaze(*angles[:, back]), made[back]
    reward = true_reward(task, scenes, gaze)
    if start is not None:
        reward = torch.where(torch.arange(steps) > made[:, None], reward, earlier)
    return Run(worth(task, reward, scenes.nearest_m), reward, cells, scores, gaze, memories)
