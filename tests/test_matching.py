"""Matching against synthetic pairs whose correspondences are known: textured planes, ray-traced in this file."""

import math
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from torchfovea.commands.shared.config import conf_dir
from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.sensing.correspondence import Budget, eye_sigma_px
from torchfovea.sensing.retina import LogPolar, Uniform
from torchfovea.setting import SettingError
from torchfovea.stereo.external import External
from torchfovea.stereo.maps import match_disparity, read_values
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.rig import posed, verged
from torchfovea.stereo.sgbm import SGBM, disparity_sgbm
from torchfovea.stereo.sweep import Sweep
from torchfovea.stereo.views import rectified_views, verged_views

BASELINE = 0.204
SIZE = 240
PINHOLE, FISHEYE = Pinhole.from_fov(90, 100), Fisheye.from_fov(120, 100)
RETINAS = [LogPolar(12_000), Uniform(12_000)]
FACING = ((0.0, 0.0, 1.0), 0.83)
SLANTED = ((-0.3, -0.15, 1.0), 0.95)


def turn(angle):
    """About the optical y axis: to the right if positive."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def numpy_rays(camera, px):
    a, b = (px[..., 0] - camera.cx_px) / camera.focal_px, (px[..., 1] - camera.cy_px) / camera.focal_px
    if isinstance(camera, Pinhole):
        return np.stack([a, b, np.ones_like(a)], -1)
    angle = np.hypot(a, b)
    return np.stack([a * np.sinc(angle / np.pi), b * np.sinc(angle / np.pi), np.cos(angle)], -1)


def numpy_project(camera, points):
    x, y, z = np.moveaxis(points, -1, 0)
    if isinstance(camera, Pinhole):
        u, v = x / z, y / z
    else:
        side = np.maximum(np.hypot(x, y), 1e-12)
        u, v = x / side * np.arctan2(side, z), y / side * np.arctan2(side, z)
    return np.stack([camera.focal_px * u + camera.cx_px, camera.focal_px * v + camera.cy_px], -1)


def hit(plane, origin, directions):
    """Points of the plane n·X = d on rays; NaN where a ray never meets it."""
    normal, distance = np.array(plane[0]), plane[1]
    slope = directions @ normal
    length = (distance - origin @ normal) / np.where(np.abs(slope) > 1e-6, slope, np.nan)
    return origin + np.where(length > 0, length, np.nan)[..., None] * directions


def texture(points, seed):
    rng = np.random.default_rng(seed)
    value = np.zeros(points.shape[:-1])
    for _ in range(60):
        wave = 2 * np.pi * rng.uniform(1.5, 15) * (lambda v: v / np.linalg.norm(v))(rng.normal(size=3))
        value += np.cos(points @ wave + rng.uniform(0, 2 * np.pi))
    return np.clip(0.5 + 0.06 * value, 0, 1)


def look(camera, rotation, origin, plane, size=SIZE, seed=0, box=None):
    """A grey image (1, H, W); a box is a nearer, facing patch: (x0, x1, y0, y1, z)."""
    view = image_camera(camera, 100.0, size)
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).astype(float)
    directions = numpy_rays(view, grid) @ rotation.T
    points = np.nan_to_num(hit(plane, origin, directions), nan=50.0)
    image = texture(points, seed)
    if box:
        near = hit(((0.0, 0.0, 1.0), box[4]), origin, directions)
        on = (near[..., 0] > box[0]) & (near[..., 0] < box[1]) & (near[..., 1] > box[2]) & (near[..., 1] < box[3])
        image = np.where(on, texture(np.nan_to_num(near), seed + 1), image)
    return torch.as_tensor(image, dtype=torch.float32)[None]


def pair(camera, vergence, plane, **options):
    """Images of both eyes; X_C = R_y(±θ/2) X_eye ∓ (b/2, 0, 0)."""
    left = np.array([-BASELINE / 2, 0, 0])
    return (
        look(camera, turn(vergence / 2), left, plane, **options),
        look(camera, turn(-vergence / 2), -left, plane, **options),
    )


def views_of(left, right, vergence, camera=PINHOLE):
    """Two eyes' images, whose retinas have a radius of 100 px."""
    return verged_views(left, right, verged(vergence, BASELINE), camera, 100.0)


def truth(camera, vergence, plane, left_px):
    """The right eye's places, and the points in C."""
    left = np.array([-BASELINE / 2, 0, 0])
    points = hit(plane, left, numpy_rays(camera, left_px) @ turn(vergence / 2).T)
    right = numpy_project(camera, (points + left) @ turn(-vergence / 2))
    return right, points


# -------------------------------------------------------------------------------------------------------- two eyes


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("plane", [FACING, SLANTED], ids=["facing", "slanted"])
@pytest.mark.parametrize("vergence", [0.0, 0.25, 0.6])
@pytest.mark.parametrize("retina", RETINAS, ids=["log_polar", "uniform"])
def test_matches_a_plane(camera, plane, vergence, retina):
    left, right = pair(camera, vergence, plane)
    found, disparity = match_sgbm(views_of(left, right, vergence, camera), retina)
    left_px, right_px, valid = found.left_px.numpy(), found.right_px.numpy(), found.valid.numpy()
    expected, points = truth(camera, vergence, plane, left_px.astype(float))
    with np.errstate(invalid="ignore"):
        seen = (points[:, 2] > 0.32) & (points[:, 2] < 5) & (np.hypot(*expected.T) < 99)
    assert seen.mean() > 0.5
    source_px = 200 / SIZE
    error = np.abs(right_px - expected)[valid & seen]
    assert (valid & seen).sum() / seen.sum() > 0.85
    assert (valid & ~seen).sum() < 0.05 * valid.sum()
    assert np.median(error[:, 0]) < 0.2 * source_px and np.median(error[:, 1]) < 0.05 * source_px
    sigma = np.hypot(found.left_sigma_px.numpy(), found.right_sigma_px.numpy())[valid & seen]
    assert np.mean(error[:, 0] < 3 * sigma) > 0.95
    # the dense disparity tells the plane's depth, too
    u, v = (240, 200) if camera is PINHOLE else (disparity.disparity.shape[1] // 2, disparity.disparity.shape[0] // 2)
    rows, columns = np.nonzero(disparity.valid.numpy())
    rays = numpy_rays(disparity.camera, np.stack([columns, rows], -1).astype(float))
    depth = hit(plane, np.array([-BASELINE / 2, 0, 0]), rays)[:, 2]
    ours = disparity.depth_m().numpy()[rows, columns]
    central = np.hypot(columns - u, rows - v) < 80
    assert np.nanmedian(np.abs(ours / depth - 1)[central]) < 0.025


@pytest.mark.parametrize(
    "exposure", [(1.0, 0.0, 1.0), (0.7, 0.05, 1.0), (1.0, 0.0, 1.8)], ids=["alike", "darker", "gamma"]
)
def test_whole_pixels_draw_no_disparity(exposure):
    """Block matching alone errs by up to 0.2 px, by the phase of the true disparity; the readings do not."""
    plane, retina, focal = ((-0.2, 0.0, 1.0), 1.0), Uniform(12_000), PINHOLE.focal_px * SIZE / 200
    left, right = pair(PINHOLE, 0.0, plane)
    found, _ = match_sgbm(views_of(left, exposure[0] * right ** exposure[2] + exposure[1], 0.0), retina)
    expected, points = truth(PINHOLE, 0.0, plane, found.left_px.double().numpy())
    error = (expected - found.right_px.double().numpy())[:, 0] * SIZE / 200
    phase = np.floor(8 * (focal * BASELINE / points[:, 2] % 1)).astype(int)
    near = found.valid.numpy() & (np.hypot(*found.left_px.numpy().T) < 60) & (np.hypot(*expected.T) < 95)
    medians = [np.median(error[near & (phase == k)]) for k in range(8)]
    assert min(np.bincount(phase[near])) > 50
    assert found.valid[np.hypot(*expected.T) < 95].float().mean() > 0.97
    assert np.abs(medians).max() < 0.05


@pytest.mark.parametrize("half_from_px", [0.1, 3.0], ids=["all_wide", "fovea_narrow"])
def test_wide_fields_are_matched_at_half_the_size(half_from_px):
    """Beside the truth, on a slanted plane, by two eyes and by parallel cameras."""
    params, retina = SGBM(half_from_px=half_from_px), RETINAS[0]
    left, right = pair(PINHOLE, 0.25, SLANTED)
    found, _ = match_sgbm(views_of(left, right, 0.25), retina, params)
    expected, points = truth(PINHOLE, 0.25, SLANTED, found.left_px.double().numpy())
    with np.errstate(invalid="ignore"):
        seen = (points[:, 2] > 0.32) & (points[:, 2] < 5) & (np.hypot(*expected.T) < 99)
    valid = found.valid.numpy()
    error = np.abs(found.right_px.double().numpy() - expected)[:, 0]
    assert (valid & seen).sum() / seen.sum() > 0.85 and (valid & ~seen).sum() < 0.05 * valid.sum()
    assert np.median(error[valid & seen]) < 0.2 * 200 / SIZE
    # within what is matched as it is, on its border and beyond: of one piece
    eccentricity = np.hypot(*found.left_px.numpy().T)
    for inner, outer in ((0, 20), (30, 45), (45, 60), (70, 99)):
        ring = valid & seen & (eccentricity >= inner) & (eccentricity < outer)
        assert np.quantile(error[ring], 0.9) < 0.5 * retina.width_px(torch.tensor([float(outer), 0.0])) + 0.3
    images, cameras, true = rectified_pair()
    _, disparity = match_sgbm(rectified_views(*images, *cameras, 0.15), retina, params)
    error = (disparity.disparity - torch.as_tensor(true))[disparity.valid].abs()
    assert error.quantile(0.9) < 1.0 and disparity.valid.float().mean() > 0.45


def test_no_field_is_wide_enough_for_half_the_size():
    images, cameras, _ = rectified_pair()
    views = rectified_views(*images, *cameras, 0.15)
    (ours, _), (plain, _) = (match_sgbm(views, Uniform(2000), SGBM(half_from_px=width)) for width in (99.0, None))
    assert torch.equal(ours.right_px, plain.right_px) and torch.equal(ours.valid, plain.valid)


def test_what_a_near_thing_hides_is_no_more_believed_at_half_the_size():
    wall, thing = ((0.0, 0.0, 1.0), 1.6), (-0.2, 0.5, -0.6, 0.6, 0.8)
    left, right = pair(PINHOLE, 0.0, wall, box=thing)
    views = views_of(left, right, 0.0)
    shares = []
    for half_from_px in (None, 3.0):
        found, _ = match_sgbm(views, RETINAS[0], SGBM(half_from_px=half_from_px))
        # the strip of the background left of the thing that only the left eye sees
        x = found.left_px.double().numpy()[:, 0] / PINHOLE.focal_px
        edge, rows = (-0.2 + BASELINE / 2) / 0.8, np.abs(found.left_px.numpy()[:, 1]) < 40
        hidden = rows & (x < edge) & (x > edge - BASELINE * (1 / 0.8 - 1 / 1.6))
        shares.append(found.valid.numpy()[hidden].mean())
    assert shares[1] < shares[0] + 0.1 and shares[1] < 0.5


def test_halved_parameters_mean_the_same():
    half = SGBM(block_px=7, speckle_px=50, first_disparity_px=-3, disparities=80).halved()
    assert (half.block_px, half.speckle_px, half.first_disparity_px, half.disparities) == (3, 13, -2, 48)
    assert half.penalties == (72, 288) and SGBM(left_right_px=-1).halved().left_right_px < 0


def test_the_largest_block_that_is_allowed_does_not_wrap_around():
    """Random squares of full contrast, where wrong matches cost most."""
    generator = np.random.default_rng(0)
    squares = np.kron(generator.random((50, 120)) < 0.5, np.ones((2, 2))).astype(np.float32)
    for params in (SGBM(block_px=11), SGBM(block_px=13, smooth_small=8, smooth_large=99)):
        disparity, valid = disparity_sgbm(squares[:, :-10].copy(), squares[:, 10:].copy(), (-16, 16), params)
        inner = np.s_[20:-20, 40:-40]
        assert valid[inner].mean() > 0.99
        assert np.abs(disparity[inner][valid[inner]] - 10).max() < 0.5


def test_the_defaults_are_those_of_the_commands():
    folder = Path(conf_dir()) / "matcher"
    for name, params in (
        ("sgbm", SGBM()),
        ("sgbm_authors", SGBM.authors),
        ("sweep", Sweep()),
        ("external", External()),
    ):
        own = asdict(params)
        told = {k: v for k, v in OmegaConf.load(folder / f"{name}.yaml").items() if k in own}
        assert told == {k: own[k] for k in told} and len(told) > 4


def test_float64_and_colour_and_bytes_agree():
    left, right = pair(PINHOLE, 0.2, FACING)
    vergence = torch.tensor(0.2)
    grey, _ = match_sgbm(views_of(left, right, vergence), RETINAS[0])
    double, _ = match_sgbm(views_of(left.double().numpy(), right.double().numpy(), vergence), RETINAS[0])
    assert double.right_px.dtype == torch.float64 and grey.right_px.dtype == torch.float32
    colour, _ = match_sgbm(views_of(left.expand(3, -1, -1), right.expand(3, -1, -1), vergence), RETINAS[0])
    bytes_ = [(image * 255).round().byte() for image in (left, right)]
    coarse, _ = match_sgbm(views_of(*bytes_, vergence), RETINAS[0])
    for other in (double, colour, coarse):
        both = grey.valid & other.valid
        assert both.sum() > 0.98 * grey.valid.sum()
        assert (grey.right_px - other.right_px)[both].abs().median() < 0.01


def test_nothing_is_averaged_over_a_depth_edge():
    retina, box = LogPolar(12_000), (-0.1, 0.15, -0.15, 0.15, 0.55)
    left, right = pair(PINHOLE, 0.2, ((0.0, 0.0, 1.0), 1.2), box=box)
    found, _ = match_sgbm(views_of(left, right, 0.2), retina)
    px = found.left_px[found.valid].double().numpy()
    eye = np.array([-BASELINE / 2, 0, 0])
    rays_left = numpy_rays(PINHOLE, px) @ turn(0.1).T
    rays_right = numpy_rays(PINHOLE, found.right_px[found.valid].double().numpy()) @ turn(-0.1).T
    disparity = rays_left[:, 0] / rays_left[:, 2] - rays_right[:, 0] / rays_right[:, 2]
    depth = BASELINE / disparity
    assert np.mean((np.abs(depth - 0.55) < 0.03) | (np.abs(depth - 1.2) < 0.12)) > 0.97
    near = hit(((0.0, 0.0, 1.0), 0.55), eye, rays_left)
    centre = (np.abs(near[:, 0] - 0.025) < 0.06) & (np.abs(near[:, 1]) < 0.08)
    assert centre.sum() > 100 and np.median(np.abs(depth[centre] - 0.55)) < 0.01


def test_a_posed_rig_is_the_verged_one():
    vergence = 0.3
    ours = verged(vergence, BASELINE)
    # X_left = R X_right + t, from X_C = R_y(±θ/2) X ∓ (b/2, 0, 0)
    rotation, shift = turn(-vergence), turn(-vergence / 2) @ np.array([BASELINE, 0, 0])
    other = posed(torch.as_tensor(rotation), torch.as_tensor(shift))
    torch.testing.assert_close(other.R_left, ours.R_left)
    torch.testing.assert_close(other.R_right, ours.R_right)
    assert other.baseline_m == pytest.approx(BASELINE)


@pytest.mark.parametrize("params", [SGBM(), SGBM.authors, SGBM(mode="hh4"), SGBM(uniqueness_percent=0)])
@pytest.mark.parametrize("value", [0.0, 0.5, 0.7, 1.0])
def test_without_texture_nothing_matches(params, value):
    image = torch.full((3, 90, 90), value)
    retina = LogPolar(1000)
    found, disparity = match_sgbm(views_of(image, image, 0.1), retina, params)
    assert not found.valid.any() and not disparity.valid.any()
    assert all(part.isfinite().all() for part in found[:4]) and found.left_px.shape == found.right_px.shape == (
        retina.count,
        2,
    )


def test_unrelated_or_tiny_images_stay_well_formed():
    retina = LogPolar(1000)
    noise = torch.rand(2, 1, 90, 90, generator=torch.Generator().manual_seed(0))
    for left, right in (noise, noise[..., :4, :4], noise[..., :1, :1]):
        for vergence in (0.0, 0.5, 3.0):
            found, _ = match_sgbm(views_of(left, right, vergence), retina)
            assert all(part.isfinite().all() for part in found[:4])
            assert found.valid.float().mean() < 0.5
            assert retina.inside(found.right_px[found.valid]).all()


def test_range_limits_are_kept():
    left, right = pair(PINHOLE, 0.2, SLANTED)
    found, _ = match_sgbm(views_of(left, right, 0.2), RETINAS[0], nearest_range_m=0.8, farthest_range_m=1.0)
    _, points = truth(PINHOLE, 0.2, SLANTED, found.left_px[found.valid].double().numpy())
    assert np.mean((points[:, 2] > 0.78) & (points[:, 2] < 1.04)) > 0.99


def test_the_authors_parameters_work():
    left, right = pair(PINHOLE, 0.2, FACING)
    found, _ = match_sgbm(views_of(left, right, 0.2), RETINAS[0], SGBM.authors)
    expected, _ = truth(PINHOLE, 0.2, FACING, found.left_px.double().numpy())
    error = np.abs(found.right_px.numpy() - expected)[found.valid.numpy()]
    assert found.valid.float().mean() > 0.3 and np.median(error[:, 0]) < 0.3
    assert SGBM.authors.search(0.0, 500.0) == (0, 80) and SGBM.authors.penalties == (768, 1536)


# ------------------------------------------------------------------------------------------------------------ budget


@given(st.floats(0.01, 1), st.one_of(st.none(), st.integers(1, 2000)), st.floats(0, 2), st.floats(0, 140))
def test_sigma_is_the_budget(share, source_px, match_px, rho):
    budget = Budget(share, source_px, match_px)
    for retina in (LogPolar(), Uniform()):
        px = torch.tensor([rho, 0.0], dtype=torch.float64)
        width = retina.width_px(px).item()
        pixel = 0 if source_px is None else 200 / source_px
        expected = math.sqrt((share * width) ** 2 + (share * pixel) ** 2 + (match_px * pixel) ** 2)
        assert eye_sigma_px(budget, retina, px).item() == pytest.approx(expected)
    assert eye_sigma_px(Budget.printed, Uniform(), px).item() == pytest.approx(1 / 6, rel=1e-3)


# -------------------------------------------------------------------------------------------------- rectified pairs


def rectified_pair(doffs=7.0, size=(160, 220), plane=SLANTED, box=None):
    """A pair of parallel pinholes that differ in cx; images, cameras, and the true disparity of every left pixel."""
    height, width = size
    cameras = Pinhole(180.0, 105.0, 81.0), Pinhole(180.0, 105.0 + doffs, 81.0)
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    points = [hit(plane, np.array([x, 0, 0]), numpy_rays(c, grid)) for c, x in zip(cameras, (0, 0.15), strict=True)]
    images = [torch.as_tensor(texture(p, 3), dtype=torch.float32)[None] for p in points]
    return images, cameras, 180 * 0.15 / points[0][..., 2] - doffs


@pytest.mark.parametrize("retina", [LogPolar(12_000), Uniform(12_000), None], ids=["log_polar", "uniform", "pixels"])
@pytest.mark.parametrize("gaze", [None, (100.0, 90.0)])
def test_rectified_pairs(retina, gaze):
    images, (camera_left, camera_right), true = rectified_pair()
    views = rectified_views(*images, camera_left, camera_right, 0.15, gaze)
    found, disparity = match_sgbm(views, retina)
    eye, other = views.cameras(retina)
    # what both see, but for the matcher's own border
    both = match_disparity(true, views, retina)[0].valid
    assert both.float().mean() > 0.75
    assert found.valid[both].float().mean() > 0.98
    assert found.valid[~both].float().mean() < 0.05
    # triangulated by hand: depth from the difference of the normalized columns, in the cameras returned
    left, right = found.left_px[found.valid].double(), found.right_px[found.valid].double()
    x, y, _ = eye.rays(left).unbind(-1)
    depth = 0.15 / (x - other.rays(right)[:, 0])
    points = torch.stack([x * depth, y * depth, depth], -1).numpy()
    off = np.abs(points @ np.array(SLANTED[0]) - SLANTED[1])
    assert np.median(off) < 0.01
    assert torch.equal(right[:, 1], left[:, 1])
    scale = camera_left.focal_px / eye.focal_px
    assert scale == (1 if retina is None else pytest.approx(160 / 200))
    error = (disparity.disparity - torch.as_tensor(true))[disparity.valid].abs()
    assert error.median() < 0.3
    torch.testing.assert_close(
        disparity.depth_m()[80, 100].double(), torch.as_tensor(27 / (true[80, 100] + 7)), rtol=0.05, atol=0
    )


@pytest.mark.parametrize("retina", [LogPolar(2000), Uniform(2000), None])
def test_true_disparity_gives_true_points(retina):
    images, cameras, true = rectified_pair()
    views = rectified_views(*images, *cameras, 0.15)
    found, _ = match_disparity(true, views, retina)
    eye, other = views.cameras(retina)
    left, right = (px[found.valid] for px in found[:2])
    x, y, _ = eye.rays(left).unbind(-1)
    depth = 0.15 / (x - other.rays(right)[:, 0])
    points = torch.stack([x * depth, y * depth, depth], -1).numpy()
    assert left.dtype == torch.float64 and found.valid.float().mean() > 0.8
    # disparity is linear on a plane: exact but for pixels
    assert np.abs(points @ np.array(SLANTED[0]) - SLANTED[1]).max() < 1e-9
    source = 160 if retina is not None else None
    if retina is not None:
        torch.testing.assert_close(found.left_sigma_px, eye_sigma_px(Budget(source_px=source), retina, found.left_px))
        torch.testing.assert_close(found.right_sigma_px, eye_sigma_px(Budget(source_px=source), retina, found.right_px))
    else:
        assert found.left_sigma_px[0].item() == pytest.approx(math.hypot(1 / 6, Budget().match_px))


def test_holes_in_a_disparity_map():
    images, cameras, true = rectified_pair()
    views = rectified_views(*images, *cameras, 0.15)
    true[:, :50], true[60:70] = np.nan, np.inf
    trusted = np.ones_like(true, bool)
    trusted[100:110] = False
    found = match_disparity(true, views, valid=trusted)[0]
    valid = found.valid.reshape(true.shape)
    assert not valid[:, :50].any() and not valid[60:70].any() and not valid[100:110].any()
    assert valid[20:50, 60:200].all() and found.right_px.isfinite().all()
    assert not match_disparity(np.full_like(true, np.nan), views)[0].valid.any()


def test_reading_a_disparity_keeps_to_one_surface():
    disparity = torch.tensor([[10.0, 10.5, 30.0], [10.0, 10.5, 30.0]])
    valid = torch.tensor([[True, True, True], [True, False, True]])
    place = torch.tensor([[0.5, 0.0], [0.4, 0.4], [1.4, 0.0], [1.6, 0.0], [1.0, 1.0], [-2.0, 0.0], [2.0, 1.0]])
    value, found = read_values(disparity, valid, place, 1.0)
    assert found.tolist() == [True, True, True, True, False, False, True]
    weights = np.array([0.6 * 0.6, 0.4 * 0.6, 0.6 * 0.4])  # the fourth neighbour is invalid
    expected = weights @ [10, 10.5, 10] / weights.sum()
    assert value[found].tolist() == pytest.approx([10.25, expected, 10.5, 30.0, 30.0])


def test_motorcycle_fovea_is_as_good_as_plain_matching():
    """Middlebury's motorcycle: in the fovea the retina loses little against OpenCV on the whole image."""
    data = pytest.importorskip("skimage.data")  # ships the pair in its wheel
    left, right, true = data.stereo_motorcycle()
    images = [torch.as_tensor(image).permute(2, 0, 1) for image in (left, right)]
    cameras = Pinhole(994.978, 311.193, 254.877), Pinhole(994.978, 311.193 + 31.086, 254.877)
    retina = LogPolar()
    views = rectified_views(*images, *cameras, 0.193001)
    found, _ = match_sgbm(views, retina, nearest_range_m=1.5)
    _, plain = match_sgbm(views, None, nearest_range_m=1.5)
    place = found.left_px * 2.5 + torch.tensor([370.0, 249.5])
    column, row = place.round().long().unbind(-1)
    expected = torch.as_tensor(true)[row, column]
    ours = 2.5 * (found.left_px - found.right_px)[:, 0]
    theirs, there = read_values(plain.disparity, plain.valid, place, 1.0)
    known = expected.isfinite()
    fovea = known & (found.left_px.norm(dim=-1) < 15)
    assert found.valid[known].float().mean() > 0.9 and found.valid[fovea].float().mean() > 0.98
    error, plain_error = (ours - expected).abs(), (theirs - expected).abs()
    assert error[fovea & found.valid].median() < 1.25 * plain_error[fovea & there].median()
    assert error[known & found.valid].median() < 0.4
    # and the budget is honest: the median of |z| is 0.67 for a Gaussian
    sigma = 2.5 * torch.hypot(found.left_sigma_px, found.right_sigma_px)
    assert 0.3 < (error / sigma)[known & found.valid].median() < 0.9


# ------------------------------------------------------------------------------------------------------------- errors

GOOD = torch.rand(3, 40, 40)
VIEWS, PAIR = views_of(GOOD, GOOD, 0.1), rectified_views(GOOD, GOOD, PINHOLE, PINHOLE, 0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: match_sgbm(VIEWS, LogPolar(500), nearest_range_m=0), "nearest_range_m = 0"),
        (lambda: match_sgbm(VIEWS, LogPolar(500), farthest_range_m=0.1), "farthest_range_m = 0.1"),
        (lambda: match_sgbm(VIEWS, None), "retina = None"),
        (lambda: match_sgbm(views_of(GOOD[None], GOOD[None], 0.1), LogPolar(500)), "left.shape"),
        (lambda: verged(4.0, BASELINE), "vergence_rad = 4"),
        (lambda: verged(0.1, -1.0), "baseline_m = -1"),
        (lambda: posed(torch.eye(3), torch.tensor([-0.1, 0, 0])), "t_left_right_m"),
        (lambda: posed(2 * torch.eye(3), torch.tensor([0.1, 0, 0])), "R_left_right"),
        (lambda: posed(torch.eye(2), torch.tensor([0.1, 0, 0])), "R, t"),
        (lambda: match_disparity(torch.rand(3, 40, 40), PAIR), "disparity.shape"),
        (lambda: match_disparity(torch.rand(40, 41), PAIR), "disparity.shape"),
        (lambda: match_disparity(torch.rand(40, 40), PAIR, valid=np.ones((40, 40))), "valid"),
        (lambda: match_disparity(torch.rand(40, 40), VIEWS), "views = .*rectified_views"),
        (lambda: Budget(sigma_over_width=0), "sigma_over_width = 0"),
        (lambda: Budget(source_px=0), "source_px = 0"),
        (lambda: Budget(match_px=-1), "match_px = -1"),
        (lambda: SGBM(block_px=4), "block_px = 4"),
        (lambda: SGBM(block_px=29), r"block_px = 29: expected at most 5 .* \(16-bit sums\)"),
        (lambda: SGBM(block_px=13), r"block_px = 13: expected at most 11 with prefilter_cap = 63 .* = 5408"),
        (lambda: SGBM(block_px=15, smooth_small=8, smooth_large=99), r"block_px = 15: expected at most 13"),
        (lambda: SGBM(smooth_small=9, smooth_large=9), "smooth_large = 9"),
        (lambda: SGBM(prefilter_cap=64), "prefilter_cap = 64"),
        (lambda: SGBM(uniqueness_percent=100), "uniqueness_percent = 100"),
        (lambda: SGBM(speckle_px=-1), "speckle_px = -1"),
        (lambda: SGBM(speckle_range_px=0), "speckle_range_px = 0"),
        (lambda: SGBM(mode="full"), "mode = full"),
        (lambda: SGBM(disparities=40), "disparities = 40"),
        (lambda: SGBM(texture=-0.1), "texture = -0.1"),
        (lambda: SGBM(rectified_fov_deg=170), "rectified_fov_deg = 170"),
        (lambda: SGBM(edge_px=0), "edge_px = 0"),
    ],
)
def test_errors(call, message):
    with pytest.raises(SettingError, match=message):
        call()


def test_without_opencv_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SettingError, match=r"torchfovea\[stereo\]"):
        disparity_sgbm(np.zeros((9, 99), np.float32), np.zeros((9, 99), np.float32), (0, 16), SGBM())
