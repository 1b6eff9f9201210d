"""Both charts against autograd Jacobians, SciPy rotations and Monte Carlo."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchfovea.gaussian import Gaussian, columns, pack, unpack
from torchfovea.sensing.chart import (
    basis,
    cartesian_from_inverse_range,
    in_tangent_frame,
    inverse_range_coordinates,
    turn_cartesian,
)


def units(count: int, seed: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    v = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    return v / v.norm(dim=-1, keepdim=True)


def belief(count: int, seed: int, scale: float = 0.05) -> Gaussian:
    rng = torch.Generator().manual_seed(seed)
    root = scale * torch.randn(count, 3, 3, generator=rng, dtype=torch.float64)
    offset = 0.1 * torch.randn(count, 2, generator=rng, dtype=torch.float64)
    rho = 0.5 + torch.rand(count, generator=rng, dtype=torch.float64)
    return Gaussian(columns(offset[:, 0], offset[:, 1], rho), pack(root @ root.mT))


def point_of(coordinates: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    a, b, rho = coordinates.unbind(-1)
    e1, e2 = basis(direction)
    u = direction + a[..., None] * e1 + b[..., None] * e2
    return u / u.norm(dim=-1, keepdim=True) / rho[..., None]


@given(st.integers(0, 10_000))
def test_basis_is_orthonormal_and_right_handed(seed):
    n = torch.cat([units(5, seed), torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    e1, e2 = basis(n)
    frame = torch.stack([e1, e2, n], -1)
    torch.testing.assert_close(frame.mT @ frame, torch.eye(3, dtype=torch.float64).expand_as(frame))
    torch.testing.assert_close(torch.linalg.cross(e1, e2), n)


@given(st.integers(0, 10_000))
def test_coordinates_undo_the_point(seed):
    direction, b = units(6, seed), belief(6, seed)
    point = point_of(b.mean, direction)
    torch.testing.assert_close(inverse_range_coordinates(point, torch.ones(6, dtype=torch.float64), direction), b.mean)
    # homogeneous: any scale, and a weight of either sign
    scaled = inverse_range_coordinates(3 * point, torch.full((6,), -3.0, dtype=torch.float64), direction)
    torch.testing.assert_close(scaled, b.mean * torch.tensor([1.0, 1, -1], dtype=torch.float64))


def test_cartesian_moments_are_first_order():
    direction, b = units(6, 1), belief(6, 1)
    got = cartesian_from_inverse_range(b, direction)
    for i in range(6):
        jacobian = torch.func.jacrev(point_of)(b.mean[i], direction[i])
        torch.testing.assert_close(got.mean[i], point_of(b.mean[i], direction[i]))
        torch.testing.assert_close(unpack(got.cov[i]), jacobian @ unpack(b.cov[i]) @ jacobian.T)


def test_the_tangent_frame_is_that_of_the_basis():
    rng = torch.Generator().manual_seed(0)
    direction, vector = (torch.randn(50, 3, generator=rng, dtype=torch.float64) for _ in range(2))
    direction = torch.nn.functional.normalize(direction, dim=-1)
    got = in_tangent_frame(direction.unbind(-1), vector.unbind(-1))
    for ours, axis in zip(got, (*basis(direction), direction), strict=True):
        torch.testing.assert_close(ours, (axis * vector).sum(-1))


def test_cartesian_moments_match_samples_where_noise_is_small():
    direction, b = units(3, 2), belief(3, 2, scale=0.005)
    root = torch.linalg.cholesky(unpack(b.cov))
    noise = torch.randn(200_000, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sample = point_of(b.mean + (root @ noise[..., None])[..., 0], direction)
    got = cartesian_from_inverse_range(b, direction)
    for i in range(3):
        want = np.cov(sample[:, i].numpy().T)
        np.testing.assert_allclose(unpack(got.cov[i]), want, atol=0.02 * np.abs(want).max())


def test_far_and_beyond_infinity_stay_finite():
    direction = units(3, 0)
    mean = torch.tensor([[0.0, 0, 0], [0, 0, -0.3], [0, 0, 1e-9]], dtype=torch.float64, requires_grad=True)
    got = cartesian_from_inverse_range(
        Gaussian(mean, pack(torch.eye(3, dtype=torch.float64).expand(3, 3, 3))), direction, far_m=50.0
    )
    torch.testing.assert_close(got.mean.norm(dim=-1), torch.full((3,), 50.0, dtype=torch.float64))
    got.cov.sum().backward()
    assert bool(torch.isfinite(got.cov).all()) and bool(torch.isfinite(mean.grad).all())


@given(st.integers(0, 10_000))
def test_turns_are_the_smallest_rotation(seed):
    source, target, b = units(4, seed), units(4, seed + 1), belief(4, seed)
    source = torch.nn.functional.normalize(target + 0.5 * source, dim=-1)
    cartesian = cartesian_from_inverse_range(b, source)
    want = turn_cartesian(cartesian, source, target)
    for i in range(4):
        axis = np.cross(source[i], target[i])
        sine, cosine = np.linalg.norm(axis), float(source[i] @ target[i])
        rotation = Rotation.from_rotvec(axis / max(sine, 1e-300) * np.arctan2(sine, cosine)).as_matrix()
        np.testing.assert_allclose(want.mean[i], rotation @ cartesian.mean[i].numpy(), atol=1e-9)
        np.testing.assert_allclose(
            unpack(want.cov[i]), rotation @ unpack(cartesian.cov[i]).numpy() @ rotation.T, atol=1e-9
        )


@pytest.mark.parametrize(
    "function",
    [
        lambda m, c, n, t: tuple(cartesian_from_inverse_range(Gaussian(m, c), n)),
        lambda m, c, n, t: tuple(turn_cartesian(Gaussian(m, c), n, t)),
        lambda m, c, n, t: inverse_range_coordinates(m, c[..., 0], n),
    ],
)
def test_gradients(function):
    b = belief(2, 5)
    inputs = (b.mean.contiguous(), b.cov.contiguous(), units(2, 6), units(2, 7))
    assert torch.autograd.gradcheck(function, tuple(x.requires_grad_() for x in inputs))


def test_keeps_float32():
    got = cartesian_from_inverse_range(Gaussian(*(x.float() for x in belief(2, 0))), units(2, 0, torch.float32))
    assert got.mean.dtype == got.cov.dtype == torch.float32
