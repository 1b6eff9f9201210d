"""Building blocks of a scene: solids with a kind, a room around the robot, and the MuJoCo model they become."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.head import Head
from torchfovea.setting import check_types, require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.head_model import add_head
from torchfovea.sim.texture import Paint

__all__ = [
    "CAN",
    "FLOOR",
    "FURNITURE",
    "POLE",
    "ROOM",
    "TARGET",
    "Room",
    "Solid",
    "build_spec",
    "can",
    "furnish",
    "paint_solids",
    "pole",
]

# kinds of geom
FLOOR, ROOM, FURNITURE, POLE, CAN, TARGET = range(6)

_COKE = (0.76, 0.06, 0.08)
_FLOOR = ((0.60, 0.50, 0.40), (0.46, 0.38, 0.33))
_WALLS = (
    ((0.62, 0.66, 0.60), (0.42, 0.52, 0.52)),
    ((0.70, 0.60, 0.45), (0.58, 0.42, 0.32)),
    ((0.55, 0.62, 0.70), (0.44, 0.46, 0.60)),
    ((0.68, 0.64, 0.58), (0.50, 0.52, 0.44)),
)
_FURNITURE = (
    ((0.72, 0.52, 0.28), (0.50, 0.33, 0.18)),
    ((0.24, 0.46, 0.50), (0.40, 0.62, 0.56)),
    ((0.80, 0.66, 0.30), (0.66, 0.44, 0.22)),
    ((0.36, 0.44, 0.66), (0.52, 0.58, 0.72)),
    ((0.42, 0.56, 0.34), (0.60, 0.64, 0.40)),
    ((0.62, 0.40, 0.48), (0.74, 0.58, 0.54)),
)
_FURNISHED = {"front_m": 3.0, "back_m": 1.8, "side_m": 2.4, "height_m": 2.2}  # the least that leaves the robot room
_METAL = (0.40, 0.41, 0.44)


@dataclass(frozen=True)
class Solid:
    """One geom: `size` are half lengths for a box, (radius, half height) for a cylinder, (radius,) for a sphere [m].

    `stripes` are a mark on a label (`torchfovea.sim.texture.Paint`).
    """

    name: str
    kind: int
    shape: str
    position_m: tuple[float, float, float]
    size_m: tuple[float, ...]
    yaw_rad: float = 0.0
    base: tuple[float, float, float] = (0.6, 0.6, 0.6)
    accent: tuple[float, float, float] = (0.5, 0.5, 0.5)
    contrast: float = 1.0
    label: bool = field(default=False)
    stripes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    repeat_m: float = math.inf


@dataclass(frozen=True)
class Room:
    """A closed, textured, furnished room; distances from the world's origin [m].

    Attributes:
        front_m: to the wall ahead, > 0.
        back_m: to the wall behind, > 0.
        side_m: to the walls on either side, > 0.
        height_m: of the ceiling, > 0.
        furniture: whether large objects stand along the walls.
        contrast: of the texture of the room and its furniture, in shares of the usual; 0 to 2.
        repeat_m: after which that texture repeats along each axis of the world; inf: never.
    """

    front_m: float = 4.0
    back_m: float = 3.0
    side_m: float = 3.2
    height_m: float = 2.8
    furniture: bool = True
    contrast: float = 1.0
    repeat_m: float = math.inf

    def __post_init__(self) -> None:
        """Raise SettingError for a room without room."""
        check_types(self, "room.")
        for name in ("front_m", "back_m", "side_m", "height_m"):
            value = getattr(self, name)
            least = _FURNISHED[name] if self.furniture else 1.0
            require(least <= value <= 50.0, f"room.{name}", value, f"{least} to 50 metres")
        require(0 <= self.contrast <= 2, "room.contrast", self.contrast, "0 to 2, in shares of the usual")
        require(self.repeat_m >= 0.02, "room.repeat_m", self.repeat_m, "at least 0.02 m, or inf")


def can(
    name: str, x: float, y: float, bottom_m: float, radius_m: float, height_m: float, target: bool, shade: float = 0.0
) -> Solid:
    """A can whose bottom stands at a height above the floor; `shade` varies its red a little."""
    red = (_COKE[0] + shade, _COKE[1] + shade / 3, _COKE[2] + shade / 3)
    accent = (red[0] * 0.8, red[1], red[2])
    place = (x, y, bottom_m + height_m / 2)
    kind = TARGET if target else CAN
    return Solid(name, kind, "cylinder", place, (radius_m, height_m / 2), 0.0, red, accent, 0.8, True)


def furnish(room: Room, rng: np.random.Generator) -> list[Solid]:
    """The floor, the walls, the ceiling and the furniture (fixed in place; the generator turns only the colours)."""
    thick = 0.05
    middle, half = (room.front_m - room.back_m) / 2, (room.front_m + room.back_m) / 2
    tall = room.height_m / 2
    walls = [
        ("front", (room.front_m + thick, 0.0, tall), (thick, room.side_m + 2 * thick, tall)),
        ("back", (-room.back_m - thick, 0.0, tall), (thick, room.side_m + 2 * thick, tall)),
        ("left", (middle, room.side_m + thick, tall), (half, thick, tall)),
        ("right", (middle, -room.side_m - thick, tall), (half, thick, tall)),
    ]
    solids = [Solid("floor", FLOOR, "plane", (middle, 0.0, 0.0), (half + 1, room.side_m + 1, 1.0), 0.0, *_FLOOR)]
    order = rng.permutation(len(_WALLS))
    for (name, place, size), k in zip(walls, order, strict=True):
        solids.append(Solid(f"wall_{name}", ROOM, "box", place, size, 0.0, *_WALLS[k]))
    lid = (half + 2 * thick, room.side_m + 2 * thick, thick)
    solids.append(
        Solid("ceiling", ROOM, "box", (middle, 0.0, room.height_m + thick), lid, 0.0, (0.8, 0.79, 0.76), (0.7,) * 3)
    )
    if room.furniture:
        f, b, s = room.front_m, room.back_m, room.side_m
        pieces: list[tuple[str, tuple[float, float], tuple[float, ...], float]] = [
            ("box", (f - 0.6, 0.45 * s), (0.42, 0.42, 0.55), 0.5),
            ("cylinder", (f - 0.55, -0.15 * s), (0.32, 1.05), 0.0),
            ("box", (f - 0.7, -0.62 * s), (0.40, 0.55, 0.40), -0.35),
            ("sphere", (f - 0.9, 0.13 * s), (0.38,), 0.0),
            ("box", (0.42 * f, s - 0.45), (0.60, 0.30, 0.85), 0.15),
            ("box", (0.45 * f, -s + 0.5), (0.50, 0.32, 0.60), -0.2),
            ("cylinder", (0.62 * f, 0.78 * s), (0.26, 0.65), 0.0),
            ("box", (-b + 0.6, 0.5 * s), (0.40, 0.60, 0.70), 0.25),
            ("cylinder", (-b + 0.7, -0.5 * s), (0.40, 0.60), 0.0),
        ]
        order = rng.permutation(len(pieces)) % len(_FURNITURE)
        for i, ((shape, (x, y), extent, yaw), k) in enumerate(zip(pieces, order, strict=True)):
            place = (x, y, extent[-1])
            solids.append(Solid(f"furniture_{i}", FURNITURE, shape, place, extent, yaw, *_FURNITURE[k]))
    return [replace(solid, contrast=room.contrast, repeat_m=room.repeat_m) for solid in solids]


def pole(name: str, x: float, y: float, top_m: float, radius_m: float) -> Solid:
    """A thin pole from the floor up to a height."""
    return Solid(name, POLE, "cylinder", (x, y, top_m / 2), (radius_m, top_m / 2), 0.0, _METAL, (0.3, 0.31, 0.33), 0.7)


def build_spec(solids: Sequence[Solid], head: Head) -> Any:
    """The MjSpec of solids with a head among them; geoms are in the order of the solids, and bear their names."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    # without these two, software GL is twenty times slower
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 2048
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.visual.headlight.specular = [0, 0, 0]
    spec.stat.extent = 1.0
    spec.stat.center = [0, 0, 1]
    spec.visual.map.znear = 0.02
    spec.visual.map.zfar = 60.0
    shapes = {
        "plane": mujoco.mjtGeom.mjGEOM_PLANE,
        "box": mujoco.mjtGeom.mjGEOM_BOX,
        "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
        "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    }
    for solid in solids:
        size = list(solid.size_m) + [0.0] * (3 - len(solid.size_m))
        turn = [math.cos(solid.yaw_rad / 2), 0, 0, math.sin(solid.yaw_rad / 2)]
        # a body each: rays are tested against the bounding sphere of a body first
        place = spec.worldbody.add_body(pos=list(solid.position_m), quat=turn)
        place.add_geom(
            name=solid.name, type=shapes[solid.shape], size=size, rgba=[*solid.base, 1.0], contype=0, conaffinity=0
        )
    add_head(spec, head)
    return spec


def paint_solids(solids: Sequence[Solid], rng: np.random.Generator) -> Paint:
    """What the solids look like; the generator draws each one's place in the noise."""

    def columns(values: Iterable[Sequence[float]]) -> Tensor:
        return torch.tensor(list(values), dtype=torch.float32).T.contiguous()

    return Paint(
        look=columns((*s.base, *s.accent, s.contrast) for s in solids),
        offset=columns(rng.uniform(0, 20, (len(solids), 3)).tolist()),
        centre=columns(s.position_m for s in solids),
        can=columns(s.size_m[:2] if s.label else (0.0, 0.0) for s in solids),
        stripes=columns(s.stripes for s in solids),
        repeat_m=torch.tensor([s.repeat_m for s in solids], dtype=torch.float32),
    )
