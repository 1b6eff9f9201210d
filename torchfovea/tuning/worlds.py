"""Cells in simulated scenes, and what a glance tells of them.

In a saccade each cell that both retinas see gets *one* noisy inverse range, measured on its own direction, and keeps a
scalar Gaussian belief of it. Removing or adding a cell changes no other cell's observations, which is what makes the
counterfactual gradient exact here. Against the full simulator there is no occlusion between the eyes, no poles and no
furniture, no pooling of receptive fields and no patch scatter; the standard deviation of an observation is that of
`torchfovea.sensing.triangulation.observe` to first order.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import eye_sigma_px
from torchfovea.sensing.head import Eyes, rig_frame
from torchfovea.setting import require
from torchfovea.tuning.scenes import Scenes, first_surfaces

__all__ = ["Known", "Task", "Worlds", "check_observer", "empty", "glance", "look", "world_of"]


class Task(NamedTuple):
    """What an episode is made of besides the cells.

    Attributes:
        observer: the fixed parts; its acquisition is not used.
        saccades: T, the initial gaze included.
        far_m: what a fixation on the floor counts as.
        metric: what an episode is worth: gap_per_saccade or gap_final.
        saccade_cost: what a degree of the mean saccade takes from it.
    """

    observer: Observer
    saccades: int = 10
    far_m: float = 6.0
    metric: str = "gap_per_saccade"
    saccade_cost: float = 0.0


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
