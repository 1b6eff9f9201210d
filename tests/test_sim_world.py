"""What an agent gets from the world, and what a referee gets."""

import math

import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.head import Gaze, Head, cyclopean, eyes, fixate
from torchfovea.sim.rays import cast
from torchfovea.sim.scene import AttentionWorld, Cans, EgoPose, build_scene
from torchfovea.sim.world import World


@pytest.fixture(scope="module")
def scene():
    return build_scene(AttentionWorld(), 0)


@pytest.fixture
def world(scene):
    return World(scene, source_px=64)


def gaze_of(*degrees):
    return Gaze(*(torch.tensor(math.radians(a)) for a in degrees))


def test_it_starts_looking_straight_ahead(world):
    assert [float(a) for a in world.gaze] == [0, 0, 0]
    seen = world.fixated()
    assert torch.allclose(seen.point_e, torch.tensor([4.0, 0.0, 0.124], dtype=torch.float64))
    assert not seen.is_floor and not seen.is_target
    assert abs(seen.range_m - math.hypot(4.0, 0.124)) < 1e-9


def test_fixating_the_truth_meets_the_target(world):
    gaze, reachable = fixate(world.head, world.scene.nearest_point_e)
    assert reachable
    world.saccade(gaze)
    seen = world.fixated()
    assert seen.is_target and not seen.is_floor and seen.geom in world.scene.target_geoms
    assert abs(seen.range_m - world.scene.nearest_range_m) < 1e-3
    world.reset()
    assert not world.fixated().is_target


def test_the_floor_is_the_floor(world):
    seen = world.fixated(gaze_of(20, 36, 0))
    assert seen.is_floor and abs(float(seen.point_e[2]) + world.head.ego_height_m) < 1e-9


def test_fixated_is_the_first_surface_on_the_cyclopean_ray(world):
    gaze = gaze_of(-20, 20, 10)
    rotation, origin = cyclopean(world.head, Gaze(*(a.double() for a in gaze)))
    seen = world.fixated(gaze)
    away = (seen.point_e - origin).norm()
    assert torch.allclose((seen.point_e - origin) / away, rotation[:, 2], atol=1e-9)
    hits = cast(world.scene, origin, rotation[:, 2][None])
    assert abs(float(hits.range_m[0] - away)) < 1e-9 and seen.geom == int(hits.geom[0])


def test_panorama_is_seen_from_e(world):
    directions = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    a, b = world.panorama(directions), cast(world.scene, torch.zeros(3), directions)
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    _, reachable = fixate(world.head, a.range_m[:, None] * directions)
    above = ~world.scene.is_floor(a.geom)
    assert (a.range_m >= world.scene.nearest_range_m - 1e-3)[reachable & above].all()


@pytest.mark.parametrize("camera", [Pinhole.from_fov(90, 100), Fisheye.from_fov(135, 100)])
def test_pictures_match_the_geometric_sensor(scene, camera):
    """The left picture's ranges are those of `correspond` along the same pixels."""
    world = World(scene, camera=camera, source_px=40)
    gaze = gaze_of(20, 25, 12)
    left, right = world.images(gaze)
    assert left.image.shape == right.image.shape == (3, 40, 40)
    index = torch.arange(40, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    rays = world.image_camera.rays(torch.stack([u, v], -1)).reshape(-1, 3)
    seen = world.correspond(gaze, rays)
    pose = eyes(world.head, Gaze(*(a.double() for a in gaze)))
    away = (seen.points_e - pose.t_left).norm(dim=-1)
    assert torch.allclose(away, left.range_m.reshape(-1).double(), rtol=1e-5)
    assert seen.hit.all() and not torch.equal(left.image, right.image)


def test_occlusion_is_what_rays_toward_the_right_eye_meet(scene):
    """A point is hidden from the right eye just where something blocks the way from it to that eye."""
    world = World(scene)
    gaze = gaze_of(-15, 22, 10)
    directions = torch.randn(3000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    directions[:, 2] = 1.0
    seen = world.correspond(gaze, directions)
    pose = eyes(world.head, Gaze(*(a.double() for a in gaze)))
    local = (seen.points_e - pose.t_right) @ pose.R_right
    rows = torch.randperm(3000, generator=torch.Generator().manual_seed(0))[:400]
    wrong = 0
    for k in rows.tolist():
        back = pose.t_right - seen.points_e[k]
        away = back.norm()
        # a hair off the surface, for the ray starts on it
        start = seen.points_e[k] + 1e-6 * back / away
        blocked = float(cast(scene, start, back[None]).range_m[0]) < away - 1e-5
        wrong += bool(seen.visible_right[k]) != (not blocked and bool(local[k, 2] > 0))
    assert wrong == 0
    hidden = (seen.hit & ~seen.visible_right).double().mean()
    assert 0.005 < hidden < 0.3


def test_correspond_keeps_the_dtype_and_the_length_of_directions_does_not_count(world):
    directions = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]])
    a, b = world.correspond(None, directions), world.correspond(None, 7 * directions)
    assert a.points_e.dtype == torch.float32
    assert torch.allclose(a.points_e, b.points_e, atol=1e-6)


def test_a_head_elsewhere_sees_other_things():
    scene = build_scene(Cans(), 2, Head(), EgoPose(0.2, -0.1, 0.5))
    ahead = World(scene).fixated()
    c, s = math.cos(0.5), math.sin(0.5)
    x, y, _ = ahead.point_e.tolist()
    place = (0.2 + c * x - s * y, -0.1 + s * x + c * y)
    assert place[0] < 4.0 + 1e-6 and abs(place[1]) < 3.2 + 1e-6
