"""The straightforward versions: whole matrices and library calls, as one would write them first, and well.

Functions with a first argument `xp` take NumPy arrays with numpy, and tensors with torch. Their results are those of
the library; `torchfovea.commands.bench.paths` checks that before it times anything.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from torchfovea.sensing.head import Eyes, Head
from torchfovea.sensing.unscented import SigmaPoints

__all__ = [
    "Choice", "Rig", "Seen", "brute_force", "converted", "decide", "filterpy_loop", "fuse_gaussians", "fuse_patches",
    "rig_of", "step", "tangent_frames", "unscented",
]  # fmt: skip

Array = Any


class Rig(NamedTuple):
    """Two pinhole eyes as plain arrays: rotations into the rectified frame, that frame in E, and its origin."""

    focal: float
    left: Array
    right: Array
    frame: Array
    origin: Array
    baseline: float


class Seen(NamedTuple):
    """Gaussians in inverse range about their directions, of M receptive fields."""

    direction: Array
    mean: Array
    cov: Array
    valid: Array


def rig_of(eyes: Eyes, focal_px: float) -> Rig:
    """The eyes' geometry in NumPy."""
    R_left, t_left, R_right, t_right = (part.double().cpu().numpy() for part in eyes)
    baseline = float(np.linalg.norm(t_right - t_left))
    x = (t_right - t_left) / baseline
    z = R_left[:, 2] + R_right[:, 2]
    z = z - (z @ x) * x
    z = z / np.linalg.norm(z)
    frame = np.stack([x, np.cross(z, x), z], 1)
    return Rig(focal_px, frame.T @ R_left, frame.T @ R_right, frame, (t_left + t_right) / 2, baseline)


def converted(rig: Rig, convert: Callable[[np.ndarray], Array]) -> Rig:
    """The geometry in other arrays."""
    return Rig(*(convert(part) if isinstance(part, np.ndarray) else part for part in rig))


def tangent_frames(xp: Any, direction: Array) -> Array:
    """Matrices (M, 3, 3) with columns e₁, e₂, n (Duff et al. 2017)."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    sign = xp.where(z < 0, -xp.ones_like(z), xp.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    e1 = xp.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    e2 = xp.stack([b, sign + y * y * a, -y], -1)
    return xp.stack([e1, e2, direction], -1)


def _images(xp: Any, places: Array, rig: Rig) -> tuple[Array, Array, Array]:
    """Sigma points (..., 9, 4) triangulated: direction of the first, (a, b, ρ) (..., 9, 3), and whether in view."""
    one = xp.ones_like(places[..., :1])
    left = xp.concatenate([places[..., :2] / rig.focal, one], -1) @ rig.left.T
    right = xp.concatenate([places[..., 2:] / rig.focal, one], -1) @ rig.right.T
    middle = left * right[..., 2:] + right * left[..., 2:]
    weight = (left[..., 0] * right[..., 2] - right[..., 0] * left[..., 2]) * (2 / rig.baseline)
    point = middle @ rig.frame.T + weight[..., None] * rig.origin
    length = xp.sqrt((point * point).sum(-1))
    direction = point[..., 0, :] / length[..., 0, None]
    offset = point @ tangent_frames(xp, direction)
    coordinates = xp.stack([offset[..., 0] / offset[..., 2], offset[..., 1] / offset[..., 2], weight / length], -1)
    ahead = (left[..., 2] > 0) & (right[..., 2] > 0)
    return direction, coordinates, ahead.all(-1)


def _turn(xp: Any, left: Array, right: Array) -> Array:
    """The rotation (..., 4, 4) of the square root's columns to disparity and version."""
    zero, scale = 0 * left, 1 / xp.sqrt(left * left + right * right)
    c, s = left * scale, right * scale
    rows = [[c, s, zero, zero], [zero, zero, c, s], [-s, c, zero, zero], [zero, zero, -s, c]]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def unscented(xp: Any, px: Array, sigma: Array, rig: Rig, points: SigmaPoints) -> Seen:
    """Triangulation and unscented transform of all receptive fields by batched 4 x 4 and 3 x 3 matrices.

    Args:
        xp: numpy or torch.
        px: left and right places (N, 4).
        sigma: of both eyes, (N, 2).
        rig: in arrays or tensors of the same kind.
        points: sigma points.
    """
    left, right = sigma[:, 0], sigma[:, 1]
    zero = 0 * left
    diagonal = [left, left, right, right]
    root = xp.stack([xp.stack([diagonal[i] if i == j else zero for j in range(4)], -1) for i in range(4)], -2)
    steps = points.spread * (root @ _turn(xp, left, right)).swapaxes(-1, -2)
    centre = px[:, None]
    direction, image, valid = _images(xp, xp.concatenate([centre, centre + steps, centre - steps], 1), rig)
    weights = [xp.asarray(w, dtype=px.dtype) for w in points.weights]
    if xp is torch:
        weights = [w.to(px.device) for w in weights]
    mean = (weights[0][:, None] * image).sum(1)
    apart = image - mean[:, None]
    return Seen(direction, mean, apart.swapaxes(-1, -2) @ (weights[1][:, None] * apart), valid)


def filterpy_loop(px: np.ndarray, sigma: np.ndarray, rig: Rig, points: SigmaPoints) -> Seen:
    """The same by a loop of filterpy's unscented transforms, in float64."""
    from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

    def root(cov: np.ndarray) -> np.ndarray:
        lower = np.linalg.cholesky(cov)
        turned: np.ndarray = lower @ _turn(np, lower[0, 0], lower[2, 2])
        return turned.T

    merwe = MerweScaledSigmaPoints(4, points.alpha, points.beta, points.kappa, sqrt_method=root)
    parts = []
    for place, (left, right) in zip(px.astype(np.float64), sigma.astype(np.float64), strict=True):
        sigmas = merwe.sigma_points(place, np.diag([left**2, left**2, right**2, right**2]))
        direction, image, valid = _images(np, sigmas, rig)
        parts.append((direction, *unscented_transform(image, merwe.Wm, merwe.Wc), valid))
    return Seen(*(np.stack(part) for part in zip(*parts, strict=True)))


def brute_force(cells: torch.Tensor, directions: torch.Tensor, at_once: int = 256) -> torch.Tensor:
    """The cell of the largest inner product, from all of them."""
    return torch.cat([(part @ cells.T).argmax(-1) for part in directions.split(at_once)])


def fuse_gaussians(
    mean: torch.Tensor, cov: torch.Tensor, cell: torch.Tensor, vector: torch.Tensor, matrix: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Eq. 34-35 with 3 x 3 blocks: moments of each cell from points (M, 3), (M, 3, 3) and its prior information."""
    information = torch.linalg.inv(cov)
    matrix = matrix.index_add(0, cell, information)
    vector = vector.index_add(0, cell, (information @ mean[..., None])[..., 0])
    after = torch.linalg.inv(matrix)
    return (after @ vector[..., None])[..., 0], after


def fuse_patches(
    row: torch.Tensor,
    rho: torch.Tensor,
    variance: torch.Tensor,
    cell: torch.Tensor,
    vector: torch.Tensor,
    matrix: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same for inverse ranges ρ = row · (g₁, g₂, ρ) with their variances (M,)."""
    weighted = row / variance[:, None]
    matrix = matrix.index_add(0, cell, row[:, :, None] * weighted[:, None])
    vector = vector.index_add(0, cell, weighted * rho[:, None])
    after = torch.linalg.inv(matrix)
    return (after @ vector[..., None])[..., 0], after


def _reachable(point: np.ndarray, head: Head) -> np.ndarray:
    """Whether the eyes can meet at points (N, 3), by the angles that it takes."""
    x, y, z = point.T
    level = np.hypot(x, y)
    reach = np.sqrt(np.maximum(x * x + y * y + z * z - head.eyes_up_m**2, 1e-12))
    distance = reach - head.eyes_forward_m
    pan = np.degrees(np.arctan2(y, x))
    tilt = np.degrees(np.arctan2(head.eyes_up_m, reach) - np.arctan2(z, level))
    vergence = np.degrees(2 * np.arctan2(head.baseline_m / 2, np.maximum(distance, 1e-6)))
    within: np.ndarray = (
        (np.abs(pan) <= head.pan_limit_deg) & (tilt <= head.tilt_down_deg) & (tilt >= -head.tilt_up_deg)
    )
    within &= (vergence <= head.vergence_max_deg) & (distance > 1e-3) & (level > 1e-6)
    return within


class Choice(NamedTuple):
    """Scores of the cells, −inf where not eligible, and the best one; moments of what each shows."""

    cell: int
    score: np.ndarray
    points: np.ndarray
    cov: np.ndarray
    rho: np.ndarray
    std: np.ndarray


def decide(
    cells: np.ndarray,
    vector: np.ndarray,
    matrix: np.ndarray,
    bearing: np.ndarray,
    seen: np.ndarray,
    head: Head,
    prior: tuple[float, float],
    limits: tuple[float, float, float],
    alpha: float,
) -> Choice:
    """Reward, upper confidence bound and the next fixation, in NumPy.

    Args:
        cells: directions (Nx, 3).
        vector: information (Nx, 3) of patches.
        matrix: (Nx, 3, 3).
        bearing: precision of their directions (Nx,).
        seen: bool (Nx,).
        head: its limits.
        prior: mean and standard deviation of an unseen cell's inverse range.
        limits: nearest range, the height below which all is ground [m], and by how many deviations a point is above.
        alpha: of the upper confidence bound.
    """
    cov = np.linalg.inv(matrix)
    moments = (cov @ vector[..., None])[..., 0]
    rho, std = np.where(seen, moments[:, 2], prior[0]), np.where(seen, np.sqrt(cov[:, 2, 2]), prior[1])
    range_m = 1 / np.maximum(moments[:, 2], 1e-3)
    points = range_m[:, None] * cells
    across = range_m**2 / bearing
    along = range_m**4 * cov[:, 2, 2] - across
    spread = across[:, None, None] * np.eye(3, dtype=cells.dtype)
    spread = spread + along[:, None, None] * cells[:, :, None] * cells[:, None]
    height = points[:, 2] - limits[2] * np.sqrt(spread[:, 2, 2])
    ground = seen & (height + head.ego_height_m < limits[1])
    eligible = _reachable(points, head) & (range_m > limits[0]) & ~ground
    score = np.where(eligible, rho + alpha * std, -np.inf)
    return Choice(int(score.argmax()), score, points, spread, rho, std)


def step(
    px: np.ndarray,
    sigma: np.ndarray,
    support: np.ndarray,
    valid: np.ndarray,
    rig: Rig,
    points: SigmaPoints,
    tree: cKDTree,
    frames: np.ndarray,
    spacing: np.ndarray,
    gates: tuple[float, float],
    vector: np.ndarray,
    matrix: np.ndarray,
    bearing: np.ndarray,
    slope_std: float,
    head: Head,
    prior: tuple[float, float],
    limits: tuple[float, float, float],
    alpha: float,
) -> Choice:
    """A whole step in NumPy and SciPy: correspondences in, the next fixation out.

    Args:
        px: (N, 4).
        sigma: (N, 2).
        support: angle that each receptive field covers to either side, (N,).
        valid: bool (N,).
        rig: the eyes.
        points: sigma points.
        tree: of the cells.
        frames: of the cells, `tangent_frames`, (Nx, 3, 3).
        spacing: of the cells (Nx,).
        gates: smallest gate [rad], and in spacings.
        vector: of the memory before, (Nx, 3).
        matrix: (Nx, 3, 3).
        bearing: (Nx,).
        slope_std: how steep patches may be.
        head: see `decide`.
        prior: see `decide`.
        limits: see `decide`.
        alpha: see `decide`.
    """
    found = unscented(np, px, sigma, rig, points)
    chord, cell = tree.query(found.direction, workers=2)
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1))
    gate = np.maximum(np.maximum(gates[1] * spacing[cell], gates[0]), support)
    keep = np.flatnonzero(valid & found.valid & (angle <= gate))
    cell, cov = cell[keep], found.cov[keep]
    across = cov[:, 0, 0] + cov[:, 1, 1]
    variance = cov[:, 2, 2] + slope_std**2 * across
    row = (found.direction[keep][:, None] @ frames[cell])[:, 0]
    weighted = row / variance[:, None]
    ones = np.ones(len(keep), px.dtype)
    add = csr_matrix((ones, (cell, np.arange(len(keep)))), shape=(len(spacing), len(keep)))
    matrix = matrix + (add @ (row[:, :, None] * weighted[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    vector = vector + add @ (weighted * found.mean[keep, 2:])
    bearing = bearing + add @ (2 / across)
    cells = np.ascontiguousarray(frames[..., 2])
    return decide(cells, vector, matrix, bearing, add @ ones > 0, head, prior, limits, alpha)
