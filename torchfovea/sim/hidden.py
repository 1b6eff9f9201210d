"""A can that a screen hides from where the robot stands first: it must go around to see it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from torchfovea.sensing.head import Head, eyes, fixate
from torchfovea.setting import SettingError, check_types, require
from torchfovea.sim.cans import Cans, place_cans, point_in_sight
from torchfovea.sim.compile import compile_solids, seeded, stand_at
from torchfovea.sim.model import EgoPose, Scene
from torchfovea.sim.rays import cast
from torchfovea.sim.room import FURNITURE, Solid, furnish

__all__ = ["Hidden"]


@dataclass(frozen=True)
class Hidden:
    """Cans, the nearest of which stands behind a screen.

    Attributes:
        cans: where they stand, as seen from the robot's first place; room.furniture should be false.
        seen_from: a place and heading [x m, y m, yaw °] from which the target is the nearest thing, in plain sight.
        screen_at: the screen's share of the way from E to the target.
        screen_half_m: half its width; it stands on the floor and reaches half as far above the line of sight.
    """

    cans: Cans = field(default_factory=Cans)
    seen_from: tuple[float, float, float] = (1.4, 0.9, -90.0)
    screen_at: float = 0.5
    screen_half_m: float = 0.16

    def __post_init__(self) -> None:
        """Raise SettingError for a screen or a place that is none; a list becomes a tuple."""
        check_types(self, "scene.")
        good = all(map(math.isfinite, self.seen_from))
        require(good, "scene.seen_from", self.seen_from, "three finite numbers, [x m, y m, yaw deg]")
        require(0.2 <= self.screen_at <= 0.9, "scene.screen_at", self.screen_at, "0.2 to 0.9 of the way")
        require(0.05 <= self.screen_half_m <= 1, "scene.screen_half_m", self.screen_half_m, "0.05 to 1 metre")

    def __call__(self, seed: int, head: Head) -> Scene:
        """The scene; see `torchfovea.sim.scene.SceneRecipe`.

        Raises:
            SettingError: a region that admits no scene.
        """
        rng = seeded(seed)
        x, y, yaw = self.seen_from
        for _ in range(self.cans.tries):
            room = furnish(self.cans.room, rng)
            cans = place_cans(self.cans, head, rng, room)
            screen = self._screen(next(s for s in cans if s.name == "can_0"), head, rng)
            scene = compile_solids([*room, *cans, screen], head, rng, self, seed)
            there = replace(scene, pose=EgoPose(x, y, math.radians(yaw)))
            if _shows_target(scene) or point_in_sight(there) is None:
                continue
            if stand_at(there, there.pose).nearest.geom in scene.target_geoms:
                return stand_at(scene, EgoPose())
        expected = "a place from which a can behind a screen is the nearest thing in sight"
        raise SettingError(f"scene.seen_from = {self.seen_from}: expected {expected}")

    def _screen(self, target: Solid, head: Head, rng: np.random.Generator) -> Solid:
        x, y, z = target.position_m
        share, turn = self.screen_at, math.atan2(y, x)
        top = head.ego_height_m + share * (z + target.size_m[1] - head.ego_height_m) + self.screen_half_m / 2
        size = (0.01, self.screen_half_m, top / 2)
        red, green, blue = (float(v) for v in rng.uniform(0.3, 0.8, 3))
        place = share * x, share * y, top / 2
        return Solid("screen", FURNITURE, "box", place, size, turn, (red, green, blue), (0.6, 0.55, 0.5))


def _shows_target(scene: Scene) -> bool:
    """Whether E or an eye sees anything of the target from where the robot stands."""
    geom = next(iter(scene.target_geoms))
    solid = scene.solids[geom]
    centre = torch.tensor(solid.position_m, dtype=torch.float64)
    centre[2] -= scene.head.ego_height_m
    step = torch.linspace(-1, 1, 15, dtype=torch.float64)
    aside = torch.nn.functional.normalize(torch.stack([-centre[1], centre[0], torch.zeros_like(centre[0])]), dim=0)
    up = torch.tensor([0.0, 0.0, solid.size_m[1]], dtype=torch.float64)
    points = (centre + step[:, None, None] * solid.size_m[0] * aside + step[None, :, None] * up).reshape(-1, 3)
    pose = eyes(scene.head, fixate(scene.head, centre)[0])
    places = torch.zeros(3, dtype=torch.float64), pose.t_left, pose.t_right
    return any(bool((cast(scene, place, points - place).geom == geom).any()) for place in places)
