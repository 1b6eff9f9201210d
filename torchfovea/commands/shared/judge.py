"""Who judges a memory: the truth about each cell, what the memory tells of it, and fixations that nobody chose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import quadratic3
from torchfovea.memory.egosphere import Memory, belief
from torchfovea.memory.nearest import neighbour_spacing_rad
from torchfovea.sensing.chart import basis
from torchfovea.sensing.head import Gaze, fixate
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.world import World

__all__ = ["Judge", "estimate", "fixation_course", "judge_cells"]


class Judge(NamedTuple):
    """The truth about each cell.

    Attributes:
        rho: true inverse range (Nx,).
        straddles: whether a depth edge runs through the cell's neighbourhood: somewhere within its distance to the
            neighbours, the inverse range is more than 2% off the plane that fits it best. Bool (Nx,).
    """

    rho: Tensor
    straddles: Tensor


def judge_cells(world: World, cells: Tensor) -> Judge:
    """The truth about cells (Nx, 3), from rays through each and sixteen places around it."""
    cells = cells.double()
    spacing = neighbour_spacing_rad(cells)[:, None]
    e1, e2 = basis(cells)
    offsets = [(0.0, 0.0)]
    for radius in (0.5, 1.0):
        turns = [2 * math.pi * (k + radius / 2) / 8 for k in range(8)]
        offsets += [(radius * math.cos(a), radius * math.sin(a)) for a in turns]
    values = []
    for a, b in offsets:
        direction = cells + spacing * (a * e1 + b * e2)
        length = direction.norm(dim=-1)
        # on a plane this is linear in the offsets
        values.append(length / world.panorama(direction / length[:, None]).range_m)
    value = torch.stack(values, -1)
    design = torch.tensor([[1.0, a, b] for a, b in offsets], dtype=torch.float64)
    rest = torch.eye(len(design), dtype=torch.float64) - design @ torch.linalg.pinv(design)
    return Judge(value[:, 0], (value @ rest).abs().amax(-1) > 0.02 * value[:, 0])


def estimate(memory: Memory) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse range along the cells, its variance, and whether they were seen."""
    moments = belief(memory)
    if memory.chart == "inverse_range":
        return moments.mean[..., 2], moments.cov[..., 5], memory.looks > 0
    r = moments.mean.norm(dim=-1)
    return 1 / r, quadratic3(moments.cov, moments.mean / r[..., None]) / r**4, memory.looks > 0


def fixation_course(arena: SimulatedArena, cells: Tensor, saccades: int, seed: int) -> Iterator[Gaze]:
    """Straight ahead, then true points of cells at random; every fifth fixation is the target."""
    generator = torch.Generator().manual_seed(seed)
    head, world = arena.observer.head, arena.world
    chosen = cells[torch.randint(len(cells), (saccades,), generator=generator)].double()
    points = world.panorama(chosen).range_m[:, None] * chosen
    zero = torch.zeros((), dtype=torch.float64)
    for t in range(saccades):
        point = world.scene.nearest_point_e if t % 5 == 3 else points[t]
        yield Gaze(zero, zero, zero) if t == 0 else fixate(head, point)[0]
