"""The loop of visual search: look, remember, decide, move. It is what a robot runs; nothing here knows the truth.

A robot is whatever can turn its head and look, `Robot`. All tensors may have leading axes, so that B robots search
together as one whose gazes are (B,).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import Generators, known_well_enough
from torchfovea.deciding.strategies import Strategy, upper_confidence_bound
from torchfovea.memory.egosphere import Memory
from torchfovea.perception import Observer, Step, check_owner, decide, gaze_at, perceive
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Gaze, eyes, fixate
from torchfovea.setting import require

__all__ = ["Glance", "Look", "Move", "Robot", "StopRule", "search"]

StopRule = tuple[float, float]
"""(tolerance, probability) of `torchfovea.deciding.acquisition.known_well_enough`."""


class Move(NamedTuple):
    """A saccade as executed, or B of them: numbers are tensors (B,) then.

    Attributes:
        gaze: where the head settled, as its encoders tell.
        seconds: how long it took.
        degrees: travelled.
    """

    gaze: Gaze
    seconds: float | Tensor
    degrees: float | Tensor


class Look(NamedTuple):
    """What the eyes bring home from one fixation.

    Attributes:
        matches: correspondences in both retinas, (..., N).
        pictures: whatever the sensor wants drawn (images, disparity), or nothing.
    """

    matches: Correspondences
    pictures: Any = None


@runtime_checkable
class Robot(Protocol):
    """What searches: a robot, a simulated one, or B of either."""

    def saccade(self, gaze: Gaze, /) -> Move:
        """Turn the head to a gaze (...) and wait until it rests."""
        ...

    def look(self, gaze: Gaze, generator: Any, /) -> Look:
        """Sense at a gaze (...), where the head rests.

        Args:
            gaze: as the encoders told.
            generator: the search's, for a sensor that needs chance; of B robots one each.
        """
        ...


class Glance(NamedTuple):
    """One saccade of a search, with all that came of it.

    Attributes:
        move: the saccade; `move.gaze` is where the head is.
        look: what was seen there; None: nobody looked any more, the stop rule ended the search before.
        step: what is known then, and decided: `step.memory`, and `step.gaze`, where the head goes next.
        looked: bool (...), who looked.
        seconds: wall time of looking and deciding.
    """

    move: Move
    look: Look | None
    step: Step
    looked: Tensor
    seconds: float


def search(
    robot: Robot,
    observer: Observer,
    memory: Memory,
    saccades: int,
    generator: Generators | None = None,
    strategy: Strategy = upper_confidence_bound,
    stop: StopRule | None = None,
) -> Iterator[Glance]:
    """Search from straight ahead; a robot moves only while somebody asks for the next glance.

    Args:
        robot: moves and looks.
        observer: the fixed parts.
        memory: what is known at the start, (Nx, 3) or (B, Nx, 3); the search runs in its dtype, on its device.
        saccades: at most so many, the initial gaze included.
        generator: for the sensor, and breaks ties; one, or one for each of B robots. The same seed gives the same
            search, whatever the batch.
        strategy: scores the cells, see `torchfovea.deciding.strategies`.
        stop: when it holds, the best cell is fixated, and the search ends; a batch goes on until it holds for all, and
            the others' heads stay; None: never.

    Yields:
        A glance for each saccade.

    Raises:
        SettingError: for no saccades, a memory that is not this observer's, and a robot that answers something else.
    """
    require(saccades >= 1, "saccades", saccades, "at least 1")
    check_owner(observer, memory)
    return _course(robot, observer, memory, saccades, generator, strategy, stop)


def _course(
    robot: Robot,
    observer: Observer,
    memory: Memory,
    saccades: int,
    generator: Generators | None,
    strategy: Strategy,
    stop: StopRule | None,
) -> Iterator[Glance]:
    zero = memory.cells.new_zeros(memory.cells.shape[:-2])
    gaze, done = Gaze(zero, zero, zero), torch.zeros_like(zero, dtype=torch.bool)
    step: Step | None = None
    for _ in range(saccades):
        move = robot.saccade(gaze)
        require(isinstance(move, Move), "robot.saccade", type(move).__name__, "a torchfovea.search.Move")
        executed = Gaze(*(torch.as_tensor(angle).to(zero) for angle in move.gaze))
        move = move._replace(gaze=executed)
        if step is not None and bool(done.all()):
            yield Glance(move, None, step, ~done, 0.0)
            return
        start = time.perf_counter()
        look = robot.look(executed, generator)
        require(isinstance(look, Look), "robot.look", type(look).__name__, "a torchfovea.search.Look")
        matches = look.matches._replace(valid=look.matches.valid & ~done[..., None])
        memory = perceive(observer, memory, matches, eyes(observer.head, executed))
        step = decide(observer, memory, generator, executed, step, strategy)
        seconds, looked = time.perf_counter() - start, ~done
        if stop is not None:
            gaze, done = _stopped(observer, step, executed, done, stop)
            step = step._replace(gaze=gaze)
        gaze = step.gaze
        yield Glance(move, look, step, looked, seconds)


def _stopped(observer: Observer, step: Step, executed: Gaze, done: Tensor, stop: StopRule) -> tuple[Gaze, Tensor]:
    """Where the heads go next, and who has looked for the last time."""
    last = known_well_enough(step.reward.mean, step.reward.std, step.eligible, *stop) & ~done
    best = torch.where(step.eligible, step.reward.mean, -torch.inf).argmax(-1)
    final = gaze_at(fixate(observer.head, step.points.mean)[0], best)
    gazes = zip(executed, final, step.gaze, strict=True)
    gaze = Gaze(*(torch.where(done, now, torch.where(last, end, onward)) for now, end, onward in gazes))
    return gaze, done | last
