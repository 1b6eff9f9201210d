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
from torchfovea.machine import Loops, columns_of, loops
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import eye_sigma_px
from torchfovea.sensing.head import Eyes, rig_frame
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import require
from torchfovea.tuning.scenes import Scenes, first_surfaces

__all__ = ["Known", "Task", "Worlds", "check_observer", "empty", "glance", "look", "sensor_numbers", "world_of"]


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
    cells = columns(*cells.unbind(-1))
    hits = first_surfaces(scenes, torch.zeros_like(cells[:, :1]), cells)
    prior = task.observer.prior
    mean = torch.full_like(hits.range_m, prior.mean)
    precision = torch.full_like(mean, prior.std**-2)
    return Worlds(cells, hits.range_m, noise, torch.ones_like(hits.floor), mean, precision)


def glance(observer: Observer, pose: Eyes, direction: Tensor, range_m: Tensor) -> tuple[Tensor, Tensor]:
    """Which points both retinas see, and the variance of their inverse range, to first order.

    In the rig's frame, with slopes u = x/z and v = y/z of the eyes' rays, the point is Z ((u + u')/2, (v + v')/2, 1)
    about the baseline's middle with Z = b/(u − u'), as in `torchfovea.sensing.triangulation.triangulate_rectified`; the
    noise of each retina reaches the slopes through its eye's rotation.

    Args:
        observer: camera, retina and error budget.
        pose: of the eyes, (B, ...).
        direction: of the points from E, unit (B, N, 3); fast where its components are contiguous.
        range_m: how far they are (B, N).

    Returns:
        bool (B, N) and (B, N) [1/m²], finite everywhere. Differentiable.
    """
    if isinstance(observer.retina, LogPolar | Uniform):
        library = loops(direction, range_m, *pose)
        if library is not None:
            return _glance_by_loops(library, observer, pose, direction, range_m)
    focal, retina = observer.camera.focal_px, observer.retina
    frame, middle, baseline = rig_frame(pose)
    half = baseline[:, None] / 2
    # vectors as columns, (B, 3, N): seen from the rig, and from the left eye and the right one (B, 2, 3, N)
    point = direction.mT * range_m[:, None]
    x, y, z = (frame.mT @ (point - middle[..., None])).unbind(1)
    ux, uy, uz = (frame.mT @ direction.mT).unbind(1)
    rotation, centre = torch.stack((pose.R_left, pose.R_right), 1), torch.stack((pose.t_left, pose.t_right), 1)
    cx, cy, cz = (rotation.mT @ (point[:, None] - centre[..., None])).unbind(2)
    ahead, forward = z > 1e-3, cz > 1e-3
    depth, distance = torch.where(ahead, z, 1.0), torch.where(forward, cz, 1.0)
    px = focal * columns(cx / distance, cy / distance)
    seen = forward & retina.inside(px)
    v = y / depth
    # of the range: by the slopes' mean and by their difference
    along = ux * x + uy * y + uz * depth
    by_mean, by_disparity, by_v = depth * ux / 2, depth * along / (2 * half), (depth * uy / 2)[:, None]
    u = torch.stack((x + half, x - half), 1) / depth[:, None]
    by_u = torch.stack((by_mean - by_disparity, by_mean + by_disparity), 1)
    sigma = eye_sigma_px(observer.budget, retina, px) / focal * (distance / depth[:, None])
    v = v[:, None]
    ax, ay, az = (frame.mT[:, None] @ rotation)[..., None].unbind(2)
    across, upright = (
        (sigma * (by_u * (ax[:, :, k] - u * az[:, :, k]) + by_v * (ay[:, :, k] - v * az[:, :, k]))).square()
        for k in (0, 1)
    )
    spread = across[:, 0] + upright[:, 0] + across[:, 1] + upright[:, 1]
    return ahead & seen[:, 0] & seen[:, 1], (spread / range_m.square().square()).clamp(min=1e-12)


def _glance_by_loops(
    library: Loops, observer: Observer, pose: Eyes, direction: Tensor, range_m: Tensor
) -> tuple[Tensor, Tensor]:
    frame, middle, baseline = rig_frame(pose)
    middle, turned = middle[:, None] @ frame, torch.stack((pose.R_left, pose.R_right), 1).mT @ frame[:, None]
    rig = torch.cat((frame.mT.flatten(1), middle[:, 0], baseline[:, None] / 2, turned.flatten(1)), 1)
    visible, variance = torch.empty(range_m.shape, dtype=torch.bool), torch.empty_like(range_m)
    given = (*range_m.shape, columns_of(direction), range_m.contiguous(), visible, variance)
    library("glance", rig, sensor_numbers(observer), given)
    return visible, variance


def sensor_numbers(observer: Observer) -> tuple[float, ...]:
    """How the loops are told the variance law of a retina of this package, see `torchfovea.sensing.eye_sigma_px`."""
    retina, budget = observer.retina, observer.budget
    assert isinstance(retina, LogPolar | Uniform)
    slope, least = retina.width_law
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    own = budget.sigma_over_width**2
    more = (own + budget.match_px**2) * source**2
    return tuple(map(float, (observer.camera.focal_px, retina.radius_px, slope**2, least**2, own, more)))


def look(task: Task, world: Worlds, memory: Known, pose: Eyes, t: int) -> Known:
    """Fuse one saccade's observations into the memory."""
    visible, variance = glance(task.observer, pose, world.direction, world.range_m)
    weight = visible / variance
    measured = 1 / world.range_m + variance.sqrt() * world.noise[t]
    return Known(memory.precision + weight, memory.vector + weight * measured, memory.seen | visible)
