"""Cans of one shape, of which the one sought bears a mark: only fine receptive fields tell it from nearer ones.

Marks are stripes of one width and contrast, each kind in a direction of its own: what does not resolve them sees one
red can like another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch

from torchfovea.memory.classes import Classes
from torchfovea.sensing.head import Head
from torchfovea.setting import SettingError, check_types, require
from torchfovea.sim.cans import Cans, place_cans, point_in_sight
from torchfovea.sim.compile import compile_solids, seeded, stand_at
from torchfovea.sim.model import EgoPose, Marks, Scene
from torchfovea.sim.room import CAN, TARGET, Solid, furnish

__all__ = ["Marked", "check_marks"]


@dataclass(frozen=True)
class Marked:
    """Cans with marks, one of which bears the one that is sought; it is not the nearest.

    Attributes:
        cans: where they stand.
        marks: how many different ones there are, classes 1, 2, ...; all but the target bear another than it does.
        sought: the target's.
        detail_m: size of what tells the marks apart, the width of a stripe.
        contrast: of the stripes, in pictures.
    """

    cans: Cans = field(default_factory=Cans)
    marks: int = 3
    sought: int = 1
    detail_m: float = 0.004
    contrast: float = 0.5

    def __post_init__(self) -> None:
        """Raise SettingError for marks that tell nothing apart."""
        check_types(self, "scene.")
        require(2 <= self.marks <= 63, "scene.marks", self.marks, "2 to 63 marks")
        known = f"a class that an object has, 1 to {self.marks}"
        require(1 <= self.sought <= self.marks, "scene.sought", self.sought, known)
        require(1e-5 <= self.detail_m <= 1, "scene.detail_m", self.detail_m, "0.00001 to 1 metre")
        require(0 <= self.contrast <= 1, "scene.contrast", self.contrast, "0 to 1")

    def __call__(self, seed: int, head: Head) -> Scene:
        """The scene; see `torchfovea.sim.scene.SceneRecipe`.

        Raises:
            SettingError: a region that admits no scene.
        """
        rng = seeded(seed)
        others = [mark for mark in range(1, self.marks + 1) if mark != self.sought]
        for _ in range(self.cans.tries):
            room = furnish(self.cans.room, rng)
            solids = place_cans(self.cans, head, rng, room)
            chosen = f"can_{rng.integers(1, self.cans.cans)}"
            kinds = {TARGET: CAN, CAN: CAN}
            solids = [replace(s, kind=TARGET if s.name == chosen else kinds.get(s.kind, s.kind)) for s in room + solids]
            marks = [
                self.sought if s.kind == TARGET else int(rng.choice(others)) if s.kind == CAN else 0 for s in solids
            ]
            solids = [self._bearing(solid, mark) for solid, mark in zip(solids, marks, strict=True)]
            scene = compile_solids(solids, head, rng, self, seed)
            if point_in_sight(scene) is not None:
                told = Marks(torch.tensor(marks), self.marks + 1, self.sought, self.detail_m)
                return stand_at(replace(scene, marks=told), EgoPose())
        place = self.cans.azimuth_deg
        raise SettingError(
            f"scene.cans.azimuth_deg = {place}: expected a region in which a can is seen behind no other"
        )

    def _bearing(self, solid: Solid, mark: int) -> Solid:
        """The solid with a mark on it; whole periods go around it. None runs upright, as a can's outline does."""
        if mark == 0:
            return solid
        turn, per_m = math.pi * (mark - 0.5) / self.marks, 1 / (2 * self.detail_m)
        around = round(2 * math.pi * solid.size_m[0] * per_m * math.cos(turn))
        return replace(solid, stripes=(around, per_m * math.sin(turn), self.contrast))


def check_marks(scene: Scene, classes: Classes) -> Marks:
    """The marks of a scene in which a class is sought.

    Raises:
        SettingError: for a scene without marks, or with others.
    """
    told = scene.marks
    require(told is not None, "reward", "of_class", "a scene whose things bear marks, such as scene=marked")
    assert told is not None
    require(classes.count == told.classes, "reward.count", classes.count, f"{told.classes}, the classes of the scene")
    here = f"{told.sought}, the class of the scene's target"
    require(classes.sought == told.sought, "reward.sought", classes.sought, here)
    return told
