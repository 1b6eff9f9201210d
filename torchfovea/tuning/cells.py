"""Cells drawn from a bias, within the head's reach, so that slightly different biases give slightly different cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.machine import loops
from torchfovea.sensing.head import Head, can_fixate, reach_numbers
from torchfovea.setting import require
from torchfovea.tuning.bias import Bias

__all__ = ["draw_cells", "reachable"]

REACH_RANGE_M = 1.0  # as in `torchfovea.commands.shared.build`: a direction is reachable if its point at 1 m is
_FEWEST_ACCEPTED = 1e-3


class _Mixtures(NamedTuple):
    """One mixture for all scenes, or one for each: edges of the components' shares, means and Cholesky factors."""

    edges: Tensor
    means: Tensor
    factor: Tensor


def reachable(head: Head, directions: Tensor) -> Tensor:
    """Whether the head can fixate points at 1 m in these directions, (..., 3) to bool (...)."""
    return can_fixate(head, REACH_RANGE_M * directions)


def draw_cells(
    bias: Bias, scenes: int, cells: int, head: Head, generator: torch.Generator, strict: bool = True
) -> Tensor:
    """Draw every scene's cells within reach (B, N, 3), slot by slot.

    Every slot has its own sequence of random numbers and takes its first reachable draw, so that a slightly different
    bias gives slightly different cells.

    Args:
        bias: B mixtures, or one for all.
        scenes: B.
        cells: N.
        head: whose reach.
        generator: random state.
        strict: whether cells without a reachable draw are an error; else they are zero vectors.

    Raises:
        SettingError: where hardly any draw is reachable.
    """
    mixtures = _Mixtures(bias.logits.detach().softmax(-1).cumsum(-1), bias.means.detach(), bias.cholesky.detach())
    direction = torch.zeros(scenes, cells, 3, dtype=bias.means.dtype)
    waiting, tried, block = torch.arange(scenes * cells), 0, 4
    seed = torch.randint(2**62, (), generator=generator)
    while len(waiting):
        good, unit = _first_draws(mixtures, cells, head, seed, waiting, range(tried, tried + block))
        direction.view(-1, 3)[waiting[good]] = unit[good]
        waiting = waiting[~good]
        tried, block = tried + block, min(2 * block, 64)
        filled = 1 - len(waiting) / (scenes * cells)
        # a share s of reachable draws would have filled 1 − (1 − s)^tried by now
        enough = tried < 512 or filled > 1 - (1 - _FEWEST_ACCEPTED) ** tried
        enough = enough and tried < 16 / _FEWEST_ACCEPTED
        if not (strict or enough):
            break
        require(
            enough,
            "reachable",
            f"{filled:.1%} of the cells after {tried} draws each",
            "at least one draw in a thousand within the head's reach: the bias and the reachable set do not overlap",
        )
    return direction


def _first_draws(
    mixtures: _Mixtures, cells: int, head: Head, seed: Tensor, slots: Tensor, numbers: range
) -> tuple[Tensor, Tensor]:
    """Which of K slots have a draw within reach among those of some numbers, bool (K,), and the first one, (K, 3)."""
    library = loops(*mixtures)
    if library is not None and isinstance(head, Head):
        unit, good = mixtures.means.new_zeros(len(slots), 3), torch.empty(len(slots), dtype=torch.bool)
        given = (*mixtures.edges.shape, *(part.contiguous() for part in mixtures))
        draws = (len(slots), cells, slots, numbers.start, numbers.stop, unit, good)
        library("draw_cells", given, reach_numbers(head), int(seed), draws)
        return good, unit
    (edges, means, factor), dtype = mixtures, mixtures.means.dtype
    sets, m = edges.shape
    counter = slots * 2**20 + torch.arange(numbers.start, numbers.stop)[:, None]
    normal = torch.stack((*_normal(seed + 2, counter, dtype), _normal(seed + 3, counter, dtype)[0]), -1)
    if sets == m == 1:
        v = means[0, 0] + normal @ factor[0, 0].mT
    else:
        scene = (slots // cells if sets > 1 else torch.zeros_like(slots)).expand_as(counter)
        lot = _uniform(seed + 1, counter, dtype)[0]
        component = (lot[..., None] > edges[scene]).sum(-1).clamp(max=m - 1)
        v = means[scene, component] + (factor[scene, component] @ normal[..., None])[..., 0]
    unit = torch.nn.functional.normalize(v, dim=-1)
    within = reachable(head, unit)
    first = within.to(torch.uint8).argmax(0)  # of equals
    return within.any(0), unit[first, torch.arange(len(slots))]


def _uniform(seed: Tensor, counter: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Two uniform numbers in (0, 1] for each counter: SplitMix64 (Steele, Lea, Flood 2014), any of them at any time."""
    x = (seed * 0x632BE59BD9B4E019 + counter) * -0x61C8864680B583EB
    x = (x ^ (x >> 30 & 0x3FFFFFFFF)) * -0x40A7B892E31B1A47
    x = (x ^ (x >> 27 & 0x1FFFFFFFFF)) * -0x6B2FB644ECCEEE15
    x = x ^ (x >> 31 & 0x1FFFFFFFF)
    return ((x & 0xFFFFFFFF).to(dtype) + 0.5) / 2**32, ((x >> 32 & 0xFFFFFFFF).to(dtype) + 0.5) / 2**32


def _normal(seed: Tensor, counter: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Two standard normal numbers for each counter (Box and Muller 1958)."""
    u, v = _uniform(seed, counter, dtype)
    radius, angle = (-2 * u.log()).sqrt(), 2 * math.pi * v
    return radius * angle.cos(), radius * angle.sin()
