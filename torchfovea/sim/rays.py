"""Rays through a scene: ranges, and pictures without any GL."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.setting import require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.model import Scene
from torchfovea.sim.texture import colour

__all__ = ["MISS_RANGE_M", "Frame", "RayHits", "Renderer", "cast", "render"]

MISS_RANGE_M = 1000.0
"""The range that a ray gets which meets nothing; its geom is -1."""

_PARALLEL_FROM = 4000  # rays below which a second thread costs more than it saves
_SKY = (0.62, 0.72, 0.82)
_STEEPEST = np.float32(0.12)  # cosine of the slant at which the footprint stops growing
_CUTOFF_M = 1e6  # surfaces beyond are misses
_CHUNK = 40000  # pixels shaded at once: they stay in the cache


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
        normal: (H, W, 3) in E.
    """

    image: Tensor
    range_m: Tensor
    geom: Tensor
    normal: Tensor


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


@lru_cache(maxsize=8)
def _pixel_rays(camera: Camera, size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (H·W, 3) and the angle that each pixel spans (H·W,) [rad]."""
    index = torch.arange(size_px, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    px = torch.stack([u, v], -1)
    ray = torch.nn.functional.normalize(camera.rays(px), dim=-1)
    spans = []
    for step in ((0.5, 0.0), (0.0, 0.5)):
        shift = torch.tensor(step, dtype=torch.float64)
        ends = [torch.nn.functional.normalize(camera.rays(px + s * shift), dim=-1) for s in (-1, 1)]
        spans.append((ends[1] - ends[0]).norm(dim=-1))
    return ray.reshape(-1, 3).numpy(), torch.maximum(*spans).reshape(-1).float().numpy()


def render(scene: Scene, R: Tensor, t: Tensor, camera: Camera, size_px: int) -> Frame:
    """A square picture by ray casting, textured by `torchfovea.sim.texture`. Not differentiable.

    Args:
        scene: what to look at.
        R: (3, 3), columns are the camera's axes in E.
        t: (3,), the camera's centre in E [m].
        camera: of the image (`torchfovea.sensing.camera.image_camera`); pixel centres are integers.
        size_px: side of the picture, >= 2.

    Raises:
        SettingError: wrong shapes or size.
    """
    require(isinstance(size_px, int) and 2 <= size_px <= 8192, "size_px", size_px, "a whole number from 2 to 8192")
    require(R.shape == (3, 3), "R", tuple(R.shape), "(3, 3)")
    require(t.shape == (3,), "t", tuple(t.shape), "(3,)")
    ray, span = _pixel_rays(camera, size_px)
    rotation, translation = scene.world_from_ego
    turn = rotation @ R.detach().to("cpu", torch.float64).numpy()
    origin = rotation @ t.detach().to("cpu", torch.float64).numpy() + translation
    n = len(ray)
    chunk = min(_CHUNK, -(-n // 2))
    image = np.empty((3, n), np.float32)
    distance = np.empty(n, np.float32)
    geom = np.empty(n, np.int64)
    normal = np.empty((n, 3), np.float32)
    from_world, centre = rotation.astype(np.float32), origin.astype(np.float32)

    def work(worker: int) -> None:
        for start in range(worker * chunk, n, 2 * chunk):
            rows = slice(start, min(start + chunk, n))
            direction = ray[rows] @ turn.T
            distance[rows], geom[rows], across64 = _cast_part(scene, worker, origin, direction)
            across, way = across64.astype(np.float32), direction.astype(np.float32)
            normal[rows] = across @ from_world
            image[:, rows] = _shade(scene, centre, way, distance[rows], geom[rows], across, span[rows]).T

    _in_parallel(n, work)
    side = (size_px, size_px)
    return Frame(
        torch.from_numpy(image).reshape(3, *side),
        torch.from_numpy(distance).reshape(side),
        torch.from_numpy(geom).reshape(side),
        torch.from_numpy(normal).reshape(*side, 3),
    )


def _shade(
    scene: Scene,
    origin: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    geom: np.ndarray,
    normal: np.ndarray,
    span: np.ndarray,
) -> np.ndarray:
    """Colours (N, 3) of hits in the world; a miss is sky."""
    point = origin + distance[:, None] * direction
    slant = np.maximum(np.abs(np.einsum("ni,ni->n", direction, normal)), _STEEPEST)
    rgb = colour(scene.paint, np.maximum(geom, 0), point, normal, distance * span / slant)
    rgb[geom < 0] = _SKY
    return rgb
