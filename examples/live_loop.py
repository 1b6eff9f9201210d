"""A live search: a robot's two cameras and its neck, here the simulator's; replace `Robot` by yours (docs/live.md).

python examples/live_loop.py
"""

import torch

import torchfovea as tf
from torchfovea.search import Look, Move, search
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.views import verged_views


class Robot:
    def __init__(self, observer: tf.Observer, seed: int = 1) -> None:
        self.observer = observer
        scene = build_scene(Cans(), seed, observer.head)
        self.world = World(scene, camera=observer.camera, source_px=200)

    def saccade(self, gaze: tf.Gaze) -> Move:  # turn the neck and the eyes, wait, read the encoders
        moved = self.world.saccade(gaze)
        return Move(moved.gaze, moved.seconds, moved.degrees)

    def look(self, gaze: tf.Gaze, generator: object) -> Look:  # grab both images and match them
        left, right = (frame.image for frame in self.world.images())
        rig, retina = rig_at(self.observer.head, gaze), self.observer.retina
        return Look(*match_sgbm(verged_views(left, right, rig, self.observer.camera, retina.radius_px), retina))


observer = tf.Observer(camera=tf.Pinhole.from_fov(90, 100))
mixture = tf.direction_mixture(weights=[1.0], means=[[0.0, 0, 0]], covariances=[[1.0, 1, 1]])
cells = tf.sample(mixture, 1000, generator=0, reachable=lambda directions: tf.fixate(observer.head, directions)[1])
robot, generator = Robot(observer), torch.Generator().manual_seed(0)
for glance in search(robot, observer, tf.new_memory(observer, cells), 8, generator):
    pan, tilt, _ = torch.rad2deg(torch.stack(glance.move.gaze)).tolist()
    point = glance.step.points.mean[glance.step.cell].tolist()
    print(f"looked at pan {pan:.0f}°, tilt {tilt:.0f}°; next at", " ".join(f"{x:.2f}" for x in point), "m")
