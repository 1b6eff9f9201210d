"""Kinematics: fixation and forward kinematics undo each other; limits are answers."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchfovea.sensing.head import Gaze, Head, can_fixate, clamp_gaze, cyclopean, eyes, fixate, to_ego
from torchfovea.setting import SettingError

VIZZY, HUMAN = Head(), Head(baseline_m=0.065, eyes_forward_m=0.08, eyes_up_m=0.06, tilt_down_deg=60, tilt_up_deg=50)


def gaze_of(pan, tilt, vergence):
    return Gaze(*(torch.tensor([math.radians(a)], dtype=torch.float64) for a in (pan, tilt, vergence)))


@given(pan=st.floats(-53, 53), tilt=st.floats(-18, 37), vergence=st.floats(0, 40))
def test_forward_kinematics_is_scipys(pan, tilt, vergence):
    gaze = gaze_of(pan, tilt, vergence)
    neck = Rotation.from_euler("ZY", [pan, tilt], degrees=True)
    optical = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose = eyes(VIZZY, gaze)
    for side, rotation, origin in ((1, pose.R_left, pose.t_left), (-1, pose.R_right, pose.t_right)):
        turned = Rotation.from_euler("y", side * vergence / 2, degrees=True).as_matrix()
        np.testing.assert_allclose(rotation[0], neck.as_matrix() @ optical @ turned, atol=1e-12)
        np.testing.assert_allclose(origin[0], neck.apply([0.048, side * 0.102, 0.124]), atol=1e-12)


@pytest.mark.parametrize("head", [VIZZY, HUMAN])
@given(pan=st.floats(-50, 50), tilt=st.floats(-15, 35), distance=st.floats(0.35, 20))
def test_both_axes_meet_at_the_fixated_point(head, pan, tilt, distance):
    rotation, origin = cyclopean(head, gaze_of(pan, tilt, 0))
    point = origin + distance * rotation[..., 2]
    gaze, reachable = fixate(head, point)
    assert reachable.item()
    pose = eyes(head, gaze)
    for r, t in ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right)):
        off = torch.linalg.cross(r[..., 2], point - t).norm()
        assert off.item() < 1e-9
    np.testing.assert_allclose([gaze.pan.item(), gaze.tilt.item()], np.radians([pan, tilt]), atol=1e-9)


def test_unreachable_is_an_answer():
    points = torch.tensor(
        [
            [-1.0, 0, 0],
            [0, 0, 2],
            [0, 0, 0],
            [0.15, 0, 0.1],
            [1, 3, 0],
            [1, 0, 1],
            [1, 0, -2],
            [torch.nan, 0, 0],
            [torch.inf, 0, 0],
            [1, 0, 0],
        ],
        dtype=torch.float64,
        requires_grad=True,
    )
    gaze, reachable = fixate(VIZZY, points)
    assert reachable.tolist() == [False] * 9 + [True]
    for angle, limit in zip(gaze, (53, 37, 40), strict=True):
        assert bool(torch.isfinite(angle).all()) and angle.abs().max() <= math.radians(limit) + 1e-12
    sum(a.sum() for a in gaze).backward()
    assert bool((points.grad[:9] == 0).all()) and bool(torch.isfinite(points.grad).all())
    assert points.grad[9].tolist() == pytest.approx([-0.3529, 1, -1], abs=1e-4)


def test_what_can_be_fixated_is_what_the_angles_say(dtype):
    """Limits of every kind, beyond a right angle too, against angles by trigonometry of its own."""
    generator = torch.Generator().manual_seed(3)
    points = 2 * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    for head in (VIZZY, Head(pan_limit_deg=150.0, tilt_up_deg=80.0, tilt_down_deg=5.0, eyes_up_m=0.4)):
        x, y, z = points.unbind(-1)
        reach = (points.square().sum(-1) - head.eyes_up_m**2).clamp(min=0).sqrt()
        distance = reach - head.eyes_forward_m
        pan = torch.rad2deg(torch.angle(torch.complex(x, y))).abs()
        tilt = torch.rad2deg(torch.asin(head.eyes_up_m / points.norm(dim=-1)) - torch.asin(z / points.norm(dim=-1)))
        vergence = torch.rad2deg(2 * torch.atan(head.baseline_m / 2 / distance.clamp(min=1e-9)))
        slack = torch.stack(
            [
                head.pan_limit_deg - pan,
                head.tilt_up_deg + tilt,
                head.tilt_down_deg - tilt,
                head.vergence_max_deg - vergence,
            ]
        ).amin(0)
        sure = (slack.abs() > 1e-3) & ((reach - head.eyes_forward_m).abs() > 1e-2)
        got = can_fixate(head, points.to(dtype))
        assert torch.equal(got[sure], ((slack > 0) & (distance > 0))[sure]) and 200 < int(got.sum()) < 3500
        assert torch.equal(got, fixate(head, points.to(dtype))[1])


def test_far_points_have_their_angles(dtype):
    """As far as numbers go: a quarter up is out of reach, 30 degrees to the side and down are not."""
    way = torch.tensor([[1.0, 0, 1.0], [0.866, 0.5, 0], [0.866, 0, -0.5]], dtype=dtype)
    for far in (1e3, 1e20, 1e37):
        gaze, reachable = fixate(VIZZY, far * way)
        assert reachable.tolist() == [False, True, True]
        angles = torch.rad2deg(torch.stack(list(gaze), -1))[1:].tolist()
        assert angles[0] == pytest.approx([30, 0, 0], abs=0.03) and angles[1] == pytest.approx([0, 30, 0], abs=0.03)


def test_points_and_gazes_of_another_kind_are_named():
    for bad in (torch.zeros(5, 2), torch.zeros(()), torch.zeros(5, 3, dtype=torch.int64)):
        with pytest.raises(SettingError, match="point = "):
            fixate(VIZZY, bad)
    zero = torch.zeros(2)
    with pytest.raises(SettingError, match=r"gaze\.dtype"):
        eyes(VIZZY, Gaze(zero, zero.double(), zero))


def test_the_authors_target_is_just_within_reach():
    gaze, reachable = fixate(VIZZY, torch.tensor([0.384, 0.419, -0.27], dtype=torch.float64))
    assert reachable.item()
    assert [round(math.degrees(a.item()), 1) for a in gaze] == [47.5, 36.8, 20.3]


def test_gradients_and_batches():
    points = torch.tensor([[1.0, 0.3, -0.2], [2, -0.5, 0.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: tuple(fixate(VIZZY, p)[0]), points)
    angles = torch.tensor([0.2, -0.3, 0.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: tuple(eyes(VIZZY, Gaze(*a))), angles)
    whole = eyes(VIZZY, fixate(VIZZY, points)[0])
    one = eyes(VIZZY, fixate(VIZZY, points[1])[0])
    for a, b in zip(whole, one, strict=True):
        torch.testing.assert_close(a[1], b)


def test_to_ego_is_the_matrix_product(dtype):
    rotation = torch.linalg.qr(torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)).Q
    vector = torch.randn(9, 2, 5, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)
    torch.testing.assert_close(to_ego(rotation, vector), vector @ rotation.mT)


def test_clamp():
    clamped = clamp_gaze(VIZZY, gaze_of(90, -90, -3))
    assert [round(math.degrees(a.item()), 6) for a in clamped] == [53, -18, 0]


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("baseline_m", 0.0),
        ("baseline_m", 204.0),
        ("pan_limit_deg", 190.0),
        ("tilt_down_deg", 90.0),
        ("vergence_max_deg", -1.0),
        ("eyes_up_m", math.inf),
        ("baseline_m", math.inf),
    ],
)
def test_errors_name_the_setting(setting, value):
    with pytest.raises(SettingError, match=f"head.{setting} = {value}"):
        Head(**{setting: value})
