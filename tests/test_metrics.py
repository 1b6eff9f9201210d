"""Metrics against plain NumPy loops and SciPy."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from torchfovea import metrics as mt
from torchfovea.gaussian import pack
from torchfovea.setting import SettingError

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def series(*shape, seed=0, dtype=torch.float64):
    rewards = -6 * torch.rand(*shape, generator=generator(seed), dtype=dtype)
    return rewards, rewards.amax(-1) + torch.rand(shape[:-1], generator=generator(seed + 1), dtype=dtype)


@dtypes
def test_gap_and_regret_by_loops(dtype):
    rewards, best = series(3, 4, 12, dtype=dtype)
    gap, regret = mt.gap(rewards, best), mt.regret(rewards, best)
    assert gap.dtype == regret.dtype == dtype
    for i, j in itertools.product(range(3), range(4)):
        r, star = rewards[i, j].double().numpy(), best[i, j].item()
        gaps = [(max(r[: t + 1]) - r[0]) / (star - r[0]) for t in range(12)]
        regrets = [star - sum(r[: t + 1]) / (t + 1) for t in range(12)]
        assert gap[i, j].tolist() == pytest.approx(gaps, rel=1e-5, abs=1e-6)
        assert regret[i, j].tolist() == pytest.approx(regrets, rel=1e-5, abs=1e-6)
        assert mt.gap_per_saccade(rewards, best)[i, j].item() == pytest.approx(sum(gaps) / 12, rel=1e-5)
        assert mt.regret_per_saccade(rewards, best)[i, j].item() == pytest.approx(sum(regrets) / 12, rel=1e-5)


def test_gap_at_its_limits():
    first_is_best = torch.tensor([-1.0, -3.0, -2.0])
    assert mt.gap(first_is_best, torch.tensor(-1.0)).tolist() == [1, 1, 1]
    assert mt.gap(first_is_best, torch.tensor(-1.001)).tolist() == [1, 1, 1]  # a ray that passes the best by a rounding
    assert mt.gap(torch.tensor([-2.0, -0.99]), torch.tensor(-1.0)).tolist() == [0, 1]
    rewards = torch.tensor([-1.0, -2.0], requires_grad=True)
    (gradient,) = torch.autograd.grad(mt.gap(rewards, torch.tensor(-1.0)).sum(), rewards)
    assert torch.isfinite(gradient).all()


@given(st.integers(0, 10**6), st.floats(0.1, 10), st.floats(-5, 5))
@settings(max_examples=40, deadline=None)
def test_laws_of_gap_and_regret(seed, scale, shift):
    rewards, best = series(7, seed=seed)
    gap = mt.gap(rewards, best)
    assert gap[0] == 0 and (gap.diff() >= 0).all() and (gap <= 1).all()
    torch.testing.assert_close(mt.gap(rewards * scale + shift, best * scale + shift), gap)
    regret = mt.regret(rewards, best)
    assert (regret >= 0).all()
    torch.testing.assert_close(mt.regret(rewards * scale + shift, best * scale + shift), regret * scale)


def test_search_outcomes():
    hit = torch.tensor([[True, False, True], [False, False, True], [False, False, False]])
    assert mt.saccades_to_target(hit).tolist() == [0, 2, 3]
    assert mt.found(hit).tolist() == [True, True, False]
    path = torch.tensor([[[1.0, 0, 0], [0, 2.0, 0], [0, 2.0, 0], [0, -1.0, 0]], [[0, 0, 1.0]] * 4])
    assert mt.degrees_travelled(path).tolist() == pytest.approx([270.0, 0.0])


# --- information -----------------------------------------------------------------------------------------------------


def covariances(*shape, seed=0):
    root = torch.randn(*shape, 3, 3, generator=generator(seed), dtype=torch.float64)
    return root @ root.mT + 1e-3 * torch.eye(3, dtype=torch.float64)


def test_information_is_minus_the_log_determinant():
    cov = covariances(4, 5)
    expected = -np.linalg.slogdet(cov.numpy())[1]
    np.testing.assert_allclose(mt.information(pack(cov)).numpy(), expected, rtol=1e-9)
    assert torch.autograd.gradcheck(mt.information, pack(cov).requires_grad_())


@pytest.mark.parametrize("length", [1.0, 1000.0])
def test_information_of_a_thin_gaussian_in_float32(length):
    axis = torch.tensor([0.8, 0.36, 0.48], dtype=torch.float64)
    thin = 0.003 * length  # 1:333, of which float32 keeps a relative 1e-2 in the smallest eigenvalue
    cov = length**2 * torch.outer(axis, axis) + thin**2 * torch.eye(3, dtype=torch.float64)
    exact = -np.linalg.slogdet(cov.numpy())[1]
    single = mt.information(pack(cov).float())
    assert single.dtype == torch.float32
    assert single.item() == pytest.approx(exact, abs=0.05)


def test_singular_covariance_has_finite_information():
    axis = torch.tensor([0.8, 0.36, 0.48])
    cov = pack(torch.outer(axis, axis)).requires_grad_()
    value = mt.information(cov)
    assert 20 < value.item() < 60
    assert torch.isfinite(torch.autograd.grad(value, cov)[0]).all()


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_information_refuses_what_is_no_covariance(bad):
    cov = torch.tensor([[1.0, 0, 0, 1.0, 0, 1.0], [1.0, 0, 0, bad, 0, 1.0]])
    with pytest.raises(SettingError, match=r"covariance yy = .*positive, finite"):
        mt.information(cov)


def test_global_and_local_information_by_loops():
    cov, g = covariances(2, 3, 20), generator(4)
    points = torch.randn(3, 20, 3, generator=g, dtype=torch.float64)
    points[0, 5] = math.nan
    target = points[:, 1] + torch.tensor([0.3, 0.0, 50.0], dtype=torch.float64) * torch.tensor([[0.0], [1.0], [1.0]])
    near = mt.near_target(points, target, 0.9)
    local, defined = mt.local_information(pack(cov), near)
    everything = mt.global_information(pack(cov))
    for b, e in itertools.product(range(2), range(3)):
        info = [-np.linalg.slogdet(cov[b, e, i].numpy())[1] for i in range(20)]
        close = [i for i in range(20) if np.linalg.norm(points[e, i].numpy() - target[e].numpy()) < 0.9]
        assert near[e].nonzero()[:, 0].tolist() == close
        assert everything[b, e].item() == pytest.approx(np.mean(info))
        assert defined[b, e].item() == bool(close)
        assert local[b, e].item() == pytest.approx(np.mean([info[i] for i in close]) if close else 0.0)
    assert defined.any() and not defined.all()


# --- honesty ---------------------------------------------------------------------------------------------------------


def test_calibration_of_honest_and_dishonest_errors():
    variance = torch.rand(50000, generator=generator(), dtype=torch.float64) + 0.1
    error = variance.sqrt() * torch.randn(50000, generator=generator(1), dtype=torch.float64)
    z = error / variance.sqrt()
    assert mt.nees(error, variance).mean().item() == pytest.approx(1, abs=0.03)
    assert mt.nees_mean(z).item() == pytest.approx(1, abs=0.03)
    assert mt.coverage(z).tolist() == pytest.approx([0.5, 0.9, 0.95, 0.99], abs=0.01)
    assert mt.outlier_share(z) == 0
    assert mt.coverage(3 * z)[1] < 0.5
    assert mt.nees_mean(2 * z, limit=100).item() == pytest.approx(4, abs=0.1)
    nll = mt.gaussian_nll(error, variance)
    np.testing.assert_allclose(nll.numpy(), -stats.norm.logpdf(error.numpy(), 0, variance.sqrt().numpy()), rtol=1e-9)
    assert mt.gaussian_nll(error, variance / 4).mean() > nll.mean() < mt.gaussian_nll(error, variance * 4).mean()


def test_calibration_by_loops_with_outliers_and_masks():
    z = torch.tensor([[0.1, -0.7, 4.9], [-5.1, 1.7, math.nan]])
    valid = torch.tensor([[True, True, True], [True, False, True]])
    assert mt.nees_mean(z, valid=valid).item() == pytest.approx((0.01 + 0.49 + 4.9**2) / 3)
    assert mt.outlier_share(z, valid=valid).item() == pytest.approx(2 / 5)
    assert mt.outlier_share(z, limit=1.0).item() == pytest.approx(4 / 6)
    levels = (0.5, 0.95)
    expected = [sum(abs(v) <= stats.norm.ppf((1 + p) / 2) for v in (0.1, 0.7, 4.9, 5.1)) / 5 for p in levels]
    assert mt.coverage(z, levels, valid).tolist() == pytest.approx(expected)


def test_a_search_without_fixations_is_named():
    for figure in (mt.gap, mt.gap_per_saccade):
        with pytest.raises(SettingError, match=r"rewards = \(2, 0\): expected at least one fixation"):
            figure(torch.zeros(2, 0), torch.zeros(2))


def test_calibration_refuses():
    nothing = torch.zeros(3, dtype=torch.bool)
    for function in (mt.nees_mean, mt.outlier_share, mt.coverage):
        with pytest.raises(SettingError, match="at least one"):
            function(torch.zeros(3), valid=nothing)
    with pytest.raises(SettingError, match="at least one"):
        mt.ause(torch.zeros(3), torch.zeros(3), nothing)
    with pytest.raises(SettingError, match="within the limit"):
        mt.nees_mean(torch.full((3,), 9.0))
    with pytest.raises(SettingError, match="level = 1"):
        mt.coverage(torch.zeros(3), (0.5, 1.0))


def test_ause_by_a_loop():
    error = torch.randn(60, generator=generator(), dtype=torch.float64)
    uncertainty = torch.rand(60, generator=generator(1), dtype=torch.float64)
    size, rank = np.abs(error.numpy()), np.argsort(-uncertainty.numpy())
    worst = np.argsort(-size)
    area = sum((size[rank[k:]].mean() - size[worst[k:]].mean()) / size.mean() for k in range(60)) / 60
    assert mt.ause(error, uncertainty).item() == pytest.approx(area)
    assert mt.ause(error, error.abs()) == 0
    assert mt.ause(error, uncertainty**3) == mt.ause(error, uncertainty)
    assert mt.ause(error, -error.abs()) > mt.ause(error, uncertainty) > mt.ause(error, error.abs() + 0.5 * uncertainty)
    assert mt.ause(0 * error, uncertainty) == 0
    keep = torch.arange(60) < 40
    assert mt.ause(error, uncertainty, keep) == mt.ause(error[:40], uncertainty[:40])
