"""Cells drawn from a bias, within the head's reach, so that slightly different biases give slightly different cells."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.sensing.head import Head, can_fixate
from torchfovea.setting import require
from torchfovea.tuning.bias import Bias

__all__ = ["draw_cells", "reachable"]

REACH_RANGE_M = 1.0  # as in `torchfovea.commands.shared.build`: a direction is reachable if its point at 1 m is
_FEWEST_ACCEPTED = 1e-3


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
    dtype, m = bias.means.dtype, bias.means.shape[1]
    logits, means, factor = (t.detach().expand(scenes, *t.shape[1:]) for t in (bias.logits, bias.means, bias.cholesky))
    edges = logits.softmax(-1).cumsum(-1)
    direction = torch.zeros(scenes, cells, 3, dtype=dtype)
    waiting, tried, block = torch.arange(scenes * cells), 0, 4
    seed = torch.randint(2**62, (), generator=generator)
    while len(waiting):
        counter = waiting * 2**20 + torch.arange(tried, tried + block)[:, None]
        draws = torch.stack((*_normal(seed + 2, counter, dtype), _normal(seed + 3, counter, dtype)[0]), -1)
        if len(bias.means) == m == 1:
            v = means[0, 0] + draws @ factor[0, 0].mT
        else:
            scene = (waiting // cells).expand_as(counter)
            lot = _uniform(seed + 1, counter, dtype)[0]
            component = (lot[..., None] > edges[scene]).sum(-1).clamp(max=m - 1)
            v = means[scene, component] + (factor[scene, component] @ draws[..., None])[..., 0]
        unit = torch.nn.functional.normalize(v, dim=-1)
        good = reachable(head, unit)
        tried, block = tried + block, min(2 * block, 64)
        order = torch.arange(len(good))[:, None]
        first = torch.where(good, order, len(good)).amin(0)
        any_good = first < len(good)
        direction.view(-1, 3)[waiting[any_good]] = unit[first[any_good], any_good.nonzero()[:, 0]]
        waiting = waiting[~any_good]
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
