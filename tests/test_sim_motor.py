"""The head in MuJoCo is the head of torchfovea.sensing.head, and both motors get it there."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.setting import SettingError
from torchfovea.sim.head_model import JOINTS
from torchfovea.sim.motor import InstantMotor, turned_deg
from torchfovea.sim.scene import AttentionWorld, build_scene
from torchfovea.sim.servo import ServoMotor
from torchfovea.sim.world import World

GAZES = [(0, 0, 0), (50, 30, 35), (-52, -17, 0), (-49, -15, 2), (10, 36, 39)]
HEADS = {"vizzy": Head(), "human": Head(0.063, 0.08, 0.1, 1.5)}


def gaze_of(degrees):
    return Gaze(*(torch.tensor(math.radians(a), dtype=torch.float64) for a in degrees))


@pytest.fixture(scope="module", params=HEADS)
def scene(request):
    return build_scene(AttentionWorld(), 0, HEADS[request.param])


@pytest.mark.parametrize("degrees", GAZES)
def test_mujocos_cameras_are_where_the_kinematics_say(scene, degrees):
    gaze = gaze_of(degrees)
    data = mujoco.MjData(scene.model)
    pan, tilt, vergence = (float(a) for a in gaze)
    for name, angle in zip(JOINTS, (pan, tilt, vergence / 2, -vergence / 2), strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(scene.model, data)
    pose = eyes(scene.head, gaze)
    base = np.array([0.0, 0.0, scene.head.ego_height_m])
    for name, rotation, centre in zip(JOINTS[2:], pose[::2], pose[1::2], strict=True):
        camera = data.cam(name)
        # MuJoCo's cameras look along −z with y up
        assert np.abs(camera.xmat.reshape(3, 3) * [1, -1, -1] - rotation.numpy()).max() < 1e-12
        assert np.abs(camera.xpos - base - centre.numpy()).max() < 1e-12


def test_servos_settle_where_they_were_sent(scene):
    world = World(scene, motor="physics", source_px=16)
    for degrees in GAZES[1:]:
        command = gaze_of(degrees)
        before = world.gaze
        moved = world.saccade(command)
        for wanted, got in zip(command, moved.gaze, strict=True):
            assert abs(math.degrees(wanted - got)) < 0.05
        # the pose that the joints give is the simulated cameras'
        data = world.motor.data
        mujoco.mj_forward(scene.model, data)
        pose = eyes(scene.head, moved.gaze)
        for name, rotation in zip(JOINTS[2:], pose[::2], strict=True):
            assert np.abs(data.cam(name).xmat.reshape(3, 3) * [1, -1, -1] - rotation.numpy()).max() < 2e-5
        assert 0.01 < moved.seconds < 1.0
        assert abs(moved.degrees - turned_deg(scene.head, before, moved.gaze)) < 1e-9
        assert world.gaze == moved.gaze


def test_servos_start_from_where_a_reset_left_the_head(scene):
    world = World(scene, motor="physics", source_px=16)
    first = world.saccade(gaze_of((30, 10, 10)))
    world.reset()
    again = world.saccade(gaze_of((30, 10, 10)))
    assert abs(first.seconds - again.seconds) < 2e-3
    assert all(abs(a - b) < 1e-4 for a, b in zip(first.gaze, again.gaze, strict=True))


def test_larger_saccades_take_longer(scene):
    for motor in ("physics", "instant"):
        seconds = []
        for size in (2, 10, 30, 50):
            world = World(scene, motor=motor, source_px=16)
            seconds.append(world.saccade(gaze_of((size, 0, 0))).seconds)
        assert seconds == sorted(seconds) and seconds[0] < seconds[-1]


def test_a_head_that_cannot_settle_says_so(scene):
    motor = ServoMotor(scene.model, timeout_s=0.02)
    with pytest.raises(SettingError, match=r"motor.timeout_s = 0.02: .* deg away"):
        motor.move(scene.head, gaze_of((0, 0, 0)), gaze_of((50, 0, 0)))


def test_instant_motor_by_hand():
    motor, head = InstantMotor(), Head()
    still = motor.move(head, gaze_of((5, 5, 5)), gaze_of((5, 5, 5)))
    assert still.seconds == 0 and still.degrees < 1e-9
    # main sequence: each eye turns half of 20 degrees
    assert abs(motor.duration_s(gaze_of((0, 0, 0)), gaze_of((0, 0, 20))) - (0.021 + 0.022)) < 1e-12
    # 30 deg at 200 deg/s and 1500 deg/s²: 2·(200/1500) of ramps over 26.67 deg, then the rest at top speed
    ramp = 200 / 1500
    assert abs(motor.duration_s(gaze_of((0, 0, 0)), gaze_of((30, 0, 0))) - (2 * ramp + (30 - 200 * ramp) / 200)) < 1e-9
    assert abs(motor.duration_s(gaze_of((0, 0, 0)), gaze_of((0, 6, 0))) - 2 * math.sqrt(6 / 1500)) < 1e-9
    assert abs(turned_deg(head, gaze_of((0, 0, 0)), gaze_of((30, 0, 9))) - 30) < 1e-9
    assert abs(turned_deg(head, gaze_of((10, -10, 0)), gaze_of((10, 30, 9))) - 40) < 1e-9


def test_what_was_executed_is_exactly_what_was_commanded(scene):
    world = World(scene, source_px=16)
    command = gaze_of((12.3, 4.5, 6.7))
    assert all(torch.equal(a, b) for a, b in zip(world.saccade(command).gaze, command, strict=True))
    # beyond the limits the head stops at them
    moved = world.saccade(gaze_of((80, -60, 90)))
    assert abs(math.degrees(moved.gaze.pan) - 53) < 1e-9
    assert abs(math.degrees(moved.gaze.tilt) + 18) < 1e-9
    assert abs(math.degrees(moved.gaze.vergence) - 40) < 1e-9


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda s: InstantMotor(eye_base_s=-1), "motor.eye_base_s"),
        (lambda s: InstantMotor(neck_speed_deg_s=0), "motor.neck_speed_deg_s"),
        (lambda s: ServoMotor(s.model, settled_deg=0), "motor.settled_deg"),
        (lambda s: World(s, motor="magic"), "motor"),
        (lambda s: World(s, renderer="magic"), "renderer"),
        (lambda s: World(s, source_px=1), "source_px"),
        (lambda s: World(s, radius_px=0), "radius_px"),
        (lambda s: World(s, head=Head(baseline_m=0.5)), "head"),
        (lambda s: World(s).saccade(Gaze(torch.tensor(math.nan), torch.tensor(0.0), torch.tensor(0.0))), "gaze.pan"),
        (lambda s: World(s).fixated(Gaze(torch.zeros(2), torch.zeros(2), torch.zeros(2))), "gaze.pan"),
    ],
)
def test_bad_settings_are_named(scene, build, named):
    with pytest.raises(SettingError, match=named):
        build(scene)
