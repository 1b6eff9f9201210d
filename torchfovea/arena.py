"""What a judged episode asks of the world: a robot that searches, and the truth; one by one or B at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchfovea.memory.egosphere import Memory
from torchfovea.rows import row, stack
from torchfovea.search import Expecting, Look, Move, Robot
from torchfovea.sensing.head import Gaze

__all__ = ["Arena", "Arenas", "Fixation", "Truth"]


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

    def look(self, gaze: Gaze, generator: Any, /) -> Look:
        """Sense at a gaze (...); what is to be judged arrives. See `torchfovea.search.Robot`."""
        ...

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

    def expect(self, memory: Memory) -> None:
        """Tell each that wants to know what is known."""
        for b, arena in enumerate(self.arenas):
            if isinstance(arena, Expecting):
                arena.expect(row(memory, b))

    def look(self, gaze: Gaze, generators: Sequence[torch.Generator]) -> Look:
        """Sense at each gaze; the pictures are a list."""
        looks = [
            arena.look(one, generator) for (arena, one), generator in zip(self._each(gaze), generators, strict=True)
        ]
        return Look(stack([look.matches for look in looks]), [look.pictures for look in looks])

    def fixation(self, gaze: Gaze) -> Fixation:
        """The truth at each gaze."""
        return Fixation(*stack([arena.fixation(one) for arena, one in self._each(gaze)]))

    def truths(self, cells: Tensor) -> list[Truth]:
        """What the judge knows as each robot stands now, of cells (B, Nx, 3); for arenas that move and can tell."""
        return [arena.truth(one) for arena, one in zip(self.arenas, cells, strict=True)]  # type: ignore[attr-defined]
