"""Rays through a scene: ranges by MuJoCo, and pictures without any GL."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.setting import require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.drawing import Painted, draw_pictures, paint_scenes
from torchfovea.sim.model import Scene

__all__ = ["MISS_RANGE_M", "Frame", "RayHits", "Renderer", "cast", "render", "render_together"]

MISS_RANGE_M = 1000.0
"""The range that a ray gets which meets nothing; its geom is -1."""

_PARALLEL_FROM = 4000  # rays below which a second thread costs more than it saves
_CUTOFF_M = 1e6  # surfaces beyond are misses


class RayHits(NamedTuple):
    """First surfaces on N rays.

    Attributes:
        range_m: (N,) distance along the ray, MISS_RANGE_M where it meets nothing.
        geom: (N,) int64, -1 for a miss.
        normal: (N, 3) of the surface, in E; zero for a miss.
    """

    range_m: Tensor
    geom: Tensor
    normal: Tensor


class Frame(NamedTuple):
    """A picture and the truth behind it.

    Attributes:
        image: (3, H, W) RGB in [0, 1], float32.
        range_m: (H, W) distance from the camera's centre along each pixel's ray, MISS_RANGE_M for a miss.
        geom: (H, W) int64, -1 for a miss.
    """

    image: Tensor
    range_m: Tensor
    geom: Tensor


@runtime_checkable
class Renderer(Protocol):
    """What draws a picture: `render`, `torchfovea.sim.gl.render`, or any function like them."""

    def __call__(self, scene: Scene, R: Tensor, t: Tensor, camera: Camera, size_px: int, /) -> Frame:
        """A square picture.

        Args:
            scene: what to look at.
            R: (3, 3), columns are the camera's axes in E.
            t: (3,), the camera's centre in E [m].
            camera: of the image; pixel centres are integers.
            size_px: side of the picture.
        """
        ...


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """One other thread, of this process: a fork takes no threads along."""
    return ThreadPoolExecutor(1, thread_name_prefix="torchfovea-rays")


def _cast_part(
    scene: Scene, worker: int, origin: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranges, geoms and normals of unit directions (N, 3) float64, all in the world.

    mj_multiRay works on the stack of its MjData, hence each worker has its own.
    """
    mujoco = load_mujoco()
    n = len(direction)
    geom, distance, normal = np.empty(n, np.int32), np.empty(n), np.empty((n, 3))
    # MuJoCo wants the vectors flat
    flat = np.ascontiguousarray(direction).reshape(-1)
    mujoco.mj_multiRay(
        scene.model, scene.data[worker], origin, flat, None, True, -1, geom, distance, normal.reshape(-1), n, _CUTOFF_M
    )
    miss = geom < 0
    if miss.any():
        distance[miss] = MISS_RANGE_M
        normal[miss] = 0
    return distance, geom, normal


def _in_parallel(n: int, work: Callable[[int], None]) -> None:
    """Run work(0) and work(1), on two threads if n rays are worth it; MuJoCo and torch let go of the GIL."""
    if n < _PARALLEL_FROM or torch.get_num_threads() < 2:
        work(0)
        work(1)
    else:
        other = _pool(os.getpid()).submit(work, 1)
        work(0)
        other.result()


def _cast_world(scene: Scene, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(direction)
    if n < _PARALLEL_FROM:
        return _cast_part(scene, 0, origin, direction)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = [()] * 2  # type: ignore[list-item]

    def work(worker: int) -> None:
        rows = slice(0, n // 2) if worker == 0 else slice(n // 2, n)
        parts[worker] = _cast_part(scene, worker, origin, direction[rows])

    _in_parallel(n, work)
    distance, geom, normal = (np.concatenate(pair) for pair in zip(*parts, strict=True))
    return distance, geom, normal


def cast(scene: Scene, origin_e: Tensor, directions_e: Tensor) -> RayHits:
    """Meet the scene's surfaces with rays from one point. Not differentiable.

    Args:
        scene: what to look at; not from two threads at once.
        origin_e: (3,) in E [m].
        directions_e: (N, 3) in E, of any positive length.

    Returns:
        Hits in the directions' dtype; rays are cast in float64.

    Raises:
        SettingError: wrong shapes, or numbers that are not finite.
    """
    require(directions_e.dim() == 2 and directions_e.shape[1] == 3, "directions_e", tuple(directions_e.shape), "(N, 3)")
    require(origin_e.shape == (3,), "origin_e", tuple(origin_e.shape), "(3,)")
    require(bool(torch.isfinite(origin_e).all()), "origin_e", origin_e.tolist(), "a finite point")
    d = directions_e.detach().to("cpu", torch.float64).numpy()
    if len(d) == 0:
        return RayHits(directions_e[:, 0], torch.empty(0, dtype=torch.long), directions_e)
    length = np.sqrt(np.einsum("ni,ni->n", d, d))
    require(bool(np.isfinite(length).all() and (length > 0).all()), "directions_e", "zero or not finite", "directions")
    rotation, translation = scene.world_from_ego
    origin = rotation @ origin_e.detach().to("cpu", torch.float64).numpy() + translation
    distance, geom, normal = _cast_world(scene, origin, (d / length[:, None]) @ rotation.T)
    dtype = directions_e.dtype
    return RayHits(
        torch.from_numpy(distance).to(dtype),
        torch.from_numpy(geom).long(),
        torch.from_numpy(normal @ rotation).to(dtype),
    )


_painted: weakref.WeakKeyDictionary[Any, dict[tuple[torch.device, int], Painted]] = weakref.WeakKeyDictionary()


def _paint(scenes: Sequence[Scene], device: torch.device) -> Painted:
    """Scenes as tensors; those of one scene, so many times, are kept: wherever the robot stands, they are the same."""
    if any(scene.model is not scenes[0].model for scene in scenes):
        return paint_scenes(scenes, device)
    known, count = _painted.setdefault(scenes[0].model, {}), len(scenes)
    if (device, count) not in known:
        known[device, count] = paint_scenes(scenes, device)
    return known[device, count]


def render(scene: Scene, R: Tensor, t: Tensor, camera: Camera, size_px: int) -> Frame:
    """A square picture by tensors (`torchfovea.sim.drawing`), textured by `torchfovea.sim.texture`. Not differentiable.

    Args:
        scene: what to look at.
        R: (3, 3), columns are the camera's axes in E; it is drawn on the device of R.
        t: (3,), the camera's centre in E [m].
        camera: of the image (`torchfovea.sensing.camera.image_camera`); pixel centres are integers.
        size_px: side of the picture, >= 2.

    Raises:
        SettingError: wrong shapes or size, or an eye outside of a closed room.
    """
    require(R.shape == (3, 3), "R", tuple(R.shape), "(3, 3)")
    require(t.shape == (3,), "t", tuple(t.shape), "(3,)")
    return render_together([scene], R[None], t[None], camera, size_px)[0]


def render_together(scenes: Sequence[Scene], R: Tensor, t: Tensor, camera: Camera, size_px: int) -> list[Frame]:
    """The pictures of `render` for K eyes in as many scenes, R (K, 3, 3) and t (K, 3), cheaper than one by one."""
    require(isinstance(size_px, int) and 2 <= size_px <= 8192, "size_px", size_px, "a whole number from 2 to 8192")
    places = zip(*(scene.world_from_ego for scene in scenes), strict=True)
    rotation, translation = (torch.from_numpy(np.stack(part)).to(R.device) for part in places)
    turn = rotation @ R.detach().double()
    eye = (rotation @ t.detach().to(R.device).double()[..., None])[..., 0] + translation
    drawn = draw_pictures(_paint(scenes, R.device), turn, eye, camera, size_px)
    range_m = drawn.range_m.clamp(max=MISS_RANGE_M)
    return [Frame(*parts) for parts in zip(drawn.image, range_m, drawn.geom, strict=True)]
