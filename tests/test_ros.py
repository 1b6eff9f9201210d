"""ROS 2 messages without ROS, and bags read as recordings."""

import math
import random
from types import SimpleNamespace as Message

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfovea.cloud import Cloud
from torchfovea.recordings.bag import Bag, Topics
from torchfovea.recordings.ros import (
    camera_from_info,
    cloud_data,
    gaze_from_joints,
    image_from_message,
    motion_from_odometry,
    positions_from_gaze,
)
from torchfovea.sensing.camera import Pinhole
from torchfovea.setting import SettingError

JOINTS = {"pan": "neck_pan", "tilt": "neck_tilt"}


def stamped(time_s: float) -> Message:
    return Message(stamp=Message(sec=int(time_s), nanosec=round(1e9 * (time_s - int(time_s)))))


def picture(pixels: np.ndarray, encoding: str, pad: int = 0, **more) -> Message:
    """An image message whose rows end in so many bytes of padding."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.concatenate([rows, np.full((height, pad), 7, np.uint8)], -1)
    data = rows.tobytes()
    return Message(height=height, width=width, step=rows.shape[1], encoding=encoding, data=data, is_bigendian=0, **more)


def odometry(time_s: float, place, turn: Rotation, covariance) -> Message:
    x, y, z, w = turn.as_quat()
    pose = Message(position=Message(x=place[0], y=place[1], z=place[2]), orientation=Message(x=x, y=y, z=z, w=w))
    return Message(header=stamped(time_s), pose=Message(pose=pose, covariance=np.asarray(covariance).reshape(-1)))


@pytest.mark.parametrize("pad", [0, 5])
def test_images_of_every_encoding(pad):
    rng = np.random.default_rng(0)
    small, wide = rng.integers(0, 256, (4, 6, 4), np.uint8), rng.integers(0, 65536, (4, 6, 3), np.uint16)
    for encoding, pixels, rgb in (
        ("rgb8", small[..., :3], small[..., :3] / 255),
        ("bgr8", small[..., :3], small[..., 2::-1] / 255),
        ("rgba8", small, small[..., :3] / 255),
        ("bgra8", small, small[..., 2::-1] / 255),
        ("mono8", small[..., :1], small[..., :1] / 255),
        ("rgb16", wide, wide / 65535),
        ("bgr16", wide, wide[..., ::-1] / 65535),
        ("mono16", wide[..., :1], wide[..., :1] / 65535),
    ):
        image = image_from_message(picture(pixels, encoding, pad))
        assert image.shape == (3, 4, 6)
        expected = np.broadcast_to(np.moveaxis(rgb, -1, 0), (3, 4, 6))
        np.testing.assert_allclose(image.numpy(), expected, atol=1e-7)
    turned = picture(wide.byteswap(), "rgb16")
    turned.is_bigendian = 1
    np.testing.assert_allclose(image_from_message(turned).numpy(), np.moveaxis(wide / 65535, -1, 0), atol=1e-7)
    with pytest.raises(SettingError, match=r"image encoding = yuv422"):
        image_from_message(picture(small, "yuv422"))
    with pytest.raises(SettingError, match=r"image = 96 bytes: expected 9 rows"):
        image_from_message(Message(**{**vars(picture(small, "rgba8")), "height": 9}))


def test_compressed_images():
    import cv2

    pixels = np.random.default_rng(1).integers(0, 256, (4, 6, 3), np.uint8)
    data = cv2.imencode(".png", pixels)[1].tobytes()
    image = image_from_message(Message(format="png", data=data))
    np.testing.assert_allclose(image.numpy(), np.moveaxis(pixels[..., ::-1] / 255, -1, 0), atol=1e-7)
    with pytest.raises(SettingError, match=r"image = 3 bytes"):
        image_from_message(Message(format="png", data=b"abc"))


def test_joints_both_ways():
    message = Message(name=["wheel", "neck_tilt", "neck_pan"], position=[9.0, 0.2, -0.1])
    gaze = gaze_from_joints(message, JOINTS)
    assert [float(angle) for angle in gaze] == [-0.1, 0.2, 0.0]
    assert positions_from_gaze(gaze, JOINTS) == (["neck_pan", "neck_tilt"], [-0.1, 0.2])
    with pytest.raises(SettingError, match=r"joint eyes = missing: expected one of wheel, neck_tilt, neck_pan"):
        gaze_from_joints(message, {"vergence": "eyes"})
    message.position[2] = math.nan
    with pytest.raises(SettingError, match=r"joint neck_pan = nan: expected a finite angle"):
        gaze_from_joints(message, JOINTS)


def test_odometry_against_monte_carlo():
    """The step's covariance is that of steps whose pose is drawn with odometry's own: errors that add up on the way."""
    rng = np.random.default_rng(2)
    first, second = np.diag([0.02, 0.03, 0.01, 0.02, 0.01, 0.03]) ** 2, np.diag([0.01] * 3 + [0.005] * 3) ** 2
    before, after = Rotation.from_rotvec([0.1, -0.2, 0.7]), Rotation.from_rotvec([0.2, 0.1, 1.1])
    start, shift = np.array([1.0, 2.0, 0.1]), np.array([0.5, -0.3, 0.2])
    count = 40000
    e1, e2 = (rng.multivariate_normal(np.zeros(6), c, count) for c in (first, second))
    # as integrated: the heading's error turns the way, and the step adds its own
    turn1 = Rotation.from_rotvec(e1[:, 3:])
    place = start + e1[:, :3] + turn1.apply(shift) + e2[:, :3]
    turn2 = Rotation.from_rotvec(e2[:, 3:]) * turn1
    error = np.concatenate([place - start - shift, turn2.as_rotvec()], -1)
    step = motion_from_odometry(
        odometry(0.0, start, before, first), odometry(0.1, start + shift, after, np.cov(error.T))
    )
    np.testing.assert_allclose(step.rotation.numpy(), (before.inv() * after).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(step.translation.numpy(), before.inv().apply(shift), atol=1e-12)
    back = np.kron(np.eye(2), after.inv().as_matrix())
    expected = back @ np.block([[second[3:, 3:], second[3:, :3]], [second[:3, 3:], second[:3, :3]]]) @ back.T
    np.testing.assert_allclose(step.covariance.numpy(), expected, atol=0.1 * expected.max())
    still = motion_from_odometry(odometry(0, start, before, first), odometry(1, start, before, first))
    assert float(still.covariance.abs().max()) < 1e-18


def test_a_cloud_is_what_a_viewer_reads():
    rng = np.random.default_rng(3)
    parts = [torch.from_numpy(rng.random(shape)) for shape in ((5, 3), (5, 6), (5, 3), (5,), (5,))]
    data = cloud_data(Cloud(*parts))
    record = np.dtype(
        {
            "names": [name for name, _ in data.fields],
            "formats": ["<f4"] * len(data.fields),
            "offsets": [offset for _, offset in data.fields],
            "itemsize": data.point_step,
        }
    )
    points = np.frombuffer(data.data, record)
    assert len(points) == data.width == 5
    np.testing.assert_allclose(np.stack([points[c] for c in "xyz"], -1), parts[0].numpy(), rtol=1e-6)
    np.testing.assert_allclose(points["cov_yz"], parts[1][:, 4].numpy(), rtol=1e-6)
    packed = np.ascontiguousarray(points["rgb"]).view(np.uint32)
    rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1)
    np.testing.assert_allclose(rgb / 255, parts[2].numpy(), atol=0.5 / 255 + 1e-9)


def test_a_camera_is_that_of_the_rectified_image():
    p = [300.0, 0, 159.5, 0, 0, 300.0, 119.5, 0, 0, 0, 1, 0]
    assert camera_from_info(Message(p=p, width=320, height=240)) == (Pinhole(300.0, 159.5, 119.5), (320, 240))
    with pytest.raises(SettingError, match=r"camera_info\.p = .*: expected one focal length"):
        camera_from_info(Message(p=[0.0] * 12, width=320, height=240))


# --- bags -------------------------------------------------------------------------------------------------------------

T = Topics(joints="/joint_states", odometry="/odom", pan="neck_pan", tilt="neck_tilt")


@pytest.fixture(params=["mcap", "sqlite3"])
def bag(tmp_path, request):
    """A function that writes a bag of four frames; `change` may edit the list of (topic, time, message)."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(time_s):
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=round(1e9 * (time_s % 1)))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="eyes")

    def image(time_s, grey):
        pixels = np.full((6, 8, 3), grey, np.uint8)
        return types["sensor_msgs/msg/Image"](header(time_s), 6, 8, "bgr8", 0, 24, pixels.reshape(-1))

    def info(time_s):
        roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        p = np.array([5.0, 0, 3.5, 0, 0, 5.0, 2.5, 0, 0, 0, 1, 0])
        k, r = np.array([5.0, 0, 3.5, 0, 5.0, 2.5, 0, 0, 1]), np.eye(3).reshape(-1)
        return types["sensor_msgs/msg/CameraInfo"](header(time_s), 6, 8, "plumb_bob", np.zeros(5), k, r, p, 0, 0, roi)

    def joints(time_s, pan):
        none = np.zeros(0)
        name, position = ["neck_pan", "neck_tilt"], np.array([pan, 0.1])
        return types["sensor_msgs/msg/JointState"](header(time_s), name, position, none, none)

    def odom(time_s, x):
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](x, 0.0, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        )
        grown = np.diag([1e-4 * x, 1e-4 * x, 0, 0, 0, 0]).reshape(-1)
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
        )
        full = types["geometry_msgs/msg/PoseWithCovariance"](pose, grown)
        return types["nav_msgs/msg/Odometry"](header(time_s), "base", full, twist)

    def write(change=lambda parts: None):
        parts = []
        for k in range(4):
            t = 1.0 + 0.25 * k
            parts += [(T.joints, t, joints(t - 0.01, 0.1 * k)), (T.odometry, t, odom(t, 0.5 * k))]
            parts += [(T.camera, t, info(t)), (T.left, t, image(t, 51 * k)), (T.right, t, image(t + 0.001, 51 * k))]
        change(parts)
        path = tmp_path / "bag"
        with Writer(path, version=9, storage_plugin=StoragePlugin[request.param.upper()]) as writer:
            connections = {}
            for topic, time_s, message in parts:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
                data = store.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[topic], int(1e9 * time_s), data)
        return path

    return write


def raised(error):
    raise error


def test_a_bag_is_a_recording(bag):
    path = bag()
    recording = Bag(path, T)
    frames = list(recording.frames(raised))
    assert len(recording) == len(frames) == 4
    assert recording.calibration.left == Pinhole(5.0, 3.5, 2.5) and recording.calibration.size_px == (8, 6)
    for k, frame in enumerate(frames):
        assert frame.time_s == pytest.approx(1.0 + 0.25 * k)
        assert [float(a) for a in frame.gaze] == pytest.approx([0.1 * k, 0.1, 0.0])
        torch.testing.assert_close(frame.left, torch.full((3, 6, 8), k / 5))
        torch.testing.assert_close(frame.right, frame.left)
    assert frames[0].base is None
    assert frames[2].base.translation.tolist() == pytest.approx([0.5, 0.0, 0.0])
    assert frames[2].base.covariance.diagonal().tolist() == pytest.approx([0, 0, 0, 5e-5, 5e-5, 0], abs=1e-12)
    alone = next(file for file in path.iterdir() if file.suffix != ".yaml")
    assert len(Bag(alone, T)) == 4


def test_what_a_bag_lacks_is_named(bag, tmp_path):
    path = bag(lambda parts: parts.pop(9))  # the right image of the second frame
    frames = list(Bag(path, T).frames(raised))
    assert [frame.right is None for frame in frames] == [False, True, False, False]
    with pytest.raises(
        SettingError, match=r"bag\.left = /eye: expected a topic of the bag with messages: /joint_states"
    ):
        Bag(path, Topics(left="/eye"))
    with pytest.raises(SettingError, match=r"bag.joints = None: expected the topic of pan"):
        Topics(pan="neck_pan")
    with pytest.raises(SettingError, match=r"expected a ROS 2 bag that can be read"):
        Bag(tmp_path / "none", T)
    (tmp_path / "odd.mcap").write_bytes(b"no bag at all")
    with pytest.raises(SettingError, match=r"expected a ROS 2 bag that can be read"):
        Bag(tmp_path / "odd.mcap", T)


def test_a_bags_frames_that_cannot_be_used(bag):
    def change(parts):
        parts[5][2].position[0] = math.nan
        parts[13] = (parts[13][0], parts[13][1], parts[3][2])  # the third left image is the first again

    lines = []
    frames = list(Bag(bag(change), T).frames(lambda error: lines.append(str(error))))
    assert [frame.left is None for frame in frames] == [False, True, True, False]
    assert "frame 1: joint neck_pan = nan: expected a finite angle" in lines[0]
    assert "frame 2: stamp = 1.000: expected at least 1.250, the frame's before: time runs backward" in lines[1]


def test_a_damaged_bag_is_one_line_or_a_recording(bag):
    path = bag()
    content = next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    whole, source, refused = content.read_bytes(), random.Random(0), 0
    for _ in range(60):
        at = source.randrange(len(whole))
        wrong = whole[:at], whole[:at] + source.randbytes(8) + whole[at + 8 :], whole[:at] + whole[at + 40 :]
        content.write_bytes(source.choice(wrong))
        try:
            assert len(list(Bag(path, T).frames(lambda error: None))) <= 4
        except SettingError as error:
            refused += 1
            assert "\n" not in str(error) and "expected" in str(error)
    assert refused > 20
