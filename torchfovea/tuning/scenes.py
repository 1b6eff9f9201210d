"""Analytic scenes for tuning: upright cans in a rectangular room, drawn and ray-cast in batches, in the ego frame E.

They are those of the simulated distribution of cans without poles and furniture, so that what is tuned here can be
judged there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.machine import columns_of, loops
from torchfovea.sensing.head import Head, can_fixate
from torchfovea.setting import check_types, require, require_name

__all__ = ["Distribution", "Hits", "Scenes", "draw_scenes", "first_surfaces", "nearest_point", "stream"]

Range = tuple[float, float]

_LOWEST_M = 0.08  # of the target's nearest point above the floor: lower points count as ground
_NEAREST_M = 0.55  # the policy does not fixate below 0.5 m
_GAP_M = 0.03  # between neighbours
_SPLITS = ("training", "validation", "heldout")


@dataclass(frozen=True)
class Distribution:
    """A named distribution of scenes: where the nearest can, the target, may stand, and where the others.

    Attributes:
        name: for tables and pictures.
        regions: of the target's centre as E sees it, each (azimuth low, high, elevation low, high) [deg], drawn with
            equal probability and uniformly inside; azimuth positive to the left, elevation up.
        conditioned: whether each scene has a task: a centre drawn from the region, told to the policy as a vector in
            [-1, 1]², with the target within `task_spread_deg` of it.
        task_spread_deg: half widths in azimuth and elevation about the task's centre [deg].
        told_spread: at most how many times wider or narrower than that the target may stand, drawn for each scene on a
            logarithmic scale and told as two more numbers of the task; 1: always as wide, and not told.
        cans: how many in all, at least 2.
        target_range_m: to the target's centre.
        azimuth_deg: of the other cans' centres.
        elevation_deg: of the others.
        range_m: of the others.
        can_radius_m: of every can.
        can_height_m: of every can.
        margin_m: the others' nearest points are farther than the target's by at least this.
        front_m: to the wall ahead of the robot.
        back_m: to the wall behind.
        side_m: to the walls on either side.
        height_m: of the ceiling.
        tries: redraws of a can that does not fit before giving up.
    """

    name: str = "left_below"
    regions: tuple[tuple[float, float, float, float], ...] = ((15.0, 45.0, -23.0, -7.0),)
    conditioned: bool = False
    task_spread_deg: Range = (8.0, 5.0)
    told_spread: float = 1.0
    cans: int = 7
    target_range_m: Range = (0.9, 1.3)
    azimuth_deg: Range = (-50.0, 50.0)
    elevation_deg: Range = (-26.0, 18.0)
    range_m: Range = (1.4, 2.8)
    can_radius_m: Range = (0.04, 0.07)
    can_height_m: Range = (0.11, 0.20)
    margin_m: float = 0.2
    front_m: float = 4.0
    back_m: float = 3.0
    side_m: float = 3.2
    height_m: float = 2.8
    tries: int = 200

    def __post_init__(self) -> None:
        """Raise SettingError for values out of range; lists become tuples."""
        check_types(self, "distribution.")
        require_name(self.name, "distribution.name")
        require(2 <= self.cans <= 40, "distribution.cans", self.cans, "a whole number from 2 to 40")
        regions = self.regions
        for region in regions:
            fine = -180 <= region[0] <= region[1] <= 180 and -85 <= region[2] <= region[3] <= 85
            require(fine, "distribution.regions", region, "[azimuth low, high, elevation low, high] in degrees")
        require(len(regions) > 0, "distribution.regions", regions, "at least one region")
        require(
            not self.conditioned or len(regions) == 1,
            "distribution.regions",
            regions,
            "one region for a conditioned family",
        )
        limits = {
            "task_spread_deg": (0, 90), "target_range_m": (0.3, 20), "azimuth_deg": (-180, 180), "elevation_deg": (-85,
            85), "range_m": (0.3, 20), "can_radius_m": (0.01, 0.3), "can_height_m": (0.02, 1.0),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            pair = getattr(self, name)
            ordered = low <= pair[0] <= high and low <= pair[1] <= high
            ordered = ordered and (name == "task_spread_deg" or pair[0] <= pair[1])
            require(ordered, f"distribution.{name}", pair, f"(low, high) within {low} to {high}")
        require(1 <= self.told_spread <= 10, "distribution.told_spread", self.told_spread, "a factor from 1 to 10")
        require(0 <= self.margin_m <= 5, "distribution.margin_m", self.margin_m, "0 to 5 metres")
        for name in ("front_m", "back_m", "side_m", "height_m"):
            require(
                0.1 <= getattr(self, name) <= 1000, f"distribution.{name}", getattr(self, name), "0.1 to 1000 metres"
            )
        require(1 <= self.tries <= 10**6, "distribution.tries", self.tries, "1 to 1000000")

    @property
    def task_numbers(self) -> int:
        """How many numbers a task has: where, and if it is told how sure that is."""
        return 4 if self.conditioned and self.told_spread > 1 else 2

    def region_of(self, a: float, e: float) -> tuple[float, float, float, float]:
        """Where the target of a conditioned task (a, e) in [-1, 1]² may stand, one of `regions`, at middling spread."""
        left, right, low, high = self.regions[0]
        azimuth, elevation = (left + right + a * (right - left)) / 2, (low + high + e * (high - low)) / 2
        da, de = self.task_spread_deg
        return azimuth - da, azimuth + da, elevation - de, elevation + de


class Scenes(NamedTuple):
    """B scenes in E; lengths in metres.

    Attributes:
        x: of the cans' axes, (B, S); the target is can 0.
        y: (B, S).
        low: of the cans' lower ends above E's origin, (B, S).
        high: of their upper ends, (B, S).
        radius: (B, S).
        nearest_m: range of the target's nearest point, (B,).
        task: what the policy is told, (B, 2) or (B, 4) in [-1, 1]; zeros where the distribution is not conditioned.
        walls: the room as (front, back, side, floor, ceiling): x in [-back, front], |y| <= side, z in [floor, ceiling].
    """

    x: Tensor
    y: Tensor
    low: Tensor
    high: Tensor
    radius: Tensor
    nearest_m: Tensor
    task: Tensor
    walls: tuple[float, float, float, float, float]

    def take(self, index: Tensor) -> Scenes:
        """The scenes of an index (K,)."""
        x, y, low, high, radius, nearest, task = (field[index] for field in self[:7])
        return Scenes(x, y, low, high, radius, nearest, task, self.walls)


class Hits(NamedTuple):
    """First surfaces on rays.

    Attributes:
        range_m: along the ray, (B, K).
        floor: whether it is the floor, bool (B, K).
        can: which can it is, int64 (B, K); −1 for none.
    """

    range_m: Tensor
    floor: Tensor
    can: Tensor


def stream(split: str, seed: int, step: int = 0) -> torch.Generator:
    """The random numbers of one minibatch; training, validation and held-out never share any.

    Args:
        split: training, validation or heldout.
        seed: of the study, 0 to 999,999.
        step: of the minibatch, 0 to 999,999,999.
    """
    require(split in _SPLITS, "split", split, "one of " + ", ".join(_SPLITS))
    require(0 <= seed < 10**6, "seed", seed, "0 to 999999")
    return torch.Generator().manual_seed((_SPLITS.index(split) + 1) * 10**15 + seed * 10**9 + step)


def nearest_point(x: Tensor, y: Tensor, low: Tensor, high: Tensor, radius: Tensor) -> Tensor:
    """The point (..., 3) of upright cylinders nearest to E's origin, which lies outside them."""
    away = torch.hypot(x, y).clamp(min=1e-6)
    scale = (away - radius).clamp(min=0) / away
    return columns(x * scale, y * scale, torch.zeros_like(x).clamp(min=low, max=high))


def draw_scenes(
    distribution: Distribution, head: Head, n: int, generator: torch.Generator, dtype: torch.dtype = torch.float32
) -> Scenes:
    """Draw scenes; what does not fit is drawn again.

    Args:
        distribution: which.
        head: whose reach every can's nearest point is within.
        n: how many.
        generator: random state on the CPU.
        dtype: of the result.

    Raises:
        SettingError: for regions in which no can fits or the head can see none.
    """
    require(n >= 1, "scenes", n, "at least 1")
    d, s = distribution, distribution.cans

    def uniform(shape: tuple[int, ...], low: float | Tensor, high: float | Tensor) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    region = torch.tensor(d.regions, dtype=torch.float64)
    mode = torch.randint(len(region), (n,), generator=generator)
    bounds = region[mode]
    task = torch.zeros(n, d.task_numbers, dtype=torch.float64)
    if d.conditioned:
        task = uniform((n, d.task_numbers), -1.0, 1.0)
        centre = (bounds[:, ::2] + bounds[:, 1::2]) / 2 + task[:, :2] * (bounds[:, 1::2] - bounds[:, ::2]) / 2
        spread = torch.tensor(d.task_spread_deg, dtype=torch.float64)
        if d.task_numbers > 2:
            spread = spread * d.told_spread ** task[:, 2:]
        bounds = torch.stack((centre - spread, centre + spread), -1).flatten(1)
    walls = (d.front_m, d.back_m, d.side_m, -head.ego_height_m, d.height_m - head.ego_height_m)
    can = torch.zeros(n, s, 5, dtype=torch.float64)
    bad = torch.ones(n, s, dtype=torch.bool)
    target = torch.arange(s) == 0
    for _ in range(d.tries):
        lower, upper = (bounds[:, i : i + 1].expand(n, s) for i in (0, 1))
        a = uniform((n, s), torch.where(target, lower, d.azimuth_deg[0]), torch.where(target, upper, d.azimuth_deg[1]))
        lower, upper = (bounds[:, i : i + 1].expand(n, s) for i in (2, 3))
        e = uniform(
            (n, s), torch.where(target, lower, d.elevation_deg[0]), torch.where(target, upper, d.elevation_deg[1])
        )
        r = uniform(
            (n, s),
            torch.where(target, d.target_range_m[0], d.range_m[0]).double(),
            torch.where(target, d.target_range_m[1], d.range_m[1]).double(),
        )
        radius, height = uniform((n, s), *d.can_radius_m), uniform((n, s), *d.can_height_m)
        a, e = a.deg2rad(), e.deg2rad()
        flat = r * e.cos()
        low = r * e.sin() - height / 2
        fresh = torch.stack((flat * a.cos(), flat * a.sin(), low, low + height, radius), -1)
        can = torch.where(bad[..., None], fresh, can)
        bad = _misfits(d, head, can, walls)
        if not bool(bad.any()):
            break
    share = float(bad[:, 0].double().mean())
    require(
        share == 0,
        "distribution.regions",
        d.regions,
        f"regions in which a can at {d.target_range_m} m fits and the head can fixate it "
        f"(none in {share:.0%} of the scenes after {d.tries} tries)",
    )
    require(not bool(bad.any()), "distribution.cans", s, "as many cans as fit their regions")
    x, y, low, high, radius = (c.to(dtype) for c in can.unbind(-1))
    nearest = nearest_point(*can[:, 0].unbind(-1)).norm(dim=-1).to(dtype)
    return Scenes(x, y, low, high, radius, nearest, task.to(dtype), walls)


def _misfits(d: Distribution, head: Head, can: Tensor, walls: tuple[float, ...]) -> Tensor:
    """Which cans (B, S) must be drawn again: out of the room or of reach, too near, or in another one's place."""
    x, y, low, high, radius = can.unbind(-1)
    front, back, side, floor, ceiling = walls
    gap = radius + _GAP_M
    fits = (x + gap < front) & (x - gap > -back) & (y.abs() + gap < side) & (low >= floor) & (high + _GAP_M < ceiling)
    point = nearest_point(x, y, low, high, radius)
    far = point.norm(dim=-1)
    fits &= can_fixate(head, point) & (far >= _NEAREST_M)
    fits[:, 0] &= point[:, 0, 2] - floor >= _LOWEST_M
    fits[:, 1:] &= far[:, 1:] >= far[:, :1] + d.margin_m
    apart = torch.hypot(x[:, :, None] - x[:, None], y[:, :, None] - y[:, None])
    touching = apart < radius[:, :, None] + radius[:, None] + _GAP_M
    later = torch.ones(d.cans, d.cans, dtype=torch.bool).tril(-1)  # the later of two gives way
    return ~fits | (touching & later).any(-1)


def first_surfaces(scenes: Scenes, origin: Tensor, direction: Tensor) -> Hits:
    """First surfaces on rays that start inside the room and outside the cans.

    Args:
        scenes: B of them.
        origin: (B, 1, 3) or (B, K, 3).
        direction: unit (B, K, 3).

    Returns:
        (B, K). The range is differentiable where the surface does not change.
    """
    library = loops(*scenes[:5], origin, direction)
    if library is not None:
        given = (*scenes.x.shape, *(part.contiguous() for part in scenes[:5]), *map(float, scenes.walls))
        kinds = (direction.dtype, torch.bool, torch.int64)
        found = Hits(*(torch.empty(direction.shape[:-1], dtype=kind) for kind in kinds))
        rays = (direction.shape[1], columns_of(direction), origin.shape[1], columns_of(origin))
        library("first_surfaces", given, rays, tuple(found))
        return found
    front, back, side, floor, ceiling = scenes.walls
    ox, oy, oz = origin.unbind(-1)
    dx, dy, dz = direction.unbind(-1)
    tiny = 1e-12
    sx, sy, sz = (torch.where(c.abs() < tiny, torch.full_like(c, tiny), c) for c in (dx, dy, dz))
    wall = torch.minimum(
        torch.where(sx > 0, front - ox, -back - ox) / sx, torch.where(sy > 0, side - oy, -side - oy) / sy
    )
    level = torch.where(sz > 0, ceiling - oz, floor - oz) / sz
    best = torch.minimum(wall, level)
    down = (level < wall) & (sz < 0)
    flat = (dx * dx + dy * dy).clamp(min=tiny)[..., None]
    x, y, low, high, radius = (field[:, None] for field in scenes[:5])
    ox, oy, oz, dx, dy, dz, sz = (c[..., None] for c in (ox, oy, oz, dx, dy, dz, sz))
    px, py = ox - x, oy - y
    b = px * dx + py * dy
    root = b * b - flat * (px * px + py * py - radius * radius)
    hits = root > 0
    half = torch.where(hits, root, torch.ones_like(root)).sqrt()
    entry, leave = (-b - half) / flat, (-b + half) / flat
    z = oz + entry * dz
    on_side = hits & (entry > 0) & (z >= low) & (z <= high)
    cap = torch.where(sz > 0, low - oz, high - oz) / sz
    on_cap = hits & (cap > 0) & (cap >= entry) & (cap <= leave)
    nearest, which = torch.minimum(torch.where(on_side, entry, math.inf), torch.where(on_cap, cap, math.inf)).min(-1)
    on_can = nearest < best
    return Hits(torch.where(on_can, nearest, best), down & ~on_can, which.masked_fill(~on_can, -1))
