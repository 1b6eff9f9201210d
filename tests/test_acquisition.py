"""Acquisitions against BoTorch, mpmath in high precision, Monte Carlo and plain loops."""

import inspect
import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from torchfovea.deciding import acquisition as aq
from torchfovea.deciding import policies as po
from torchfovea.setting import SettingError

mpmath.mp.dps = 60
Z = (-1e5, -3e4, -1e3, -137.0, -38.0, -12.0, -6.0, -4.01, -4.0, -3.99, -2.0, -0.5, 0.0, 0.3, 1.0, 5.0, 40.0, 1e3, 1e5)
TOLERANCE = {torch.float64: 1e-10, torch.float32: 2e-5}
LOGS = (aq.log_probability_of_improvement, aq.log_expected_improvement)
PLAIN = (aq.probability_of_improvement, aq.expected_improvement)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def belief(*shape, dtype=torch.float64, seed=0):
    g = generator(seed)
    return torch.randn(*shape, generator=g, dtype=dtype), torch.rand(*shape, generator=g, dtype=dtype) + 0.1


def tail(z):
    """Log Φ(z), its slope, log h with h = zΦ + φ, its slope, and φ/h, in 60 digits or more."""
    with mpmath.workdps(60 if abs(z) < 100 else 120):
        x = mpmath.mpf(z)
        cdf, pdf = mpmath.erfc(-x / mpmath.sqrt(2)) / 2, mpmath.npdf(x)
        better = pdf + x * cdf
        return tuple(float(v) for v in (mpmath.log(cdf), pdf / cdf, mpmath.log(better), cdf / better, pdf / better))


@dtypes
@pytest.mark.parametrize("z", Z)
def test_logs_and_their_gradients_from_far_tail_to_far_tail(z, dtype):
    log_pi, d_log_pi, log_ei, d_log_ei, _ = tail(float(torch.tensor(z, dtype=dtype)))
    for function, value, slope in zip(LOGS, (log_pi, log_ei), (d_log_pi, d_log_ei), strict=True):
        mean = torch.tensor([z], dtype=dtype, requires_grad=True)
        result = function(mean, torch.ones(1, dtype=dtype), 0.0)
        (gradient,) = torch.autograd.grad(result, mean)
        assert result.dtype == dtype
        assert result.item() == pytest.approx(value, rel=TOLERANCE[dtype], abs=TOLERANCE[dtype])
        assert gradient.item() == pytest.approx(slope, rel=TOLERANCE[dtype], abs=TOLERANCE[dtype])


@dtypes
@pytest.mark.parametrize("z", [-1e5, -50.0, -5.0, -4.0, -1.0, 0.0, 2.0, 30.0, 1e5])
def test_gradient_in_the_standard_deviation(z, dtype):
    scale = 0.37
    mean = torch.tensor([z * scale], dtype=dtype)
    std = torch.tensor([scale], dtype=dtype, requires_grad=True)
    z = (mean.double() / std.detach().double()).item()
    _, d_log_pi, _, _, d_sigma = tail(z)
    sigma = std.item()
    expected = (-d_log_pi * z / sigma, d_sigma / sigma)
    for function, slope in zip(LOGS, expected, strict=True):
        (gradient,) = torch.autograd.grad(function(mean, std, 0.0), std)
        assert gradient.item() == pytest.approx(slope, rel=1e-4 if dtype == torch.float32 else 1e-8, abs=1e-30)


@dtypes
@pytest.mark.parametrize("function", LOGS + PLAIN)
@pytest.mark.parametrize("difference", [-1000.0, -1.0, -1e-20, 0.0, 1e-20, 1.0, 1000.0])
@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e-8])
def test_no_uncertainty_is_finite_with_finite_gradients(function, difference, sigma, dtype):
    mean = torch.tensor([difference], dtype=dtype, requires_grad=True)
    std = torch.tensor([sigma], dtype=dtype, requires_grad=True)
    result = function(mean, std, torch.zeros((), dtype=dtype))
    gradients = torch.autograd.grad(result, (mean, std))
    assert torch.isfinite(result).all() and all(torch.isfinite(g).all() for g in gradients)
    if function is aq.expected_improvement:
        assert result.item() == pytest.approx(max(difference, 0.0), rel=1e-6, abs=1e-7)
    if function is aq.probability_of_improvement and abs(difference) >= 1:
        assert result.item() == float(difference > 0)


@dtypes
@pytest.mark.parametrize("z", [-9.0, -6.0, -4.0, -2.0, 0.0, 3.0])
def test_plain_forms_keep_their_digits_in_the_tail(z, dtype):
    log_pi, _, log_ei, _, _ = tail(z)
    mean, one = torch.tensor([z], dtype=dtype), torch.ones(1, dtype=dtype)
    rel = 1e-9 if dtype == torch.float64 else 2e-5
    assert aq.probability_of_improvement(mean, one, 0.0).item() == pytest.approx(math.exp(log_pi), rel=rel)
    assert aq.expected_improvement(mean, one, 0.0).item() == pytest.approx(math.exp(log_ei), rel=rel)


def test_against_numerical_integration():
    mean, std = belief(7)
    incumbent = 0.4
    ei, pi = aq.expected_improvement(mean, std, incumbent), aq.probability_of_improvement(mean, std, incumbent)
    for i, (m, s) in enumerate(zip(mean.tolist(), std.tolist(), strict=True)):
        end = max(m, incumbent) + 12 * s
        value, _ = integrate.quad(
            lambda r, m=m, s=s: (r - incumbent) * stats.norm.pdf(r, m, s), incumbent, end, epsabs=1e-13
        )
        assert ei[i].item() == pytest.approx(value, abs=1e-10)
        assert pi[i].item() == pytest.approx(stats.norm.sf(incumbent, m, s), abs=1e-12)


@pytest.mark.filterwarnings("ignore")  # BoTorch advises against its own plain EI
def test_against_botorch():
    botorch = pytest.importorskip("botorch")
    from botorch.acquisition import analytic
    from botorch.models.model import Model
    from botorch.posteriors.gpytorch import GPyTorchPosterior
    from gpytorch.distributions import MultivariateNormal

    assert botorch.__version__
    mean, std = belief(200)
    mean = mean * 4

    class Beliefs(Model):
        num_outputs = 1

        def posterior(self, X, *args, **kwargs):
            at = X[..., 0].long()
            return GPyTorchPosterior(MultivariateNormal(mean[at], torch.diag_embed(std[at].square())))

    cells = torch.arange(200, dtype=torch.float64)[:, None, None]
    model, incumbent = Beliefs(), torch.tensor(0.7, dtype=torch.float64)
    best = (mean, std, incumbent)
    pairs = [
        (analytic.UpperConfidenceBound(model, beta=4.0), aq.upper_confidence_bound(mean, std, 2.0)),
        (analytic.ProbabilityOfImprovement(model, incumbent), aq.probability_of_improvement(*best)),
        (analytic.LogProbabilityOfImprovement(model, incumbent), aq.log_probability_of_improvement(*best)),
        (analytic.ExpectedImprovement(model, incumbent), aq.expected_improvement(*best)),
        (analytic.LogExpectedImprovement(model, incumbent), aq.log_expected_improvement(*best)),
    ]
    for theirs, ours in pairs:
        torch.testing.assert_close(ours, theirs(cells), rtol=1e-9, atol=1e-12)


@given(
    st.floats(-50, 50),
    st.floats(1e-3, 30),
    st.floats(-50, 50),
    st.floats(1e-2, 10),
    st.floats(0.1, 10),
    st.floats(-9, 9),
)
@settings(max_examples=60, deadline=None)
def test_laws(mean, std, incumbent, more, scale, shift):
    mean, std = (torch.tensor([v], dtype=torch.float64) for v in (mean, std))
    ei, pi = (f(mean, std, incumbent) for f in (aq.expected_improvement, aq.probability_of_improvement))
    assert ei >= 0 and 0 <= pi <= 1
    assert ei >= (mean - incumbent).clamp_min(0) - 1e-9
    for function in LOGS:
        value = function(mean, std, incumbent)
        assert function(mean + more, std, incumbent) >= value
        moved = function(mean * scale + shift, std * scale, incumbent * scale + shift)
        if function is aq.log_expected_improvement:
            assert function(mean, std + more, incumbent) >= value
            moved = moved - math.log(scale)
        assert torch.allclose(moved, value, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("function", LOGS + PLAIN)
def test_gradcheck(function):
    mean, std = belief(3, 5)
    mean = (mean * 5).requires_grad_()
    incumbent = torch.tensor([0.0, 1.0, 6.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, (mean, std.requires_grad_(), incumbent))
    assert torch.autograd.gradgradcheck(function, (mean, std, incumbent))


@pytest.mark.parametrize("function", LOGS + PLAIN)
def test_incumbent_of_each_row(function):
    mean, std = belief(2, 3, 5)
    incumbent = torch.arange(6.0).reshape(2, 3)
    rows = [function(mean[i, j], std[i, j], incumbent[i, j].item()) for i in range(2) for j in range(3)]
    want = torch.stack(rows).reshape(2, 3, 5)
    torch.testing.assert_close(function(mean, std, incumbent), want, rtol=1e-13, atol=1e-300)


@pytest.mark.parametrize("function", [*LOGS, *PLAIN, aq.upper_confidence_bound, aq.thompson])
def test_shapes_that_do_not_belong_together_are_named(function):
    def call(mean, std, row=0.0):
        mean, std = torch.zeros(mean), torch.ones(std)
        return function(mean, std, generator() if function is aq.thompson else row)

    assert call((4, 1), (4, 1)).shape == (4, 1)
    for mean, std in (((4, 1), (4,)), ((4,), (4, 1)), ((2, 4), (2, 3))):
        with pytest.raises(SettingError, match=r"std\.shape"):
            call(mean, std)
    if function is not aq.thompson:
        assert call((4, 3), (4, 3), torch.ones(4)).shape == (4, 3)
        for mean, row in (((4,), (4,)), ((2, 4), (3,)), ((2, 4), (2, 1))):
            with pytest.raises(SettingError, match=r"(incumbent|alpha)\.shape"):
                call(mean, mean, torch.ones(row))


@dtypes
@pytest.mark.parametrize("std", [1e-10, 1e-12, 1e-15])
def test_the_smallest_deviations_are_themselves(std, dtype):
    """EI(0) = σ φ(0), PI(0) = 1/2 and what follows a few σ off, for a σ whose fourth power underflows in float32."""
    for z in (0.0, 1.0, -2.0, -6.0):
        deviation = torch.tensor([std], dtype=dtype)
        density, above = stats.norm.pdf(z), stats.norm.cdf(z)
        want = {
            aq.expected_improvement: std * (z * above + density),
            aq.log_expected_improvement: math.log(std) + math.log(z * above + density),
            aq.probability_of_improvement: above,
            aq.log_probability_of_improvement: math.log(above),
        }
        for function, value in want.items():
            leaves = [(z * deviation).requires_grad_(), deviation.clone().requires_grad_()]
            got = function(*leaves, 0.0)
            assert got.item() == pytest.approx(value, rel=1e-4)
            assert all(torch.isfinite(g).all() for g in torch.autograd.grad(got.sum(), leaves))


def test_upper_confidence_bound():
    mean, std = belief(3, 5)
    assert torch.equal(aq.upper_confidence_bound(mean, std, 0.0), mean)
    assert torch.equal(aq.upper_confidence_bound(mean, std, math.inf), std)
    alpha = torch.tensor([0.0, 2.0, math.inf], dtype=torch.float64, requires_grad=True)
    score = aq.upper_confidence_bound(mean, std, alpha)
    assert torch.equal(score, torch.stack([mean[0], mean[1] + 2 * std[1], std[2]]))
    (gradient,) = torch.autograd.grad(score.sum(), alpha)
    torch.testing.assert_close(gradient, torch.stack([std[0].sum(), std[1].sum(), 0 * std[0, 0]]))
    assert torch.equal(aq.upper_confidence_bound(mean, std, torch.tensor(2.0)), mean + 2 * std)
    for bad in (-1.0, math.nan):
        with pytest.raises(SettingError, match=r"acquisition\.alpha"):
            aq.upper_confidence_bound(mean, std, bad)


@dtypes
def test_thompson_draws_the_belief(dtype):
    mean, std = belief(4, dtype=dtype)
    drawn = aq.thompson(mean.expand(20000, 4), std.expand(20000, 4), generator())
    assert drawn.dtype == dtype
    torch.testing.assert_close(drawn.mean(0), mean, atol=0.04, rtol=0)
    torch.testing.assert_close(drawn.std(0), std, atol=0.04, rtol=0)


def test_one_generator_a_row_equals_one_by_one():
    mean, std = belief(2, 3, 40)
    eligible = torch.rand(2, 3, 40, generator=generator()) > 0.3
    coarse = mean.round()

    def row(m, s, e, g):
        return (
            aq.thompson(m, s, g),
            po.random_scores(m, g),
            aq.choose(m.round(), e, g),
            *po.hedge_choose(po.Hedge(m[..., :4]), torch.arange(4).expand_as(m[..., :4]), 1.0, g),
        )

    together = row(mean, std, eligible, [generator(i) for i in range(6)])
    alone = [row(mean[i, j], std[i, j], eligible[i, j], generator(3 * i + j)) for i in range(2) for j in range(3)]
    for k, batch in enumerate(together):
        assert torch.equal(batch.flatten(0, 1), torch.stack([one[k] for one in alone]))
    with pytest.raises(SettingError, match="generators = 2: expected one, or one for each of the 6 rows"):
        aq.choose(coarse, eligible, [generator(), generator()])


def test_nothing_to_choose_from_is_named():
    for score in (torch.zeros(0), torch.zeros(3, 0), torch.zeros(())):
        with pytest.raises(SettingError, match=r"score = \(.*\): expected at least one cell"):
            aq.choose(score, torch.ones(score.shape, dtype=torch.bool), generator())


def test_choose():
    score = torch.tensor([1.0, 3.0, 3.0, math.nan, 9.0, -math.inf])
    eligible = torch.tensor([True, True, True, True, False, True])
    picks = aq.choose(score.expand(4000, 6), eligible, generator())
    assert set(picks.tolist()) == {1, 2}
    assert abs((picks == 1).double().mean().item() - 0.5) < 0.04
    assert aq.choose(score, eligible) == 1
    assert aq.choose(score, torch.zeros(6, dtype=torch.bool), generator()) == -1
    assert aq.choose(score, torch.arange(6) == 3, generator()) == -1
    assert aq.choose(score, torch.arange(6) == 5, generator()) == 5
    assert aq.choose(torch.tensor([0.0, math.inf]), torch.ones(2, dtype=torch.bool), generator()) == 1


def test_ties_among_thousands_are_uniform():
    picks = aq.choose(torch.zeros(3000, 2000), torch.ones(2000, dtype=torch.bool), generator())
    counts = np.bincount(picks.numpy() // 100, minlength=20)
    assert stats.chisquare(counts).pvalue > 1e-4


def test_stop_rule_bounds_the_probability():
    mean, std = belief(300, 12)
    mean = 1.5 * mean
    eligible = torch.rand(300, 12, generator=generator(3)) > 0.2
    stopped = aq.known_well_enough(mean, std * 0.3, eligible, 0.1, 0.1)
    assert 0.2 < stopped.double().mean() < 0.8
    draws = mean + 0.3 * std * torch.randn(4000, 300, 12, generator=generator(5), dtype=torch.float64)
    best = torch.where(eligible, mean, -torch.inf).argmax(-1)
    top = torch.where(eligible, draws, -torch.inf).amax(-1)
    beaten = (top > draws.gather(-1, best.expand(4000, 300)[..., None])[..., 0] + 0.1).double().mean(0)
    assert (beaten[stopped] < 0.1 + 0.02).all()
    assert (beaten[~stopped] > 0.04).all()  # pessimistic, but not idly so


def test_stop_rule_by_loop_and_its_limits():
    mean, std = torch.tensor([1.0, 0.4, math.nan, 3.0]), torch.tensor([0.1, 0.2, 0.1, 0.1])
    eligible = torch.tensor([True, True, True, False])
    bound = stats.norm.cdf((0.4 - 1.0 - 0.05) / math.hypot(0.1, 0.2))
    assert aq.known_well_enough(mean, std, eligible, 0.05, bound * 1.01)
    assert not aq.known_well_enough(mean, std, eligible, 0.05, bound * 0.99)
    assert not aq.known_well_enough(mean, std, torch.zeros(4, dtype=torch.bool), 0.05, 0.5)
    assert aq.known_well_enough(mean, 0 * std, eligible, 0.0, 0.01)
    for tolerance, probability in ((-1.0, 0.1), (0.1, 0.0), (0.1, 1.0), (math.nan, 0.5)):
        with pytest.raises(SettingError, match=r"stop\."):
            aq.known_well_enough(mean, std, eligible, tolerance, probability)


def test_pure_functions_only():
    assert "torch" + ".nn" not in inspect.getsource(aq)
    assert all(hasattr(aq, name) for name in aq.__all__)
