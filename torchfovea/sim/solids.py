"""The solids of scenes as tensors, and where rays enter and leave them.

Scenes are rooms with upright boxes, upright cylinders and spheres in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.chart import Components
from torchfovea.setting import SettingError, require
from torchfovea.sim.model import Scene
from torchfovea.sim.room import FLOOR, ROOM, Solid

__all__ = [
    "FAR_M",
    "Group",
    "Solids",
    "chord",
    "extent",
    "first",
    "outward",
    "solids_of",
    "take",
    "tiny",
    "way_out",
]

FAR_M = 1e6
"""How far the walls of an open scene are; a ray that gets there meets nothing."""


def tiny(dtype: torch.dtype) -> float:
    """A step that stands for none: its inverse times any length in a scene is finite."""
    return torch.finfo(dtype).tiny * 1e8


class Group(NamedTuple):
    """Solids of one shape in B scenes, padded to K with solids far below that no ray meets.

    Attributes:
        centre: x, y and z, (3, B, K, 1).
        size: up to three half lengths, or radius and half height, or radius, (3, B, K, 1).
        turn: cosine and sine of the yaw, (2, B, K, 1).
        geom: (B, K).
    """

    centre: Tensor
    size: Tensor
    turn: Tensor
    geom: Tensor


class Solids(NamedTuple):
    """B scenes as tensors, in each scene's world.

    Attributes:
        middle: of the room, (3, B, 1).
        half: its half lengths, (3, B, 1).
        faces: geoms that close it toward −x, x, −y, y, −z and z, (6, B).
        boxes: turned boxes.
        cylinders: upright.
        spheres: of any size.
        rotation: yaw of E as cosine and sine, (2, B, 1).
        translation: of E, (3, B, 1).
    """

    middle: Tensor
    half: Tensor
    faces: Tensor
    boxes: Group
    cylinders: Group
    spheres: Group
    rotation: Tensor
    translation: Tensor

    @property
    def groups(self) -> tuple[tuple[str, Group], ...]:
        """What stands in the rooms, by shape, as `chord` knows it."""
        return (("box", self.boxes), ("cylinder", self.cylinders), ("sphere", self.spheres))


def solids_of(
    scenes: Sequence[Scene],
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
    closed: bool = True,
) -> Solids:
    """Scenes as tensors.

    Args:
        scenes: B.
        device: of the tensors.
        dtype: and their precision.
        closed: whether scenes must be closed rooms; the parts of an open one are boxes like others, and its faces have
            no geom, -1, and are `FAR_M` away.

    Raises:
        SettingError: for a scene that is not a room closed by one floor, four walls and a ceiling, if it must be.
    """
    chosen: dict[str, list[list[tuple[int, Solid]]]] = {"boxes": [], "cylinders": [], "spheres": []}
    rooms, faces, yaw, place = [], [], [], []
    for scene in scenes:
        parts: dict[str, list[tuple[int, Solid]]] = {name: [] for name in chosen}
        shell = []
        for geom, solid in enumerate(scene.solids):
            if solid.kind in (FLOOR, ROOM):
                shell.append((geom, solid))
            else:
                parts["boxes" if solid.shape == "box" else f"{solid.shape}s"].append((geom, solid))
        try:
            ends, geoms = _closed(shell)
        except SettingError:
            if closed:
                raise
            ends, geoms = [[-FAR_M, FAR_M]] * 3, [-1] * 6
            parts["boxes"] += shell
        rooms.append(ends)
        faces.append(geoms)
        rotation, translation = scene.world_from_ego
        yaw.append((float(rotation[0, 0]), float(rotation[1, 0])))
        place.append(tuple(float(t) for t in translation))
        for name, found in parts.items():
            chosen[name].append(found)

    def tensor(values: object) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device)

    low, high = tensor(rooms).permute(2, 1, 0).contiguous()
    return Solids(
        ((low + high) / 2)[..., None],
        ((high - low) / 2)[..., None],
        torch.tensor(faces, device=device).T.contiguous(),
        boxes=_group(chosen["boxes"], tensor),
        cylinders=_group(chosen["cylinders"], tensor),
        spheres=_group(chosen["spheres"], tensor),
        rotation=tensor(yaw).T[..., None].contiguous(),
        translation=tensor(place).T[..., None].contiguous(),
    )


def take(solids: Solids, index: Tensor) -> Solids:
    """Some of the scenes, each as often as an index (K,) names it."""

    def some(part: Any) -> Any:
        if isinstance(part, Group):
            return Group(*(p.index_select(max(p.dim() - 3, 0), index) for p in part))
        return part.index_select(1, index)

    return Solids(*map(some, solids))


def _closed(shell: list[tuple[int, Solid]]) -> tuple[list[list[float]], list[int]]:
    """Where the room ends toward −x and x, −y and y, −z and z, and the geoms there, in that order."""
    ends, faces = [[-math.inf, math.inf] for _ in range(3)], [-1] * 6
    for geom, solid in shell:
        axis = 2 if solid.shape == "plane" else min(range(3), key=lambda k: solid.size_m[k])
        side = 0 if solid.shape == "plane" else int(solid.position_m[axis] > 0)
        thick = 0.0 if solid.shape == "plane" else solid.size_m[axis]
        require(faces[2 * axis + side] < 0 and solid.yaw_rad == 0, "scene", solid.name, "one wall on each side")
        ends[axis][side] = solid.position_m[axis] + (thick, -thick)[side]
        faces[2 * axis + side] = geom
    require(min(faces) >= 0, "scene", f"{len(shell)} parts of a room", "a floor, four walls and a ceiling")
    return ends, faces


def _group(scenes: list[list[tuple[int, Solid]]], tensor: Callable[[object], Tensor]) -> Group:
    most = max(len(scene) for scene in scenes)
    rows = []
    for scene in scenes:
        row = []
        for geom, solid in scene:
            # a plane is a box without thickness; its third size is the spacing of a grid
            size = (*solid.size_m[:2], 0.0) if solid.shape == "plane" else (*solid.size_m, 0.0, 0.0)[:3]
            yaw = torch.tensor(solid.yaw_rad, dtype=torch.float64)
            row.append((*solid.position_m, *size, float(yaw.cos()), float(yaw.sin()), float(geom)))
        # far below and without size
        row += [(0.0, 0.0, -1e6, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0)] * (most - len(row))
        rows.append(row)
    values = tensor(rows).reshape(len(scenes), most, 9).permute(2, 0, 1).contiguous()
    return Group(values[:3, ..., None], values[3:6, ..., None], values[6:8, ..., None], values[8].long())


def _inverse(step: Tensor) -> Tensor:
    least = tiny(step.dtype)
    return 1 / torch.where(step.abs() > least, step, torch.full_like(step, least))


def way_out(middle: Tensor, half: Tensor, step: Tensor) -> Tensor:
    """Where rays from inside leave |x − middle| ≤ half, at infinity along it; x advances by a step a unit of range."""
    return (half + middle * step.sign()) / step.abs()


def _slab(middle: Tensor, half: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave |x − middle| ≤ half; x advances by a step for each unit of range."""
    inverse = _inverse(step)
    centre, reach = middle * inverse, half * inverse.abs()
    return centre - reach, centre + reach


def chord(
    shape: str, offset: Components, size: Components, turn: tuple[Tensor, Tensor], direction: Components
) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave solids; what they miss they leave before they enter.

    Args:
        shape: box, cylinder or sphere.
        offset: from the rays' origins to the solids' centres; all shapes here are broadcast.
        size: as `Group.size`.
        turn: as `Group.turn`.
        direction: of unit length.
    """
    (rx, ry, rz), (sx, sy, sz), (c, s), (dx, dy, dz) = offset, size, turn, direction
    if shape == "box":
        ends = [
            _slab(c * rx + s * ry, sx, c * dx + s * dy),
            _slab(c * ry - s * rx, sy, c * dy - s * dx),
            _slab(rz, sz, dz),
        ]
    elif shape == "cylinder":
        a = dx * dx + dy * dy
        upright = a <= tiny(a.dtype)  # along the axis: inside all the way, or nowhere
        a, cross = torch.where(upright, torch.ones_like(a), a), dx * ry - dy * rx
        middle = torch.where(upright, torch.zeros_like(a), (dx * rx + dy * ry) / a)
        inside = torch.where(upright, sx * sx - rx * rx - ry * ry, sx * sx * a - cross * cross)
        half = torch.where(upright, torch.full_like(a, torch.inf), inside.clamp(min=0).sqrt() / a)
        ends = [(torch.where(inside >= 0, middle - half, torch.inf), middle + half), _slab(rz, sy, dz)]
    else:
        along = dx * rx + dy * ry + dz * rz
        inside = sx * sx - (rx * rx + ry * ry + rz * rz) + along * along
        half = inside.clamp(min=0).sqrt()
        ends = [(torch.where(inside >= 0, along - half, torch.inf), along + half)]
    entry, leave = ends[0]
    for low, high in ends[1:]:
        entry, leave = torch.maximum(entry, low), torch.minimum(leave, high)
    return entry, leave


def first(entry: Tensor, leave: Tensor) -> Tensor:
    """Range of the first surface: the entry, or from inside the exit; infinite where missed or behind."""
    range_m = torch.where(entry > 0, entry, leave)
    return torch.where((entry <= leave) & (leave > 0), range_m, torch.inf)


def extent(shape: str, size: Tensor) -> tuple[Tensor, Tensor]:
    """Radius seen from above and half height of the upright cylinder around solids; sizes (3, ...) as `Group.size`."""
    if shape == "box":
        return torch.hypot(size[0], size[1]), size[2]
    return size[0], size[1] if shape == "cylinder" else size[0]


def outward(shape: str, point: Components, size: Components, turn: tuple[Tensor, Tensor]) -> Components:
    """Outward unit normals of solids at points of their surfaces.

    Args:
        shape: box, cylinder or sphere.
        point: from the solids' centres; all shapes here are broadcast.
        size: as `Group.size`.
        turn: as `Group.turn`.
    """
    (x, y, z), (c, s) = point, turn
    if shape == "sphere":
        scale = torch.rsqrt(x * x + y * y + z * z)
        return x * scale, y * scale, z * scale
    if shape == "cylinder":
        radius = torch.hypot(x, y)
        side = (radius * size[1] >= z.abs() * size[0]).to(z)
        scale = side / radius.clamp(min=tiny(z.dtype))
        return x * scale, y * scale, (1 - side) * z.sign()
    x, y = c * x + s * y, c * y - s * x
    # the face is the one that the point is at; no face of a plane but its own is
    near = [part.abs() - half for part, half in zip((x, y, z), size, strict=True)]
    up = (near[2] >= torch.maximum(near[0], near[1])).to(z)
    ahead = (near[0] >= near[1]).to(z) * (1 - up)
    x, y, z = ahead * x.sign(), (1 - up - ahead) * y.sign(), up * z.sign()
    return c * x - s * y, s * x + c * y, z
