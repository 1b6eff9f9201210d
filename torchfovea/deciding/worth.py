"""What each cell is worth, and which may be fixated: all that a decision takes from the memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.compiling import kernel
from torchfovea.deciding.eligibility import Eligibility
from torchfovea.deciding.reward import (
    RewardBelief,
    inverse_range_from_range,
    of_class,
    range_from_inverse_range,
    range_reward,
    user_reward,
)
from torchfovea.gaussian import Gaussian, columns
from torchfovea.machine import Loops, columns_of, loops
from torchfovea.memory.classes import class_moments
from torchfovea.memory.egosphere import (
    FAR_M,
    Memory,
    belief,
    cartesian_from_patches,
    inverse_range_belief,
    reducible,
    trust,
)
from torchfovea.sensing.head import Head, Kinematics, can_fixate, reach_numbers

__all__ = ["Appraisal", "appraise", "worth_of_cells"]

Measure = str | Callable[[Tensor], Tensor]  # of nearness, see `torchfovea.perception.Observer`


class Appraisal(NamedTuple):
    """What a decision knows.

    Attributes:
        points: 3-D belief of every cell (..., Nx).
        reward: its reward (..., Nx).
        open_to_looks: the standard deviation that is worth exploring (..., Nx).
        target: where the eyes would meet (..., Nx, 3) [m].
        eligible: which cells may be fixated, bool (..., Nx).
        incumbent: the best mean reward of those seen, or of all where none was, or 0, (...).
    """

    points: Gaussian
    reward: RewardBelief
    open_to_looks: Tensor
    target: Tensor
    eligible: Tensor
    incumbent: Tensor


def appraise(
    memory: Memory, measure: Measure, sought: int | None, head: Head | Kinematics, limits: Eligibility
) -> Appraisal:
    """What each cell is worth, and whether and where the eyes may meet on it.

    Args:
        memory: what is known, (...).
        measure: of nearness, see `worth_of_cells`.
        sought: a class, see there.
        head: what can be reached.
        limits: which cells may be fixated.

    Differentiable but in what may be fixated.
    """
    if isinstance(measure, str) and isinstance(head, Head) and memory.chart != "cartesian" and memory.classes is None:
        library = loops(memory.cells, memory.bearing, memory.looks, memory.lasting, memory.votes)
        if library is not None:
            return _by_loops(library, memory, measure, head, limits)
    return _appraise(memory, measure, sought, head, limits)


@kernel
def _appraise(
    memory: Memory, measure: Measure, sought: int | None, head: Head | Kinematics, limits: Eligibility
) -> Appraisal:
    points, reward, open_to_looks = worth_of_cells(memory, measure, sought)
    seen = memory.looks > 0
    # the eyes meet where the surface is, or where an unseen one would be while it is more likely not there
    doubted = seen & (trust(memory) < 0.5)
    at, instead = points.mean.unbind(-1), _unseen_points(memory).unbind(-1)
    target = columns(*(torch.where(doubted, there, here) for there, here in zip(instead, at, strict=True)))
    x, y, z = at
    surely = z - limits.ground_sigmas * points.cov[..., 5].sqrt()
    ground = seen & (surely + head.ego_height_m < limits.ground_z_m)
    far_enough = (x * x).addcmul_(y, y).addcmul_(z, z) > limits.nearest_m**2
    eligible = can_fixate(head, target) & far_enough & ~ground
    floor = torch.full_like(reward.mean, -torch.inf)
    incumbent = torch.where(eligible & seen, reward.mean, floor).amax(-1)
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.where(eligible, reward.mean, floor).amax(-1))
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.zeros_like(incumbent))
    return Appraisal(points, reward, open_to_looks, target, eligible, incumbent)


def _by_loops(library: Loops, memory: Memory, measure: str, head: Head, limits: Eligibility) -> Appraisal:
    """`appraise` by the loops of appraise.c."""
    cells, prior = memory.cells, memory.prior
    shape = memory.looks.shape
    known = (
        shape[:-1].numel(),
        shape[-1],
        *map(columns_of, memory.information),
        memory.bearing.contiguous(),
        memory.looks.contiguous(),
        *map(columns_of, (memory.lasting, memory.votes, cells)),
    )
    then = RewardBelief(*(torch.tensor(v, dtype=cells.dtype) for v in (prior.mean, prior.std)))
    mean, std = map(float, range_from_inverse_range(then) if measure == "range" else then)
    ground = (head.ego_height_m, limits.ground_z_m, limits.ground_sigmas)
    numbers = (FAR_M, torch.finfo(cells.dtype).tiny, *ground, limits.nearest_m, mean, std, 1 / prior.mean)
    points, cov, reward, target = (cells.new_empty(parts, *shape) for parts in (3, 6, 3, 3))
    eligible, incumbent = torch.empty(shape, dtype=torch.bool), cells.new_empty(shape[:-1])
    given = (*map(float, numbers), int(measure == "range"))
    library(
        "appraise",
        known,
        given,
        reach_numbers(head),
        (points, cov, *reward.unbind(0), target, eligible, incumbent),
    )
    beliefs = Gaussian(points.movedim(0, -1), cov.movedim(0, -1)), RewardBelief(reward[0], reward[1])
    return Appraisal(*beliefs, reward[2], target.movedim(0, -1), eligible, incumbent)


def worth_of_cells(
    memory: Memory, measure: Measure, sought: int | None = None
) -> tuple[Gaussian, RewardBelief, Tensor]:
    """Each cell's 3-D belief, its reward (Eq. 36-40), and the standard deviation that is worth exploring (..., Nx).

    A surface is worth its reward as far as it is believed, for the rest what an unseen cell is: mean and standard
    deviation are averaged with the prior's by `torchfovea.memory.egosphere.trust`, so that no doubtful surface wins a
    comparison of thousands. Of the prior's standard deviation looks that should have shown something, and did not,
    leave less and less. Unseen cells that no look has reached share the prior's reward exactly: ties are ties. What no
    look can change is not worth exploring, see `torchfovea.memory.egosphere.reducible`. Where a class is sought, all is
    worth that as far as it is of the class.

    Args:
        memory: what is known, (...).
        measure: of nearness, see `torchfovea.perception.Observer`.
        sought: the class that counts; None: any.
    """
    points, reward, unseen, variance = _rewards(memory, measure)
    sure, fruitless = trust(memory), memory.votes[..., 1]
    mean, std = (then.to(reward.mean) for then in unseen)
    std = std * (1 + fruitless).rsqrt()
    mean = torch.where(sure > 0, sure * reward.mean + (1 - sure) * mean, mean)
    whole, open_to_looks = (
        torch.where(sure > 0, sure * known + (1 - sure) * std, std)
        for known in (reward.std, reward.std * reducible(memory, variance).sqrt())
    )
    if sought is None or memory.classes is None:
        return points, RewardBelief(mean, whole), open_to_looks
    share = class_moments(memory.classes, sought)
    return points, of_class(RewardBelief(mean, whole), *share), of_class(RewardBelief(mean, open_to_looks), *share).std


def _rewards(memory: Memory, measure: Measure) -> tuple[Gaussian, RewardBelief, RewardBelief, Tensor]:
    """Points of the surfaces, their reward, that of an unseen one (a number, or one for each cell), and a variance.

    The variance is what `torchfovea.memory.egosphere.reducible` asks for.
    """
    prior, cartesian = memory.prior, memory.chart == "cartesian"
    if cartesian:
        points = belief(memory)
        rho, variance = None, points.cov[..., 5]
    else:
        rho, variance = inverse_range_belief(memory)
        points = cartesian_from_patches(rho, variance, memory)
    if not isinstance(measure, str):
        # the prior's range is uncertain along the ray; in x, y, z it is so in every direction
        sigma = prior.std if cartesian else prior.std / prior.mean**2
        x, y, z = memory.cells.unbind(-1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        shape = (one, zero, zero, one, zero, one) if cartesian else (x * x, x * y, x * z, y * y, y * z, z * z)
        unseen = Gaussian(_unseen_points(memory), columns(*(sigma**2 * part for part in shape)))
        return points, user_reward(measure, points), user_reward(measure, unseen), variance
    like = points.mean.dtype
    if rho is None:
        reward = range_reward(points)
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (-prior.mean, prior.std)))
        if measure == "inverse_range":
            reward, then = inverse_range_from_range(reward), inverse_range_from_range(then)
    else:
        reward = RewardBelief(rho, variance.sqrt())
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (prior.mean, prior.std)))
        if measure == "range":
            reward, then = range_from_inverse_range(reward), range_from_inverse_range(then)
    return points, reward, then, variance


def _unseen_points(memory: Memory) -> Tensor:
    """Where each cell's point would be if it had not been seen, (..., Nx, 3) [m]."""
    prior = memory.prior.mean
    return memory.cells * (prior if memory.chart == "cartesian" else 1 / prior)
