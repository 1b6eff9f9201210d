"""The scenes keep their promises, checked from their solids and not from the code that placed them."""

import math

import numpy as np
import pytest
import torch

from torchfovea.sensing.head import Gaze, Head, cyclopean, eyes, fixate
from torchfovea.setting import SettingError
from torchfovea.sim.rays import cast
from torchfovea.sim.room import CAN, FLOOR, POLE, TARGET
from torchfovea.sim.scene import AttentionWorld, Cans, EgoPose, Room, build_scene, stand_at

SEEDS = range(20)


def cylinder_distance(solid, height=0.54):
    """Distance from E's origin to an upright cylinder, and its nearest point."""
    x, y, z = solid.position_m
    radius, half = solid.size_m
    away = math.hypot(x, y)
    low, high = z - half - height, z + half - height
    across = max(away - radius, 0.0)
    up = min(max(0.0, low), high)
    return math.hypot(across, up), np.array([x / away * across, y / away * across, up])


def surface(solid, height=0.54):
    x, y, z = solid.position_m
    radius, half = solid.size_m
    angle, share = np.meshgrid(np.linspace(0, 2 * math.pi, 200), np.linspace(-1, 1, 41))
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z + half * share - height], -1).reshape(
        -1, 3
    )


@pytest.fixture(scope="module")
def fields():
    return [build_scene(Cans(), seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def hidden():
    return [build_scene(Cans(outside_first_view=True), seed) for seed in SEEDS]


def test_attention_world_is_the_authors():
    scene = build_scene(AttentionWorld(), 0)
    cans = [s for s in scene.solids if s.kind in (CAN, TARGET)]
    places = [(1.811, 0.421), (0.860, -0.027), (0.661, -0.282), (0.710, -0.562), (0.453, 0.464)]
    assert [s.position_m[:2] for s in cans] == places
    assert all(s.size_m == (0.085, 0.1575) and s.position_m[2] == 0.1575 for s in cans)
    (target,) = scene.target_geoms
    assert scene.solids[target].position_m[:2] == (0.453, 0.464)
    distance, point = cylinder_distance(scene.solids[target])
    assert abs(scene.nearest_range_m - distance) < 1e-3
    assert np.abs(scene.nearest_point_e.numpy() - point).max() < 2e-3
    # the authors logged (0.384, 0.419, 0.268) there, 0.54 m below E
    assert np.linalg.norm(scene.nearest_point_e.numpy() - [0.384, 0.419, -0.272]) < 0.06
    assert scene.nearest.geom == target


def test_only_textures_change_with_the_seed_of_attention_world():
    a, b = (build_scene(AttentionWorld(), seed) for seed in (0, 9))
    assert [(s.name, s.position_m, s.size_m) for s in a.solids] == [(s.name, s.position_m, s.size_m) for s in b.solids]
    assert not np.array_equal(a.paint.offset, b.paint.offset)


def test_geoms_are_the_solids_in_order(fields):
    for scene in fields[:3]:
        for geom, solid in enumerate(scene.solids):
            assert scene.model.geom(geom).name == solid.name
            assert np.allclose(scene.data[0].geom_xpos[geom], solid.position_m)
        geoms = torch.tensor([-1, *range(len(scene.solids))])
        assert scene.is_floor(geoms).tolist() == [False] + [s.kind == FLOOR for s in scene.solids]
        assert scene.is_target(geoms).tolist() == [False] + [s.kind == TARGET for s in scene.solids]


def check_cans(scene, params):
    cans = [s for s in scene.solids if s.kind in (CAN, TARGET)]
    poles = {s.name.replace("pole", "can"): s for s in scene.solids if s.kind == POLE}
    assert len(cans) == params.cans
    (target,) = [s for s in cans if s.kind == TARGET]
    nearest, point = cylinder_distance(target)
    # nearest, by the margin, and at least 0.55 m away so that the policy may fixate it
    assert nearest >= 0.55 - 1e-9
    assert all(cylinder_distance(s)[0] >= nearest + params.margin_m - 1e-9 for s in cans if s is not target)
    for name, pole in poles.items():
        limit = nearest + params.margin_m * (0.2 if name == target.name else 1.0)
        assert cylinder_distance(pole)[0] >= limit - 1e-9
    # the head reaches every can, with the margin
    margin = math.radians(params.reach_margin_deg)
    head = scene.head
    for s in cans:
        gaze, reachable = fixate(head, torch.from_numpy(cylinder_distance(s)[1]))
        assert reachable
        assert abs(gaze.pan) <= math.radians(head.pan_limit_deg) - margin + 1e-9
        assert -math.radians(head.tilt_up_deg) + margin - 1e-9 <= gaze.tilt
        assert gaze.tilt <= math.radians(head.tilt_down_deg) - margin + 1e-9
        assert gaze.vergence <= math.radians(head.vergence_max_deg) - margin + 1e-9
    # nothing floats, nothing overlaps
    for s in cans:
        bottom = s.position_m[2] - s.size_m[1]
        if s.name in poles:
            pole = poles[s.name]
            assert abs(pole.position_m[2] + pole.size_m[1] - bottom) < 1e-9
            assert abs(pole.position_m[2] - pole.size_m[1]) < 1e-9
            assert pole.position_m[:2] == s.position_m[:2] and pole.size_m[0] < s.size_m[0]
        else:
            assert abs(bottom) < 1e-9
    for i, a in enumerate(cans):
        for b in cans[:i]:
            gap = math.dist(a.position_m[:2], b.position_m[:2]) - a.size_m[0] - b.size_m[0]
            assert gap > 0
    # the truth found by rays is the target's
    assert scene.nearest.geom in scene.target_geoms
    assert abs(scene.nearest_range_m - nearest) < 1e-3
    assert np.abs(scene.nearest_point_e.numpy() - point).max() < 5e-3
    # E and, fixating it, both eyes and the cyclopean eye see it
    gaze, _ = fixate(head, scene.nearest_point_e)
    core = torch.tensor(target.position_m, dtype=torch.float64) - torch.tensor([0, 0, 0.54])
    inner = torch.from_numpy(point) + 0.02 * (core - torch.from_numpy(point))
    pose = eyes(head, gaze)
    for eye in (torch.zeros(3, dtype=torch.float64), pose.t_left, pose.t_right, cyclopean(head, gaze)[1]):
        aim = inner - eye
        assert cast(scene, eye, aim[None]).geom.item() in scene.target_geoms


def test_cans_keep_their_laws(fields):
    for scene in fields:
        check_cans(scene, scene.params)


def test_cans_outside_the_first_view_keep_them_too(hidden):
    zero = torch.zeros((), dtype=torch.float64)
    straight = eyes(Head(), Gaze(zero, zero, zero))
    for scene in hidden:
        check_cans(scene, scene.params)
        (target,) = scene.target_geoms
        points = surface(scene.solids[target])
        for eye in (straight.t_left, straight.t_right):
            line = points - eye.numpy()
            angle = np.degrees(np.arccos(line[:, 0] / np.linalg.norm(line, axis=-1)))
            assert angle.min() > 45.0


def test_the_target_is_somewhere_else_each_time(fields):
    azimuths = [math.atan2(*s.nearest_point_e[[1, 0]].tolist()) for s in fields]
    assert np.std(np.degrees(azimuths)) > 15
    assert len({s.solids[next(iter(s.target_geoms))].position_m[2] for s in fields}) == len(fields)


def test_same_seed_same_scene():
    params = Cans(cans=6)
    a, b, c = build_scene(params, 4), build_scene(params, 4), build_scene(params, 5)
    assert a.solids == b.solids and a.solids != c.solids
    assert np.array_equal(a.paint.offset, b.paint.offset) and torch.equal(a.nearest_point_e, b.nearest_point_e)


def test_a_region_is_kept():
    params = Cans(cans=6, target_azimuth_deg=[10, 25], target_elevation_deg=[-20, -5], target_range_m=(0.7, 0.8))
    assert params.target_azimuth_deg == (10.0, 25.0)
    for seed in range(5):
        scene = build_scene(params, seed)
        (target,) = (s for s in scene.solids if s.kind == TARGET)
        x, y, z = np.array(target.position_m) - [0, 0, 0.54]
        assert 10 <= math.degrees(math.atan2(y, x)) <= 25
        assert 0.65 <= math.sqrt(x * x + y * y + z * z) <= 0.85


def test_the_truth_moves_with_the_robot():
    scene = build_scene(AttentionWorld(), 0)
    turned = stand_at(scene, EgoPose(0.0, 0.0, 0.3))
    assert abs(turned.nearest_range_m - scene.nearest_range_m) < 1e-3
    c, s = math.cos(0.3), math.sin(0.3)
    back = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64) @ turned.nearest_point_e
    assert (back - scene.nearest_point_e).norm() < 5e-3
    away = stand_at(scene, EgoPose(0.0, 0.0, math.pi))
    assert away.nearest.geom not in scene.target_geoms
    assert away.nearest_range_m > 1.0


def test_an_empty_reach_is_no_nan():
    scene = build_scene(AttentionWorld(room=Room(furniture=False, height_m=40, front_m=50, back_m=50, side_m=50)), 0)
    away = stand_at(scene, EgoPose(-10.0, 0.0, math.pi))
    assert torch.isfinite(away.nearest_point_e).all()


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda: Cans(cans=1), "scene.cans"),
        (lambda: Cans(cans=2.5), "scene.cans"),
        (lambda: Cans(target_azimuth_deg=(10, -10)), "scene.target_azimuth_deg"),
        (lambda: Cans(range_m=(0.1, 2)), "scene.range_m"),
        (lambda: Cans(pole_radius_m=0.05), "scene.pole_radius_m"),
        (lambda: Cans(margin_m=-0.1), "scene.margin_m"),
        (lambda: Cans(reach_margin_deg=40), "scene.reach_margin_deg"),
        (lambda: Cans(first_view_deg=5), "scene.first_view_deg"),
        (lambda: Cans(tries=0), "scene.tries"),
        (lambda: AttentionWorld(can_radius_m=0.2), "scene.can_radius_m"),
        (lambda: AttentionWorld(can_height_m=0.0), "scene.can_height_m"),
        (lambda: AttentionWorld(room=Room(front_m=1.5, furniture=False)), "room.front_m"),
        (lambda: Room(contrast=-0.1), "room.contrast = -0.1"),
        (lambda: Room(repeat_m=0.0), "room.repeat_m = 0.0"),
        (lambda: Room(height_m=0.5), "room.height_m"),
        (lambda: Room(side_m=1.5), "room.side_m"),
        (lambda: build_scene(Cans(), -1), "seed"),
        (lambda: build_scene("cans", 0), "scene"),
        (lambda: build_scene(AttentionWorld(), 0, pose=EgoPose(math.nan)), "pose.x_m"),
        (lambda: build_scene(Cans(target_azimuth_deg=(100, 120)), 0), "scene.target_azimuth_deg"),
        (lambda: build_scene(Cans(target_azimuth_deg=(0, 5), outside_first_view=True), 0), "outside the first view"),
        (lambda: build_scene(Cans(cans=30, range_m=(1.0, 1.1), azimuth_deg=(-20, 20)), 0), "scene.cans"),
    ],
)
def test_bad_settings_are_named(build, named):
    with pytest.raises(SettingError, match=named):
        build()
