"""Acquisitions against BoTorch, mpmath in high precision, Monte Carlo and plain loops."""

import inspect
import math
import time

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from torchfovea import acquisition as aq
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
    assert torch.equal(function(mean, std, incumbent), torch.stack(rows).reshape(2, 3, 5))


def test_upper_confidence_bound():
    mean, std = belief(3, 5)
    assert torch.equal(aq.upper_confidence_bound(mean, std, 0.0), mean)
    assert torch.equal(aq.upper_confidence_bound(mean, std, math.inf), std)
    alpha = torch.tensor([0.0, 2.0, math.inf], dtype=torch.float64, requires_grad=True)
    score = aq.upper_confidence_bound(mean, std, alpha)
    assert torch.equal(score, torch.stack([mean[0], mean[1] + 2 * std[1], std[2]]))
    (gradient,) = torch.autograd.grad(score.sum(), alpha)
    assert torch.equal(gradient, torch.stack([std[0].sum(), std[1].sum(), 0 * std[0, 0]]))
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
            aq.random_scores(m, g),
            aq.choose(m.round(), e, g),
            *aq.hedge_choose(aq.Hedge(m[..., :4]), torch.arange(4).expand_as(m[..., :4]), 1.0, g),
        )

    together = row(mean, std, eligible, [generator(i) for i in range(6)])
    alone = [row(mean[i, j], std[i, j], eligible[i, j], generator(3 * i + j)) for i in range(2) for j in range(3)]
    for k, batch in enumerate(together):
        assert torch.equal(batch.flatten(0, 1), torch.stack([one[k] for one in alone]))
    with pytest.raises(SettingError, match="generators = 2: expected one, or one for each of the 6 rows"):
        aq.choose(coarse, eligible, [generator(), generator()])


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


# --- infomax ---------------------------------------------------------------------------------------------------------


def sphere(n, seed=0, dtype=torch.float64):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator(seed), dtype=dtype), dim=-1)


def test_information_gain_is_the_entropy_a_measurement_removes(monkeypatch):
    monkeypatch.setattr(aq, "_BLOCK", 40)
    g = generator()
    variance = torch.rand(2, 9, generator=g, dtype=torch.float64)
    precision = torch.rand(2, 7, 9, generator=g, dtype=torch.float64) * 10
    precision[0, 2, 3] = 0
    eligible = torch.rand(2, 9, generator=g) > 0.3
    gain = aq.information_gain(variance, precision, eligible)
    for b in range(2):
        for i in range(7):
            total = 0.0
            for j in range(9):
                if eligible[b, j]:
                    posterior = 1 / (1 / variance[b, j].item() + precision[b, i, j].item())
                    total += stats.norm.entropy(scale=variance[b, j].item() ** 0.5)
                    total -= stats.norm.entropy(scale=posterior**0.5)
            assert gain[b, i].item() == pytest.approx(total, abs=1e-12)
    shared = aq.information_gain(variance, precision[1], eligible)
    torch.testing.assert_close(shared[1], gain[1])
    alone = aq.information_gain(variance[0], precision[0])
    torch.testing.assert_close(alone, aq.information_gain(variance, precision)[0])
    v, p = variance.clone().requires_grad_(), precision.clone().requires_grad_()
    assert torch.autograd.gradcheck(aq.information_gain, (v, p))


@dtypes
def test_gaze_information_gain(dtype):
    cells, candidates = sphere(30, dtype=dtype), sphere(11, 1, dtype)
    candidates = torch.cat([candidates, cells[:1], -cells[:1]])
    variance = torch.rand(4, 30, generator=generator(), dtype=dtype)
    law = aq.eccentricity_law(0.01, 0.3)
    precision = aq.precision_by_eccentricity(candidates, cells, law, 0.8)
    for i, c in enumerate(candidates.double().numpy()):
        for j, x in enumerate(cells.double().numpy()):
            angle = math.atan2(np.linalg.norm(np.cross(c, x)), c @ x)
            expected = 1 / (0.01**2 + (0.3 * angle) ** 2) if angle <= 0.8 else 0.0
            assert precision[i, j].item() == pytest.approx(expected, rel=1e-4 if dtype == torch.float32 else 1e-9)
    gain = aq.gaze_information_gain(variance, candidates, cells, law, 0.8)
    torch.testing.assert_close(gain, aq.information_gain(variance, precision))
    v, c = variance.clone().requires_grad_(), candidates.clone().requires_grad_()
    gradients = torch.autograd.grad(aq.gaze_information_gain(v, c, cells, law).sum(), (v, c))
    assert all(torch.isfinite(g).all() for g in gradients)


def test_a_fovea_looks_where_it_knows_least():
    cells = sphere(400)
    variance = torch.full((400,), 1e-4, dtype=torch.float64)
    variance[(cells @ cells[17]) > 0.95] = 1.0
    gain = aq.gaze_information_gain(variance, cells, cells, aq.eccentricity_law(0.01, 1.0), 0.7)
    assert cells[gain.argmax()] @ cells[17] > 0.95
    assert gain[17] > 5 * gain[(cells @ cells[17]).argmin()]


def test_information_gain_of_two_thousand_by_two_thousand_is_cheap():
    cells = sphere(2000, dtype=torch.float32)
    start = time.perf_counter()
    aq.gaze_information_gain(torch.rand(2000), cells, cells, aq.eccentricity_law(0.01, 0.3), 0.8)
    assert time.perf_counter() - start < 5  # tens of milliseconds on an idle machine


@pytest.mark.parametrize("sigma", [(0.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, math.inf)])
def test_eccentricity_law_refuses(sigma):
    with pytest.raises(SettingError, match="sigma_"):
        aq.eccentricity_law(*sigma)


# --- costs, portfolio, baselines -------------------------------------------------------------------------------------


def test_costs():
    forward = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    directions = torch.tensor([[1.0, 0, 0], [0, 3.0, 0], [-1.0, 0, 0], [1.0, 1.0, 0]]).double().requires_grad_()
    degrees = aq.saccade_degrees(forward, directions)
    assert degrees.tolist() == pytest.approx([0, 90, 180, 45])
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(degrees.sum(), (forward, directions)))
    assert aq.saccade_degrees(forward.expand(5, 3), directions).shape == (5, 4)
    assert aq.saccade_seconds(degrees).tolist() == pytest.approx([0, 0.219, 0.417, 0.12])
    score = torch.tensor([1.0, 2.0, 4.0, 8.0], dtype=torch.float64)
    assert aq.per_cost(score, degrees, 10.0).tolist() == pytest.approx([0.1, 0.02, 4 / 190, 8 / 55])
    assert aq.minus_cost(score, degrees, 0.1).tolist() == pytest.approx([1, -7, -14, 3.5])
    both = aq.minus_cost(score.expand(2, 4), degrees, torch.tensor([0.0, 0.1]))
    torch.testing.assert_close(both, torch.stack([score, score - torch.tensor(0.1).double() * degrees]))
    with pytest.raises(SettingError, match="overhead"):
        aq.per_cost(score, degrees, 0.0)


def test_saccade_degrees_gradcheck():
    direction, directions = sphere(2, 3).requires_grad_(), sphere(8, 4).reshape(2, 4, 3).clone().requires_grad_()
    assert torch.autograd.gradcheck(aq.saccade_degrees, (direction, directions))


def test_hedge_follows_the_probabilities_and_learns():
    state = aq.Hedge(torch.tensor([0.0, math.log(2.0), math.log(5.0)]).expand(20000, 3))
    nominees = torch.tensor([7, 8, 9]).expand(20000, 3)
    cell, followed = aq.hedge_choose(state, nominees, 1.0, generator())
    assert torch.equal(cell, followed + 7)
    assert (torch.bincount(followed) / 20000).tolist() == pytest.approx([1 / 8, 2 / 8, 5 / 8], abs=0.015)

    mean = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    state, good = aq.hedge_start((), 3, mean), 0
    for g in map(generator, range(200)):
        nominees = torch.tensor([0, 2, -1])
        _, followed = aq.hedge_choose(state, nominees, math.sqrt(8 * math.log(3) / 200), g)
        good += int(followed == 1)
        state = aq.hedge_update(state, nominees, mean)
    assert state.gains.tolist() == [0, 200, 0]
    assert good > 170
    assert aq.hedge_start((2, 5), 3, mean).gains.shape == (2, 5, 3)
    with pytest.raises(SettingError, match=r"acquisition\.eta"):
        aq.hedge_choose(state, nominees, -1.0, generator())


def test_hedge_update_is_a_loop():
    mean, _ = belief(2, 6)
    nominees = torch.tensor([[0, 5, 5], [3, -1, 2]])
    gains = aq.hedge_update(aq.hedge_start((2,), 3, mean), nominees, mean).gains
    expected = [[mean[b, c].item() if c >= 0 else 0.0 for c in row] for b, row in enumerate(nominees.tolist())]
    assert gains.tolist() == expected


def test_raster_visits_row_by_row_and_cycles():
    pan, tilt = torch.meshgrid(torch.linspace(-50, 50, 41), torch.linspace(-36, 18, 23), indexing="ij")
    pan, tilt = torch.deg2rad(pan.flatten()), torch.deg2rad(tilt.flatten())
    cells = torch.stack([tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), tilt.sin()], -1).double()
    ranks = aq.raster_ranks(cells, 20.0)
    order = ranks.argsort()[-int((ranks >= 0).sum()) :]
    assert ranks[order].tolist() == list(range(len(order)))
    steps = aq.saccade_degrees(cells[order][:-1], cells[order][1:, None])[:, 0]
    assert steps.max() < 32 and steps.mean() > 12
    assert (cells @ cells[order].T).max(1).values.min() > math.cos(math.radians(16))
    assert tilt[order[0]] > tilt[order[-1]]
    eligible = torch.ones(len(cells), dtype=torch.bool)
    last, seen = torch.tensor(-1), []
    for _ in range(len(order) + 1):
        last = aq.choose(aq.raster_scores(ranks, last), eligible, generator())
        seen.append(last.item())
    assert seen == [*order.tolist(), order[0].item()]
    eligible[order[1]] = False
    assert aq.choose(aq.raster_scores(ranks, order[0]), eligible) == order[2]
    batch = aq.raster_scores(ranks, order[:2])
    assert torch.equal(batch[1], aq.raster_scores(ranks, order[1]))
    off = int((ranks < 0).nonzero()[0])
    assert aq.choose(aq.raster_scores(ranks, torch.tensor(-1)), torch.arange(len(cells)) == off) == off
    assert aq.choose(aq.raster_scores(ranks, torch.tensor(off)), ranks >= 0) == order[0]
    for bad in (0.0, -3.0, 180.0, math.nan):
        with pytest.raises(SettingError, match="spacing_deg"):
            aq.raster_ranks(cells, bad)


def test_random_first_glance_and_oracle():
    mean, _ = belief(3, 50)
    everything = torch.ones(50, dtype=torch.bool)
    picks = [aq.choose(aq.random_scores(mean, generator(i)), everything, generator(i))[0].item() for i in range(300)]
    assert len(set(picks)) == 50 or len(set(picks)) > 45
    chosen = aq.choose(aq.first_glance_scores(mean, torch.full((3,), -1)), everything, generator())
    assert torch.equal(chosen, mean.argmax(-1))
    later, _ = belief(3, 50, seed=1)
    assert torch.equal(aq.choose(aq.first_glance_scores(later, chosen), everything, generator()), chosen)
    cells = sphere(50)
    best = sphere(3, 9)
    expected = [max(range(50), key=lambda j, b=b: float(cells[j] @ b)) for b in best]
    assert aq.oracle_scores(cells, best).argmax(-1).tolist() == expected


def test_best_of():
    mean = torch.tensor([[1.0, 5.0, 3.0], [1.0, 5.0, 3.0]])
    among = torch.tensor([[True, False, True], [False, False, False]])
    assert aq.best_of(mean, among).tolist() == [3.0, 1.0]


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
