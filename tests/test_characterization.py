"""Planes seen by both sensors: NumPy loops, known values of a study of its own, laws, and the command itself."""

import csv
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.cli import main
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import SettingError
from torchfovea.studies.characterization import (
    PlaneSensor,
    characterize_planes,
    correspond_plane,
    half_retina,
    matched_vergence,
    peak_vergence,
    plane_information,
    plane_points,
    solid_angle_sr,
    spread_over_vergence,
    straight_eyes,
)
from torchfovea.studies.plane import draw_plane, octave_noise
from torchfovea.studies.realised import (
    look_at_plane,
    off_lattice_distances,
    pool_sights,
    realised_information,
    rings_of_error,
)

BASELINE = 0.065
CAMERA = Pinhole.from_fov(90, 100)
LOG_POLAR, UNIFORM = PlaneSensor(CAMERA, LogPolar()), PlaneSensor(CAMERA, Uniform())
SMALL = [PlaneSensor(CAMERA, LogPolar(2000)), PlaneSensor(CAMERA, Uniform(2000))]
MATCHED = matched_vergence(BASELINE, torch.tensor([0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0])).tolist()


# Measured by a separate program with σ = width/3; at width/6 each |Σ| is 2⁶ times smaller.
@pytest.mark.parametrize(
    "distance, vergence, uniform, foveal",
    [
        (0.05, MATCHED[0], 51.9, 59.8),
        (0.1, MATCHED[1], 47.4, 55.1),
        (0.3, MATCHED[3], 39.0, 46.4),
        (1.0, MATCHED[6], 29.4, 36.7),
    ],
)
def test_information_at_the_matched_vergence_is_the_studys(distance, vergence, uniform, foveal):
    shift = 6 * math.log(2)
    got = [float(plane_information(sensor, distance, vergence).information) for sensor in (UNIFORM, LOG_POLAR)]
    assert got == pytest.approx([uniform + shift, foveal + shift], abs=0.08)
    assert 7.2 < got[1] - got[0] < 8.0


def numpy_information(sensor, px, distance, vergence):
    """Eq. 8-18 and 44 for one left receptive field, as printed, with rays and triangulation of its own."""
    focal, half = sensor.camera.focal_px, vergence / 2

    def world(place, sign):
        # optical frame of the head: x right, y down, z forward; an eye turned inward
        x, y = place[0] / focal, place[1] / focal
        c, s = math.cos(half), sign * math.sin(half)
        return np.array([c * x + s, y, -s * x + c])

    def midpoint(four):
        p, q = np.array([-BASELINE / 2, 0, 0]), np.array([BASELINE / 2, 0, 0])
        d, e = world(four[:2], 1), world(four[2:], -1)
        s, t = np.linalg.lstsq(np.stack([d, -e], 1), q - p, rcond=None)[0]
        return (p + s * d + q + t * e) / 2

    ray = world(px, 1)
    point = np.array([-BASELINE / 2, 0, 0]) + ray * distance / ray[2]
    seen = point - np.array([BASELINE / 2, 0, 0])
    c, s = math.cos(half), math.sin(half)
    local = np.array([c * seen[0] + s * seen[2], seen[1], -s * seen[0] + c * seen[2]])
    right = focal * local[:2] / local[2]
    if local[2] <= 0 or np.hypot(*right) > 100:
        return None
    width = [float(sensor.retina.width_px(torch.tensor(np.asarray(p))[None])) for p in (px, right)]
    sigma = np.repeat(np.array(width) / 6, 2)
    mean, spread = np.concatenate([px, right]), math.sqrt(0.4375)
    points = [mean] + [mean + sgn * spread * sigma[k] * np.eye(4)[k] for sgn in (1, -1) for k in range(4)]
    lam = 0.25**2 * 7 - 4
    w_mean = np.array([lam / (4 + lam)] + [0.5 / (4 + lam)] * 8)
    w_cov = w_mean.copy()
    w_cov[0] += 1 - 0.25**2 + 2
    images = np.array([midpoint(p) for p in points])
    centred = images - w_mean @ images
    return -math.log(np.linalg.det((w_cov[:, None] * centred).T @ centred))


@pytest.mark.parametrize("sensor", SMALL, ids=["log_polar", "uniform"])
@pytest.mark.parametrize("distance, vergence", [(0.3, 0.2), (0.8, 0.6)])
def test_a_numpy_loop_says_the_same(sensor, distance, vergence):
    places = half_retina(CAMERA, sensor.retina, torch.float64)
    some = slice(0, None, 41)
    few = places._replace(
        px=places.px[some], weight=torch.ones(len(places.px[some])).double(), solid_angle_sr=places.solid_angle_sr[some]
    )
    got = plane_information(sensor, distance, vergence, few)
    want = [numpy_information(sensor, px.numpy(), distance, vergence) for px in few.px]
    matched = [v for v in want if v is not None]
    assert float(got.matched_fraction) == pytest.approx(len(matched) / len(want))
    assert float(got.information) == pytest.approx(np.mean(matched), abs=1e-6)


@pytest.mark.parametrize("retina", [LogPolar(2000), Uniform(2000), LogPolar(2000, uniform_fovea=True), Uniform(1234)])
def test_half_a_retina_stands_for_all_of_it(retina):
    sensor = PlaneSensor(CAMERA, retina)
    half = half_retina(CAMERA, retina, torch.float64)
    assert float(half.weight.sum()) == retina.count
    px = retina.centers_px(dtype=torch.float64)
    whole = type(half)(px, torch.ones(len(px)).double(), solid_angle_sr(CAMERA, retina, px))
    for a, b in zip(plane_information(sensor, 0.4, 0.3, half), plane_information(sensor, 0.4, 0.3, whole), strict=True):
        assert float(a) == pytest.approx(float(b), rel=1e-9)


@pytest.mark.parametrize("sensor", [LOG_POLAR, UNIFORM], ids=["log_polar", "uniform"])
def test_a_third_of_the_retina_stands_for_all_of_it(sensor):
    third = half_retina(CAMERA, sensor.retina, every=3)
    assert float(third.weight.sum()) == pytest.approx(sensor.retina.count, rel=1e-3)
    for distance, vergence in ((0.1, 0.0), (0.4, 0.2), (1.0, 0.8)):
        some, every = (plane_information(sensor, distance, vergence, p) for p in (third, None))
        assert float(some.information) == pytest.approx(float(every.information), abs=0.01)
        assert float(some.information_solid_angle) == pytest.approx(float(every.information_solid_angle), abs=0.01)
        assert float(some.matched_fraction) == pytest.approx(float(every.matched_fraction), abs=0.005)


def test_precision_is_the_callers():
    single = [plane_information(s, 0.3, 0.2) for s in SMALL]
    double = [plane_information(s, 0.3, 0.2, half_retina(CAMERA, s.retina, torch.float64)) for s in SMALL]
    for a, b in zip(single, double, strict=True):
        assert float(a.information) == pytest.approx(float(b.information), abs=2e-3)


@given(distance=st.floats(0.06, 2), vergence=st.floats(0, 1.2), u=st.floats(-60, 60), v=st.floats(-60, 60))
def test_matched_points_lie_on_the_plane_and_on_both_rays(distance, vergence, u, v):
    pose = straight_eyes(BASELINE, vergence, torch.float64)
    matches, points = correspond_plane(LOG_POLAR, torch.tensor([[u, v]], dtype=torch.float64), pose, distance)
    if matches.valid.item():
        assert points[0, 0].item() == pytest.approx(distance)
        for rotation, origin, px in (
            (pose.R_left, pose.t_left, matches.left_px),
            (pose.R_right, pose.t_right, matches.right_px),
        ):
            ray = rotation @ CAMERA.rays(px)[0]
            assert torch.linalg.cross(ray, points[0] - origin).norm().item() < 1e-9
    assert torch.isfinite(points).all() and torch.isfinite(matches.right_px).all()


@pytest.mark.parametrize("camera", [CAMERA, Fisheye.from_fov(90, 100)])
def test_solid_angles_sum_to_the_cone(camera):
    retina = Uniform(8000)
    total = solid_angle_sr(camera, retina, retina.centers_px(dtype=torch.float64)).sum()
    assert float(total) == pytest.approx(2 * math.pi * (1 - math.cos(math.pi / 4)), rel=0.01)


@pytest.mark.parametrize("vergence", [math.pi * 1.2, -2.5, 3.0])
def test_eyes_that_look_away_match_nothing(vergence):
    for sensor in SMALL:
        look = plane_information(sensor, 0.5, vergence)
        assert all(bool(torch.isfinite(v)) for v in look)
        if vergence != 3.0:
            assert [float(v) for v in look] == [0, 0, 0]


def test_a_finer_source_never_hurts_and_the_retina_alone_is_the_limit():
    for sensor in SMALL:
        nats = []
        for source in (100, 400, 1600, None):
            budget = Budget(source_px=source, match_px=0.15 if source else 0.0)
            at = PlaneSensor(CAMERA, sensor.retina, BASELINE, budget)
            nats.append(float(plane_information(at, 0.3, matched_vergence(BASELINE, torch.tensor(0.3))).information))
        assert nats == sorted(nats)


def test_the_grid_is_its_looks_and_its_summaries():
    sensor = SMALL[0]
    distance, vergence = torch.tensor([0.1, 0.5]), torch.linspace(0, 1.5, 16)
    calls = []
    grid = characterize_planes(sensor, distance, vergence, lambda: calls.append(1))
    assert len(calls) == 32 and grid.information.shape == (2, 16)
    one = plane_information(sensor, 0.5, float(vergence[3]))
    assert float(grid.information[1, 3]) == pytest.approx(float(one.information), abs=1e-6)
    spread = spread_over_vergence(grid)
    assert float(spread[1]) == pytest.approx(float(grid.information[1].max() - grid.information[1].min()))
    for row, d in enumerate(distance):
        assert peak_vergence(sensor, grid, row) == pytest.approx(float(matched_vergence(BASELINE, d)), abs=0.02)
    blind = grid._replace(matched_fraction=torch.zeros(2, 16))
    assert spread_over_vergence(blind).tolist() == [0, 0]


def test_bad_planes_and_eyes_are_refused():
    with pytest.raises(SettingError, match="baseline_m = 0"):
        PlaneSensor(CAMERA, Uniform(2000), 0)
    for distance in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(SettingError, match="distance_m"):
            plane_information(SMALL[1], distance, 0.1)
    with pytest.raises(SettingError, match="source_px = 1"):
        draw_plane(CAMERA, 100.0, 1, straight_eyes(BASELINE, 0.1), 0.5, 0)
    with pytest.raises(SettingError, match="distance_m = 0"):
        draw_plane(CAMERA, 100.0, 64, straight_eyes(BASELINE, 0.1), 0.0, 0)


def test_rays_that_miss_the_plane_are_masked_with_finite_gradients():
    rays = torch.tensor([[1.0, 0.2, 0], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64, requires_grad=True)
    points, meets = plane_points(rays, torch.zeros(3, dtype=torch.float64), 2.0)
    assert meets.tolist() == [True, False, False]
    assert points[0].tolist() == pytest.approx([2, 0.4, 0])
    points.sum().backward()
    assert torch.isfinite(rays.grad).all()


def test_both_eyes_see_one_texture():
    pose = straight_eyes(BASELINE, matched_vergence(BASELINE, torch.tensor(0.4)), torch.float64)
    left, right = draw_plane(CAMERA, 100.0, 160, pose, 0.4, 3)
    assert left.shape == right.shape == (1, 160, 160)
    assert 0 <= float(left.min()) and float(left.max()) <= 1 and float(left.std()) > 0.15
    assert torch.equal(left, draw_plane(CAMERA, 100.0, 160, pose, 0.4, 3)[0])
    # where the right eye sees what a left pixel sees, it sees the same shade
    retinal = (torch.tensor([[60.0, 80], [100, 40], [90, 120]], dtype=torch.float64) - 79.5) / 0.8
    matches, _ = correspond_plane(LOG_POLAR, retinal, pose, 0.4)
    at = (matches.right_px * 0.8) / 79.5
    seen = torch.nn.functional.grid_sample(right[None], at[None, None], align_corners=True)[0, 0, 0]
    for k, (x, y) in enumerate(((60, 80), (100, 40), (90, 120))):
        assert float(seen[k]) == pytest.approx(float(left[0, y, x]), abs=0.12)


def test_noise_fades_under_a_large_footprint():
    place = torch.rand(4000, 2, dtype=torch.float64)
    sharp, blurred = (
        octave_noise(place, torch.full((4000,), size).double(), torch.Generator().manual_seed(0))
        for size in (1e-4, 2.0)
    )
    assert float(sharp.std()) > 4 * float(blurred.std())


def test_rings_count_and_scale():
    sensor = PlaneSensor(CAMERA, LogPolar(4000), BASELINE, Budget())
    distances = off_lattice_distances(sensor, 200, 0.5, 2)
    reach = 100 * BASELINE
    assert [reach / d % 1 for d in distances] == pytest.approx([0.25, 0.75])
    sights = [look_at_plane(sensor, 200, d, float(matched_vergence(BASELINE, torch.tensor(d))), 0) for d in distances]
    sight = pool_sights(sights)
    edges = torch.tensor([0.0, 0.3, 0.7, 1.6])
    rings = rings_of_error(sight, edges)
    assert sum(r.receptive_fields for r in rings) == int(sight.visible.sum())
    found = sight.matched & (sight.eccentricity_rad < 0.3)
    ordered = np.sort((sight.error / sight.sigma).abs()[found].numpy())
    actual = ordered[(len(ordered) - 1) // 2] * 1.4826  # the lower median, as torch has it
    assert rings[0].scale == pytest.approx(actual, rel=1e-4)
    assert rings[0].matched_fraction > 0.9 and rings[0].coverage_95 > 0.9
    assert rings[0].printed_m < rings[0].predicted_m
    means = realised_information(sight, edges)
    assert means["printed"][0] > means["predicted"][0]
    nothing = sight._replace(matched=torch.zeros_like(sight.matched))
    assert rings_of_error(nothing, edges)[0].matched_fraction == 0
    assert realised_information(nothing, edges)["realised"] == (0.0, 0.0)


TINY = [
    "profile=quick", "sensor.receptive_fields=1500", "distances=2", "vergences=3", "propagation.samples=2000",
    "propagation.ratios=[0.05]", "propagation.vergences_deg=[0]", "realised.planes=1", "realised.distances_m=[0.4]",
    "advantage_source_px=[400]", "layout_receptive_fields=300",
]  # fmt: skip


def characterize(tmp_path, *overrides):
    return main(["characterize", *TINY, f"hydra.run.dir={tmp_path}/run", *overrides])


def test_the_command_leaves_what_its_contract_says(tmp_path, capsys):
    assert characterize(tmp_path) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{tmp_path}/run"
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["foveal_advantage_min_nats"] > 5 and result["uniform_monotone"] is True
    for key in ("foveal_advantage_median_nats", "peak_vergence_error_max_rad", "uniform_range_over_foveal_range"):
        assert isinstance(result[key], float)
    assert result["advantage.source_400.median_nats"] < result["advantage.printed.median_nats"]
    with (tmp_path / "run" / "fig5.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "sensor", "distance_m", "vergence_rad", "information", "information_solid_angle", "matched_fraction",
    ]  # fmt: skip
    assert len(rows) == 2 * 2 * 3
    for row in rows:
        assert (row["information"] == "") == (float(row["matched_fraction"]) == 0)
    for name in ("fig5", "layouts", "advantage", "propagation", "realised"):
        assert (tmp_path / "run" / f"{name}.png").stat().st_size > 5000
    assert "nan" not in (tmp_path / "run" / "realised.csv").read_text().lower()


def test_planes_that_nobody_matches_leave_empty_cells(tmp_path):
    """With a narrow view and eyes far apart the axes cross long before the plane: no counterpart anywhere."""
    overrides = ("sensor.fov_deg=20", "vergence_min_deg=60", "realised.run=false", "propagation.run=false")
    assert characterize(tmp_path, *overrides) == 0
    with (tmp_path / "run" / "fig5.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["distance_m"]) == 1.0]
    assert all(row["matched_fraction"] == "0.0" and row["information"] == "" for row in rows)
    json.loads((tmp_path / "run" / "result.json").read_text(), parse_constant=pytest.fail)


def test_planes_are_matched_by_the_matcher_that_is_asked(tmp_path, capsys, monkeypatch):
    few = ("propagation.run=false", "realised.source_px=[100]")
    (tmp_path / "blind.py").write_text(
        "import numpy as np\ndef see(left, right): return np.full(left.shape[:2], np.nan)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    shares = {}
    for matcher in ("sgbm", "sweep", "external"):
        source = ("matcher.source=blind:see",) if matcher == "external" else ()
        assert characterize(tmp_path / matcher, *few, f"matcher={matcher}", *source) == 0, capsys.readouterr().err
        with (tmp_path / matcher / "run" / "realised.csv").open() as file:
            shares[matcher] = [float(row["matched_fraction"]) for row in csv.DictReader(file)]
    assert not any(shares["external"])
    assert max(shares["sgbm"]) > 0.5 and max(shares["sweep"]) > 0.5 and shares["sgbm"] != shares["sweep"]


@pytest.mark.parametrize(
    "override, line",
    [
        ("baseline_m=0", "baseline_m = 0: expected a positive number"),
        ("distance_min_m=0", "distance_min_m = 0: expected more than 0: a plane in front of the eyes"),
        ("distance_max_m=0.01", "distance_max_m = 0.01: expected more than distance_min_m = 0.05"),
        ("vergence_min_deg=-5", "vergence_min_deg = -5: expected at least 0: below, the axes cross behind the head"),
        (
            "vergence_max_deg=200",
            "vergence_max_deg = 200: expected less than 180: beyond, the eyes look behind the head",
        ),
        ("distances=1", "distances = 1: expected at least 2"),
        ("advantage_source_px=[3]", "advantage_source_px = [3.0]: expected whole numbers, at least 16"),
        ("advantage_source_px=[3.5]", "advantage_source_px = [3.5]: expected a list, each of it a whole number"),
        ("realised.distances_m=[-1]", "realised.distances_m = [-1.0]: expected positive distances in metres"),
        ("propagation.ratios=[0]", "propagation.ratios = [0.0]: expected positive numbers"),
        (
            "propagation.eccentricities=[2]",
            "propagation.eccentricities = [2.0]: expected shares of the retina's radius, 0 to 1",
        ),
    ],
)
def test_bad_settings_are_one_line(override, line, tmp_path, capsys):
    assert characterize(tmp_path, override) == 1
    assert capsys.readouterr().err.splitlines() == [f"torchfovea characterize: {line}"]
