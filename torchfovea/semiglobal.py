"""Semi-global aggregation of matching costs on a grid that may be closed, such as rings by sectors.

Reference: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008; here
along both axes in both directions. Long lines are cut into segments that run side by side, each after a run-in on what
precedes it: what a path remembers fades within a few cells.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

__all__ = ["aggregate"]

SEGMENT = 48
RUN_IN = 12


@torch.no_grad()
def aggregate(cost: Tensor, values: Tensor, closed: bool, small: float, large: float, contrast: float) -> Tensor:
    """Costs with those of the best continuations on four sides, averaged.

    Args:
        cost: (B, D, R, S), of D hypotheses in order.
        values: (B, R, S), the image; edges in it make large steps cheaper.
        closed: whether the last column neighbours the first.
        small: penalty of a step to the next hypothesis.
        large: penalty of a larger step.
        contrast: difference of values at which the large penalty is halved (but never below the small one).

    Returns:
        (D, B, R, S). Not differentiable.
    """
    batch, depth, rows, columns = cost.shape
    total: Tensor | None = None
    for dim, around in ((2, False), (3, closed)):
        size, other = cost.shape[dim], rows * columns // cost.shape[dim]
        line = cost.movedim(dim, 0).transpose(1, 2).reshape(size, depth, batch * other)
        image = values.movedim(dim - 1, 0).reshape(size, batch * other)
        out = torch.zeros_like(line)
        parts = max(1, round(size / SEGMENT))
        length = math.ceil(size / parts) + (RUN_IN if around or parts > 1 else 0)
        borders = [k * size // parts for k in range(parts + 1)]
        back = torch.arange(-length, 0, device=cost.device)
        # what one step handles is contiguous: (T, D, parts · lines)
        costs = cost.new_empty(length, depth, parts, batch * other)
        shades = cost.new_empty(length, parts, batch * other)
        for forward in (True, False):
            ways = []
            for k, (start, end) in enumerate(pairwise(borders)):
                way = end + back if forward else start - 1 - back
                ways.append(way % size if around else way.clamp(0, size - 1))
                costs[:, :, k] = line[ways[-1]]
                shades[:, k] = image[ways[-1]]
            bound = (large / (1 + (shades[1:] - shades[:-1]).abs() / contrast)).clamp(min=small)
            _pass(costs.flatten(2), bound.flatten(1), small)
            for k, way in enumerate(ways):
                kept = borders[k + 1] - borders[k]
                out.index_add_(0, way[-kept:], costs[-kept:, :, k])
        # (size, D, B, other) to (D, B, R, S)
        out = out.unflatten(-1, (batch, other)).permute(1, 2, *((0, 3) if dim == 2 else (3, 0)))
        total = out.contiguous() if total is None else total.add_(out)
    assert total is not None
    return total.mul_(0.25)


def _pass(cost: Tensor, large: Tensor, small: float) -> None:
    """Pass costs (T, D, n) along T with penalties (T − 1, n) of large steps, in place."""
    shell = cost.new_full((cost.shape[1] + 2, cost.shape[2]), math.inf)
    before, lower, upper = shell[1:-1], shell[:-2], shell[2:]
    step = torch.empty_like(cost[0])
    for t in range(1, len(cost)):
        torch.sub(cost[t - 1], cost[t - 1].amin(0), out=before)
        torch.minimum(lower, upper, out=step).add_(small)
        torch.minimum(step, before, out=step)
        cost[t].add_(torch.minimum(step, large[t - 1], out=step))
