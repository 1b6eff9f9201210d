"""Calibration: budgets recovered from synthetic observations, figures against SciPy, the command as users run it."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.special
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.cli import main
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, Disparity, eye_sigma_px
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Gaze, Head, eyes, to_ego
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.stereo.confidence import BLOCK_PX, read_clues
from torchfovea.stereo.matching import correspondences
from torchfovea.stereo.rectified import match_disparity
from torchfovea.studies.calibration import (
    Judged,
    Likelihood,
    concatenate,
    fit_budget,
    judge,
    judged,
    mixture_nll,
    select,
    sigma_of,
)

RETINA = LogPolar(3000)


def observations(count, budget, seed=0, outliers=0.0):
    """Errors drawn from a budget's own law; a share of them ten times as wide."""
    rng = np.random.default_rng(seed)
    spread = {
        "left_gain": rng.uniform(0.01, 0.1, count), "right_gain": rng.uniform(0.01, 0.1, count),
        "left_width_px": rng.uniform(0.1, 4, count), "right_width_px": rng.uniform(0.1, 4, count),
        "pixel_px": np.full(count, 0.5), "bend_px": rng.exponential(2, count) * (rng.random(count) < 0.4),
        "gap_px": rng.exponential(3, count) * (rng.random(count) < 0.3), "claim_px": rng.exponential(0.5, count),
        "range_m": rng.uniform(0.5, 1.5, count), "eccentricity_rad": rng.uniform(0, 1, count),
    }  # fmt: skip
    data = Judged(torch.zeros(count), *(torch.as_tensor(spread[name]) for name in Judged._fields[1:]))
    wide = np.where(rng.random(count) < outliers, 10.0, 1.0)
    return data._replace(error=sigma_of(data, budget) * torch.as_tensor(wide * rng.normal(size=count)))


# ------------------------------------------------------------------------------------------------------------- the fit


@pytest.mark.parametrize("fit_outliers", [False, True])
def test_a_known_budget_is_recovered(fit_outliers):
    true = Budget(0.12, 400, 0.3, bend=0.5, gap=0.25, claim=1.7)
    data = observations(40_000, true, outliers=0.02)
    fit = fit_budget([data], Budget(), Likelihood(fit_outliers=fit_outliers))
    for name in ("sigma_over_width", "match_px", "bend", "gap", "claim"):
        assert getattr(fit.budget, name) == pytest.approx(getattr(true, name), rel=0.05), name
    assert fit.outlier_share == pytest.approx(0.02, abs=0.004)
    assert fit.loss < fit.first_loss and fit.budget.source_px == 400


def test_a_fit_repeats_and_leaves_alone_what_no_observation_tells():
    true = Budget(0.2, 400, 0.1)
    data = observations(2000, true)
    zero = torch.zeros_like(data.error)
    plain = data._replace(bend_px=zero, gap_px=zero, claim_px=zero)
    start = Budget(bend=0.7, gap=0.0, claim=0.9)
    one, other = fit_budget([plain], start), fit_budget([plain], start)
    assert one == other
    assert (one.budget.bend, one.budget.gap, one.budget.claim) == (0.7, 0.0, 0.9)


def test_each_set_weighs_the_same():
    narrow, wide = observations(500, Budget(0.1, 400, 0.1)), observations(5000, Budget(0.3, 400, 0.3), seed=1)
    both = fit_budget([narrow, wide])
    again = fit_budget([concatenate([narrow] * 3), wide])
    assert both.budget.sigma_over_width == pytest.approx(again.budget.sigma_over_width, rel=1e-4)


def test_the_likelihood_has_the_right_gradient():
    torch.manual_seed(0)
    error, variance = torch.randn(6, dtype=torch.float64), torch.rand(6, dtype=torch.float64) + 0.1
    share = torch.tensor(0.05, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (error, variance, share))
    assert torch.autograd.gradcheck(lambda e, v, s: mixture_nll(e, v, s, 10.0), inputs)
    far = mixture_nll(torch.tensor([1e4], requires_grad=True), torch.tensor([1e-6]), torch.tensor(0.01), 10.0)
    assert torch.isfinite(torch.autograd.grad(far.sum(), far)[0]).all() and torch.isfinite(far).all()


@given(st.floats(-30, 30), st.floats(0.01, 10), st.floats(0.001, 0.4), st.floats(1.5, 50))
def test_the_likelihood_against_scipy(error, sigma, share, inflation):
    pair = [math.log(1 - share), math.log(share)], [sigma, inflation * sigma]
    expected = -scipy.special.logsumexp(
        [w + scipy.stats.norm.logpdf(error, scale=s) for w, s in zip(*pair, strict=True)]
    )
    tensors = [torch.tensor(v, dtype=torch.float64) for v in (error, sigma**2, share)]
    assert mixture_nll(*tensors, inflation).item() == pytest.approx(expected, rel=1e-9, abs=1e-9)


# ------------------------------------------------------------------------------------------------------------- judging


def test_figures_against_scipy():
    data = observations(5000, Budget(0.2, 400, 0.2, bend=0.3), seed=3)
    sigma = sigma_of(data, Budget(0.15, 400, 0.1, bend=0.2))
    found, z = judge(data, sigma), (data.error / sigma).numpy()
    for level in (50, 90, 95, 99):
        half = scipy.stats.norm.ppf(0.5 + level / 200)
        assert found[f"coverage_{level}"] == pytest.approx(np.mean(np.abs(z) <= half))
    assert found["nees_mean"] == pytest.approx(np.mean(z[np.abs(z) <= 5] ** 2))
    assert found["outlier_share"] == pytest.approx(np.mean(np.abs(z) > 5))
    assert found["nll"] == pytest.approx(-scipy.stats.norm.logpdf(data.error.numpy(), scale=sigma.numpy()).mean())


def test_an_honest_gaussian_is_judged_honest():
    budget = Budget(0.15, 400, 0.1)
    data = observations(60_000, budget, seed=4)
    level = torch.full_like(data.left_gain, 0.05)  # one σ for all, so that medians are those of one Gaussian
    data = data._replace(left_gain=level, right_gain=level, left_width_px=level, right_width_px=level)
    zero = torch.zeros_like(level)
    data = data._replace(bend_px=zero, gap_px=zero, claim_px=zero, range_m=torch.ones_like(level))
    sigma = sigma_of(data, budget)
    noise = torch.randn(len(level), generator=torch.Generator().manual_seed(0), dtype=level.dtype)
    found = judge(data._replace(error=sigma * noise), sigma)
    assert found["nees_mean"] == pytest.approx(1, abs=0.02)
    assert found["coverage_50"] == pytest.approx(0.5, abs=0.01) and found["coverage_95"] == pytest.approx(
        0.95, abs=0.005
    )
    assert found["interval_over_error"] == pytest.approx(1.96 / 0.6745, rel=0.02)


def test_selecting_and_joining():
    data = observations(300, Budget())
    halves = select(data, torch.arange(300) < 100), select(data, torch.arange(300) >= 100)
    for a, b in zip(concatenate(halves), data, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("camera", [Pinhole.from_fov(90, 100), Fisheye.from_fov(120, 100)])
def test_first_order_is_what_observe_says(camera, generator):
    """The fit's σ beside the unscented transform's, at verged eyes in a turned head."""
    head, budget = Head(), Budget(0.15, 400, 0.2, bend=0.5, gap=0.3)
    pose = eyes(head, Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (0.3, 0.2, 0.15))))
    left_px = RETINA.centers_px(dtype=torch.float64)
    ray = torch.nn.functional.normalize(camera.rays(left_px), dim=-1)
    away = 0.6 + 0.8 * torch.rand(RETINA.count, generator=generator, dtype=torch.float64)
    points = pose.t_left + to_ego(pose.R_left, ray) * away[:, None]
    visible = torch.ones(RETINA.count, dtype=torch.bool)
    matches = correspond_points(points, visible, left_px, pose, camera, RETINA, budget, None)
    clues = Clues(*(torch.rand(RETINA.count, generator=generator, dtype=torch.float64) for _ in range(2)))
    matches = matches._replace(
        left_sigma_px=eye_sigma_px(budget, RETINA, matches.left_px, clues),
        right_sigma_px=eye_sigma_px(budget, RETINA, matches.right_px, clues),
    )
    data, which = judged(matches, pose, camera, RETINA, budget, 1 / away, clues)
    assert len(data.error) == int(which.sum()) > 0.5 * RETINA.count
    assert data.claim_px.abs().max() == 0
    # the unscented mean differs from the truth by the curvature alone
    assert (data.error.abs() / sigma_of(data, budget)).max() < 0.1
    at_eye = pose._replace(t_left=torch.zeros_like(pose.t_left), t_right=pose.t_right - pose.t_left)
    seen = observe(matches, at_eye, camera, RETINA.width_px(left_px) / 2)
    expected = seen.cov[which, 5].sqrt()
    torch.testing.assert_close(sigma_of(data, budget), expected, rtol=0.02, atol=0)
    assert (sigma_of(data, budget) / expected - 1).abs().median() < 2e-3
    torch.testing.assert_close(data.range_m, away[which])


def test_a_matchers_own_claim_is_found_again():
    camera, budget = Pinhole.from_fov(90, 100), Budget(claim=2.0)
    left_px = RETINA.centers_px(dtype=torch.float64)
    right_px = left_px - torch.tensor([5.0, 0.0], dtype=torch.float64)
    own = torch.linspace(0.05, 2, RETINA.count, dtype=torch.float64)
    left, right = (eye_sigma_px(budget, RETINA, px) for px in (left_px, right_px))
    matches = Correspondences(
        left_px, right_px, left, torch.hypot(right, 2.0 * own), torch.ones_like(own, dtype=torch.bool)
    )
    pose = eyes(Head(), Gaze(*torch.zeros(3, dtype=torch.float64)))
    data, which = judged(matches, pose, camera, RETINA, budget, torch.ones_like(own))
    seen = data.claim_px > 0
    torch.testing.assert_close(data.claim_px[seen], own[which][seen])
    assert seen.double().mean() > 0.9


def test_unknown_truth_is_left_out_and_nothing_is_an_error():
    camera = Pinhole.from_fov(90, 100)
    left_px = RETINA.centers_px()
    sigma, valid = torch.full((RETINA.count,), 0.1), torch.ones(RETINA.count, dtype=torch.bool)
    matches = Correspondences(left_px, left_px - torch.tensor([4.0, 0.0]), sigma, sigma, valid)
    pose = eyes(Head(), Gaze(*torch.zeros(3)))
    truth = torch.ones(RETINA.count)
    truth[:10], truth[10:20], truth[20:30] = math.nan, 0.0, math.inf
    data, which = judged(matches, pose, camera, RETINA, Budget(), truth)
    assert not which[:30].any() and len(data.error) == int(which.sum()) == RETINA.count - 30
    empty, _ = judged(matches._replace(valid=~valid), pose, camera, RETINA, Budget(), truth)
    assert len(empty.error) == 0
    with pytest.raises(SettingError, match="observations with truth = 0"):
        judge(empty, sigma_of(empty, Budget()))
    with pytest.raises(SettingError, match="observations with truth = 0: expected at least 100"):
        fit_budget([empty])
    with pytest.raises(SettingError, match=r"budget\.source = False"):
        fit_budget([data], Budget.printed)
    with pytest.raises(SettingError, match="sets = 0"):
        fit_budget([])


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: Likelihood(outlier_share=0.0), r"fit\.outlier_share = 0"),
        (lambda: Likelihood(inflation=1.0), r"fit\.inflation = 1"),
        (lambda: Budget(bend=-1.0), r"budget\.bend = -1"),
        (lambda: Budget(gap=math.inf), r"budget\.gap = inf"),
        (lambda: Budget(claim=math.nan), r"budget\.claim = nan"),
        (lambda: Budget(shared=1.0), r"budget\.shared = 1\.0"),
        (lambda: Budget(shared_px=-1.0), r"budget\.shared_px = -1"),
        (lambda: Budget(shared_widths=math.inf), r"budget\.shared_widths = inf"),
        (lambda: Budget(shared=0.2, lasting=0.3), r"budget\.lasting = 0\.3: expected 0 or more and not above"),
    ],
)
def test_impossible_numbers(make, line):
    with pytest.raises(SettingError, match=line):
        make()


# --------------------------------------------------------------------------------------------------------------- clues


def field(disparity, valid=None):
    values = torch.as_tensor(disparity, dtype=torch.float64)
    mask = torch.ones_like(values, dtype=torch.bool) if valid is None else torch.as_tensor(valid)
    return Disparity(torch.zeros_like(values), values, mask, Pinhole(100.0), 0.0, 0.1)


def test_clues_against_a_loop():
    rng = np.random.default_rng(0)
    disparity, valid = rng.normal(20, 3, (50, 60)), rng.random((50, 60)) < 0.8
    place = np.stack([rng.uniform(-2, 62, 80), rng.uniform(-2, 52, 80)], -1)
    shift, width = rng.normal(20, 3, 80), rng.uniform(0, 9, 80)
    found = read_clues(field(disparity, valid), *(torch.as_tensor(a) for a in (place, shift, width)))
    for i, (x, y) in enumerate(place):
        radius, bend, holes = math.hypot(width[i], BLOCK_PX), 0.0, 0

        def read(angle, x=x, y=y, radius=radius):
            u, v = round(x + radius * math.cos(angle)), round(y + radius * math.sin(angle))
            return disparity[v, u] if 0 <= u < 60 and 0 <= v < 50 and valid[v, u] else None

        for k in range(4):
            one, other = read(k * math.pi / 4), read(k * math.pi / 4 + math.pi)
            holes += (one is None) + (other is None)
            if one is not None and other is not None:
                bend = max(bend, abs((one + other) / 2 - shift[i]))
        assert found.bend_px[i].item() == pytest.approx(bend)
        assert found.gap_px[i].item() == pytest.approx(radius * holes / 8)


def test_a_slant_is_no_clue_and_an_edge_is():
    column = np.broadcast_to(np.arange(60.0), (50, 60))
    place = torch.tensor([[30.0, 25.0]], dtype=torch.float64)
    slanted = read_clues(field(10 + 0.2 * column), place, torch.tensor([16.0]).double(), torch.ones(1).double())
    assert slanted.bend_px.item() < 0.01 and slanted.gap_px.item() == 0
    edge = read_clues(
        field(np.where(column > 31, 30.0, 10.0)), place, torch.tensor([10.0]).double(), torch.ones(1).double()
    )
    assert edge.bend_px.item() == pytest.approx(10)


def test_clues_widen_the_matchers_error():
    budget = Budget(0.1, 200, 0.2, bend=0.5, gap=0.25)
    px, clues = torch.tensor([[3.0, 4.0]]), Clues(torch.tensor([6.0]), torch.tensor([8.0]))
    expected = math.sqrt((0.1 * RETINA.width_px(px).item()) ** 2 + 0.1**2 + 0.2**2 + 3.0**2 + 2.0**2)
    assert eye_sigma_px(budget, RETINA, px, clues).item() == pytest.approx(expected, rel=1e-5)
    assert eye_sigma_px(replace(budget, source_px=None), RETINA, px, clues).item() == pytest.approx(
        0.1 * RETINA.width_px(px).item(), rel=1e-5
    )
    pixels = correspondences(px, px, torch.tensor([True]), None, budget, clues)
    assert pixels.left_sigma_px.item() == pytest.approx(math.sqrt(0.1**2 + 0.2**2 + 3.0**2 + 2.0**2), rel=1e-5)


def test_matches_carry_the_same_sigma_as_the_fit_assumes():
    """What sense and search will claim with a fitted budget is what the fit made honest."""
    rng = np.random.default_rng(1)
    disparity = np.where(np.arange(160) > 90, 14.0, 9.0) + 0.1 * rng.normal(size=(120, 160))
    valid = rng.random((120, 160)) < 0.95
    budget, retina = Budget(0.12, 400, 0.1, bend=0.6, gap=0.3), Uniform(2000)
    left, right = Pinhole(150.0, 79.5, 59.5), Pinhole(150.0, 79.5, 59.5)
    match = match_disparity(disparity, left, right, 0.1, retina, valid=valid, budget=budget)
    found, scale = match.correspondences, 120 / 200
    place = found.left_px * scale + torch.tensor([79.5, 59.5])
    shift, width = (found.left_px - found.right_px)[:, 0] * scale, retina.width_px(found.left_px) * scale
    clues = read_clues(match.disparity, place, shift, width)
    own = replace(budget, source_px=120)
    same = torch.eye(3)
    from torchfovea.sensing.head import Eyes

    pose = Eyes(same, torch.zeros(3), same, torch.tensor([0.1, 0.0, 0.0]))
    data, which = judged(
        found, pose, match.camera_left, retina, own, torch.ones(retina.count), clues, match.camera_right
    )
    seen = observe(found, pose, match.camera_left, width, right_camera=match.camera_right)
    assert data.bend_px.max() > 2 and data.gap_px.max() > 0 and data.claim_px.max() == 0
    ratio = sigma_of(data, own).double() / seen.cov[which, 5].sqrt().double()
    assert ratio.median().item() == pytest.approx(1, abs=2e-3) and (ratio - 1).abs().quantile(0.9) < 0.05


# --------------------------------------------------------------------------------------------------------- the command


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return tmp_path


def calibrate(capsys, *overrides):
    assert main(["calibrate", *overrides]) == 0, capsys.readouterr().err
    run = Path(capsys.readouterr().out.splitlines()[-1])
    return run, json.loads((run / "result.json").read_text())


FIGURES = ("nees_mean", "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nll", "outlier_share", "ause")


def test_the_motorcycle_alone_and_its_budget_used(folder, capsys):
    small = "sensor.receptive_fields=6000", "matcher.nearest_range_m=1.5"
    run, result = calibrate(capsys, "scenes=0", "real=true", *small)
    for name in FIGURES:
        assert math.isfinite(result[f"before.{name}"]) and math.isfinite(result[f"after.{name}"])
    assert result["after.nll"] < result["before.nll"]
    assert 0.9 < result["after.coverage_95"] < 0.98
    assert {"result.json", "bins.csv", "calibration.png", "budget"} <= {p.name for p in run.iterdir()}
    rows = list(csv.DictReader((run / "bins.csv").read_text().splitlines()))
    whole = [row for row in rows if row["range_from_m"] == row["eccentricity_from_deg"] == ""]
    assert [row["model"] for row in whole] == ["before", "after"]
    assert float(whole[1]["nees_mean"]) == pytest.approx(result["after.nees_mean"])
    assert int(whole[0]["observations"]) == result["observations"]
    assert main(["sense", "--config-dir", str(run), "budget=fitted", "pair=motorcycle", *small]) == 0
    sensed = json.loads((Path(capsys.readouterr().out.splitlines()[-1]) / "result.json").read_text())
    assert 0.9 < sensed["coverage_95"] < 0.98


def test_simulated_scenes(folder, capsys):
    sizes = "scenes=1", "judged_scenes=1", "looks=1", "sensor.receptive_fields=3000", "sensor.source_px=200"
    run, result = calibrate(capsys, *sizes)
    assert result["after.nll"] < result["before.nll"] and result["observations"] > 1000
    assert 0.9 < result["after.coverage_95"] <= 0.99
    again = calibrate(capsys, *sizes)[1]
    assert again == result
    text = (run / "budget" / "fitted.yaml").read_text()
    assert "scenes cans" in text and "source: true" in text


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["scenes=0"], "scenes = 0: expected at least 1, or real=true"),
        (["real=maybe"], "real = maybe: expected true or false"),
        (["looks=0"], "looks = 0"),
        (["judged_scenes=0"], "judged_scenes = 0"),
        (["fit.inflation=0.5"], "fit.inflation = 0.5"),
        (["range_edges_m=[2, 1]"], "range_edges_m = [2, 1]: expected two or more ascending numbers"),
        (["matcher.name=magic"], "matcher.name = magic"),
        (["OWN"], "disparity = null: expected the true disparity"),
        (["OWN", "disparity=truth.npy"], "observations with truth = 0: expected at least 100"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(folder, capsys, overrides, line):
    cv2.imwrite("grey.png", np.full((120, 160), 128, np.uint8))
    np.save("truth.npy", np.full((120, 160), 8, np.float32))
    own = ["scenes=0", "real=true", "pair=null", "left=grey.png", "right=grey.png", "focal_px=180", "cx_px=79.5"]
    own += ["cy_px=59.5", "baseline_m=0.1", "sensor.receptive_fields=2000"]
    overrides = [o for item in overrides for o in (own if item == "OWN" else [item])]
    assert main(["calibrate", *overrides]) != 0
    printed = capsys.readouterr()
    assert printed.err.startswith("torchfovea calibrate: ") and len(printed.err.splitlines()) == 1, printed.err
    assert line in printed.err
    assert not list(folder.rglob("result.json"))


@pytest.mark.parametrize("name", ["ours", "printed", "calibrated"])
def test_the_budgets_that_come_along(name):
    from hydra import compose, initialize_config_dir

    from torchfovea.config import conf_dir
    from torchfovea.experiments.build import construct

    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("sense", [f"budget={name}"])
    budget = construct(Budget, {**cfg.budget, "source_px": 400 if cfg.budget.source else None}, "budget")
    expected = {"ours": Budget(), "printed": Budget.printed}.get(name, budget)
    assert budget == expected and (budget.bend > 0) == (name == "calibrated")
