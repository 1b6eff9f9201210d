"""Scenes: the paper's attention world and seeded fields of cans, and the one way to build them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from torchfovea.sensing.head import Head
from torchfovea.setting import require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.cans import Cans, place_cans, target_in_sight
from torchfovea.sim.model import EgoPose, Nearest, Scene
from torchfovea.sim.room import Room, Solid, build_spec, can, furnish, paint_solids
from torchfovea.sim.truth import find_nearest

__all__ = ["AttentionWorld", "Cans", "EgoPose", "Nearest", "Room", "Scene", "build_scene", "stand_at"]

# the authors' world file, relative to the robot's base (x forward, y left); the last is the nearest
_ATTENTION_CANS = ((1.811, 0.421), (0.860, -0.027), (0.661, -0.282), (0.710, -0.562), (0.453, 0.464))


@dataclass(frozen=True)
class AttentionWorld:
    """The scene of the paper's Sec. 7.2: five cans on the floor before walls and large textured objects.

    Attributes:
        can_radius_m: of every can.
        can_height_m: of every can.
        room: the walls and objects behind.
    """

    can_radius_m: float = 0.085
    can_height_m: float = 0.315
    room: Room = field(default_factory=Room)

    def __post_init__(self) -> None:
        """Raise SettingError for cans that overlap or reach the head."""
        require(0.01 <= self.can_radius_m <= 0.14, "scene.can_radius_m", self.can_radius_m, "0.01 to 0.14 m")
        require(0.02 <= self.can_height_m <= 0.5, "scene.can_height_m", self.can_height_m, "0.02 to 0.5 m")
        require(self.room.front_m >= 2.5, "room.front_m", self.room.front_m, "at least 2.5 m behind the farthest can")
        require(self.room.side_m >= 1.0, "room.side_m", self.room.side_m, "at least 1 m")


def build_scene(
    params: AttentionWorld | Cans, seed: int = 0, head: Head | None = None, pose: EgoPose | None = None
) -> Scene:
    """Build a scene; the same arguments give the same scene.

    Args:
        params: which scene. The seed changes only the textures of an `AttentionWorld`, and everything of `Cans`.
        seed: >= 0.
        head: whose reach the scene's truth is about, and whose height E has; Vizzy's by default.
        pose: where the robot stands, by default at the world's origin, for which `Cans` are placed.

    Raises:
        SettingError: a setting out of range, or a region of `Cans` that admits no scene.
    """
    require(isinstance(seed, int) and seed >= 0, "seed", seed, "a whole number >= 0")
    head = Head() if head is None else head
    rng = np.random.default_rng([seed, 1])
    if isinstance(params, AttentionWorld):
        scene = _compile(_attention_solids(params, rng), head, rng, params, seed)
    elif isinstance(params, Cans):
        for _ in range(params.tries):
            room = furnish(params.room, rng)
            scene = _compile(room + place_cans(params, head, rng, room), head, rng, params, seed)
            if target_in_sight(scene, params.margin_m):
                break
        else:
            require(False, "scene.target_azimuth_deg", params.target_azimuth_deg, "a region whose target can be seen")
    else:
        require(False, "scene", type(params).__name__, "AttentionWorld or Cans")
    return stand_at(scene, EgoPose() if pose is None else pose)


def stand_at(scene: Scene, pose: EgoPose) -> Scene:
    """The same scene with the robot standing elsewhere; its truth is found anew."""
    for name, value in pose._asdict().items():
        require(math.isfinite(value), f"pose.{name}", value, "a finite number")
    moved = replace(scene, pose=pose)
    return replace(moved, nearest=find_nearest(moved))


def _attention_solids(params: AttentionWorld, rng: np.random.Generator) -> list[Solid]:
    solids = furnish(params.room, rng)
    last = len(_ATTENTION_CANS) - 1
    for i, (x, y) in enumerate(_ATTENTION_CANS):
        shade = float(rng.uniform(-0.06, 0.06))
        solids.append(can(f"can_{i}", x, y, 0.0, params.can_radius_m, params.can_height_m, i == last, shade))
    return solids


def _compile(solids: list[Solid], head: Head, rng: np.random.Generator, params: object, seed: int) -> Scene:
    mujoco = load_mujoco()
    model = build_spec(solids, head).compile()
    data = tuple(mujoco.MjData(model) for _ in range(2))
    for d in data:
        mujoco.mj_forward(model, d)
    kind = torch.tensor([solid.kind for solid in solids])
    paint = paint_solids(solids, rng)
    return Scene(model, (data[0], data[1]), tuple(solids), paint, kind, head, params=params, seed=seed)
