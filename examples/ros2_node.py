"""A ROS 2 node that searches: two rectified cameras, joint states and joint commands, out comes a coloured cloud.

python examples/ros2_node.py --ros-args -r left:=/left/image_rect -r right:=/right/image_rect -r command:=/neck/command
(needs ROS 2 and torchfovea[stereo] in one environment; the topics are docs/live.md's)
"""

import threading
import time

import torch

import torchfovea as tf
from torchfovea.cloud import cloud_of, painted, unpainted
from torchfovea.looking import look_at
from torchfovea.recordings.ros import (
    camera_from_info,
    cloud_data,
    gaze_from_joints,
    image_from_message,
    positions_from_gaze,
    stamp_s,
)  # fmt: skip
from torchfovea.search import Look, Move, search
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.views import posed_views

JOINTS = {"pan": "neck_pan", "tilt": "neck_tilt", "vergence": "eyes_vergence"}
TOGETHER_S, TIMEOUT_S, AT_REST_RAD = 0.005, 0.5, 0.01


class Robot:
    """What torchfovea.search.search drives.

    `latest` holds the newest message of each topic, `command(names, positions)` sends joints on their way, and `now()`
    tells the time of the messages' stamps; waits are in steps of `tick_s`.
    """

    def __init__(self, observer, camera, latest, command, now=time.time, tick_s=0.005):
        self.observer, self.camera, self.latest, self.command = observer, camera, latest, command
        self.now, self.tick_s, self.since = now, tick_s, 0.0

    def wait(self, done):
        """Until something is so; whether it is, in time."""
        until = self.now() + TIMEOUT_S
        while not done() and self.now() < until:
            time.sleep(self.tick_s)
        return done()

    def saccade(self, gaze):
        start, before = self.now(), gaze_from_joints(self.latest["joints"], JOINTS)
        self.command(*positions_from_gaze(gaze, JOINTS))
        self.wait(lambda: max(abs(float(a - b)) for a, b in zip(self.told(), gaze, strict=True)) < AT_REST_RAD)
        told, self.since = self.told(), self.now()
        turned = torch.rad2deg(torch.stack([a - b for a, b in zip(told, before, strict=True)]).norm())
        return Move(told, self.since - start, float(turned))

    def told(self):
        return gaze_from_joints(self.latest["joints"], JOINTS)

    def look(self, gaze, generator):
        """Both images of one moment after the head came to rest; None where none came in time."""
        if not self.wait(self.fresh):
            return None
        left, right = (image_from_message(self.latest[side]) for side in ("left", "right"))
        camera, rig = self.camera, rig_at(self.observer.head, gaze)
        views = posed_views(left, right, camera, camera, rig, (camera.cx_px, camera.cy_px))
        look: Look = look_at(self.observer, views, Matcher(SGBM()), generator)
        return look

    def fresh(self):
        if "left" not in self.latest or "right" not in self.latest:
            return False
        left, right = stamp_s(self.latest["left"]), stamp_s(self.latest["right"])
        return left >= self.since and abs(left - right) <= TOGETHER_S


def observer_for(camera, size_px, head=None):
    """An observer whose retina spans the images."""
    retina = tf.LogPolar(8000)
    scale = 2 * retina.radius_px / min(size_px)
    eye = camera.scaled(scale, (-scale * camera.cx_px, -scale * camera.cy_px))
    return tf.Observer(head=head or tf.Head(), camera=eye, retina=retina)


def main():
    """Subscribe, search without end, publish the cloud."""
    import rclpy
    from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2, PointField

    rclpy.init()
    node, latest = rclpy.create_node("torchfovea"), {}
    topics = {"left": Image, "right": Image, "camera_info": CameraInfo, "joints": JointState}
    for name, kind in topics.items():
        node.create_subscription(kind, name, lambda message, name=name: latest.__setitem__(name, message), 5)
    commands, clouds = node.create_publisher(JointState, "command", 5), node.create_publisher(PointCloud2, "cloud", 5)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    while rclpy.ok() and not {"camera_info", "joints"} <= set(latest):
        time.sleep(0.1)
    camera, size_px = camera_from_info(latest["camera_info"])
    observer = observer_for(camera, size_px)
    cells = tf.sample(tf.direction_mixture([1.0], [[0.0, 0, 0]], [[1.0, 1, 1]]), 20000, generator=0)
    cells = cells[tf.fixate(observer.head, cells)[1]]
    robot = Robot(observer, camera, latest, lambda names, at: commands.publish(JointState(name=names, position=at)))
    memory = tf.new_memory(observer, cells)
    colours = unpainted(memory)
    for glance in search(robot, observer, memory, 1_000_000):
        step = glance.step
        if glance.look is not None:
            pose = tf.eyes(observer.head, glance.move.gaze)
            seen, image = step.memory.looks > 0, glance.look.pictures.left
            colours = painted(colours, seen, step.points.mean, image, camera, pose)
            data = cloud_data(cloud_of(step.memory, colours))
            fields = [PointField(name=n, offset=o, datatype=PointField.FLOAT32, count=1) for n, o in data.fields]
            cloud = PointCloud2(height=1, width=data.width, fields=fields, point_step=data.point_step, data=data.data)
            cloud.row_step, cloud.is_dense, cloud.header.frame_id = data.width * data.point_step, True, "ego"
            cloud.header.stamp = node.get_clock().now().to_msg()
            clouds.publish(cloud)


if __name__ == "__main__":
    main()
