"""Scenes: the paper's attention world and seeded fields of cans, and the one way to build them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from torchfovea.sensing.head import Head
from torchfovea.setting import check_types, require
from torchfovea.sim.cans import Cans
from torchfovea.sim.compile import scene_of, seeded, stand_at
from torchfovea.sim.hidden import Hidden
from torchfovea.sim.marked import Marked
from torchfovea.sim.model import EgoPose, Nearest, Scene
from torchfovea.sim.room import Room, Solid, can, furnish

__all__ = [
    "AttentionWorld",
    "Cans",
    "EgoPose",
    "Hidden",
    "Marked",
    "Nearest",
    "Room",
    "Scene",
    "SceneRecipe",
    "build_scene",
    "stand_at",
]

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
        check_types(self, "scene.")
        require(0.01 <= self.can_radius_m <= 0.14, "scene.can_radius_m", self.can_radius_m, "0.01 to 0.14 m")
        require(0.02 <= self.can_height_m <= 0.5, "scene.can_height_m", self.can_height_m, "0.02 to 0.5 m")
        require(self.room.front_m >= 2.5, "room.front_m", self.room.front_m, "at least 2.5 m behind the farthest can")
        require(self.room.side_m >= 1.0, "room.side_m", self.room.side_m, "at least 1 m")

    def __call__(self, seed: int, head: Head) -> Scene:
        """The scene; see `SceneRecipe`."""
        rng = seeded(seed)
        return scene_of(_attention_solids(self, rng), head, rng, self, seed)


@runtime_checkable
class SceneRecipe(Protocol):
    """What builds a scene: `AttentionWorld`, `Cans`, or any function of a seed and a head."""

    def __call__(self, seed: int, head: Head) -> Scene:
        """The scene of a seed, with the robot at the world's origin; the same seed gives the same scene.

        Args:
            seed: >= 0.
            head: whose reach the scene's truth is about, and whose height E has.
        """
        ...


def build_scene(recipe: SceneRecipe, seed: int = 0, head: Head | None = None, pose: EgoPose | None = None) -> Scene:
    """Build a scene; the same arguments give the same scene.

    Args:
        recipe: which scene. The seed changes only the textures of an `AttentionWorld`, and everything of `Cans`.
        seed: >= 0.
        head: Vizzy's by default.
        pose: where the robot stands, by default at the world's origin, for which `Cans` are placed.

    Raises:
        SettingError: a setting out of range, a region of `Cans` that admits no scene, a recipe that returns none.
    """
    name = getattr(recipe, "__name__", type(recipe).__name__)
    require(callable(recipe), "scene", name, "AttentionWorld, Cans or a function (seed, head) that returns a Scene")
    scene = recipe(seed, Head() if head is None else head)
    require(isinstance(scene, Scene), "scene", f"{type(scene).__name__} from {name}(seed, head)", "a Scene")
    return scene if pose is None else stand_at(scene, pose)


def _attention_solids(params: AttentionWorld, rng: np.random.Generator) -> list[Solid]:
    solids = furnish(params.room, rng)
    last = len(_ATTENTION_CANS) - 1
    for i, (x, y) in enumerate(_ATTENTION_CANS):
        shade = float(rng.uniform(-0.06, 0.06))
        solids.append(can(f"can_{i}", x, y, 0.0, params.can_radius_m, params.can_height_m, i == last, shade))
    return solids
