"""What a judged episode asks of the world: a robot that searches, and the truth; one by one or B at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfovea.memory.nearest import CellIndex, index_of_set, join_indices
from torchfovea.search import Look, Move, Robot
from torchfovea.sensing.head import Gaze
from torchfovea.setting import require

__all__ = ["Arena", "Arenas", "Fixation", "Truth", "row", "stack"]


class Fixation(NamedTuple):
    """The truth at a fixation, the first surface on the cyclopean ray, or at B of them: numbers are tensors (B,) then.

    Attributes:
        point: where, in E, (3,); far along the ray for a miss.
        range_m: its distance from the ego frame's origin; infinite for a miss.
        is_floor: whether it is the floor.
        is_target: whether it belongs to the target.
    """

    point: Tensor
    range_m: float | Tensor
    is_floor: bool | Tensor
    is_target: bool | Tensor


class Truth(NamedTuple):
    """What the judge knows and the observer does not.

    Attributes:
        nearest_m: range of the nearest reachable point that is not floor.
        nearest_point: that point in E, (3,).
        cell_points: the true surface point of each memory cell, (Nx, 3); infinite where there is none.
    """

    nearest_m: float
    nearest_point: Tensor
    cell_points: Tensor


class Arena(Robot, Protocol):
    """A place where a robot searches, or B robots in as many, beside a judge who knows the truth."""

    def fixation(self, gaze: Gaze, /) -> Fixation:
        """The truth at a gaze (...)."""
        ...


class Arenas:
    """Arenas one after the other, as a batch; an `Arena` itself.

    Args:
        arenas: whose looks have the same number of receptive fields.
    """

    def __init__(self, arenas: Sequence[Arena]) -> None:
        self.arenas = arenas

    def _each(self, gaze: Gaze) -> list[tuple[Arena, Gaze]]:
        return [(arena, Gaze(*(angle[b] for angle in gaze))) for b, arena in enumerate(self.arenas)]

    def saccade(self, gaze: Gaze) -> Move:
        """Move each head."""
        return Move(*stack([arena.saccade(one) for arena, one in self._each(gaze)]))

    def look(self, gaze: Gaze, generators: Sequence[torch.Generator]) -> Look:
        """Sense at each gaze; the pictures are a list."""
        looks = [
            arena.look(one, generator) for (arena, one), generator in zip(self._each(gaze), generators, strict=True)
        ]
        return Look(stack([look.matches for look in looks]), [look.pictures for look in looks])

    def fixation(self, gaze: Gaze) -> Fixation:
        """The truth at each gaze."""
        return Fixation(*stack([arena.fixation(one) for arena, one in self._each(gaze)]))


def stack(rows: Sequence[Any]) -> Any:
    """Rows of nested named tuples of tensors and numbers, as one with a leading axis.

    Indices of cells are joined. Whatever else there is (a memory's prior and chart) must be the same for all.

    Raises:
        SettingError: for rows that cannot be one batch.
    """
    first = rows[0]
    if isinstance(first, CellIndex):
        return join_indices(rows)
    if isinstance(first, tuple):
        return type(first)(*(stack(parts) for parts in zip(*rows, strict=True)))
    if first is None:
        return None
    if isinstance(first, bool):
        return torch.tensor(rows)
    if isinstance(first, float | int):
        return torch.tensor(rows, dtype=torch.float64)
    if isinstance(first, Tensor):
        shapes = {tuple(part.shape) for part in rows}
        require(len(shapes) == 1, "rows", sorted(shapes), "the same shape for all")
        return torch.stack(list(rows))
    other = next((part for part in rows if part != first), first)
    require(other == first, "rows", f"{first} and {other}", "the same for all")
    return first


def row(value: Any, b: int) -> Any:
    """Row b of every tensor, and of every index of cells, in nested tuples; whatever else stays as it is."""
    if isinstance(value, CellIndex):
        return index_of_set(value, b)
    if isinstance(value, tuple):
        parts = [row(part, b) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value[b] if isinstance(value, Tensor) else value
