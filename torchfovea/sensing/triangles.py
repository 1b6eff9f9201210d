"""Values between places that follow no lattice: linear over the triangles of their neighbours."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import Delaunay, cKDTree
from torch import Tensor

__all__ = ["from_triangles"]


def from_triangles(values: Tensor, centers_px: Tensor, px: Tensor) -> Tensor:
    """Linear interpolation over Delaunay's triangles; beyond them the nearest place's value.

    Args:
        values: (B, C, N), of the places.
        centers_px: (N, 2), the places.
        px: (P, 2), where the values are wanted.

    Returns:
        (B, C, P). Differentiable in the values and, within the triangles, in the wanted places.
    """
    centers, wanted = (np.ascontiguousarray(x.detach().cpu().double().numpy()) for x in (centers_px, px))
    mesh = Delaunay(centers)
    triangle = mesh.find_simplex(wanted)
    turn = mesh.transform[triangle]
    corner = mesh.simplices[triangle].astype(np.int64)
    outside = (triangle < 0) | ~np.isfinite(turn).all((-2, -1))
    turn[outside] = 0.0  # where only the first corner, which is the last in the mesh's coordinates, counts
    corner[outside] = cKDTree(centers).query(wanted[outside])[1][:, None]
    index, turn = torch.as_tensor(corner).to(values.device), torch.as_tensor(turn).to(values)
    two = (turn[:, :2] @ (px.to(values) - turn[:, 2])[..., None])[..., 0]
    weight = torch.cat([two, 1 - two.sum(-1, keepdim=True)], -1)
    return (values[..., index] * weight).sum(-1)
