"""Packed symmetric algebra and the two forms of a Gaussian, against torch.linalg and filterpy."""

import numpy as np
import pytest
import torch
from filterpy.kalman import InformationFilter
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.gaussian import (
    Gaussian,
    columns,
    gaussian_from_information,
    information_from_gaussian,
    inverse3,
    pack,
    positive_definite,
    quadratic3,
    rotate3,
    times3,
    unpack,
)


def random_spd(count: int, seed: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(count, 3, 3, generator=rng, dtype=torch.float64)
    return pack(root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)).to(dtype)


def test_columns_are_contiguous_and_in_order():
    a, b = torch.arange(5.0), torch.arange(5.0) + 10
    joined = columns(a, b)
    assert joined.shape == (5, 2) and joined[..., 1].is_contiguous()
    assert torch.equal(joined[..., 1], b)


@given(st.integers(0, 10_000))
def test_algebra_agrees_with_linalg(seed):
    s = random_spd(7, seed)
    full = unpack(s)
    v = torch.randn(7, 3, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    assert torch.equal(pack(full), s)
    torch.testing.assert_close(unpack(inverse3(s)), torch.linalg.inv(full), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(times3(s, v), (full @ v[..., None])[..., 0])
    torch.testing.assert_close(quadratic3(s, v), (v[:, None] @ full @ v[..., None])[:, 0, 0])
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).Q
    torch.testing.assert_close(unpack(rotate3(rotation, s)), rotation @ full @ rotation.T)
    assert bool(positive_definite(s).all())


def test_not_positive_definite_is_told():
    s = pack(
        torch.stack([torch.diag(torch.tensor(d)) for d in ([1.0, 1, 0], [1, -1, 1], [1, 1, torch.inf], [1, 2, 3])])
    )
    assert positive_definite(s).tolist() == [False, False, False, True]
    singular = pack(torch.tensor([[[1.0, 1, 0], [1, 1, 0], [0, 0, 1]]]))
    assert not positive_definite(singular).item()
    assert not positive_definite(torch.full((1, 6), torch.nan)).item()


def test_inverse_of_needles_survives_float32():
    """Millimetres across, decimetres along: the determinant itself would be 1e-14."""
    turn = torch.linalg.qr(torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)).Q
    sigma = torch.tensor([1e-5, 1e-5, 1e-2], dtype=torch.float64)
    full = turn @ torch.diag(sigma**2) @ turn.mT
    round_trip = unpack(inverse3(inverse3(pack(torch.diag(sigma**2).float()))))
    torch.testing.assert_close(round_trip.double(), torch.diag(sigma**2), rtol=1e-5, atol=0)
    torch.testing.assert_close(unpack(inverse3(pack(full))), torch.linalg.inv(full), rtol=1e-5, atol=1e-3)


def test_information_form_is_filterpys(dtype):
    prior, measured = (
        Gaussian(torch.randn(1, 3, generator=torch.Generator().manual_seed(s)).to(dtype), random_spd(1, s, dtype))
        for s in (3, 4)
    )
    a, b = information_from_gaussian(prior), information_from_gaussian(measured)
    fused = gaussian_from_information(type(a)(a.vector + b.vector, a.matrix + b.matrix))
    peer = InformationFilter(3, 3)
    peer.H = np.eye(3)
    peer.P_inv = np.linalg.inv(unpack(prior.cov)[0].double().numpy())
    peer.x = prior.mean[0].double().numpy()[:, None]
    peer.update(measured.mean[0].double().numpy()[:, None], np.linalg.inv(unpack(measured.cov)[0].double().numpy()))
    tolerance = 1e-4 if dtype == torch.float32 else 1e-10
    np.testing.assert_allclose(fused.mean[0].double().numpy(), peer.x.ravel(), atol=tolerance)
    np.testing.assert_allclose(unpack(fused.cov)[0].double().numpy(), np.linalg.inv(peer.P_inv), atol=tolerance)


@pytest.mark.parametrize("function", [inverse3, lambda s: rotate3(torch.eye(3, dtype=s.dtype), s)])
def test_gradients(function):
    assert torch.autograd.gradcheck(function, random_spd(3, 1).contiguous().requires_grad_())
