"""The ROS 2 node's robot, without ROS: messages made by hand, and a clock that waits for nobody."""

import runpy
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest
import torch

from torchfovea.cloud import cloud_of
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.store import load_memory, save_memory
from torchfovea.perception import new_memory
from torchfovea.recordings.ros import cloud_data
from torchfovea.search import search
from torchfovea.sensing.head import Gaze, fixate
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World

NODE = runpy.run_path(str(Path(__file__).resolve().parents[1] / "examples" / "ros2_node.py"))


class Bench:
    """A simulated robot behind topics: commands move it, images come with the next tick of the clock, or are lost."""

    def __init__(self):
        self.world = World(build_scene(Cans(), 1), source_px=96)
        self.camera = self.world.image_camera
        self.time, self.latest, self.lost = 10.0, {}, False
        self.tell()

    def tell(self):
        names = [*NODE["JOINTS"].values()]
        self.latest["joints"] = Message(name=names, position=[float(angle) for angle in self.world.gaze])

    def command(self, names, positions):
        by_name = dict(zip(names, positions, strict=True))
        self.world.saccade(Gaze(*(torch.tensor(by_name[name]) for name in NODE["JOINTS"].values())))

    def now(self):
        self.time += 0.02
        self.tell()
        for side, frame in zip(("left", "right"), self.world.images(), strict=True):
            if not self.lost:
                self.latest[side] = self.image(frame.image)
        return self.time

    def image(self, image):
        pixels = (image.movedim(0, -1).numpy() * 255).round().astype(np.uint8)
        stamp = Message(sec=int(self.time), nanosec=int(1e9 * (self.time % 1)))
        shape = {"height": 96, "width": 96, "step": 288, "encoding": "rgb8", "is_bigendian": 0}
        return Message(header=Message(stamp=stamp), data=pixels.tobytes(), **shape)


def test_the_nodes_robot_searches_and_goes_on_next_time(tmp_path):
    bench = Bench()
    observer = NODE["observer_for"](bench.camera, (96, 96))
    cells = fibonacci_directions(800)
    memory = new_memory(observer, cells[fixate(observer.head, cells)[1]])
    robot = NODE["Robot"](observer, bench.camera, bench.latest, bench.command, now=bench.now, tick_s=0)
    glances = list(search(robot, observer, memory, 2))
    seen = glances[-1].step.memory.looks > 0
    truth = bench.world.panorama(memory.cells[seen].double()).range_m
    error = (glances[-1].step.points.mean[seen].norm(dim=-1) / truth - 1).abs()
    assert int(seen.sum()) > 80 and float(error.median()) < 0.1
    assert float(glances[1].move.degrees) > 1 and float(glances[1].move.gaze.vergence) > 0.01
    assert cloud_data(cloud_of(glances[-1].step.memory)).width == int(seen.sum())

    save_memory(tmp_path / "memory.npz", glances[-1].step.memory)
    bench.lost = True
    again = list(search(robot, observer, load_memory(tmp_path / "memory.npz"), 2))
    assert [glance.look for glance in again] == [None, None]
    for one, other in zip(again[-1].step.memory.information, glances[-1].step.memory.information, strict=True):
        assert torch.equal(one, other)


def test_a_joint_that_is_not_there_is_named():
    bench = Bench()
    bench.latest["joints"].name[0] = "wheel"
    robot = NODE["Robot"](None, bench.camera, bench.latest, bench.command, now=lambda: 0.0)
    with pytest.raises(ValueError, match="joint neck_pan = missing: expected one of wheel"):
        robot.told()
