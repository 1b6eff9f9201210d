"""Cameras: projection and rays undo each other, against OpenCV."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.setting import SettingError

CAMERAS = [Pinhole(41.4), Pinhole(300.0, 12.0, -3.0), Fisheye(80.0), Fisheye(60.0, 5.0, 7.0)]


@pytest.mark.parametrize("camera", CAMERAS)
@given(u=st.floats(-90, 90), v=st.floats(-90, 90))
def test_project_undoes_rays(camera, u, v):
    px = torch.tensor([[u, v]], dtype=torch.float64)
    torch.testing.assert_close(camera.project(camera.rays(px)), px, rtol=1e-9, atol=1e-6)


def test_agrees_with_opencv():
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, 1], [2, 2, 4], (200, 3))
    k = np.array([[80.0, 0, 4], [0, 80, 9], [0, 0, 1]])
    pinhole, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, None)
    fisheye, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros((3, 1)), np.zeros((3, 1)), k, np.zeros((4, 1)))
    direction = torch.from_numpy(points)
    np.testing.assert_allclose(Pinhole(80, 4, 9).project(direction), pinhole[:, 0], atol=1e-9)
    np.testing.assert_allclose(Fisheye(80, 4, 9).project(direction), fisheye[:, 0], atol=1e-9)


@pytest.mark.parametrize("camera", CAMERAS)
def test_finite_everywhere_with_finite_gradients(camera, dtype):
    direction = torch.tensor(
        [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, -1], [0, 0, 0], [1e-9, 0, 1]], dtype=dtype, requires_grad=True
    )
    px = camera.project(direction)
    px.sum().backward()
    assert px.dtype == dtype and bool(torch.isfinite(px).all()) and bool(torch.isfinite(direction.grad).all())
    assert camera.in_view(direction)[0] and not camera.in_view(direction)[1]
    centre = torch.tensor([[camera.cx_px, camera.cy_px]], dtype=dtype, requires_grad=True)
    camera.rays(centre).sum().backward()
    assert bool(torch.isfinite(centre.grad).all())


@pytest.mark.parametrize("camera", CAMERAS)
def test_gradients(camera):
    px = torch.tensor([[0.3, 0.2], [40, -20]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(camera.rays, px)
    direction = torch.tensor([[0.1, 0.2, 1], [0.5, -0.4, 0.8]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(camera.project, direction)


@pytest.mark.parametrize(("kind", "half"), [(Pinhole, np.tan(np.pi / 4)), (Fisheye, np.pi / 4)])
def test_field_of_view_and_image_camera(kind, half):
    camera = kind.from_fov(90, 100)
    assert camera.focal_px == pytest.approx(100 / half)
    edge = camera.rays(torch.tensor([[100.0, 0.0]], dtype=torch.float64))
    angle = torch.atan2(edge[..., 0], edge[..., 2]).item()
    assert angle == pytest.approx(np.pi / 4)
    image = image_camera(camera, 100, 400)
    # the image's border (half a pixel outside its last column) sees what the retina's rim sees
    torch.testing.assert_close(image.rays(torch.tensor([[399.5, 199.5]], dtype=torch.float64)), edge)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: Pinhole.from_fov(180, 100), "fov_deg = 180"),
        (lambda: Pinhole.from_fov(0, 100), "fov_deg = 0"),
        (lambda: Fisheye.from_fov(360, 100), "fov_deg = 360"),
        (lambda: Pinhole(0), "focal_px = 0"),
        (lambda: Fisheye(float("nan")), "focal_px = nan"),
    ],
)
def test_errors_name_the_setting(call, name):
    with pytest.raises(SettingError, match=name):
        call()


def test_a_pinholes_rays_are_linear_in_its_pixels():
    camera = Pinhole(70.0, 3.0, -2.0)
    px = torch.tensor([[10.0, 20.0], [-30.0, 7.0]], dtype=torch.float64)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, 0], [-0.3, 0, 0.1], [0, -0.1, 0]], dtype=torch.float64))
    got = torch.cat([px, torch.ones(2, 1, dtype=torch.float64)], -1) @ camera.turned(turn).mT
    torch.testing.assert_close(got, camera.rays(px) @ turn.mT)


@pytest.mark.parametrize("kind", [Pinhole, Fisheye])
def test_a_camera_has_finite_numbers(kind):
    for name in ("focal_px", "cx_px", "cy_px"):
        for value in (math.nan, math.inf):
            with pytest.raises(SettingError, match=f"{name} = {value}"):
                kind(**{"focal_px": 1.0, name: value})
