"""Rays and pictures against NumPy, and the laws that stereo needs from them."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.sensing.head import Gaze, Head, eyes, fixate
from torchfovea.setting import SettingError
from torchfovea.sim.model import EgoPose, Scene
from torchfovea.sim.rays import MISS_RANGE_M, cast, render
from torchfovea.sim.room import CAN, FURNITURE, Solid, build_spec, paint_solids
from torchfovea.sim.scene import AttentionWorld, Cans, build_scene, stand_at


def scene_of(solids):
    model = build_spec(solids, Head()).compile()
    data = tuple(mujoco.MjData(model) for _ in range(2))
    for d in data:
        mujoco.mj_forward(model, d)
    kind = torch.tensor([s.kind for s in solids])
    return Scene(model, data, tuple(solids), paint_solids(solids, np.random.default_rng(0)), kind, Head())


def first_hit(solids, origin, direction):
    """By hand: nearest positive root on every solid, in the world. Returns range, index, normal."""
    best = (MISS_RANGE_M, -1, np.zeros(3))
    for index, s in enumerate(solids):
        c, n = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
        turn = np.array([[c, -n, 0], [n, c, 0], [0, 0, 1]])
        o, d = turn.T @ (origin - np.array(s.position_m)), turn.T @ direction
        roots = []
        if s.shape == "plane":
            if d[2] < 0 < o[2]:
                t = -o[2] / d[2]
                p = o + t * d
                if abs(p[0]) <= s.size_m[0] and abs(p[1]) <= s.size_m[1]:
                    roots.append((t, np.array([0, 0, 1.0])))
        elif s.shape == "sphere":
            b, q = o @ d, o @ o - s.size_m[0] ** 2
            if b * b > q:
                t = -b - math.sqrt(b * b - q)
                roots.append((t, (o + t * d) / s.size_m[0]))
        elif s.shape == "box":
            for axis in range(3):
                for sign in (-1, 1):
                    if d[axis] * sign < 0:
                        t = (sign * s.size_m[axis] - o[axis]) / d[axis]
                        p = o + t * d
                        others = [k for k in range(3) if k != axis]
                        if all(abs(p[k]) <= s.size_m[k] for k in others):
                            roots.append((t, sign * np.eye(3)[axis]))
        else:
            r, h = s.size_m
            a, b, q = d[:2] @ d[:2], o[:2] @ d[:2], o[:2] @ o[:2] - r * r
            if a > 0 and b * b > a * q:
                t = (-b - math.sqrt(b * b - a * q)) / a
                p = o + t * d
                if abs(p[2]) <= h:
                    roots.append((t, np.array([p[0], p[1], 0]) / r))
            for sign in (-1, 1):
                if d[2] * sign < 0:
                    t = (sign * h - o[2]) / d[2]
                    p = o + t * d
                    if np.hypot(p[0], p[1]) <= r:
                        roots.append((t, np.array([0, 0, float(sign)])))
        for t, normal in roots:
            if 0 < t < best[0]:
                best = (t, index, turn @ normal)
    return best


@pytest.fixture(scope="module")
def scene():
    return build_scene(AttentionWorld(), 0)


@pytest.fixture(scope="module")
def field():
    return build_scene(Cans(), 5)


@pytest.mark.parametrize("pose", [EgoPose(), EgoPose(-0.4, 0.3, 1.1), EgoPose(1.2, -0.5, -2.5)])
def test_every_ray_meets_what_numpy_meets(field, pose):
    scene = stand_at(field, pose)
    generator = torch.Generator().manual_seed(1)
    origin = torch.tensor([0.05, -0.1, 0.12], dtype=torch.float64)
    directions = torch.randn(500, 3, dtype=torch.float64, generator=generator)
    hits = cast(scene, origin, directions)
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    start = turn @ origin.numpy() + np.array([pose.x_m, pose.y_m, 0.54])
    for k, d in enumerate(torch.nn.functional.normalize(directions, dim=-1).numpy()):
        far, geom, normal = first_hit(scene.solids, start, turn @ d)
        assert hits.geom[k] == geom
        assert abs(float(hits.range_m[k]) - far) < 1e-9 * max(far, 1)
        assert np.abs(turn @ hits.normal[k].numpy() - normal).max() < 1e-7


def test_a_sphere_and_nothing_else():
    scene = scene_of([Solid("ball", CAN, "sphere", (2.0, 0.0, 0.54), (0.5,))])
    hits = cast(scene, torch.zeros(3), torch.tensor([[3.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [2.0, 0.4, 0.0]]))
    assert hits.geom.tolist() == [0, -1, 0]
    assert hits.range_m.dtype == torch.float32
    assert abs(float(hits.range_m[0]) - 1.5) < 1e-6
    assert float(hits.range_m[1]) == MISS_RANGE_M
    assert torch.equal(hits.normal[1], torch.zeros(3))
    assert torch.allclose(hits.normal[0], torch.tensor([-1.0, 0.0, 0.0]))


def test_many_rays_are_as_few_rays(scene):
    directions = torch.randn(9001, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    origin = torch.zeros(3, dtype=torch.float64)
    whole = cast(scene, origin, directions)
    for part, rows in zip(zip(*(x.split(1000) for x in whole), strict=True), directions.split(1000), strict=True):
        for a, b in zip(part, cast(scene, origin, rows), strict=True):
            assert torch.equal(a, b)


def test_no_rays(scene):
    hits = cast(scene, torch.zeros(3), torch.zeros(0, 3))
    assert hits.range_m.shape == (0,) and hits.geom.shape == (0,) and hits.normal.shape == (0, 3)


@pytest.mark.parametrize(
    ("origin", "directions", "named"),
    [
        (torch.zeros(3), torch.zeros(4, 2), "directions_e"),
        (torch.zeros(3), torch.zeros(3), "directions_e"),
        (torch.zeros(2), torch.ones(4, 3), "origin_e"),
        (torch.zeros(3), torch.zeros(1, 3), "directions_e"),
        (torch.zeros(3), torch.full((1, 3), math.nan), "directions_e"),
        (torch.full((3,), math.inf), torch.ones(1, 3), "origin_e"),
    ],
)
def test_bad_rays_are_named(scene, origin, directions, named):
    with pytest.raises(SettingError, match=named):
        cast(scene, origin, directions)


def pose_at(scene, point):
    return eyes(scene.head, fixate(scene.head, torch.tensor(point, dtype=torch.float64))[0])


@pytest.mark.parametrize("camera", [Pinhole.from_fov(90, 100), Fisheye.from_fov(150, 100)])
def test_a_picture_is_its_pixels_rays(scene, camera):
    camera = image_camera(camera, 100, 61)
    pose = pose_at(scene, (1.5, 0.3, -0.2))
    frame = render(scene, pose.R_left, pose.t_left, camera, 61)
    rows, columns = torch.randint(0, 61, (2, 200), generator=torch.Generator().manual_seed(0))
    px = torch.stack([columns, rows], -1).double()
    hits = cast(scene, pose.t_left, camera.rays(px) @ pose.R_left.mT)
    assert torch.equal(frame.geom[rows, columns], hits.geom)
    assert torch.allclose(frame.range_m[rows, columns].double(), hits.range_m, rtol=1e-5)
    assert frame.image.shape == (3, 61, 61) and frame.image.dtype == torch.float32
    assert frame.image.min() >= 0 and frame.image.max() <= 1


def test_same_seed_same_picture_other_seed_other_picture(scene):
    camera = image_camera(Pinhole.from_fov(90, 100), 100, 64)
    pose = pose_at(scene, (1.0, 0.0, 0.0))
    first, second, other = (
        render(s, pose.R_left, pose.t_left, camera, 64)
        for s in (scene, build_scene(AttentionWorld(), 0), build_scene(AttentionWorld(), 1))
    )
    assert torch.equal(first.image, second.image)
    assert torch.equal(first.range_m, other.range_m)
    assert (first.image - other.image).abs().mean() > 0.02


def test_a_picture_depends_on_where_the_camera_is_not_on_where_the_robot_stands(scene):
    camera = image_camera(Pinhole.from_fov(90, 100), 100, 48)
    zero = torch.zeros((), dtype=torch.float64)
    straight = eyes(scene.head, Gaze(zero, zero, zero))
    moved = stand_at(scene, EgoPose(0.3, -0.2, 0.4))
    c, s = math.cos(0.4), math.sin(0.4)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    shift = torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64)
    a = render(moved, straight.R_left, straight.t_left, camera, 48)
    b = render(scene, turn @ straight.R_left, turn @ straight.t_left + shift, camera, 48)
    assert torch.equal(a.geom, b.geom)
    assert (a.image - b.image).abs().max() < 1e-3


def test_texture_is_filtered_to_the_pixel(scene):
    """Averaging a finer picture's pixels gives the coarse picture: nothing aliases."""
    pose = pose_at(scene, (1.5, 0.2, -0.1))
    size, factor = 100, 4
    coarse, fine = (
        render(scene, pose.R_left, pose.t_left, image_camera(Pinhole.from_fov(90, 100), 100, n), n)
        for n in (size, size * factor)
    )
    mean = torch.nn.functional.avg_pool2d(fine.image, factor)
    blocks = fine.geom.reshape(size, factor, size, factor)
    whole = (blocks == coarse.geom[:, None, :, None]).all(1).all(-1)
    # where the surface faces the eye, the pixel's footprint is round, as the filter takes it to be
    index = torch.arange(size, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    ray = image_camera(Pinhole.from_fov(90, 100), 100, size).rays(torch.stack([u, v], -1))
    way = torch.nn.functional.normalize(ray, dim=-1) @ pose.R_left.mT
    normal = cast(scene, pose.t_left, way.flatten(0, 1)).normal.view_as(way)
    facing = (way * normal).sum(-1).abs() > 0.8
    keep = whole & facing
    assert keep.double().mean() > 0.2
    a, b = mean[:, keep].flatten(), coarse.image[:, keep].flatten()
    error = (a - b).abs()
    assert error.median() < 0.015
    assert torch.corrcoef(torch.stack([a, b]))[0, 1] > 0.97
    # and a picture that merely drops pixels is clearly farther off
    dropped = fine.image[:, ::factor, ::factor][:, keep].flatten()
    assert error.mean() < 0.5 * (a - dropped).abs().mean()


def test_texture_is_rich_at_every_distance(field):
    """Stereo has something to match: gradients across a pixel, on every surface."""
    camera = image_camera(Pinhole.from_fov(90, 100), 100, 200)
    for point in ((2.0, 0.0, 0.0), (1.0, 0.0, -0.6), (1.0, 1.0, 0.2)):
        pose = pose_at(field, point)
        frame = render(field, pose.R_left, pose.t_left, camera, 200)
        gray = frame.image.mean(0)
        step = (gray[:, 1:] - gray[:, :-1]).abs()
        assert step.median() > 0.008
        for geom in frame.geom.unique():
            mask = frame.geom == geom
            if mask.sum() > 400:
                assert gray[mask].std() > 0.015


def test_both_eyes_see_one_colour(scene):
    """A surface point that both eyes see has the same colour in both, up to the pixels' own blur."""
    size = 240
    camera = image_camera(Pinhole.from_fov(60, 100), 100, size)
    pose = pose_at(scene, (1.2, 0.1, -0.15))
    left, right = (
        render(scene, r, t, camera, size) for r, t in ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right))
    )
    index = torch.arange(size, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    ray = torch.nn.functional.normalize(camera.rays(torch.stack([u, v], -1)), dim=-1)
    point = pose.t_left + left.range_m[..., None].double() * (ray @ pose.R_left.mT)
    local = (point - pose.t_right) @ pose.R_right
    px = camera.project(local)
    grid = (px / (size - 1) * 2 - 1).float()[None]
    seen = torch.nn.functional.grid_sample(right.image[None], grid, align_corners=True)[0]
    far = torch.nn.functional.grid_sample(right.range_m[None, None], grid, align_corners=True)[0, 0]
    inside = ((px > 1) & (px < size - 2)).all(-1) & ((far.double() - local.norm(dim=-1)).abs() < 3e-3)
    assert inside.double().mean() > 0.4
    error = (seen - left.image).abs()[:, inside]
    contrast = left.image[:, inside].std()
    assert error.median() < 0.15 * contrast
    assert torch.corrcoef(torch.stack([seen[:, inside].flatten(), left.image[:, inside].flatten()]))[0, 1] > 0.96


def test_a_slanted_surface_keeps_its_mean_brightness_far_away():
    """Octaves that fade take no light with them."""
    wall = Solid("wall", FURNITURE, "box", (50.0, 0.0, 0.54), (0.1, 60.0, 60.0))
    near = Solid("wall", FURNITURE, "box", (2.0, 0.0, 0.54), (0.1, 60.0, 60.0))
    camera = image_camera(Pinhole.from_fov(60, 100), 100, 160)
    zero = torch.zeros((), dtype=torch.float64)
    pose = eyes(Head(), Gaze(zero, zero, zero))
    means = [render(scene_of([s]), pose.R_left, pose.t_left, camera, 160).image.mean() for s in (wall, near)]
    assert abs(float(means[0] / means[1]) - 1) < 0.06


def test_sky_where_there_is_nothing():
    scene = scene_of([Solid("ball", CAN, "sphere", (-2.0, 0.0, 0.54), (0.5,))])
    zero = torch.zeros((), dtype=torch.float64)
    pose = eyes(Head(), Gaze(zero, zero, zero))
    frame = render(scene, pose.R_left, pose.t_left, image_camera(Pinhole.from_fov(60, 100), 100, 8), 8)
    assert (frame.geom == -1).all() and (frame.range_m == MISS_RANGE_M).all() and torch.isfinite(frame.image).all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"size_px": 1}, "size_px"),
        ({"size_px": 2.5}, "size_px"),
        ({"R": torch.eye(2)}, "R"),
        ({"t": torch.ones(2)}, "t"),
    ],
)
def test_bad_pictures_are_named(scene, change, named):
    arguments = {"R": torch.eye(3), "t": torch.zeros(3), "camera": Pinhole(10.0), "size_px": 8, **change}
    with pytest.raises(SettingError, match=named):
        render(scene, **arguments)
