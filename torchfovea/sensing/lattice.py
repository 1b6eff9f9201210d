"""Square lattices of receptive fields that fill a disc: a whole retina, or the fovea of a log-polar one."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

__all__ = ["BUDGET_TOLERANCE", "disc_lattice", "fovea_lattice"]

BUDGET_TOLERANCE = 0.005
"""A layout's count may differ from its budget by this share."""


@lru_cache(maxsize=64)
def disc_lattice(budget: int) -> tuple[float, tuple[float, float], np.ndarray]:
    """The lattice points of a disc: its radius [pitches], the axis' place, the whole-number columns and rows (N, 2)."""
    ideal = math.sqrt(budget / math.pi)
    side = np.arange(-math.ceil(1.5 * ideal) - 1, math.ceil(1.5 * ideal) + 2)
    rows, columns = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    # a disc about a corner of four RFs is the most symmetric; others serve small budgets that no symmetric count meets
    for axis in ((-0.5, -0.5), (0.0, 0.0), (-0.5, 0.0), (0.137, 0.291)):
        radius = np.hypot(columns - axis[0], rows - axis[1])
        steps = np.unique(np.round(radius, 9))
        between = (steps[1:] + steps[:-1]) / 2
        counts = np.searchsorted(np.sort(radius), between)
        meets = np.abs(counts - budget) <= BUDGET_TOLERANCE * budget
        if meets.any():
            if abs((radius <= ideal).sum() - budget) <= BUDGET_TOLERANCE * budget:
                limit = ideal
            else:
                limit = between[meets][np.argmin(np.abs(between[meets] - ideal))]
            inside = radius <= limit
            return float(limit), axis, np.stack([columns[inside], rows[inside]], -1)
    raise AssertionError("the last axis has no symmetry, so that every count occurs")


@lru_cache(maxsize=64)
def fovea_lattice(count: int) -> tuple[float, np.ndarray]:
    """The lattice points nearest to the axis: the radius of their disc [pitches], and x, y (n, 2) by row and column."""
    ideal = math.sqrt(count / math.pi)
    reach = math.ceil(ideal) + 2
    side = np.arange(-reach, reach) + 0.5
    y, x = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    nearest = np.sort(np.argsort(np.round(x * x + y * y, 6), kind="stable")[:count])
    return max(ideal, 1.000001 * np.hypot(x, y)[nearest].max()), np.stack([x[nearest], y[nearest]], -1)
