"""Rewards against Monte Carlo, finite differences and NumPy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfovea.deciding import reward as rw
from torchfovea.deciding.reward import RewardBelief
from torchfovea.gaussian import Gaussian, pack, unpack
from torchfovea.setting import SettingError

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def points(*shape, spread=0.05, dtype=torch.float64, seed=0):
    g = generator(seed)
    mean = torch.randn(*shape, 3, generator=g, dtype=dtype) + torch.tensor([2.0, 0.0, 0.0], dtype=dtype)
    root = spread * torch.randn(*shape, 3, 3, generator=g, dtype=dtype)
    return Gaussian(mean, pack(root @ root.mT))


@dtypes
def test_range_reward_is_the_first_order_formula(dtype):
    gaussian = points(4, 9, dtype=dtype)
    belief = rw.range_reward(gaussian)
    assert belief.mean.dtype == belief.std.dtype == dtype and belief.mean.shape == (4, 9)
    for i in range(4):
        for j in range(9):
            x, cov = gaussian.mean[i, j].double().numpy(), unpack(gaussian.cov[i, j]).double().numpy()
            slope = -x / np.linalg.norm(x)
            assert belief.mean[i, j].item() == pytest.approx(-np.linalg.norm(x), rel=1e-6)
            assert belief.std[i, j].item() == pytest.approx(math.sqrt(slope @ cov @ slope), rel=1e-5)


@pytest.mark.parametrize(
    ("belief_of", "reward"),
    [
        (rw.range_reward, lambda x: -x.norm(dim=-1)),
        (lambda g: rw.inverse_range_from_range(rw.range_reward(g)), lambda x: 1 / x.norm(dim=-1)),
        (lambda g: rw.user_reward(rw.nearest_to(torch.tensor([9.0, 1.0, 0.0])), g), None),
        (lambda g: rw.user_reward(rw.nearest_to(torch.tensor([9.0, 1.0, 0.0])), g, "unscented"), None),
    ],
)
def test_against_monte_carlo(belief_of, reward):
    if reward is None:
        reward = rw.nearest_to(torch.tensor([9.0, 1.0, 0.0], dtype=torch.float64))
    gaussian = points(5, spread=0.02)
    belief = belief_of(gaussian)
    root = torch.linalg.cholesky(unpack(gaussian.cov))
    drawn = gaussian.mean + (root @ torch.randn(40000, 5, 3, 1, generator=generator(2), dtype=torch.float64))[..., 0]
    samples = reward(drawn)
    torch.testing.assert_close(belief.mean, samples.mean(0), rtol=3e-3, atol=1e-3)
    torch.testing.assert_close(belief.std, samples.std(0), rtol=0.03, atol=1e-4)


def test_conversions_invert_each_other_and_share_the_order():
    belief = rw.range_reward(points(50))
    inverse = rw.inverse_range_from_range(belief)
    back = rw.range_from_inverse_range(inverse)
    torch.testing.assert_close(back.mean, belief.mean)
    torch.testing.assert_close(back.std, belief.std)
    assert torch.equal(inverse.mean.argsort(), belief.mean.argsort())


def test_conversions_are_clamped():
    far = rw.range_from_inverse_range(
        RewardBelief(torch.tensor([0.5, 0.01, 0.0, -3.0]), torch.full((4,), 0.1)), far_m=50.0
    )
    assert far.mean.tolist() == pytest.approx([-2, -50, -50, -50])
    assert far.std.tolist() == pytest.approx([0.4, 250, 250, 250])
    near = rw.inverse_range_from_range(
        RewardBelief(torch.tensor([-2.0, -0.001, 0.0]), torch.full((3,), 0.1)), near_m=0.1
    )
    assert near.mean.tolist() == pytest.approx([0.5, 10, 10])
    assert near.std.tolist() == pytest.approx([0.025, 10, 10])
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(SettingError, match="far_m"):
            rw.range_from_inverse_range(far, bad)
        with pytest.raises(SettingError, match="near_m"):
            rw.inverse_range_from_range(near, bad)


@dtypes
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-15, 1e-8, 1e-3])
@pytest.mark.parametrize("spread", [0.0, 1e-4, 1.0])
def test_gradients_are_finite_at_the_origin(size, spread, dtype):
    mean = torch.full((2, 3), size, dtype=dtype, requires_grad=True)
    cov = (spread * torch.tensor([1.0, 0, 0, 1.0, 0, 1.0], dtype=dtype)).expand(2, 6).clone().requires_grad_()
    gaussian = Gaussian(mean, cov)
    beliefs = [rw.range_reward(gaussian), rw.inverse_range_from_range(rw.range_reward(gaussian))]
    for method in ("first_order", "unscented"):
        beliefs.append(rw.user_reward(rw.nearest_to(torch.zeros(3, dtype=dtype)), gaussian, method))
    for belief in beliefs:
        assert torch.isfinite(belief.mean).all() and torch.isfinite(belief.std).all()
        gradients = torch.autograd.grad(belief.mean.sum() + belief.std.sum(), (mean, cov), retain_graph=True)
        assert all(torch.isfinite(g).all() for g in gradients)
    assert beliefs[0].std.tolist() == pytest.approx([spread**0.5] * 2, rel=1e-5)


def nearest_of_colour(appearance, colour):
    """A reward of a user's own, with tensors of its own: the nearest thing of a colour."""
    penalty = 5 * torch.linalg.vector_norm(appearance - colour, dim=-1)
    return lambda x: -torch.linalg.vector_norm(x, dim=-1) - penalty


@pytest.mark.parametrize("method", ["range", "inverse", "first_order", "unscented"])
def test_gradcheck(method):
    gaussian = points(2, 3)
    colours = torch.rand(2, 3, 4, generator=generator(), dtype=torch.float64)

    def moments(mean, cov):
        gaussian = Gaussian(mean, cov)
        if method == "range":
            return tuple(rw.range_reward(gaussian))
        if method == "inverse":
            return tuple(rw.inverse_range_from_range(rw.range_reward(gaussian)))
        return tuple(rw.user_reward(nearest_of_colour(colours, colours[0, 0]), gaussian, method))

    assert torch.autograd.gradcheck(moments, tuple(v.clone().requires_grad_() for v in gaussian))


def test_first_order_of_the_users_nearness_is_the_papers():
    gaussian = points(3, 7)
    theirs = rw.user_reward(rw.nearest_to(torch.zeros(3, dtype=torch.float64)), gaussian)
    for a, b in zip(theirs, rw.range_reward(gaussian), strict=True):
        torch.testing.assert_close(a, b)
    with torch.no_grad():
        torch.testing.assert_close(rw.user_reward(rw.nearest_to(torch.zeros(3).double()), gaussian).std, theirs.std)


@given(st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_affine_rewards_are_exact_by_either_method(seed):
    gaussian = points(4, spread=1.0, seed=seed)
    slope = torch.randn(3, generator=generator(seed), dtype=torch.float64)
    variance = ((slope @ unpack(gaussian.cov)) * slope).sum(-1)
    for method in ("first_order", "unscented"):
        belief = rw.user_reward(lambda x: x @ slope + 2, gaussian, method)
        torch.testing.assert_close(belief.mean, gaussian.mean @ slope + 2)
        torch.testing.assert_close(belief.std, variance.sqrt())


def test_unscented_knows_the_mean_of_a_quadratic_reward():
    gaussian = points(6, spread=0.5)

    def squared_range(x):
        return -x.square().sum(-1)

    trace = gaussian.cov[..., 0] + gaussian.cov[..., 3] + gaussian.cov[..., 5]
    at_mean = squared_range(gaussian.mean)
    torch.testing.assert_close(rw.user_reward(squared_range, gaussian, "unscented").mean, at_mean - trace)
    torch.testing.assert_close(rw.user_reward(squared_range, gaussian).mean, at_mean)


def test_singular_covariances_have_a_root():
    along = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    cov = torch.stack([pack(torch.outer(along, along)), torch.zeros(6).double()])
    belief = rw.user_reward(lambda x: x @ along, Gaussian(torch.ones(2, 3).double(), cov), "unscented")
    assert belief.std.tolist() == pytest.approx([1.0, 0.0])


def test_batch_is_a_loop():
    gaussian = points(3, 5)
    colours = torch.rand(3, 5, 2, generator=generator(), dtype=torch.float64)
    for method in ("first_order", "unscented"):
        together = rw.user_reward(nearest_of_colour(colours, colours[0, 0]), gaussian, method)
        for i in range(3):
            one = Gaussian(gaussian.mean[i], gaussian.cov[i])
            alone = rw.user_reward(nearest_of_colour(colours[i], colours[0, 0]), one, method)
            torch.testing.assert_close(together.mean[i], alone.mean)
            torch.testing.assert_close(together.std[i], alone.std)


def test_examples_prefer_what_they_name():
    mean = torch.tensor([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 1.0, 0.0]])
    gaussian = Gaussian(mean, torch.tensor([1e-4, 0, 0, 1e-4, 0, 1e-4]).expand(3, 6))
    red, blue = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    assert rw.range_reward(gaussian).mean.argmax() == 0
    assert rw.user_reward(rw.nearest_to(torch.tensor([3.0, 0.9, 0.0])), gaussian).mean.argmax() == 2
    seek = nearest_of_colour(torch.tensor([blue, red, red]), torch.tensor(red))
    for method in ("first_order", "unscented"):
        assert rw.user_reward(seek, gaussian, method).mean.argmax() == 1


def test_what_is_refused():
    gaussian = points(4)
    with pytest.raises(SettingError, match=r"reward\.method = exact"):
        rw.user_reward(rw.nearest_to(torch.zeros(3)), gaussian, "exact")
    for method in ("first_order", "unscented"):
        with pytest.raises(SettingError, match="the user's reward = NaN or infinite values"):
            rw.user_reward(lambda x: x[..., 0] * math.nan, gaussian, method)
        with pytest.raises(SettingError, match="shape of the user's reward"):
            rw.user_reward(lambda x: -x, gaussian, method)
