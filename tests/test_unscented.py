"""The unscented transform against the paper's equations in NumPy, filterpy, and exact laws."""

import numpy as np
import pytest
import torch
from filterpy.kalman import MerweScaledSigmaPoints
from filterpy.kalman import unscented_transform as filterpy_transform
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.gaussian import columns, definiteness, pack, positive_definite, unpack
from torchfovea.sensing.unscented import SigmaPoints, unscented_transform
from torchfovea.setting import SettingError

CHOICES = [SigmaPoints(), SigmaPoints.paper(), SigmaPoints.midpoint()]


def full(packed: torch.Tensor, m: int) -> torch.Tensor:
    matrix = torch.zeros(*packed.shape[:-1], m, m, dtype=packed.dtype)
    row, column = torch.triu_indices(m, m)
    matrix[..., row, column] = packed
    matrix[..., column, row] = packed
    return matrix


def bend(x: torch.Tensor) -> torch.Tensor:
    a, b, c, d = x.unbind(-1)
    return columns(1 / (2 + a - c), torch.sin(b) + d, a * d)


def test_weights_are_equations_14_to_16():
    alpha, beta, kappa, size = 0.25, 2.0, 3.0, 4
    lam = alpha**2 * (size + kappa) - size
    mean, cov = SigmaPoints.paper().weights
    np.testing.assert_allclose(mean, [lam / (size + lam), *[1 / (2 * (size + lam))] * 8])
    np.testing.assert_allclose(cov, [lam / (size + lam) + 1 - alpha**2 + beta, *[1 / (2 * (size + lam))] * 8])
    assert SigmaPoints.paper().spread == pytest.approx(0.4375**0.5)
    assert mean[0] == pytest.approx(-8.143, abs=1e-3) and cov[0] == pytest.approx(-5.205, abs=1e-3)


@pytest.mark.parametrize("points", CHOICES)
def test_transform_is_filterpys(points):
    rng = np.random.default_rng(1)
    mean, root = rng.normal(size=(5, 4)), np.tril(rng.normal(size=(5, 4, 4))) * 0.1
    got_mean, got_cov, image = unscented_transform(bend, torch.from_numpy(mean), torch.from_numpy(root), points)
    assert image.shape == (9, 5, 3)
    peer = MerweScaledSigmaPoints(4, points.alpha, points.beta, points.kappa)
    for i in range(5):
        sigma = peer.sigma_points(mean[i], root[i] @ root[i].T)
        images = bend(torch.from_numpy(sigma)).numpy()
        want_mean, want_cov = filterpy_transform(images, peer.Wm, peer.Wc)
        # filterpy takes the upper Cholesky factor's rows, that is the lower one's columns: the same points
        np.testing.assert_allclose(got_mean[i], want_mean, rtol=1e-9)
        if points.by_axis:  # the covariances of filterpy's transforms of one dimension, added up
            line = MerweScaledSigmaPoints(1, 1.0, 0.0, 2.0)
            want_cov = np.zeros((3, 3))
            for column in root[i].T:
                places = mean[i] + line.sigma_points(np.zeros(1), np.eye(1)) * column
                want_cov += filterpy_transform(bend(torch.from_numpy(places)).numpy(), line.Wm, line.Wc)[1]
        np.testing.assert_allclose(full(got_cov, 3)[i], want_cov, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("points", CHOICES)
@given(seed=st.integers(0, 1000))
def test_exact_for_affine_maps(points, seed):
    rng = torch.Generator().manual_seed(seed)
    matrix, shift, mean = (torch.randn(*s, generator=rng, dtype=torch.float64) for s in ((3, 4), (3,), (2, 4)))
    root = torch.randn(2, 4, 4, generator=rng, dtype=torch.float64)
    got_mean, got_cov, _ = unscented_transform(lambda x: x @ matrix.T + shift, mean, root, points)
    torch.testing.assert_close(got_mean, mean @ matrix.T + shift)
    torch.testing.assert_close(full(got_cov, 3), matrix @ root @ root.mT @ matrix.T, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("points", [SigmaPoints(), SigmaPoints(3, kappa=0.0), SigmaPoints(1, kappa=2.0)], ids=str)
def test_the_variance_of_a_sum_of_squares_is_right(points, dtype):
    n = points.dimensions
    zero, one = torch.zeros(n, dtype=dtype), torch.eye(n, dtype=dtype)
    mean, variance, _ = unscented_transform(lambda x: x.square().sum(-1, keepdim=True), zero, one, points)
    assert (mean.item(), variance.item()) == (pytest.approx(n, rel=1e-6), pytest.approx(2 * n, rel=1e-6))


@pytest.mark.parametrize("points", [*CHOICES, SigmaPoints(3, kappa=0.0), SigmaPoints(2, 1.0, 0.0, -1.0)], ids=str)
def test_no_variance_is_negative(points):
    rng = torch.Generator().manual_seed(0)
    n = points.dimensions
    form = torch.randn(500, n, n, generator=rng, dtype=torch.float64) + torch.randn(500, 1, 1, generator=rng)
    mean, root = (torch.randn(500, *s, generator=rng, dtype=torch.float64) for s in ((n,), (n, n)))

    def bend(x):
        return torch.stack([(x * (form @ x[..., None])[..., 0]).sum(-1), x[..., 0]], -1)

    _, cov, _ = unscented_transform(bend, mean, root, points)
    assert float(torch.linalg.eigvalsh(full(cov, 2))[:, 0].min()) > -1e-9


def test_float32_keeps_its_digits_with_the_papers_weights():
    mean = torch.tensor([[300.0, 200, 280, 200]])
    root = 0.1 * torch.eye(4).expand(1, 4, 4)
    narrow = unscented_transform(lambda x: x[..., :3], mean, root, SigmaPoints.paper())
    torch.testing.assert_close(narrow[0], mean[:, :3], rtol=1e-6, atol=0)
    torch.testing.assert_close(full(narrow[1], 3)[0], 0.01 * torch.eye(3), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("points", CHOICES)
def test_gradients(points):
    rng = torch.Generator().manual_seed(0)
    mean = torch.randn(2, 4, generator=rng, dtype=torch.float64).mul(0.1).requires_grad_()
    root = torch.randn(2, 4, 4, generator=rng, dtype=torch.float64).mul(0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda m, r: unscented_transform(bend, m, r, points), (mean, root))


def test_errors_name_the_setting():
    with pytest.raises(SettingError, match=r"sigma_points.kappa = -4"):
        SigmaPoints(4, kappa=-4)
    with pytest.raises(SettingError, match=r"sigma_points.alpha = 0"):
        SigmaPoints(alpha=0)
    with pytest.raises(SettingError, match=r"sigma_points.beta = 0.0: expected more than 0.875"):
        SigmaPoints(4, 1.0, 0.0, -3.5)
    for name in ("alpha", "beta", "kappa"):
        with pytest.raises(SettingError, match=f"sigma_points.{name} = nan"):
            SigmaPoints(**{name: float("nan")})
    with pytest.raises(SettingError, match=r"sigma_points.dimensions = 4: expected 2"):
        unscented_transform(lambda x: x, torch.zeros(1, 2), torch.eye(2)[None], SigmaPoints())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_definiteness_is_positive_where_positive_definite(dtype):
    rng = torch.Generator().manual_seed(0)
    factor = torch.randn(4000, 3, 4, generator=rng, dtype=torch.float64)
    sign = torch.where(torch.rand(4000, 1, 4, generator=rng) < 0.1, -1.0, 1.0)
    size = 10.0 ** torch.randint(-5, 3, (4000, 3, 1), generator=rng)
    cov = pack(((factor * sign) @ factor.mT * size * size.mT).to(dtype))
    for k, value in enumerate((0.0, -1.0, torch.inf, torch.nan)):
        for entry in range(6):
            cov[6 * k + entry, entry] = value
    # Sylvester's criterion on the unit diagonal, by LAPACK
    full, tolerance = unpack(cov.double()), max(8 * torch.finfo(dtype).eps, 1e-13)
    scale = full.diagonal(dim1=1, dim2=2).rsqrt()
    full = (full * scale[:, :, None] * scale[:, None]).nan_to_num(0.0)
    want = (torch.linalg.det(full[:, :2, :2]) > tolerance) & (torch.linalg.det(full) > tolerance)
    want &= torch.isfinite(cov).all(-1) & (unpack(cov).diagonal(dim1=1, dim2=2) > 0).all(-1)
    assert 100 < int(want.sum()) < 3900
    assert torch.equal(definiteness(cov.unbind(-1)) > 0, want)
    assert torch.equal(positive_definite(cov), want)
