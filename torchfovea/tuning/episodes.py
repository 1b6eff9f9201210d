"""Episodes by the loops of simulator.c, in place of thousands of operations on small tensors."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.weighted import Weighting
from torchfovea.machine import Loops, columns_of, loops
from torchfovea.perception import Observer
from torchfovea.sensing.head import Head, reach_numbers
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.tuning.worlds import Known, Worlds, sensor_numbers

__all__ = ["Course", "episode_loops", "play_by_loops"]

_COVERED = ("alpha", "by_time", "by_unseen", "cost_per_deg")


class Course(NamedTuple):
    """What was done in B episodes: a `torchfovea.tuning.simulator.Run` without what it was worth.

    Attributes:
        cell: chosen for the fixation at t, (B, T), or −1.
        score: of it, (B, T).
        angles: pan, tilt and vergence (3, B, T).
        memories: before each decision, if asked for.
    """

    cell: Tensor
    score: Tensor
    angles: Tensor
    memories: list[Known]


def episode_loops(observer: Observer, world: Worlds, weights: Weighting) -> Loops | None:
    """The loops, where they are wanted and know the head, the retina and all that weighs; None: as written."""
    known = isinstance(observer.head, Head) and isinstance(observer.retina, LogPolar | Uniform)
    if not known or any(weights.counts(name) for name in ("improvement", "information", "doubt")):
        return None
    return loops(world.direction, world.range_m, world.noise, world.prior_mean, world.prior_precision)


def play_by_loops(
    library: Loops, observer: Observer, world: Worlds, weights: Weighting, memory: Known, made: Tensor | None,
    angles: Tensor, far_m: float, keep: bool,
) -> Course:  # fmt: skip
    """Episodes from where they begin to their ends.

    Args:
        library: of `episode_loops`.
        observer: the fixed parts.
        world: of B episodes.
        weights: of the acquisition.
        memory: before the first decision; before the first look where `made` is None.
        made: decisions already made, (B,); None: the episodes begin with a look at the initial gaze.
        angles: so far, (3, B, T); written to.
        far_m: what a belief beyond it counts as.
        keep: keep the memories before each decision.
    """
    head, limits = observer.head, observer.eligibility
    assert isinstance(head, Head)
    (n, cells), steps = world.range_m.shape, angles.shape[-1]
    chosen, scores = torch.full((n, steps), -1), torch.full((n, steps), -math.inf, dtype=angles.dtype)
    kept = (steps - 1, n, cells) if keep else (0,)
    before = Known(angles.new_empty(kept), angles.new_empty(kept), torch.empty(kept, dtype=torch.bool))
    rows = [torch.as_tensor(getattr(weights, name), dtype=angles.dtype).expand(n) for name in _COVERED]
    field = (columns_of(world.direction), *(f.contiguous() for f in (world.range_m, world.noise, world.allowed)))
    start = (*(f.contiguous() for f in memory), made, torch.stack(rows))
    pan, up, down, vergence = map(
        math.radians, (head.pan_limit_deg, -head.tilt_up_deg, head.tilt_down_deg, head.vergence_max_deg)
    )
    body = (head.baseline_m, head.ego_height_m, pan, up, down, vergence)
    eligible = (far_m, limits.nearest_m, limits.ground_z_m, limits.ground_sigmas)
    counts = (observer.reward == "range", weights.counts("by_unseen"), weights.counts("cost_per_deg"))
    library(
        "episodes",
        (n, cells, steps, *field),
        start,
        reach_numbers(head),
        (*map(float, (*body, *eligible)), *map(int, counts)),
        sensor_numbers(observer),
        (chosen, scores, angles, *(before if keep else (None,) * 3)),
    )
    memories = [Known(*parts) for parts in zip(*before, strict=True)] if keep else []
    return Course(chosen, scores, angles, memories)
