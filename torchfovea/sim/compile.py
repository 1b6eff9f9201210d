"""From solids to a scene: MuJoCo's model, what it looks like, and the truth about it."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import torch

from torchfovea.sensing.head import Head
from torchfovea.setting import require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.model import EgoPose, Scene
from torchfovea.sim.room import Solid, build_spec, paint_solids
from torchfovea.sim.truth import find_nearest

__all__ = ["compile_solids", "displaced", "scene_of", "seeded", "stand_at"]


def seeded(seed: int) -> np.random.Generator:
    """The source of chance of a scene.

    Raises:
        SettingError: a seed that is no whole number >= 0.
    """
    require(isinstance(seed, int) and seed >= 0, "seed", seed, "a whole number >= 0")
    return np.random.default_rng([seed, 1])


def compile_solids(
    solids: Sequence[Solid], head: Head, rng: np.random.Generator, params: object = None, seed: int = 0
) -> Scene:
    """A scene whose truth is not found yet (`stand_at` does that).

    Args:
        solids: a closed room (`torchfovea.sim.room.furnish`) and what stands in it.
        head: whose reach the truth is about, and whose height E has.
        rng: draws the textures' places.
        params: the settings that it was built from.
        seed: and the seed.
    """
    mujoco = load_mujoco()
    model = build_spec(solids, head).compile()
    data = tuple(mujoco.MjData(model) for _ in range(2))
    for d in data:
        mujoco.mj_forward(model, d)
    kind = torch.tensor([solid.kind for solid in solids])
    paint = paint_solids(solids, rng)
    return Scene(model, (data[0], data[1]), tuple(solids), paint, kind, head, params=params, seed=seed)


def scene_of(
    solids: Sequence[Solid], head: Head, rng: np.random.Generator, params: object = None, seed: int = 0
) -> Scene:
    """A scene of solids, seen from the world's origin: what a recipe returns. See `compile_solids`."""
    return stand_at(compile_solids(solids, head, rng, params, seed), EgoPose())


def stand_at(scene: Scene, pose: EgoPose) -> Scene:
    """The same scene with the robot standing elsewhere; its truth is found anew."""
    for name, value in pose._asdict().items():
        require(math.isfinite(value), f"pose.{name}", value, "a finite number")
    moved = replace(scene, pose=pose)
    return replace(moved, nearest=find_nearest(moved))


def displaced(scene: Scene, names: Collection[str], shift_m: tuple[float, float, float]) -> Scene:
    """The same scene after somebody has moved things, their textures with them; its truth is found anew.

    Args:
        scene: before.
        names: of the solids that are moved; what is moved far below the floor is gone.
        shift_m: by how much, in the world.
    """
    known = [solid.name for solid in scene.solids]
    for name in names:
        require(name in known, "names", name, "a solid of the scene")
    solids = []
    offset, centre = scene.paint.offset.clone(), scene.paint.centre.clone()
    for geom, solid in enumerate(scene.solids):
        if solid.name in names:
            x, y, z = (float(a + b) for a, b in zip(solid.position_m, shift_m, strict=True))
            solid = replace(solid, position_m=(x, y, z))
            shift = torch.tensor(shift_m, dtype=offset.dtype)
            offset[:, geom] -= shift
            centre[:, geom] += shift
        solids.append(solid)
    after = compile_solids(solids, scene.head, np.random.default_rng(0), scene.params, scene.seed)
    paint = scene.paint._replace(offset=offset, centre=centre)
    return stand_at(replace(after, paint=paint, marks=scene.marks), scene.pose)
