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
from synthetic import LINE, observations, without_clues

from torchfovea.cli import main
from torchfovea.commands.shared.regions import REGIONS
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, Disparity, eye_sigma_px
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Gaze, Head, eyes, to_ego
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.stereo.confidence import BLOCK_PX, read_clues
from torchfovea.stereo.maps import correspondences, match_disparity
from torchfovea.stereo.views import rectified_views
from torchfovea.studies.calibration import (
    concatenate,
    inlier_of,
    judge,
    judged,
    mixture_nll,
    mixture_std,
    reliability,
    select,
    sigma_of,
)
from torchfovea.studies.fitting import Likelihood, fit_budget, least_match_px

RETINA = LogPolar(3000)


# ------------------------------------------------------------------------------------------------------------- the fit


def test_a_known_budget_is_recovered():
    spread = {"bend": 0.5, "gap": 0.25, "fringe": 0.3, "noise": 0.8, "claim": 1.7}
    odds = {"outliers_gap": 0.8, "outliers_hidden": 1.0}
    true = Budget(0.12, 400, 0.3, **spread, outliers=0.03, **odds, outliers_mismatch=2.0)
    sets = [observations(40_000, true, seed) for seed in range(8)]
    fit = fit_budget(sets, Budget())
    for name in ("sigma_over_width", "match_px", *spread):
        assert getattr(fit.budget, name) == pytest.approx(getattr(true, name), rel=0.1), name
    for name in (*odds, "outliers_mismatch"):
        assert getattr(fit.budget, name) == pytest.approx(getattr(true, name), rel=0.25), name
    assert fit.budget.outliers == pytest.approx(0.03, abs=0.008)
    assert fit.loss < fit.first_loss and fit.budget.source_px == 400
    # what the fit claims is true: its own probabilities, on observations that it never saw
    fresh = observations(60_000, true, seed=99)
    claimed, real = inlier_of(fresh, fit.budget), inlier_of(fresh, true)
    assert (claimed - real).abs().mean() < 0.02
    rows = reliability(fresh, sigma_of(fresh, fit.budget), claimed, [0, 0.6, 0.8, 0.9, 1])
    assert sum(row[2] for row in rows) == 60_000 and [row[1] for row in rows] == [0.6, 0.8, 0.9, 1]
    # some wild ones fall within 3 sigma
    lucky = (6 * sigma_of(fresh, fit.budget) / LINE).clamp(max=1)
    for low, high, count, p, near in rows:
        row = (claimed > low) & (claimed <= high)
        expected = 0.9973 * claimed[row] + lucky[row] * (1 - claimed[row])
        assert p == pytest.approx(claimed[row].mean().item())
        assert near == pytest.approx(expected.mean().item(), abs=0.02 + 2 / math.sqrt(count))


def test_outliers_that_are_not_fitted_keep_their_share():
    true = Budget(0.12, 400, 0.3, claim=0.0, outliers=0.02)
    data = without_clues(observations(20_000, true))
    fit = fit_budget([data], Budget(), Likelihood(fit_outliers=False))
    assert fit.budget.outliers == pytest.approx(0.02) and fit.budget.outliers_gap == 0
    assert fit.budget.match_px == pytest.approx(0.3, rel=0.1)


def test_a_fit_repeats_and_leaves_alone_what_no_observation_tells():
    plain = without_clues(observations(2000, Budget(0.2, 400, 0.1)))
    start = Budget(bend=0.7, gap=0.0, claim=0.9, outliers_gap=0.4)
    one, other = fit_budget([plain], start), fit_budget([plain], start)
    assert one == other
    assert (one.budget.bend, one.budget.gap, one.budget.claim, one.budget.outliers_gap) == (0.7, 0.0, 0.9, 0.4)


def test_each_set_weighs_the_same():
    narrow, wide = observations(500, Budget(0.1, 400, 0.1)), observations(5000, Budget(0.3, 400, 0.3), seed=1)
    both = fit_budget([narrow, wide]).budget.sigma_over_width
    assert both == pytest.approx(fit_budget([wide, concatenate([narrow] * 3)]).budget.sigma_over_width, rel=0.1)


def test_a_set_weighs_by_area():
    """Narrow fields that err much and cover nothing do not decide."""
    wide = without_clues(observations(3000, Budget(0.1, 400, 0.1)))
    wide = wide._replace(left_width_px=torch.full_like(wide.error, 3.0))
    wide = wide._replace(
        error=sigma_of(wide, Budget(0.1, 400, 0.1)) * torch.randn(3000, generator=torch.Generator().manual_seed(0))
    )
    narrow = wide._replace(left_width_px=torch.full_like(wide.error, 0.01), error=50 * wide.error)
    fit = fit_budget([concatenate([wide, narrow, narrow])])
    assert fit.budget.sigma_over_width == pytest.approx(fit_budget([wide]).budget.sigma_over_width, rel=0.15)


def test_a_truth_in_steps_leaves_sigma_its_width():
    data = without_clues(observations(3000, Budget(0.05, 400, 0.0)))
    data = data._replace(error=torch.zeros_like(data.error) + 1e-9)
    fit = fit_budget([data], least_match=least_match_px(1 / 3))
    assert fit.budget.match_px >= least_match_px(1 / 3) == pytest.approx(1 / 3 / math.sqrt(12) / math.sqrt(2))


def test_the_likelihood_has_the_right_gradient():
    torch.manual_seed(0)
    error, variance = torch.randn(6, dtype=torch.float64), torch.rand(6, dtype=torch.float64) + 0.1
    share = torch.tensor(0.95, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (error, variance, share))
    assert torch.autograd.gradcheck(lambda e, v, s: mixture_nll(e, v, s, torch.tensor(4.0)), inputs)
    for p in (0.99, 1.0):
        far = mixture_nll(
            torch.tensor([1e4], requires_grad=True), torch.tensor([1e-6]), torch.tensor(p), torch.tensor(4.0)
        )
        assert torch.isfinite(torch.autograd.grad(far.sum(), far)[0]).all() and torch.isfinite(far).all()


@given(st.floats(-30, 30), st.floats(0.01, 10), st.floats(0.001, 1.0), st.floats(0.1, 50))
def test_the_likelihood_against_scipy(error, sigma, inlier, line):
    terms = [math.log(inlier) + scipy.stats.norm.logpdf(error, scale=sigma)]
    terms += [math.log1p(-inlier) - math.log(line)] if inlier < 1 else []
    tensors = [torch.tensor(v, dtype=torch.float64) for v in (error, sigma**2, inlier, line)]
    expected = -scipy.special.logsumexp(terms)
    assert mixture_nll(*tensors).item() == pytest.approx(expected, rel=1e-9, abs=1e-9)


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
    data = without_clues(data)._replace(range_m=torch.ones_like(level))
    sigma = sigma_of(data, budget)
    noise = torch.randn(len(level), generator=torch.Generator().manual_seed(0), dtype=level.dtype)
    found = judge(data._replace(error=sigma * noise), sigma)
    assert found["inlier_share"] == found["inlier_mean"] == 1 and found["mixture_nll"] == pytest.approx(found["nll"])
    assert found["nees_mean"] == pytest.approx(1, abs=0.02)
    assert found["coverage_50"] == pytest.approx(0.5, abs=0.01) and found["coverage_95"] == pytest.approx(
        0.95, abs=0.005
    )
    assert found["interval_over_error"] == pytest.approx(1.96 / 0.6745, rel=0.02)


def test_weights_are_repetitions():
    data = observations(400, Budget(outliers=0.1), seed=5)
    times = torch.arange(400) % 3
    again = select(data, torch.repeat_interleave(torch.arange(400), times))
    claims = [(sigma_of(d, Budget()), inlier_of(d, Budget(outliers=0.3, outliers_gap=1.0))) for d in (data, again)]
    weighted, repeated = judge(data, *claims[0], times), judge(again, *claims[1])
    for name in weighted.keys() - {"ause"}:
        assert weighted[name] == pytest.approx(repeated[name]), name


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
    matches = correspond_points(points, visible, left_px, pose, camera, RETINA, budget)
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
        (lambda: Budget(outliers=1.0), r"budget\.outliers = 1\.0"),
        (lambda: Budget(outliers_gap=-1.0), r"budget\.outliers_gap = -1"),
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
    camera, black = Pinhole(150.0, 79.5, 59.5), torch.zeros(1, 120, 160)
    views = rectified_views(black, black, camera, camera, 0.1)
    found, field = match_disparity(disparity, views, retina, budget, valid=valid)
    scale, (left, right) = 120 / 200, views.cameras(retina)
    place = found.left_px * scale + torch.tensor([79.5, 59.5])
    shift, width = (found.left_px - found.right_px)[:, 0] * scale, retina.width_px(found.left_px) * scale
    clues = read_clues(field, place, shift, width)
    own = replace(budget, source_px=120)
    same = torch.eye(3)
    from torchfovea.sensing.head import Eyes

    pose = Eyes(same, torch.zeros(3), same, torch.tensor([0.1, 0.0, 0.0]))
    data, which = judged(found, pose, (left, right), retina, own, torch.ones(retina.count), clues)
    seen = observe(found, pose, (left, right), width)
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
    assert result["after.mixture_nll_by_area"] < result["before.mixture_nll_by_area"]
    assert 0.9 < result["after.coverage_95"] < 0.98
    assert 0 < result["after.inlier_mean"] < 1 == result["before.inlier_mean"]
    assert sum(result[f"after.{region}.share_by_area"] for region in REGIONS) == pytest.approx(1)
    assert result["after.edge.coverage_95_by_area"] < result["after.smooth.coverage_95_by_area"]
    assert {"result.json", "bins.csv", "calibration.png", "budget"} <= {p.name for p in run.iterdir()}
    rows = list(csv.DictReader((run / "bins.csv").read_text().splitlines()))
    whole = [row for row in rows if row["range_from_m"] == row["eccentricity_from_deg"] == ""]
    assert [row["model"] for row in whole] == ["before", "after"]
    assert float(whole[1]["nees_mean"]) == pytest.approx(result["after.nees_mean"])
    assert int(whole[0]["observations"]) == result["observations"]
    assert main(["sense", "--config-dir", str(run), "budget=fitted", "pair=motorcycle", *small]) == 0
    sensed = json.loads((Path(capsys.readouterr().out.splitlines()[-1]) / "result.json").read_text())
    assert 0.9 < sensed["coverage_95"] < 0.98 and 0 < sensed["inlier_mean"] < 1


def test_simulated_scenes(folder, capsys):
    sizes = "scenes=1", "judged_scenes=1", "looks=1", "sensor.receptive_fields=3000", "sensor.source_px=200"
    run, result = calibrate(capsys, *sizes)
    assert result["after.mixture_nll"] < result["before.mixture_nll"] and result["observations"] > 1000
    assert 0.9 < result["after.coverage_95_by_area"] <= 0.99  # the fit weighs by area
    again = calibrate(capsys, *sizes, "workers=2")[1]  # processes of one thread each, which may round otherwise
    known, repeated = ({k: v for k, v in found.items() if v is not None} for found in (result, again))
    assert repeated == pytest.approx(known, rel=1e-3, abs=1e-5, nan_ok=True)
    text = (run / "budget" / "fitted.yaml").read_text()
    assert "scenes cans" in text and "source: true" in text


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["scenes=0"], "scenes = 0: expected at least 1, real=true or pairs"),
        (["pairs=art"], "pairs = art: expected a list"),
        (["scenes=0", "pairs=[nowhere]"], "pairs[0] = nowhere: expected motorcycle, or a folder"),
        (["scenes=0", "pairs=[3]"], "pairs = [3]: expected a list, each of it text"),
        (["fovs_deg=[90, 60]"], "fovs_deg = [90, 60]: expected ascending numbers"),
        (["real=maybe"], "real = maybe: expected true or false"),
        (["looks=0"], "looks = 0"),
        (["judged_scenes=0"], "judged_scenes = 0"),
        (["fit.outlier_share=0.5"], "fit.outlier_share = 0.5"),
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


@pytest.mark.parametrize("name", ["ours", "printed"])
def test_the_budgets_that_come_along(name):
    from hydra import compose, initialize_config_dir

    from torchfovea.commands.shared.config import conf_dir
    from torchfovea.commands.shared.settings import construct

    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("sense", [f"budget={name}"])
    budget = construct(Budget, {**cfg.budget, "source_px": 400 if cfg.budget.source else None}, "budget")
    assert budget == {"ours": Budget(), "printed": Budget.printed}[name]


def test_one_standard_deviation_for_a_mixture_holds_its_95_percent():
    p = torch.tensor([1.0, 0.99, 0.9, 0.5, 0.0], dtype=torch.float64)
    sigma, spread = torch.full_like(p, 0.02), torch.tensor(0.3, dtype=torch.float64)
    claimed = mixture_std(sigma, p, spread)
    assert claimed[0].item() == pytest.approx(0.02) and claimed[-1].item() == pytest.approx(math.hypot(0.02, 0.3))
    rng = np.random.default_rng(0)
    for share, std in zip(p.tolist(), claimed.tolist(), strict=True):
        width = np.where(rng.random(400_000) < share, 0.02, math.hypot(0.02, 0.3))
        inside = np.mean(np.abs(width * rng.normal(size=400_000)) < 1.959964 * std)
        assert inside == pytest.approx(0.95, abs=0.002)
