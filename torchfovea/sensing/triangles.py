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
        (B, C, P). Differentiable in the values.
    """
    centers, wanted = (np.ascontiguousarray(x.detach().cpu().double().numpy()) for x in (centers_px, px))
    mesh = Delaunay(centers)
    triangle = mesh.find_simplex(wanted)
    turn = mesh.transform[triangle]
    two = np.einsum("pij,pj->pi", turn[:, :2], wanted - turn[:, 2])
    weight = np.concatenate([two, 1 - two.sum(-1, keepdims=True)], -1)
    corner = mesh.simplices[triangle].astype(np.int64)
    outside = (triangle < 0) | ~np.isfinite(weight).all(-1)
    weight[outside] = (1.0, 0.0, 0.0)
    corner[outside] = cKDTree(centers).query(wanted[outside])[1][:, None]
    index = torch.as_tensor(corner).to(values.device)
    return (values[..., index] * torch.as_tensor(weight).to(values)).sum(-1)
