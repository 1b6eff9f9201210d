"""The truth that metrics are made of, found by rays from E's origin."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.arena import Truth
from torchfovea.sensing.head import Head, fixate
from torchfovea.sim.model import Nearest, Scene
from torchfovea.sim.rays import RayHits, cast

__all__ = ["find_nearest", "reachable_grid", "truth_of"]

_STARTS = 6  # places of the coarse grid that are refined
_HALF = 10  # a refinement looks at (2·10 + 1)² rays


def _directions(azimuth: Tensor, elevation: Tensor) -> Tensor:
    c = torch.cos(elevation)
    return torch.stack([torch.cos(azimuth) * c, torch.sin(azimuth) * c, torch.sin(elevation)], -1)


def _reach(head: Head) -> tuple[float, float, float]:
    """Azimuth to either side, lowest and highest elevation [rad] at which E may see a reachable point.

    A point is at elevation asin(up / distance) − tilt; the first term is largest for the nearest distance that the
    vergence allows and falls to zero far away.
    """
    lift = math.atan2(head.eyes_up_m, max(head.nearest_m + head.eyes_forward_m, 1e-3))
    more, straight = math.radians(head.sight_deg), math.radians(89.9)
    low = max(-math.radians(head.tilt_down_deg) - more + min(lift, 0.0), -straight)
    high = min(math.radians(head.tilt_up_deg) + more + max(lift, 0.0), straight)
    return min(math.radians(head.pan_limit_deg) + more, math.pi), low, high


def reachable_grid(head: Head, step_deg: float) -> Tensor:
    """A grid of unit directions from E (N, 3), float64, that covers every direction in which a point can be fixated."""
    side, low, high = _reach(head)
    step = math.radians(step_deg)
    azimuth = torch.linspace(-side, side, max(2, math.ceil(2 * side / step) + 1), dtype=torch.float64)
    elevation = torch.linspace(low, high, max(2, math.ceil((high - low) / step) + 1), dtype=torch.float64)
    return _directions(*torch.meshgrid(azimuth, elevation, indexing="ij")).reshape(-1, 3)


def _eligible_range(scene: Scene, direction: Tensor) -> tuple[Tensor, RayHits]:
    hits = cast(scene, torch.zeros(3, dtype=torch.float64), direction)
    _, reachable = fixate(scene.head, hits.range_m[:, None] * direction)
    sought = ~scene.is_floor(hits.geom) if scene.marks is None else scene.is_target(hits.geom)
    keep = reachable & (hits.geom >= 0) & sought
    return torch.where(keep, hits.range_m, torch.full_like(hits.range_m, math.inf)), hits


def find_nearest(scene: Scene, step_deg: float = 0.3) -> Nearest:
    """The nearest reachable surface point that is not floor, among first surfaces on rays from E's origin.

    In a scene with marks, that of the target.

    A grid over all reachable directions, then shrinking grids around the best places of it, to well below a millimetre.
    An object thinner than `step_deg` may be missed.
    """
    grid = reachable_grid(scene.head, step_deg)
    far, hits = _eligible_range(scene, grid)
    best = Nearest(torch.zeros(3, dtype=torch.float64), math.inf, -1)
    order = far.argsort()
    starts: list[int] = []
    for i in order[:4000].tolist():
        if len(starts) == _STARTS or not math.isfinite(far[i]):
            break
        if all(float(grid[i] @ grid[j]) < math.cos(math.radians(3 * step_deg)) for j in starts):
            starts.append(i)
    offset = torch.linspace(-1, 1, 2 * _HALF + 1, dtype=torch.float64)
    du, dv = (o.reshape(-1) for o in torch.meshgrid(offset, offset, indexing="ij"))
    side, low, high = _reach(scene.head)
    for i in starts:
        x, y, z = grid[i]
        azimuth, elevation, width = torch.atan2(y, x), torch.asin(z.clamp(-1, 1)), math.radians(1.5 * step_deg)
        for _ in range(6):
            a = (azimuth + width * du).clamp(-side, side)
            e = (elevation + width * dv).clamp(low, high)
            direction = _directions(a, e)
            far, hits = _eligible_range(scene, direction)
            k = int(far.argmin())
            if not math.isfinite(far[k]):
                break
            if float(far[k]) < best.range_m:
                best = Nearest(far[k] * direction[k], float(far[k]), int(hits.geom[k]))
            azimuth, elevation, width = a[k], e[k], width * 0.25
    return best


def truth_of(scene: Scene, cells: Tensor) -> Truth:
    """What the judge of an episode knows: the nearest point, and the surface behind every memory cell (Nx, 3)."""
    hits = cast(scene, torch.zeros(3, dtype=torch.float64), cells)
    points = hits.range_m.to(cells)[:, None] * cells
    points = torch.where((hits.geom >= 0)[:, None], points, torch.full_like(points, torch.inf))
    return Truth(float(scene.nearest_range_m), scene.nearest_point_e.to(cells), points)
