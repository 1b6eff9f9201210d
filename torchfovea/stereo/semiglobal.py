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

__all__ = ["RUN_IN", "SEGMENT", "aggregate"]

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
    total = torch.zeros(depth, batch, rows, columns, dtype=cost.dtype, device=cost.device)
    for dim, around in ((2, False), (3, closed)):
        size, other = cost.shape[dim], rows * columns // cost.shape[dim]
        line = cost.movedim(dim, 0).transpose(1, 2).reshape(size, depth, batch * other)
        image = values.movedim(dim - 1, 0).reshape(size, batch * other)
        parts = max(1, round(size / SEGMENT))
        length = math.ceil(size / parts) + (RUN_IN if around or parts > 1 else 0)
        back = torch.arange(-length, 0, device=cost.device)
        # each segment [start, end) forward and backward; what one step handles is contiguous: (T, D, 2 parts, lines)
        segments = list(pairwise(k * size // parts for k in range(parts + 1)))
        ways = [way for start, end in segments for way in (end + back, start - 1 - back)]
        costs = cost.new_empty(length, depth, len(ways), batch * other)
        shades = cost.new_empty(length, len(ways), batch * other)
        for k, way in enumerate(ways):
            place = way % size if around else way.clamp(0, size - 1)
            costs[:, :, k], shades[:, k] = line.index_select(0, place), image.index_select(0, place)
        bound = (large / (1 + (shades[1:] - shades[:-1]).abs() / contrast)).clamp_(min=small)
        _pass(costs.flatten(2), bound.flatten(1), small)
        out = total.permute(2, 0, 1, 3) if dim == 2 else total.permute(3, 0, 1, 2)
        for k, (start, end) in enumerate(segments):
            forward, backward = costs[start - end :, :, 2 * k], costs[start - end :, :, 2 * k + 1].flip(0)
            out[start:end] += backward.add_(forward).unflatten(-1, (batch, other))
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
