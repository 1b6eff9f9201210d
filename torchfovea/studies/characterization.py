"""What a sensor can know of a fronto-parallel plane: its mean information over distance and vergence (paper Sec. 7.1).

Each left receptive field (RF) looks at the plane, and the point it sees is projected into the right retina; the
uncertainty of that correspondence goes through triangulation. The head looks straight ahead: the ego frame E
lies midway between the eyes, x forward, and the plane is x = distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.metrics import information
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Eyes, Gaze, Head, eyes, to_ego
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import check_types, require

__all__ = [
    "Characterization", "Places", "PlaneSensor", "Snapshot", "characterize_planes", "correspond_plane",
    "elementwise_jacobian", "half_retina", "matched_vergence", "peak_vergence", "plane_information", "plane_points",
    "solid_angle_sr", "spread_over_vergence", "straight_eyes",
]  # fmt: skip

GRAZING = 1e-6  # rays closer than this to parallel with the plane do not meet it

PAPER = SigmaPoints.paper()


@dataclass(frozen=True)
class PlaneSensor:
    """Two eyes of one kind, and how their uncertainty is carried to 3-D.

    Attributes:
        camera: of both eyes, in retinal pixels.
        retina: of both eyes.
        baseline_m: distance between the eyes, > 0.
        budget: the retinal error budget; the paper has the retina's term only.
        points: sigma points; the paper's by default.
        rotated: see `torchfovea.sensing.unscented.sigma_root`; the paper's root is diagonal.
    """

    camera: Camera
    retina: Retina
    baseline_m: float = 0.065
    budget: Budget = Budget.printed
    points: SigmaPoints = PAPER
    rotated: bool = False

    def __post_init__(self) -> None:
        """Raise SettingError for eyes that coincide."""
        check_types(self)
        require(0 < self.baseline_m < math.inf, "baseline_m", self.baseline_m, "a positive distance in metres")


class Places(NamedTuple):
    """Receptive fields that stand for a whole retina.

    Attributes:
        px: (n, 2), their centres.
        weight: (n,), how many each stands for.
        solid_angle_sr: (n,), that each covers.
    """

    px: Tensor
    weight: Tensor
    solid_angle_sr: Tensor


class Snapshot(NamedTuple):
    """One look at one plane; the means are 0 where nothing is matched.

    Attributes:
        information: mean of −log|Σ| over the matched RFs (Eq. 44-45) [nats].
        information_solid_angle: the same mean, each RF weighted by the solid angle it covers.
        matched_fraction: share of the left RFs whose counterpart lies on the right retina and triangulates.
    """

    information: Tensor
    information_solid_angle: Tensor
    matched_fraction: Tensor


class Characterization(NamedTuple):
    """Snapshots on a grid of distances (rows) and vergences (columns): tensors (D,), (V,) and three of (D, V)."""

    distance_m: Tensor
    vergence_rad: Tensor
    information: Tensor
    information_solid_angle: Tensor
    matched_fraction: Tensor


def matched_vergence(baseline_m: float, distance_m: Tensor) -> Tensor:
    """The vergence whose axes meet on the plane, 2 atan(b/2d); (...) to (...) [rad]."""
    return 2 * torch.atan(baseline_m / (2 * distance_m))


def straight_eyes(baseline_m: float, vergence_rad: float | Tensor, dtype: torch.dtype = torch.float32) -> Eyes:
    """Eyes that look straight ahead with a vergence, E midway between them.

    Args:
        baseline_m: distance between the eyes, > 0.
        vergence_rad: angle between the optical axes, any shape (...); negative diverges.
        dtype: of the poses.

    Raises:
        SettingError: for eyes that coincide.
    """
    vergence = torch.as_tensor(vergence_rad, dtype=dtype)
    zero = torch.zeros_like(vergence)
    return eyes(Head(baseline_m, eyes_forward_m=0.0, eyes_up_m=0.0), Gaze(zero, zero, vergence))


def plane_points(rays: Tensor, origin: Tensor, distance_m: float | Tensor) -> tuple[Tensor, Tensor]:
    """Where rays meet the plane x = distance.

    Args:
        rays: directions in E of any length, (..., 3).
        origin: their common origin in E, broadcastable to (..., 3) [m].
        distance_m: the plane, broadcastable to (...).

    Returns:
        Points (..., 3) [m] and whether the ray meets the plane in front of it, bool (...); finite everywhere.
        Differentiable.
    """
    ahead = rays[..., 0] > GRAZING * rays.abs().sum(-1)
    reach = (distance_m - origin[..., 0]) / torch.where(ahead, rays[..., 0], torch.ones_like(rays[..., 0]))
    meets = ahead & (reach > 0)
    return origin + torch.where(meets, reach, torch.ones_like(reach))[..., None] * rays, meets


def correspond_plane(
    sensor: PlaneSensor, left_px: Tensor, pose: Eyes, distance_m: float | Tensor
) -> tuple[Correspondences, Tensor]:
    """The exact correspondences of a plane, with the budget's standard deviations.

    Args:
        sensor: the eyes.
        left_px: places on the left retina, (..., N, 2).
        pose: poses of the eyes, (...).
        distance_m: the plane, broadcastable to (..., N).

    Returns:
        Correspondences (..., N) and the points on the plane (..., N, 3) in E [m].
    """
    rays = to_ego(pose.R_left, sensor.camera.rays(left_px))
    points, meets = plane_points(rays, pose.t_left.unsqueeze(-2), distance_m)
    return correspond_points(points, meets, left_px, pose, sensor.camera, sensor.retina, sensor.budget), points


def elementwise_jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Jacobians of a function that treats every element by itself, by automatic differentiation.

    Args:
        function: (..., n) to (..., m).
        x: (..., n).

    Returns:
        (..., m, n).
    """
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = function(x)
        rows = [torch.autograd.grad(part.sum(), x, retain_graph=True)[0] for part in value.unbind(-1)]
    return torch.stack(rows, -2)


def solid_angle_sr(camera: Camera, retina: Retina, px: Tensor) -> Tensor:
    """Solid angle that an RF covers, W² times the camera's steradians per square pixel; (..., 2) to (...)."""

    def unit(place: Tensor) -> Tensor:
        ray = camera.rays(place)
        return ray * (ray * ray).sum(-1, keepdim=True).rsqrt()

    across, down = elementwise_jacobian(unit, px).unbind(-1)
    per_px: Tensor = torch.linalg.cross(across, down).norm(dim=-1)
    return retina.width_px(px).square() * per_px


def half_retina(camera: Camera, retina: Retina, dtype: torch.dtype = torch.float32, every: int = 1) -> Places:
    """RFs enough to know all of them where the scene is as symmetric as a plane, up and down.

    Args:
        camera: of the eyes.
        retina: their layout.
        dtype: of the result.
        every: only every so-many-th of them, for as many times more.

    Returns:
        The lower half, each for two, where the layout is its own mirror image; otherwise every RF.
    """
    px = retina.centers_px(dtype=torch.float64)
    places = torch.round(px * 1e6)
    mirrored = places * places.new_tensor([1, -1])
    symmetric = torch.equal(torch.unique(places, dim=0), torch.unique(mirrored, dim=0))
    weight = 1 + torch.sign(places[:, 1]) if symmetric else torch.ones_like(px[:, 0])
    keep = (weight > 0).nonzero()[::every, 0]
    half = columns(px[keep, 0].to(dtype), px[keep, 1].to(dtype))
    return Places(half, every * weight[keep].to(dtype), solid_angle_sr(camera, retina, half))


def plane_information(
    sensor: PlaneSensor,
    distance_m: float | Tensor,
    vergence_rad: float | Tensor,
    places: Places | None = None,
) -> Snapshot:
    """Look at one plane with one vergence.

    Args:
        sensor: the eyes.
        distance_m: the plane, > 0.
        vergence_rad: angle between the optical axes.
        places: of the left eye; None: `half_retina`. They choose the precision.

    Returns:
        Scalars. Cartesian information, the paper's measure; Eq. 45 as a mean over the *matched* RFs, for those
        without a counterpart have no covariance.

    Raises:
        SettingError: for a plane that is not in front.
    """
    require(0 < float(distance_m) < math.inf, "distance_m", float(distance_m), "a positive distance in metres")
    px, count, wide = places or half_retina(sensor.camera, sensor.retina)
    pose = straight_eyes(sensor.baseline_m, vergence_rad, px.dtype)
    matches, _ = correspond_plane(sensor, px, pose, float(distance_m))
    seen = observe(
        matches, pose, sensor.camera, sensor.retina.width_px(px) / 2, sensor.points, "cartesian", sensor.rotated
    )
    nats = information(seen.cov).double()
    matched = torch.where(seen.valid, count, torch.zeros_like(count)).double()
    return Snapshot(_mean(nats, matched), _mean(nats, matched * wide), matched.sum() / count.double().sum())


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    total = weights.sum()
    return torch.where(total > 0, (values * weights).sum() / total.clamp(min=1e-300), torch.zeros_like(total))


def characterize_planes(
    sensor: PlaneSensor,
    distance_m: Tensor,
    vergence_rad: Tensor,
    done: Callable[[], None] | None = None,
    places: Places | None = None,
) -> Characterization:
    """Look at every plane with every vergence (paper Fig. 5).

    Args:
        sensor: the eyes.
        distance_m: (D,), > 0.
        vergence_rad: (V,).
        done: called without arguments after each look.
        places: as in `plane_information`.

    Raises:
        SettingError: for a plane that is not in front.
    """
    places = places or half_retina(sensor.camera, sensor.retina)
    looks = []
    for distance in distance_m.tolist():
        for vergence in vergence_rad.tolist():
            looks.append(plane_information(sensor, distance, vergence, places))
            if done is not None:
                done()
    shape = (len(distance_m), len(vergence_rad))
    return Characterization(
        distance_m, vergence_rad, *(torch.stack(c).reshape(shape) for c in zip(*looks, strict=True))
    )


def spread_over_vergence(grid: Characterization) -> Tensor:
    """Largest less smallest information over the vergences that match anything, (D,) [nats]; 0 where none does."""
    seen = grid.matched_fraction > 0
    high = torch.where(seen, grid.information, -math.inf).amax(1)
    low = torch.where(seen, grid.information, math.inf).amin(1)
    return torch.where(seen.any(1), high - low, torch.zeros_like(high))


def peak_vergence(
    sensor: PlaneSensor, grid: Characterization, row: int, rounds: int = 2, places: Places | None = None
) -> float:
    """The vergence with the most information about one plane of a grid, refined between the grid's vergences.

    Args:
        sensor: the eyes that made the grid.
        grid: from `characterize_planes`.
        row: which distance.
        rounds: each looks at nine vergences in the gap around the best one so far, which shrinks by four.
        places: as in `plane_information`.

    Returns:
        The vergence [rad].
    """
    places = places or half_retina(sensor.camera, sensor.retina)
    angles = grid.vergence_rad.double()
    seen = torch.where(grid.matched_fraction[row] > 0, grid.information[row], -math.inf)
    best = float(angles[seen.argmax()])
    step = float((angles[1:] - angles[:-1]).max()) if len(angles) > 1 else 0.0
    low, high = float(angles.min()), float(angles.max())
    for _ in range(rounds):
        near = torch.linspace(max(low, best - step), min(high, best + step), 9, dtype=torch.float64).tolist()
        looks = [plane_information(sensor, grid.distance_m[row], angle, places) for angle in near]
        nats = [float(s.information) if s.matched_fraction > 0 else -math.inf for s in looks]
        best, step = near[nats.index(max(nats))], step / 4
    return best
