"""Real lenses: against OpenCV and kornia both ways, where they fold over, and that a retina looks through them once."""

import math

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.camera import distort_points_kannala_brandt
from test_views import AWAY, NORMAL, drawn, turned

from torchfovea.sensing.camera import Camera, Pinhole, image_camera
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import posed
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep
from torchfovea.stereo.views import posed_views

SIZE = (480, 640)
BROWN = {
    "webcam": (-0.282, 0.0389, 0.00121, -0.000126, 0.119),
    "barrel": (-0.3, 0.09, 0.001, -0.002),
    "pincushion": (0.3, -0.1, 0.0, 0.0, 0.02),
    "rational": (0.1, -0.2, 0.001, 0.001, 0.01, 0.2, -0.1, 0.02),
    "none": (),
}
KANNALA = {
    "plain": (0.0, 0.0, 0.0, 0.0),
    "wide": (-0.01, 0.02, -0.005, 0.0003),
    "folding": (0.1, -0.05, 0.01, -0.002),
    "strong": (-0.1, 0.0, 0.0, 0.0),
}
LENSES = [BrownConrady(533.4, 530.1, 342.5, 234.7, k) for k in BROWN.values()]
LENSES += [KannalaBrandt(200.0, 195.0, 330.0, 236.0, k) for k in KANNALA.values()]
NAMES = [*BROWN, *KANNALA]


def matrix(lens):
    return np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])


def pixels(step=7, size=SIZE):
    row, column = (torch.arange(0, n, step, dtype=torch.float64) for n in size)
    return torch.stack(torch.broadcast_tensors(column, row[:, None]), -1).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_projects_as_opencv_does(lens):
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.6, -0.5, 1], [0.6, 0.5, 1], (200, 3)) * rng.uniform(0.5, 4, (200, 1))
    still, k = np.zeros((3, 1)), np.array(lens.distortion, dtype=float)
    if isinstance(lens, BrownConrady):
        place = cv2.projectPoints(points, still, still, matrix(lens), k if k.size else None)[0][:, 0]
    else:
        place = cv2.fisheye.projectPoints(points[:, None], still, still, matrix(lens), k)[0][:, 0]
    got = lens.project(torch.from_numpy(points))
    np.testing.assert_allclose(got, place, atol=1e-9)
    single = lens.project(torch.from_numpy(points).float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, place, atol=1e-3)


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_rays_are_what_opencv_undistorts(lens):
    px, k = pixels(40), np.array(lens.distortion, dtype=float)
    rays = lens.rays(px)
    seen = rays[:, 2] > 0.3
    px, rays = px[seen], rays[seen]
    pairs = np.ascontiguousarray(px.numpy()[:, None])
    if isinstance(lens, BrownConrady):
        iterated = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of OpenCV 4, and of 5
        tight = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-13)
        plane = iterated(pairs, matrix(lens), k if k.size else np.zeros(4), R=None, P=None, criteria=tight)
    else:
        plane = cv2.fisheye.undistortPoints(pairs, matrix(lens), k)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane[:, 0], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_every_pixel_comes_back_or_looks_straight_behind(lens, dtype):
    px = pixels().to(dtype)
    rays = lens.rays(px)
    seen = lens.in_view(rays)
    assert rays.dtype == dtype and bool(torch.isfinite(rays).all()) and seen.double().mean() > 0.5
    torch.testing.assert_close(
        lens.project(rays)[seen], px[seen], rtol=0, atol=1e-8 if dtype == torch.float64 else 0.01
    )
    assert torch.equal(rays[~seen], rays.new_tensor([0, 0, -1.0]).expand((~seen).sum(), 3))
    everywhere = lens.project(torch.randn(500, 3, dtype=dtype, generator=torch.Generator().manual_seed(0)))
    assert bool(torch.isfinite(everywhere).all())


def test_nothing_is_seen_beyond_the_fold():
    """r(1 − r²/3) turns around at r = 1, and θ(1 − θ²/3) at 1 rad: what is farther out would land inside again."""
    lens, fish = (
        BrownConrady(100.0, 100.0, 0.0, 0.0, (-1 / 3, 0, 0, 0)),
        KannalaBrandt(100, 100, 0, 0, (-1 / 3, 0, 0, 0)),
    )
    assert lens.fold == pytest.approx(1) and fish.fold_rad == pytest.approx(1)
    near, far = torch.tensor([[0.99, 0, 1], [0, 0.5, 1]]), torch.tensor([[1.01, 0, 1], [1.5, 0, 1]])
    behind = torch.tensor([[0, 0, -1], [1.0, 0, -1]])
    assert lens.in_view(near).all() and not lens.in_view(torch.cat([far, behind])).any()
    near[:, :2], far[:, :2] = near[:, :2].tan(), far[:, :2].tan()
    assert fish.in_view(near).all() and not fish.in_view(torch.cat([far, behind])).any()
    rays = lens.rays(torch.tensor([[66.0, 0], [67.0, 0]]))  # the farthest place is 66.7
    assert rays[0, 2] == 1 and 0.8 < rays[0, 0] < 1 and rays[1].tolist() == [0, 0, -1]
    assert fish.rays(torch.tensor([[67.0, 0.0]])).tolist() == [[0, 0, -1]]


def test_a_fisheye_sees_behind_itself():
    lens = KannalaBrandt(100.0, 110.0, 3.0, 4.0, (0.02, -0.003, 0.0002, 0.0))
    angle = torch.linspace(0.1, 2.2, 22, dtype=torch.float64)
    directions = torch.stack([angle.sin(), 0 * angle, angle.cos()], -1)
    place = lens.project(directions)
    assert lens.in_view(directions).all() and (place[:, 0].diff() > 0).all()
    torch.testing.assert_close(lens.rays(place), directions)
    ahead = angle < 1.5
    params = torch.tensor([100.0, 110, 3, 4, 0.02, -0.003, 0.0002, 0], dtype=torch.float64)
    plane = directions[ahead, :2] / directions[ahead, 2:]
    torch.testing.assert_close(place[ahead], distort_points_kannala_brandt(plane, params))


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_gradients(lens):
    px = torch.tensor([[300.0, 200], [lens.cx_px, lens.cy_px], [470, 350]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lens.rays, px)
    assert torch.autograd.gradcheck(lens.project, lens.rays(px).detach().requires_grad_())
    beyond = torch.tensor([[1e4, 1e4], [0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    lens.rays(beyond).sum().backward()
    assert bool(torch.isfinite(beyond.grad).all())
    astray = torch.tensor([[0, 0, -1], [0, 0, 0], [1, 0, 0], [1, 1, -1]], dtype=torch.float64, requires_grad=True)
    lens.project(astray).sum().backward()
    assert bool(torch.isfinite(astray.grad).all())


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_the_same_camera_in_other_pixels(lens):
    assert isinstance(lens, Camera) and hash(lens) == hash(lens.scaled(1.0, (0.0, 0.0)))
    px = pixels(90)
    torch.testing.assert_close(lens.scaled(0.3, (-7.0, 5.0)).rays(0.3 * px + px.new_tensor([-7, 5])), lens.rays(px))
    image = image_camera(lens.scaled(1.0, (-lens.cx_px, -lens.cy_px)), 100.0, 50)
    assert image.focal_px == pytest.approx(lens.focal_px / 4) and image.cx_px == image.cy_px == 24.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BrownConrady(0.0, 1.0, 0.0, 0.0), "fx_px = 0.0"),
        (lambda: BrownConrady(1.0, math.nan, 0.0, 0.0), "fy_px = nan"),
        (lambda: BrownConrady(1.0, 1.0, math.inf, 0.0), "cx_px = inf"),
        (lambda: BrownConrady(1.0, 1.0, 0.0, 0.0, (0.1,)), r"distortion = \(0.1,\)"),
        (lambda: BrownConrady(1.0, 1.0, 0.0, 0.0, (0.1, math.nan, 0.0, 0.0)), "distortion = nan: expected a number"),
        (lambda: BrownConrady(1.0, 1.0, 0.0, 0.0, (0.1, math.inf, 0.0, 0.0)), "finite"),
        (lambda: KannalaBrandt(1.0, -1.0, 0.0, 0.0), "fy_px = -1.0"),
        (lambda: KannalaBrandt(1.0, 1.0, 0.0, 0.0, (0.1,)), "k1, k2, k3, k4"),
    ],
)
def test_errors_name_the_number(make, message):
    with pytest.raises(SettingError, match=message):
        make()


# ------------------------------------------------------------------------------------------------- pairs, as they are

ROTATION, SHIFT = turned(-0.12, 0.03, 0.04), torch.tensor([0.15, 0.01, -0.02], dtype=torch.float64)
PAIRS = {
    "ideal": (Pinhole(300.0, 176.0, 122.0), Pinhole(310.0, 160.0, 136.0)),
    "brown": (
        BrownConrady(300.0, 297.0, 176.0, 122.0, (-0.28, 0.04, 0.0012, -0.0001, 0.02)),
        BrownConrady(313.0, 310.0, 160.0, 136.0, (-0.3, 0.14, -0.0005, 0.0001, -0.05)),
    ),
    "fisheye": (
        KannalaBrandt(280.0, 275.0, 176.0, 122.0, (-0.01, 0.02, -0.005, 0.0003)),
        KannalaBrandt(270.0, 272.0, 160.0, 136.0, (0.02, -0.01, 0.001, 0.0)),
    ),
}


def judged(name, params):
    """Of a verging pair through its lenses: share of valid points, inverse-range errors over σ, and in 1/m."""
    (left, right), retina = PAIRS[name], LogPolar(2000)
    same, here = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    images = drawn(left, same, here, (260, 340)), drawn(right, ROTATION, SHIFT, (260, 340))
    views = posed_views(*images, left, right, posed(ROTATION, SHIFT))
    matches, _ = Matcher(params, 0.5)(views, retina, Budget())
    camera = views.cameras(retina)
    points = observe(matches, Eyes(same, here, ROTATION, SHIFT), camera, retina.width_px(matches.left_px) / 2)
    rays = camera[0].rays(matches.left_px)
    truth = (rays @ NORMAL) / AWAY / rays.norm(dim=-1)
    error = (points.mean[:, 2] - truth)[points.valid]
    return points.valid.double().mean(), error / points.cov[points.valid, 5].sqrt(), error.abs().median()


@pytest.mark.parametrize("params", [SGBM(), Sweep()], ids=["sgbm", "sweep"])
def test_a_raw_verging_pair_gives_what_the_ideal_one_gives(params):
    """Images drawn through two lenses that differ, never undistorted: as many points, as exact, as honest."""
    valid, z, median = judged("ideal", params)
    for name in ("brown", "fisheye"):
        seen, score, error = judged(name, params)
        assert abs(seen - valid) < 0.02 and error < 1.6 * median and score.abs().median() < 2
        for level in (0.674, 1.96):
            inside = (score.abs() < level).double().mean()
            assert abs(inside - (z.abs() < level).double().mean()) < 0.04
