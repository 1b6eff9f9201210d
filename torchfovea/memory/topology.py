"""Regular topologies of the sensory ego-sphere (Fig. 4a-c), and the even lattice that integrates over a sphere.

References:
    Goldberg (1937), A class of multi-symmetric polyhedra, Tohoku Mathematical Journal 43.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from torchfovea.setting import require

__all__ = [
    "Reachable",
    "ask",
    "fibonacci_directions",
    "geodesic_directions",
    "latitude_longitude_directions",
    "reachable_directions",
    "truncated_icosahedron_directions",
]

Reachable = Callable[[Tensor], Tensor]
"""Predicate of a set of directions: unit vectors (n, 3) to bool (n,)."""


def ask(reachable: Reachable, directions: Tensor) -> Tensor:
    """Which directions (n, 3) a predicate accepts, bool (n,), checked."""
    answer = reachable(directions)
    n = len(directions)
    good = answer.dtype == torch.bool and answer.shape == (n,)
    require(good, "reachable", f"{answer.dtype} {tuple(answer.shape)}", f"a predicate that returns bool ({n},)")
    return answer


def fibonacci_directions(n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """Spherical Fibonacci lattice: n directions, each with nearly the same share of the sphere.

    Args:
        n: how many, exactly.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    i = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * i + 1) / n
    azimuth = i * (math.pi * (3 - math.sqrt(5)))
    r = (1 - z * z).sqrt()
    return torch.stack((r * azimuth.cos(), r * azimuth.sin(), z), -1).to(device, dtype or torch.get_default_dtype())


def latitude_longitude_directions(
    n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """The 2-D array of Fig. 4a: rows of latitude, twice as many columns of longitude, denser toward the poles.

    Args:
        n: about how many; the result has 2 rows² directions.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    rows = max(1, round(math.sqrt(n / 2)))
    latitude = ((torch.arange(rows, dtype=torch.float64) + 0.5) / rows - 0.5).mul(math.pi)[:, None]
    longitude = (torch.arange(2 * rows, dtype=torch.float64) + 0.5).mul(math.pi / rows)
    x, y, z = torch.broadcast_tensors(
        latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()
    )
    return torch.stack((x, y, z), -1).flatten(0, 1).to(device, dtype or torch.get_default_dtype())


def geodesic_directions(n: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """The geodesic dome of Fig. 4b: vertices of an icosahedron whose faces are divided b times.

    Args:
        n: about how many; the result has 10 b² + 2 directions.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    return _divide(_icosahedron(), round(math.sqrt(max(n - 2, 0) / 10))).to(device, dtype or torch.get_default_dtype())


def truncated_icosahedron_directions(
    n: int = 32, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """The truncated icosahedron of Fig. 4c: its 12 pentagons and 20 hexagons are the cells, and finer ones divide them.

    Args:
        n: about how many; the result has 30 b² + 2 directions (Goldberg's polyhedra of class (b, b)), 32 for b = 1.
        dtype: default torch's.
        device: default torch's.
    """
    require(n >= 1, "n", n, "at least 1")
    corners = _icosahedron()
    faces = corners[ConvexHull(corners).simplices].sum(1)
    cells = np.concatenate((corners, faces / np.linalg.norm(faces, axis=-1, keepdims=True)))
    return _divide(cells, round(math.sqrt(max(n - 2, 0) / 30))).to(device, dtype or torch.get_default_dtype())


def reachable_directions(topology: Callable[[int], Tensor], n: int, reachable: Reachable) -> Tensor:
    """A regular topology made so dense that about n of its directions are reachable; returns those.

    Args:
        topology: such as `geodesic_directions`, called with a number of directions on the whole sphere.
        n: how many reachable ones to aim at (a regular topology comes in steps).
        reachable: predicate of the reachable set.

    Raises:
        SettingError: where the reachable set is empty or smaller than 1/100,000 of the sphere.
    """
    probe = 100_000
    share = int(ask(reachable, fibonacci_directions(probe)).sum()) / probe
    require(share > 0, "reachable", "no direction", f"at least one of {probe} directions of the sphere")
    for _ in range(3):  # a topology need not be equally dense everywhere
        directions = topology(max(1, round(n / share)))
        reached = directions[ask(reachable, directions)]
        share = max(len(reached), 1) / len(directions)
    return reached


def _icosahedron() -> np.ndarray:
    golden = (1 + math.sqrt(5)) / 2
    corners = [np.roll((0.0, i, j * golden), k) for i in (-1, 1) for j in (-1, 1) for k in range(3)]
    return np.stack(corners) / math.hypot(1, golden)


def _divide(vertices: np.ndarray, times: int) -> Tensor:
    """Vertices of a convex polyhedron with triangular faces after each edge is divided `times` (at least 1)."""
    times = max(times, 1)
    i, j = np.meshgrid(np.arange(times + 1), np.arange(times + 1))
    weights = np.stack((i, j, times - i - j), -1)[i + j <= times] / times
    points = np.einsum("wk,fkx->fwx", weights, vertices[ConvexHull(vertices).simplices]).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    _, first = np.unique(np.round(points, 9) + 0.0, axis=0, return_index=True)  # faces share their edges
    return torch.from_numpy(points[np.sort(first)])
