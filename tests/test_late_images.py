"""A robot whose images come late or not at all, and whose base moves: the loop enters each where it was taken."""

import math

import pytest
import torch

from torchfovea.memory.egosphere import cartesian_belief
from torchfovea.memory.moving import Motion, motion
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, new_memory
from torchfovea.rows import row, stack
from torchfovea.search import Look, Move, search, seen_from
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Gaze, Head, clamp_gaze, eyes, fixate, to_ego
from torchfovea.sensing.layout import LogPolar

HEAD, ROOM_M = Head(), 3.0
STEP = motion(
    torch.tensor([[math.cos(0.1), -math.sin(0.1), 0], [math.sin(0.1), math.cos(0.1), 0], [0, 0, 1.0]]),
    torch.tensor([0.2, 0.3, 0.0]),
)


class Walker:
    """A robot that takes STEP before every saccade but the first, in a spherical room about the world's origin.

    Args:
        late: whether a look brings the images of the saccade before.
        told: whether it says so.
        lost: after which saccades no images come.
    """

    def __init__(self, observer, late=False, told=True, lost=()):
        self.observer, self.late, self.told, self.lost = observer, late, told, lost
        self.turn, self.place = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        self.count, self.gaze, self.before = -1, None, None

    def saccade(self, gaze):
        self.before = (self.gaze, self.turn, self.place)
        self.gaze, self.count = clamp_gaze(HEAD, Gaze(*(a.double() for a in gaze))), self.count + 1
        if self.count == 0:
            return Move(self.gaze, 0.1, 1.0)
        self.place, self.turn = self.place + self.turn @ STEP.translation, self.turn @ STEP.rotation
        return Move(self.gaze, 0.1, 1.0, STEP)

    def look(self, gaze, generator):
        if self.count in self.lost:
            return None
        then = self.before if self.late and self.count > 0 else (self.gaze, self.turn, self.place)
        pose = seen_from(HEAD, then[0], STEP) if self.late and self.count > 0 and self.told else None
        return Look(self.matches(*then), eyes=pose)

    def matches(self, gaze, turn, place):
        o, pose = self.observer, eyes(HEAD, gaze)
        px = o.retina.centers_px(dtype=torch.float64)
        way = to_ego(turn, to_ego(pose.R_left, torch.nn.functional.normalize(o.camera.rays(px), dim=-1)))
        start = turn @ pose.t_left + place
        b = way @ start
        range_m = -b + (b * b - start @ start + ROOM_M**2).sqrt()
        points = (start + range_m[:, None] * way - place) @ turn
        seen = torch.ones(len(px), dtype=torch.bool)
        return correspond_points(points, seen, px, pose, o.camera, o.retina, o.budget)


def off_the_wall(robot, memory):
    """Relative distance of the seen cells' points from the room's wall, median."""
    seen = memory.looks > 0
    points = cartesian_belief(memory).mean[seen].double() @ robot.turn.mT + robot.place
    return float((points.norm(dim=-1) / ROOM_M - 1).abs().median())


@pytest.fixture
def start():
    observer = Observer(head=HEAD, camera=Pinhole.from_fov(90, 100), retina=LogPolar(600))
    cells = fibonacci_directions(1200, torch.float64)
    return observer, new_memory(observer, cells[fixate(HEAD, cells)[1]])


def test_images_that_come_late_are_entered_where_they_were_taken(start):
    off = {}
    for name, settings in {"in time": {}, "late": {"late": True}, "untold": {"late": True, "told": False}}.items():
        robot = Walker(start[0], **settings)
        *_, last = search(robot, *start, 5)
        off[name] = off_the_wall(robot, last.step.memory)
        assert int((last.step.memory.looks > 0).sum()) > 100
    assert off["in time"] < 0.005 and off["late"] < 0.005
    assert off["untold"] > 0.03


def test_images_that_do_not_come_leave_the_memory_as_it_was(start):
    observer, memory = start
    robot = Walker(observer, lost=(0, 2))
    glances = list(search(robot, observer, memory, 4))
    assert [glance.look is None for glance in glances] == [True, False, True, False]
    assert [bool(glance.looked) for glance in glances] == [False, True, False, True]
    assert int(glances[0].step.memory.looks.sum()) == 0
    assert float(glances[2].step.memory.looks.max()) == 1 and float(glances[3].step.memory.looks.max()) == 2
    assert off_the_wall(robot, glances[3].step.memory) < 0.005


def test_eyes_of_then_in_the_frame_of_now():
    """Where a point was seen then is where it is now, for both eyes."""
    generator = torch.Generator().manual_seed(0)
    gaze = Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (0.3, 0.1, 0.2)))
    then, now = eyes(HEAD, gaze), seen_from(HEAD, gaze, STEP)
    for side in ("left", "right"):
        point = torch.randn(3, generator=generator, dtype=torch.float64)
        old = getattr(then, f"R_{side}") @ point + getattr(then, f"t_{side}")
        new = getattr(now, f"R_{side}") @ point + getattr(now, f"t_{side}")
        torch.testing.assert_close(STEP.rotation @ new + STEP.translation, old)
    assert all(map(torch.equal, seen_from(HEAD, gaze), then))


def test_a_batch_moves_as_each_alone(start):
    observer, memory = start
    still = motion(torch.eye(3), torch.zeros(3))

    class Pair:
        """Two walkers, of which the second stands still."""

        def __init__(self):
            self.robots = [Walker(observer), Walker(observer)]

        def saccade(self, gaze):
            moves = [robot.saccade(Gaze(*(a[b] for a in gaze))) for b, robot in enumerate(self.robots)]
            if moves[1].base is not None:
                self.robots[1].turn, self.robots[1].place = torch.eye(3, dtype=torch.float64), torch.zeros(3).double()
                moves[1] = moves[1]._replace(base=still)
            return stack(moves)

        def look(self, gaze, generator):
            return Look(stack([robot.look(None, None).matches for robot in self.robots]))

    *_, both = search(Pair(), observer, stack([memory, memory]), 3)
    *_, alone = search(Walker(observer), observer, memory, 3)
    for one, other in zip(row(both.step.memory, 0).information, alone.step.memory.information, strict=True):
        torch.testing.assert_close(one, other)
    assert isinstance(both.move.base, Motion) and both.move.base.rotation.shape == (2, 3, 3)
