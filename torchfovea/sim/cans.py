"""A seeded distribution of scenes: cans on poles in a room, exactly one of them nearest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.head import Gaze, Head, cyclopean, eyes, fixate
from torchfovea.setting import SettingError, check_types, require
from torchfovea.sim.compile import compile_solids, seeded, stand_at
from torchfovea.sim.model import EgoPose, Scene
from torchfovea.sim.rays import cast
from torchfovea.sim.room import POLE, TARGET, Room, Solid, can, furnish, pole
from torchfovea.sim.truth import reachable_grid

__all__ = ["Cans", "place_cans", "point_in_sight", "target_in_sight"]

_BATCH = 256  # candidates drawn at once
_GROUNDED_M = 0.05  # a can this near the floor stands on it
_GAP_M = 0.03  # between neighbours
_NEAREST_M = 0.55  # the policy does not fixate below 0.5 m
_LOWEST_M = 0.08  # of the target's nearest point above the floor: lower points count as ground

Range = tuple[float, float]


@dataclass(frozen=True)
class Cans:
    """Cans at different distances and heights; regions are where a can's centre is seen from E, drawn uniformly.

    Attributes:
        cans: how many, at least 2; the nearest is the target.
        target_azimuth_deg: positive to the left.
        target_elevation_deg: positive up.
        target_range_m: to its centre.
        azimuth_deg: of the other cans.
        elevation_deg: of the others.
        range_m: of the others.
        can_radius_m: of every can.
        can_height_m: of every can.
        pole_radius_m: of what it stands on, thinner than the thinnest can.
        margin_m: by which the target's nearest surface is nearer than any other object's (its own pole: a fifth of it).
        reach_margin_deg: by which every can's nearest point lies within the head's pan, tilt and vergence.
        outside_first_view: whether every point of the target lies outside the cone of `first_view_deg` of both eyes at
            gaze 0: the disc that a retina sees (the corners of a square image reach farther out than a wide-set pair of
            eyes on Vizzy's neck can turn to).
        first_view_deg: full angle of that cone.
        room: around it all.
        tries: scenes drawn before giving up.
    """

    cans: int = 7
    target_azimuth_deg: Range = (-51.0, 51.0)
    target_elevation_deg: Range = (-28.0, 14.0)
    target_range_m: Range = (0.62, 0.95)
    azimuth_deg: Range = (-51.0, 51.0)
    elevation_deg: Range = (-26.0, 18.0)
    range_m: Range = (0.85, 2.6)
    can_radius_m: Range = (0.04, 0.07)
    can_height_m: Range = (0.11, 0.20)
    pole_radius_m: float = 0.012
    margin_m: float = 0.1
    reach_margin_deg: float = 1.5
    outside_first_view: bool = False
    first_view_deg: float = 90.0
    room: Room = field(default_factory=Room)
    tries: int = 40

    def __post_init__(self) -> None:
        """Raise SettingError for values out of range; lists become tuples."""
        check_types(self, "scene.")
        require(2 <= self.cans <= 40, "scene.cans", self.cans, "a whole number from 2 to 40")
        limits = {
            "target_azimuth_deg": (-180, 180), "target_elevation_deg": (-85, 85), "target_range_m": (0.3, 20),
            "azimuth_deg": (-180, 180), "elevation_deg": (-85, 85), "range_m": (0.3, 20),
            "can_radius_m": (0.01, 0.3), "can_height_m": (0.02, 1.0),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            fine = low <= value[0] <= value[1] <= high
            require(fine, f"scene.{name}", value, f"(low, high) within {low} to {high}")
        thin = 0.002 <= self.pole_radius_m < self.can_radius_m[0]
        require(thin, "scene.pole_radius_m", self.pole_radius_m, "at least 0.002 and thinner than the thinnest can")
        require(0 <= self.margin_m <= 1, "scene.margin_m", self.margin_m, "0 to 1 metre")
        require(0 <= self.reach_margin_deg <= 15, "scene.reach_margin_deg", self.reach_margin_deg, "0 to 15 degrees")
        require(10 <= self.first_view_deg <= 150, "scene.first_view_deg", self.first_view_deg, "10 to 150 degrees")
        require(self.tries >= 1, "scene.tries", self.tries, "at least 1")

    def __call__(self, seed: int, head: Head) -> Scene:
        """The scene; see `torchfovea.sim.scene.SceneRecipe`.

        Raises:
            SettingError: a region that admits no scene.
        """
        rng = seeded(seed)
        for _ in range(self.tries):
            room = furnish(self.room, rng)
            scene = compile_solids(room + place_cans(self, head, rng, room), head, rng, self, seed)
            if target_in_sight(scene, self.margin_m):
                return stand_at(scene, EgoPose())
        place = self.target_azimuth_deg
        raise SettingError(f"scene.target_azimuth_deg = {place}: expected a region whose target can be seen")


class _Candidates(NamedTuple):
    """Cans in E, arrays (B,): axis, lower and upper end, radius; the nearest point (B, 3) and its range."""

    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray
    radius: np.ndarray
    point: np.ndarray
    range_m: np.ndarray
    pole_m: np.ndarray


def _cylinder_nearest(
    x: np.ndarray, y: np.ndarray, low: np.ndarray, high: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """The point (B, 3) of upright cylinders nearest to the origin, which lies outside."""
    away = np.maximum(np.hypot(x, y), 1e-9)
    scale = np.maximum(away - radius, 0) / away
    return np.stack([x * scale, y * scale, np.clip(0.0, low, high)], -1)


def _draw(
    params: Cans, head: Head, rng: np.random.Generator, azimuth: Range, elevation: Range, far: Range
) -> _Candidates:
    a = np.radians(rng.uniform(*azimuth, _BATCH))
    e = np.radians(rng.uniform(*elevation, _BATCH))
    r = rng.uniform(*far, _BATCH)
    radius = rng.uniform(*params.can_radius_m, _BATCH)
    height = rng.uniform(*params.can_height_m, _BATCH)
    x, y = r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a)
    low = r * np.sin(e) - height / 2
    floor = -head.ego_height_m
    low = np.where(np.abs(low - floor) < _GROUNDED_M, floor, low)
    point = _cylinder_nearest(x, y, low, low + height, radius)
    stands = low > floor
    thin = np.full(_BATCH, params.pole_radius_m)
    stem = _cylinder_nearest(x, y, np.full(_BATCH, floor), np.where(stands, low, floor), thin)
    pole_m = np.where(stands, np.linalg.norm(stem, axis=-1), math.inf)
    return _Candidates(x, y, low, low + height, radius, point, np.linalg.norm(point, axis=-1), pole_m)


def _reachable(params: Cans, head: Head, point: np.ndarray) -> np.ndarray:
    margin = params.reach_margin_deg
    tight = replace(
        head,
        pan_limit_deg=max(head.pan_limit_deg - margin, min(head.pan_limit_deg, 1e-3)),
        tilt_up_deg=max(head.tilt_up_deg - margin, 0.0),
        tilt_down_deg=max(head.tilt_down_deg - margin, min(head.tilt_down_deg, 1e-3)),
        vergence_max_deg=max(head.vergence_max_deg - margin, min(head.vergence_max_deg, 1e-3)),
        sight_deg=max(head.sight_deg - margin, min(head.sight_deg, 1e-3)),
    )
    return fixate(tight, torch.from_numpy(point))[1].numpy()


def _within_room(params: Cans, head: Head, c: _Candidates) -> np.ndarray:
    room, gap = params.room, c.radius + _GAP_M
    inside: np.ndarray = (c.x + gap < room.front_m) & (c.x - gap > -room.back_m) & (np.abs(c.y) + gap < room.side_m)
    inside &= (c.low >= -head.ego_height_m) & (c.high + head.ego_height_m + _GAP_M < room.height_m)
    return inside


def _outside_first_view(params: Cans, head: Head, c: _Candidates) -> np.ndarray:
    """Whether all of each can lies outside the first view of both eyes."""
    zero = torch.zeros((), dtype=torch.float64)
    pose = eyes(head, Gaze(zero, zero, zero))
    angle = np.linspace(0, 2 * math.pi, 36, endpoint=False)
    share = np.linspace(0, 1, 7)
    shape = (_BATCH, len(share), len(angle))
    px = np.broadcast_to(c.x[:, None, None] + c.radius[:, None, None] * np.cos(angle), shape)
    py = np.broadcast_to(c.y[:, None, None] + c.radius[:, None, None] * np.sin(angle), shape)
    pz = np.broadcast_to((c.low[:, None] + (c.high - c.low)[:, None] * share)[..., None], shape)
    points = np.stack([px, py, pz], -1).reshape(_BATCH, -1, 3)
    edge = math.tan(math.radians(params.first_view_deg) / 2)
    outside = np.ones(_BATCH, bool)
    for rotation, centre in ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right)):
        x, y, z = np.moveaxis((points - centre.numpy()) @ rotation.numpy(), -1, 0)
        outside &= (np.hypot(x, y) > edge * z * 1.01).all(-1)
    return outside


def place_cans(params: Cans, head: Head, rng: np.random.Generator, around: list[Solid]) -> list[Solid]:
    """Draw the cans and their poles by rejection, in the world, for a robot at its origin.

    Raises:
        SettingError: a region in which no can fits; the message names it.
    """
    obstacles = [(s.position_m[0], s.position_m[1], math.hypot(*s.size_m[:2])) for s in around if s.name[:4] == "furn"]
    chosen: list[tuple[_Candidates, int]] = []

    def free(c: _Candidates, i: int) -> bool:
        near = [(o.x[k], o.y[k], o.radius[k]) for o, k in chosen] + obstacles
        return all(math.hypot(c.x[i] - x, c.y[i] - y) > c.radius[i] + r + _GAP_M for x, y, r in near)

    def choose(fits: np.ndarray, c: _Candidates) -> bool:
        for i in np.flatnonzero(fits):
            if free(c, int(i)):
                chosen.append((c, int(i)))
                return True
        return False

    for _ in range(params.tries):
        c = _draw(params, head, rng, params.target_azimuth_deg, params.target_elevation_deg, params.target_range_m)
        fits = _within_room(params, head, c) & _reachable(params, head, c.point)
        fits &= (c.range_m >= _NEAREST_M) & (c.point[:, 2] + head.ego_height_m >= _LOWEST_M)
        fits &= c.pole_m >= c.range_m + params.margin_m / 5
        if params.outside_first_view:
            fits &= _outside_first_view(params, head, c)
        if choose(fits, c):
            break
    else:
        raise SettingError(
            f"scene.target_azimuth_deg = {params.target_azimuth_deg}, scene.target_elevation_deg = "
            f"{params.target_elevation_deg}, scene.target_range_m = {params.target_range_m}: expected a region "
            f"in which a can fits, within the head's reach"
            + (", outside the first view" if params.outside_first_view else "")
        )
    limit = chosen[0][0].range_m[chosen[0][1]] + params.margin_m
    for _ in range(params.tries):
        if len(chosen) == params.cans:
            break
        c = _draw(params, head, rng, params.azimuth_deg, params.elevation_deg, params.range_m)
        fits = _within_room(params, head, c) & _reachable(params, head, c.point)
        fits &= (c.range_m >= limit) & (c.pole_m >= limit)
        choose(fits, c)
    if len(chosen) < params.cans:
        raise SettingError(
            f"scene.cans = {params.cans}: expected at most {len(chosen)} in scene.azimuth_deg = {params.azimuth_deg}, "
            f"scene.elevation_deg = {params.elevation_deg}, scene.range_m = {params.range_m}, farther than the target"
        )
    solids = []
    for n, (c, i) in enumerate(chosen):
        x, y, low, tall = float(c.x[i]), float(c.y[i]), float(c.low[i]) + head.ego_height_m, float(c.high[i] - c.low[i])
        shade = float(rng.uniform(-0.06, 0.06))
        solids.append(can(f"can_{n}", x, y, low, float(c.radius[i]), tall, n == 0, shade))
        if low > 0:
            solids.append(pole(f"pole_{n}", x, y, low, params.pole_radius_m))
    return solids


def target_in_sight(scene: Scene, margin_m: float) -> bool:
    """Whether rays confirm a target: see `point_in_sight`, and everything else that the head can reach is farther.

    By the margin; its own pole by a fifth of it.
    """
    near = point_in_sight(scene)
    if near is None:
        return False
    geom = next(iter(scene.target_geoms))
    direction = reachable_grid(scene.head, 0.5)
    hits = cast(scene, torch.zeros(3, dtype=torch.float64), direction)
    within = fixate(scene.head, hits.range_m[:, None] * direction)[1] & ~scene.is_floor(hits.geom) & (hits.geom != geom)
    limit = torch.full_like(hits.range_m, float(near.norm()) + margin_m)
    own = scene.is_kind(hits.geom, POLE) & (scene.kind[(hits.geom - 1).clamp(min=0)] == TARGET)
    limit = torch.where(own, limit - 0.8 * margin_m, limit)
    return bool((hits.range_m[within] >= limit[within]).all())


def point_in_sight(scene: Scene) -> Tensor | None:
    """The nearest point (3,) of the target, a can, if it can be seen; None otherwise.

    E sees nearly all of its front, and both eyes and C see its nearest point when they fixate it.
    """
    geom = next(iter(scene.target_geoms))
    radius, half = scene.model.geom_size[geom][:2]
    centre = torch.from_numpy(scene.data[0].geom_xpos[geom].copy())
    rotation, translation = (torch.from_numpy(a) for a in scene.world_from_ego)
    x, y, z = ((centre - translation) @ rotation).tolist()
    one = np.ones(1)
    near = torch.from_numpy(_cylinder_nearest(x * one, y * one, (z - half) * one, (z + half) * one, radius * one))[0]
    origin = torch.zeros(3, dtype=torch.float64)
    # the can's outline as E sees it, drawn in by a tenth
    side = torch.linspace(-0.9, 0.9, 13, dtype=torch.float64)
    along = torch.linspace(-0.9, 0.9, 13, dtype=torch.float64)
    away = math.hypot(x, y)
    outline = torch.stack(
        [
            x + (-y / away) * radius * side[:, None].expand(13, 13),
            y + (x / away) * radius * side[:, None].expand(13, 13),
            z + half * along[None, :].expand(13, 13),
        ],
        -1,
    ).reshape(-1, 3)
    if float((cast(scene, origin, outline).geom == geom).double().mean()) < 0.95:
        return None
    gaze, reachable = fixate(scene.head, near)
    inner = near + 1e-3 * torch.nn.functional.normalize(torch.tensor([x, y, z], dtype=torch.float64) - near, dim=0)
    pose = eyes(scene.head, gaze)
    for eye in (pose.t_left, pose.t_right, cyclopean(scene.head, gaze)[1]):
        if int(cast(scene, eye, (inner - eye)[None]).geom[0]) != geom:
            return None
    return near if bool(reachable) else None
