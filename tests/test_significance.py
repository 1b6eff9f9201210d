"""Intervals and tests against SciPy and plain loops."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy import stats

from torchfovea.setting import SettingError
from torchfovea.studies import significance as sg


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_bootstrap_against_scipy(level):
    values = torch.from_numpy(np.random.default_rng(3).gamma(1.5, size=(24, 3)))
    ours = sg.bootstrap_interval(values, generator(), level, resamples=40000)
    for k in range(3):
        data = (values[:, k].numpy(),)
        theirs = stats.bootstrap(data, np.mean, confidence_level=level, n_resamples=40000, rng=1).confidence_interval
        assert ours.estimate[k].item() == pytest.approx(data[0].mean())
        assert ours.low[k].item() == pytest.approx(theirs.low, abs=0.02)
        assert ours.high[k].item() == pytest.approx(theirs.high, abs=0.03)


def test_bootstrap_covers():
    inside = 0
    truth = math.exp(0.125)
    for seed in range(300):
        values = torch.exp(0.5 * torch.randn(25, generator=generator(seed), dtype=torch.float64))
        interval = sg.bootstrap_interval(values, generator(seed + 1000), 0.9, 500)
        inside += int(interval.low <= truth <= interval.high)
    assert 0.84 < inside / 300 < 0.96


def test_bootstrap_keeps_columns_paired_and_handles_agreement():
    values = torch.rand(12, 2, generator=generator())
    stacked = torch.stack([values[:, 0], values[:, 0], torch.full((12,), 0.1), torch.zeros(12)], -1)
    interval = sg.bootstrap_interval(stacked, generator(), resamples=500)
    assert interval.low[0] == interval.low[1] and interval.high[0] == interval.high[1]
    assert interval.low[2:].tolist() == interval.high[2:].tolist() == pytest.approx([0.1, 0.0])
    again = sg.bootstrap_interval(stacked, generator(), resamples=500)
    assert all(torch.equal(a, b) for a, b in zip(interval, again, strict=True))
    curves = sg.bootstrap_interval(torch.rand(6, 4, 5, generator=generator()), generator(), resamples=200)
    assert (
        curves.low.shape == (4, 5) and (curves.low <= curves.estimate).all() and (curves.estimate <= curves.high).all()
    )
    assert sg.bootstrap_interval(values[:, 0], generator(), resamples=200).low.dim() == 0
    sg.bootstrap_interval(torch.tensor([True, False, True]).double(), generator(), resamples=100)


def test_sign_flips():
    few = torch.tensor([0.3, 0.1, -0.05, 0.4, 0.2, 0.25], dtype=torch.float64)
    sums = [
        abs(sum(s * d for s, d in zip(signs, few.tolist(), strict=True)))
        for signs in itertools.product((-1, 1), repeat=6)
    ]
    exact = sum(s >= few.sum().item() - 1e-9 for s in sums) / 64
    assert sg.sign_flip_p_value(few, generator()).item() == pytest.approx(exact)
    many = torch.randn(30, 2, generator=generator(), dtype=torch.float64) + torch.tensor([0.4, 0.0])
    p = sg.sign_flip_p_value(many, generator())
    for k in range(2):
        test = stats.permutation_test(
            (many[:, k].numpy(),), np.mean, permutation_type="samples", n_resamples=9999, rng=0
        )
        assert p[k].item() == pytest.approx(test.pvalue, abs=0.02)
    assert sg.sign_flip_p_value(torch.zeros(5), generator()) == 1
    assert sg.sign_flip_p_value(torch.full((40,), 0.1), generator()).item() == pytest.approx(1 / 10000)


def test_the_studentized_bootstrap_against_a_loop():
    few = np.random.default_rng(5).gamma(1.0, size=12) - 0.4
    drawn = torch.randint(12, (999, 12), generator=generator(4)).numpy()
    t, beyond = few.mean() / few.std(ddof=1), [0, 0]
    for index in drawn:
        again = (few[index].mean() - few.mean()) / few[index].std(ddof=1)
        beyond = [beyond[0] + (again <= t), beyond[1] + (again >= t)]
    ours = sg.studentized_p_value(torch.from_numpy(few), generator(4), 999)
    assert float(ours) == pytest.approx(2 * (1 + min(beyond)) / 1000)
    normal = torch.randn(40, generator=generator(2), dtype=torch.float64) + 0.3
    theirs = stats.ttest_1samp(normal.numpy(), 0).pvalue
    assert float(sg.studentized_p_value(normal, generator())) == pytest.approx(theirs, abs=0.03)
    assert float(sg.studentized_p_value(torch.zeros(5), generator())) == 1
    assert float(sg.studentized_p_value(torch.full((8,), 0.2), generator(), 999)) == pytest.approx(2 / 1000)
    for bad in (torch.zeros(1), torch.zeros(3, 2), torch.tensor([0.0, math.nan])):
        with pytest.raises(SettingError):
            sg.studentized_p_value(bad, generator())


def test_skewed_differences_reject_less_often_by_the_larger_of_both():
    """Of lognormal differences of mean 0 the sign flip rejects far more than its level."""
    size = {"flip": 0, "both": 0}
    for k in range(250):
        x = torch.exp(1.2 * torch.randn(20, generator=generator(k), dtype=torch.float64)) - math.exp(0.72)
        flip = float(sg.sign_flip_p_value(x, generator(k), 499))
        both = max(flip, float(sg.studentized_p_value(x, generator(k), 499)))
        size["flip"] += flip <= 0.05
        size["both"] += both <= 0.05
    assert size["flip"] / 250 > 0.09 and size["both"] < 0.8 * size["flip"]


def test_holm():
    assert sg.holm(torch.tensor([0.01, 0.04, 0.03, 0.005]).double()).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert sg.holm(torch.tensor([0.9, 0.8])).tolist() == [1.0, 1.0]
    assert sg.holm(torch.tensor([])).tolist() == []
    p = torch.rand(9, generator=generator(), dtype=torch.float64)
    order = sorted(range(9), key=lambda i: p[i])
    expected, worst = [0.0] * 9, 0.0
    for k, i in enumerate(order):
        worst = max(worst, min(1.0, (9 - k) * p[i].item()))
        expected[i] = worst
    assert sg.holm(p).tolist() == pytest.approx(expected)
    for bad in (torch.tensor([0.1, 1.2]), torch.tensor([math.nan]), torch.zeros(2, 2)):
        with pytest.raises(SettingError, match="p_values"):
            sg.holm(bad)


@pytest.mark.parametrize(
    ("values", "settings", "message"),
    [
        (torch.zeros(1), {}, "scenes"),
        (torch.tensor(1.0), {}, "scenes"),
        (torch.tensor([0.0, math.nan]), {}, "values"),
        (torch.zeros(3), {"level": 1.0}, "level"),
        (torch.zeros(3), {"resamples": 9}, "resamples"),
    ],
)
def test_bootstrap_refuses(values, settings, message):
    with pytest.raises(SettingError, match=message):
        sg.bootstrap_interval(values, generator(), **settings)


@pytest.mark.parametrize(
    ("values", "flips", "message"),
    [(torch.zeros(0), 999, "scenes"), (torch.tensor([math.inf]), 999, "differences"), (torch.zeros(3), 9, "flips")],
)
def test_sign_flips_refuse(values, flips, message):
    with pytest.raises(SettingError, match=message):
        sg.sign_flip_p_value(values, generator(), flips)
