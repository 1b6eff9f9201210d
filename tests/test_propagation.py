"""Propagation compared: laws of the comparison, Monte Carlo against NumPy, and what each way is good for."""

import math

import numpy as np
import pytest
import torch

from torchfovea.gaussian import Gaussian, pack, unpack
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError
from torchfovea.studies.characterization import PlaneSensor, elementwise_jacobian
from torchfovea.studies.propagation import (
    chart_point,
    compare_gaussians,
    first_order,
    noise_ratio,
    sample_moments,
    stereo_cases,
    unscented,
)

SENSOR = PlaneSensor(Pinhole.from_fov(90, 100), LogPolar(), budget=Budget())
RATIOS = torch.tensor([0.02, 0.1, 0.2])
CASES = stereo_cases(SENSOR, RATIOS, torch.tensor([0.0, 0.3]), torch.tensor([0.0, 0.5]))
CHARTS = ("cartesian", "inverse_range")


@pytest.fixture(scope="module")
def truth():
    return sample_moments(CASES, CHARTS, 100_000, torch.Generator().manual_seed(1))


def test_cases_have_the_wanted_noise_and_grow_with_distance():
    assert len(CASES.ratio) == 12 and bool(CASES.matches.valid.all())
    got = noise_ratio(CASES.matches, CASES.eyes, CASES.camera).squeeze(-1)
    torch.testing.assert_close(got, CASES.ratio, rtol=1e-3, atol=0)
    # parallel axes at the centre: D = b/Z and σ_D = √(σₗ² + σᵣ²)/f
    sigma = math.hypot(float(CASES.matches.left_sigma_px[0]), float(CASES.matches.right_sigma_px[0]))
    assert float(CASES.distance_m[0]) == pytest.approx(
        0.02 * SENSOR.baseline_m * CASES.camera.focal_px / sigma, rel=1e-3
    )
    assert bool((CASES.distance_m[8:] > CASES.distance_m[:4]).all())


def test_cases_beyond_the_other_retina_are_left_out():
    some = stereo_cases(SENSOR, torch.tensor([0.02]), torch.tensor([0.0]), torch.tensor([0.0, 0.8]))
    assert some.eccentricity_rad.tolist() == [0.0]
    with pytest.raises(SettingError, match="disparities that some place"):
        stereo_cases(SENSOR, torch.tensor([0.02]), torch.tensor([0.0]), torch.tensor([1.0]))
    with pytest.raises(SettingError, match="eccentricities"):
        stereo_cases(SENSOR, RATIOS, torch.tensor([0.0]), torch.tensor([1.5]))


@pytest.mark.parametrize("chart", CHARTS)
def test_the_map_is_the_one_that_observations_go_through(chart):
    seen = observe(CASES.matches, CASES.eyes, CASES.camera, torch.tensor(0.5).double(), SigmaPoints(), chart)
    ours = unscented(CASES, chart, SigmaPoints(), True)
    valid = seen.valid.squeeze(-1)
    assert int(valid.sum()) >= 4
    torch.testing.assert_close(ours.mean[valid], seen.mean.squeeze(-2)[valid], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(ours.cov[valid], seen.cov.squeeze(-2)[valid], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("chart", CHARTS)
def test_first_order_is_the_limit_of_small_noise(chart):
    small = CASES._replace(
        matches=CASES.matches._replace(
            left_sigma_px=1e-3 * CASES.matches.left_sigma_px, right_sigma_px=1e-3 * CASES.matches.right_sigma_px
        )
    )
    ways = [
        first_order(small, chart),
        unscented(small, chart, SigmaPoints.paper(), False),
        unscented(small, chart, SigmaPoints(), True),
    ]
    for other in ways[1:]:
        error = compare_gaussians(small, chart, other, ways[0])
        assert float(error.covariance.max()) < 1e-4 and float(error.mean.max()) < 1e-3


def test_jacobians_are_finite_differences():
    px = torch.cat([CASES.matches.left_px, CASES.matches.right_px], -1)

    def through(place):
        return chart_point(place, CASES.eyes, CASES.camera, "inverse_range", CASES.direction)[0]

    jacobian, step = elementwise_jacobian(through, px), 1e-4
    for k in range(4):
        shift = step * torch.eye(4, dtype=px.dtype)[k]
        torch.testing.assert_close(
            jacobian[..., k], (through(px + shift) - through(px - shift)) / (2 * step), rtol=1e-5, atol=1e-7
        )


def test_moments_of_samples_are_numpys(truth):
    generator = torch.Generator().manual_seed(1)
    px = torch.cat([CASES.matches.left_px, CASES.matches.right_px], -1).squeeze(-2)
    left, right = CASES.matches.left_sigma_px, CASES.matches.right_sigma_px
    sigma = torch.cat([left, left, right, right], -1)
    z = torch.cat(
        [
            torch.randn(4, n, generator=generator, dtype=torch.float64).T
            for n in [1 << 14] * 6 + [100_000 - 6 * (1 << 14)]
        ]
    )
    for k in (1, 6, 11):
        pose = type(CASES.eyes)(*(part[k] for part in CASES.eyes))
        for chart in CHARTS:
            sample, kept = chart_point(px[k] + sigma[k] * z, pose, CASES.camera, chart, CASES.direction[k])
            sample = sample[kept].numpy()
            moments = truth[chart].moments
            np.testing.assert_allclose(moments.mean[k], sample.mean(0), rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(unpack(moments.cov)[k], np.cov(sample.T, bias=True), rtol=1e-6, atol=1e-12)
            assert float(truth[chart].kept[k]) == pytest.approx(kept.double().mean().item())


def test_restriction_and_standard_error(truth):
    far = stereo_cases(SENSOR, torch.tensor([0.5]), torch.tensor([0.0]), torch.tensor([0.0]))
    sampled = sample_moments(far, ("inverse_range",), 40_000, torch.Generator().manual_seed(0), chunk=2000)[
        "inverse_range"
    ]
    assert float(sampled.kept[0]) == pytest.approx(0.97725, abs=0.003)  # P(D > 0) at two standard deviations
    assert float(truth["inverse_range"].range_error.max()) < 0.02


def test_comparison_of_known_errors():
    chart = "inverse_range"
    reference = first_order(CASES, chart)
    wider = Gaussian(reference.mean, 1.1 * reference.cov)
    error = compare_gaussians(CASES, chart, wider, reference)
    for got in error[:2]:
        torch.testing.assert_close(got, torch.full_like(got, 0.1))
    root = torch.linalg.cholesky(unpack(reference.cov))
    moved = Gaussian(reference.mean + root[..., 1] * 0.3, reference.cov)
    torch.testing.assert_close(compare_gaussians(CASES, chart, moved, reference).mean, torch.full((12,), 0.3).double())
    # no choice of units matters
    scale = torch.diag(torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64))
    turned = [Gaussian(g.mean @ scale, pack(scale @ unpack(g.cov) @ scale)) for g in (wider, reference)]
    torch.testing.assert_close(compare_gaussians(CASES, chart, *turned).covariance, error.covariance)


@pytest.mark.parametrize("way", ["first_order", "ut_paper", "ut_default"])
def test_inverse_range_is_right_up_to_a_fifth(truth, way):
    belief = {
        "first_order": lambda: first_order(CASES, "inverse_range"),
        "ut_paper": lambda: unscented(CASES, "inverse_range", SigmaPoints.paper(), False),
        "ut_default": lambda: unscented(CASES, "inverse_range", SigmaPoints(), True),
    }[way]()
    error = compare_gaussians(CASES, "inverse_range", belief, truth["inverse_range"].moments)
    assert float(error.covariance.max()) < 0.02 and float(error.range_variance.abs().max()) < 0.02


def test_cartesian_first_order_is_overconfident(truth):
    error = compare_gaussians(CASES, "cartesian", first_order(CASES, "cartesian"), truth["cartesian"].moments)
    assert float(error.range_variance[8:].max()) < -0.08  # at e = 0.2
    assert float(error.covariance[:4].max()) < 0.02  # at e = 0.02


def test_cartesian_sigma_points_at_one_sigma_are_right_up_to_a_tenth(truth):
    belief = unscented(CASES, "cartesian", SigmaPoints(4, 1.0, 1.0, -3.0), True)
    error = compare_gaussians(CASES, "cartesian", belief, truth["cartesian"].moments)
    assert float(error.covariance[:8].max()) < 0.025 and float(error.range_variance[:8].abs().max()) < 0.025


def test_errors_raised():
    px = torch.zeros(1, 4, dtype=torch.float64)
    one = type(CASES.eyes)(*(part[0] for part in CASES.eyes))
    with pytest.raises(SettingError, match="chart = polar"):
        chart_point(px, one, CASES.camera, "polar")
    with pytest.raises(SettingError, match="direction"):
        chart_point(px, one, CASES.camera, "inverse_range")
    with pytest.raises(SettingError, match="samples = 3"):
        sample_moments(CASES, CHARTS, 3, torch.Generator())
    with pytest.raises(SettingError, match="ratios"):
        stereo_cases(SENSOR, torch.tensor([0.0]), torch.tensor([0.0]), torch.tensor([0.0]))
