"""The loop of visual search: look, remember, decide, move. It is what a robot runs; nothing here knows the truth.

A robot is whatever can turn its head and look, `Robot`. All tensors may have leading axes, so that B robots search
together as one whose gazes are (B,).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import Generators, known_well_enough
from torchfovea.deciding.strategies import Strategy, upper_confidence_bound
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.moving import Motion
from torchfovea.memory.moving import move as move_memory
from torchfovea.perception import Observer, Step, check_owner, decide, gaze_at, perceive
from torchfovea.rows import row, stack
from torchfovea.sensing.correspondence import Correspondences, check_valid
from torchfovea.sensing.head import Eyes, Gaze, Head, Kinematics, eyes, fixate, gaze_point
from torchfovea.setting import require, typed

__all__ = ["Expecting", "Glance", "Look", "Move", "Robot", "StopRule", "search", "seen_from", "steadied"]

StopRule = tuple[float, float]
"""(tolerance, probability) of `torchfovea.deciding.acquisition.known_well_enough`."""


class Move(NamedTuple):
    """A saccade as executed, or B of them: numbers are tensors (B,) then.

    Attributes:
        gaze: where the head settled, as its encoders tell.
        seconds: how long it took.
        degrees: travelled.
        base: how the base moved since the look before, as odometry tells (`torchfovea.memory.moving.motion`; of B
            robots with a leading axis); the memory goes along. None: it stood still.
    """

    gaze: Gaze
    seconds: float | Tensor
    degrees: float | Tensor
    base: Motion | None = None


class Look(NamedTuple):
    """What the eyes bring home from one fixation.

    Attributes:
        matches: correspondences in both retinas, (..., N).
        pictures: whatever the sensor wants drawn (images, disparity), or nothing.
        eyes: where the eyes were, in the ego frame of now, when the images were taken: for images that come late, see
            `seen_from`. None: where the head rests.
    """

    matches: Correspondences
    pictures: Any = None
    eyes: Eyes | None = None


@runtime_checkable
class Robot(Protocol):
    """What searches: a robot, a simulated one, or B of either."""

    def saccade(self, gaze: Gaze, /) -> Move:
        """Turn the head to a gaze (...) and wait until it rests."""
        ...

    def look(self, gaze: Gaze, generator: Any, /) -> Look | None:
        """Sense at a gaze (...), where the head rests; None where no images came: the memory stays as it is.

        Args:
            gaze: as the encoders told.
            generator: the search's, for a sensor that needs chance; of B robots one each.
        """
        ...


@runtime_checkable
class Expecting(Protocol):
    """A `Robot` that wants to know, before it looks, what is known; one that does not lacks this method."""

    def expect(self, memory: Memory, /) -> None:
        """Take what is known before the next look, of B robots with a leading axis; the base is where it is then."""
        ...


class Glance(NamedTuple):
    """One saccade of a search, with all that came of it.

    Attributes:
        move: the saccade; `move.gaze` is where the head is.
        look: what was seen there; None: no images came, or nobody looked any more, for the stop rule had ended the
            search.
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
    require(typed(saccades, "int", "saccades") >= 1, "saccades", saccades, "at least 1")
    moves = callable(getattr(robot, "saccade", None)) and callable(getattr(robot, "look", None))
    require(moves, "robot", type(robot).__name__, "something with saccade(gaze) and look(gaze, generator)")
    require(
        stop is None or (isinstance(stop, tuple) and len(stop) == 2), "stop", stop, "(tolerance, probability), or None"
    )
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
        whole = bool(torch.stack(executed).isfinite().all())
        require(whole, "robot.saccade's gaze", [angle.tolist() for angle in executed], "finite angles")
        move = move._replace(gaze=executed)
        if step is not None and bool(done.all()):
            yield Glance(move, None, step, ~done, 0.0)
            return
        start = time.perf_counter()
        if move.base is not None:
            memory = _carried(observer, memory, move.base)
        if isinstance(robot, Expecting):
            robot.expect(memory)
        look, looked = robot.look(executed, generator), ~done
        require(look is None or isinstance(look, Look), "robot.look", type(look).__name__, "a torchfovea.search.Look")
        if look is None:
            looked = torch.zeros_like(done)
        else:
            check_valid(look.matches)
            matches = look.matches._replace(valid=look.matches.valid & looked[..., None])
            pose = eyes(observer.head, executed) if look.eyes is None else look.eyes
            memory = perceive(observer, memory, matches, pose)
        step = decide(observer, memory, generator, executed, step, strategy)
        seconds = time.perf_counter() - start
        if stop is not None:
            gaze, done = _stopped(observer, step, executed, done, stop)
            step = step._replace(gaze=gaze)
        gaze = step.gaze
        yield Glance(move, look, step, looked, seconds)


def seen_from(head: Head | Kinematics, gaze: Gaze, base: Motion | None = None) -> Eyes:
    """Where the eyes were when late images were taken, in the ego frame of now: the `eyes` of a `Look`.

    Args:
        head: of the observer.
        gaze: of that moment (...).
        base: how the base has moved since; its covariance is not used: odometry is far better known over a delay than
            a match is. None: it stood still.
    """
    pose = eyes(head, gaze)
    if base is None:
        return pose
    turn, shift = base.rotation.to(pose.t_left), base.translation.to(pose.t_left)
    left, right = ((t - shift) @ turn for t in (pose.t_left, pose.t_right))
    return Eyes(turn.mT @ pose.R_left, left, turn.mT @ pose.R_right, right)


def steadied(head: Head | Kinematics, gaze: Gaze, base: Motion) -> Gaze:
    """The gaze that meets the same point after the base has moved, as near as the head can turn to it.

    Args:
        head: of the robot.
        gaze: before (...).
        base: how the base moved.
    """
    parallel = 1e-6  # eyes that do not converge look at the horizon
    point = gaze_point(head, gaze._replace(vergence=gaze.vergence.clamp(min=parallel)))
    turn, shift = base.rotation.to(point), base.translation.to(point)
    return fixate(head, (point - shift) @ turn)[0]


def _carried(observer: Observer, memory: Memory, base: Motion) -> Memory:
    """One memory, or each of B, along with its base."""
    if memory.cells.dim() == 2:
        return move_memory(memory, base, observer.fusion)
    rows = range(len(memory.cells))
    return cast(Memory, stack([move_memory(row(memory, b), row(base, b), observer.fusion) for b in rows]))


def _stopped(observer: Observer, step: Step, executed: Gaze, done: Tensor, stop: StopRule) -> tuple[Gaze, Tensor]:
    """Where the heads go next, and who has looked for the last time."""
    last = known_well_enough(step.reward.mean, step.reward.std, step.eligible, *stop) & ~done
    best = torch.where(step.eligible, step.reward.mean, -torch.inf).argmax(-1)
    final = gaze_at(fixate(observer.head, step.points.mean)[0], best)
    gazes = zip(executed, final, step.gaze, strict=True)
    gaze = Gaze(*(torch.where(done, now, torch.where(last, end, onward)) for now, end, onward in gazes))
    return gaze, done | last
