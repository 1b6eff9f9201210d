import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from projnormal.formulas.projected_normal import log_pdf
from scipy.integrate import quad
from scipy.spatial import cKDTree
from torch.autograd import gradcheck, gradgradcheck

from torchfovea.memory.sphere import (
    DirectionMixture,
    direction_mixture,
    fibonacci_directions,
    fix_gauge,
    geodesic_directions,
    latitude_longitude_directions,
    log_density,
    log_normalizer,
    reachable_directions,
    sample,
    sphere_quadrature,
    truncated_icosahedron_directions,
)
from torchfovea.setting import SettingError

MEMORY = Path(__file__).parents[1] / "conf" / "memory"
F64 = torch.float64


def random_mixture(seed: int, components: int = 3, dtype: torch.dtype = F64, spread: float = 1.0) -> DirectionMixture:
    g = torch.Generator().manual_seed(seed)
    factor = 0.3 * torch.randn(components, 3, 3, generator=g, dtype=F64)
    covariances = factor @ factor.mT + 0.05 * torch.eye(3, dtype=F64)
    return direction_mixture(
        (torch.rand(components, generator=g, dtype=F64) + 0.1).to(dtype),
        (spread * torch.randn(components, 3, generator=g, dtype=F64)).to(dtype),
        covariances.to(dtype),
    )


def product_quadrature(polar: int = 160, azimuths: int = 320) -> tuple[torch.Tensor, torch.Tensor]:
    """Gauss-Legendre in z times the trapezoid rule in azimuth."""
    nodes, weights = np.polynomial.legendre.leggauss(polar)
    z = torch.from_numpy(nodes)[:, None].expand(polar, azimuths)
    azimuth = (torch.arange(azimuths, dtype=F64) * (2 * math.pi / azimuths)).expand(polar, azimuths)
    r = (1 - z * z).sqrt()
    area = torch.from_numpy(weights)[:, None].expand(polar, azimuths) * (2 * math.pi / azimuths)
    return torch.stack((r * azimuth.cos(), r * azimuth.sin(), z), -1).reshape(-1, 3), area.reshape(-1)


# ---------------------------------------------------------------- density


@pytest.mark.parametrize("seed", range(4))
def test_density_integrates_to_one(seed):
    directions, area = product_quadrature()
    total = (log_density(random_mixture(seed), directions).exp() * area).sum()
    assert abs(float(total) - 1) < 1e-6


def test_density_of_one_component_agrees_with_projnormal():
    directions = fibonacci_directions(500, dtype=F64)
    for seed in range(5):
        mixture = random_mixture(seed, components=1)
        cov = mixture.cholesky[0] @ mixture.cholesky[0].mT
        theirs = log_pdf(mixture.means[0], cov, directions)
        # projnormal's constants are float32
        torch.testing.assert_close(log_density(mixture, directions), theirs, atol=1e-6, rtol=0)


def test_density_of_a_mixture_is_the_weighted_sum_of_its_components():
    mixture = random_mixture(3)
    directions = fibonacci_directions(200, dtype=F64)
    parts = [
        w * log_density(direction_mixture([1.0], m[None], cholesky=c[None]), directions).exp()
        for w, m, c in zip(mixture.logits.softmax(0), mixture.means, mixture.cholesky, strict=True)
    ]
    torch.testing.assert_close(log_density(mixture, directions).exp(), sum(parts))


def test_isotropic_component_is_uniform():
    mixture = direction_mixture([2.0], [[0.0, 0.0, 0.0]], [[0.5, 0.5, 0.5]], dtype=F64)
    expected = torch.full((50,), -math.log(4 * math.pi), dtype=F64)
    torch.testing.assert_close(log_density(mixture, fibonacci_directions(50, dtype=F64)), expected)


@pytest.mark.parametrize(
    "d", [-1000.0, -300.0, -60.0, -20.0, -8.0, -3.0, -2.5, -2.4, -1.5, -1.4, 0.0, 3.0, 40.0, 1000.0]
)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_density_at_extreme_parameters(d, dtype):
    # u = x, Sigma = 1, mu = (D, 0, 0): f = (2 pi)^(-3/2) int s^2 exp(-(s - D)^2 / 2) ds, by SciPy in a scaled variable.
    if d <= 0:
        scale = 1 / max(1.0, -d)
        integral = quad(
            lambda s: (s * scale) ** 2 * math.exp(-0.5 * (s * scale) ** 2 + d * s * scale),
            0,
            60,
            epsabs=0,
            epsrel=1e-12,
        )[0]
        expected = math.log(integral * scale) - 0.5 * d * d - 1.5 * math.log(2 * math.pi)
    else:
        integral = quad(lambda s: (s + d) ** 2 * math.exp(-0.5 * s * s), -min(d, 12.0), 12, epsabs=0, epsrel=1e-12)[0]
        expected = math.log(integral) - 1.5 * math.log(2 * math.pi)
    mixture = direction_mixture([1.0], [[d, 0.0, 0.0]], [[1.0, 1.0, 1.0]], dtype=dtype)
    value = log_density(mixture, torch.tensor([1.0, 0.0, 0.0], dtype=dtype))
    tolerance = 3e-6 if dtype == torch.float32 else 2e-12
    assert float(value) == pytest.approx(expected, rel=tolerance, abs=tolerance)


def test_float32_follows_float64_off_axis_at_large_means():
    g = torch.Generator().manual_seed(0)
    for length in (10.0, 100.0, 1000.0):
        mean = length * torch.nn.functional.normalize(torch.randn(1, 3, generator=g), dim=-1)
        directions = fibonacci_directions(400)
        directions = torch.cat((directions, mean / length + 1e-3 * torch.randn(100, 3, generator=g)))
        single = log_density(direction_mixture([1.0], mean, [[1.0, 0.5, 2.0]]), directions)
        double = log_density(direction_mixture([1.0], mean.double(), [[1.0, 0.5, 2.0]]), directions.double())
        assert bool(((single - double).abs() < 1e-6 * double.abs() + 1e-6 * length).all())


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_gradients_are_finite_at_extreme_parameters(dtype):
    for d in (-1000.0, -100.0, -2.5, -1.5, 0.0, 100.0, 1000.0):
        mean = torch.tensor([[d, 0.0, 0.0]], dtype=dtype, requires_grad=True)
        weights = torch.ones(1, dtype=dtype, requires_grad=True)
        factor = torch.eye(3, dtype=dtype)[None].clone().requires_grad_()
        u = torch.tensor([1.0, 0.0, 0.0], dtype=dtype, requires_grad=True)
        log_density(direction_mixture(weights, mean, cholesky=factor), u).backward()
        for leaf in (mean, weights, factor, u):
            assert bool(torch.isfinite(leaf.grad).all())


def test_density_gradients():
    directions = fibonacci_directions(7, dtype=F64)
    base = random_mixture(1, components=2, spread=3.0)
    leaves = [t.detach().clone().requires_grad_() for t in (base.logits, base.means, base.cholesky)]

    def density(logits, means, cholesky):
        return log_density(direction_mixture(logits.softmax(0), means, cholesky=cholesky.tril()), directions)

    assert gradcheck(density, leaves)
    assert gradgradcheck(density, leaves)
    assert gradcheck(lambda u: log_density(base, u), directions.clone().requires_grad_())
    far = direction_mixture([1.0], [[-30.0, 1.0, 0.5]], [[1.0, 0.7, 0.4]], dtype=F64)
    assert gradcheck(lambda m: log_density(far._replace(means=m), directions), far.means.clone().requires_grad_())


def test_density_takes_any_leading_shape_and_length():
    mixture = random_mixture(5)
    directions = fibonacci_directions(24, dtype=F64)
    flat = log_density(mixture, directions)
    torch.testing.assert_close(log_density(mixture, 1e-30 * directions.reshape(2, 3, 4, 3)), flat.reshape(2, 3, 4))
    torch.testing.assert_close(log_density(mixture, directions[5]), flat[5])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(-3, 3))
def test_density_invariances(seed, log_scale):
    mixture = random_mixture(seed)
    g = torch.Generator().manual_seed(seed + 1)
    directions = fibonacci_directions(20, dtype=F64)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=F64))[0]
    value = log_density(mixture, directions)
    scale = math.exp(log_scale)
    scaled = DirectionMixture(mixture.logits + log_scale, scale * mixture.means, scale * mixture.cholesky)
    torch.testing.assert_close(log_density(scaled, directions), value)
    covariances = rotation @ mixture.cholesky @ mixture.cholesky.mT @ rotation.mT
    covariances = 0.5 * (covariances + covariances.mT)
    turned = direction_mixture(mixture.logits.softmax(0), mixture.means @ rotation.mT, covariances)
    torch.testing.assert_close(log_density(turned, directions @ rotation.mT), value)
    order = torch.randperm(3, generator=g)
    torch.testing.assert_close(log_density(DirectionMixture(*(t[order] for t in mixture)), directions), value)


def test_fix_gauge_keeps_the_density_and_fixes_the_power():
    mixture = random_mixture(8, spread=5.0)
    fixed = fix_gauge(mixture)
    directions = fibonacci_directions(100, dtype=F64)
    torch.testing.assert_close(log_density(fixed, directions), log_density(mixture, directions))
    power = fixed.means.square().sum(-1) + fixed.cholesky.square().sum((-2, -1))
    torch.testing.assert_close(power, torch.ones(3, dtype=F64))
    torch.testing.assert_close(fix_gauge(fixed).means, fixed.means)
    scaled = DirectionMixture(mixture.logits - 2.0, 7 * mixture.means, 7 * mixture.cholesky)
    torch.testing.assert_close(fix_gauge(scaled).cholesky, fixed.cholesky)


# ---------------------------------------------------------------- sampling


def test_samples_agree_with_the_density_in_caps():
    mixture = random_mixture(11)
    n = 200_000
    cells = sample(mixture, n, 0)
    torch.testing.assert_close(cells.norm(dim=-1), torch.ones(n, dtype=F64))
    for axis in fibonacci_directions(12, dtype=F64):
        # quadrature in a frame whose pole is the cap's axis, over the cap alone
        nodes, weights = np.polynomial.legendre.leggauss(60)
        low = math.cos(0.6)
        z = torch.from_numpy(low + (1 - low) * (nodes + 1) / 2)[:, None]
        azimuth = torch.arange(120, dtype=F64) * (2 * math.pi / 120)
        first = torch.nn.functional.normalize(torch.linalg.cross(axis, axis.flip(0) + 0.3), dim=0)
        second = torch.linalg.cross(axis, first)
        r = (1 - z * z).sqrt()[..., None]
        ring = azimuth.cos()[:, None] * first + azimuth.sin()[:, None] * second
        density = log_density(mixture, z[..., None] * axis + r * ring).exp().mean(-1) * 2 * math.pi
        mass = float((density * torch.from_numpy(weights) * (1 - low) / 2).sum())
        share = float((cells @ axis > low).double().mean())
        assert abs(share - mass) < 5 * math.sqrt(mass * (1 - mass) / n) + 1e-6


def test_restricted_sampling_and_its_normalizer():
    mixture = random_mixture(2)

    def reachable(u):
        return (u[:, 0] > 0.3) & (u[:, 2].abs() < 0.5)

    cells = sample(mixture, 5000, 1, reachable)
    assert cells.shape == (5000, 3) and bool(reachable(cells).all())
    share = float(reachable(sample(mixture, 400_000, 2)).double().mean())
    part = float(log_normalizer(mixture, sphere_quadrature(40_000, reachable, dtype=F64)).exp())
    assert part == pytest.approx(share, abs=3e-3)
    whole = log_normalizer(mixture, sphere_quadrature(20_000, dtype=F64))
    assert abs(float(whole)) < 1e-4


def test_normalizer_gradients():
    base = random_mixture(4, components=2)
    quadrature = sphere_quadrature(200, lambda u: u[:, 0] > 0, dtype=F64)
    leaves = [t.detach().clone().requires_grad_() for t in base]
    assert gradcheck(lambda *t: log_normalizer(DirectionMixture(t[0], t[1], t[2].tril()), quadrature), leaves)


def test_sampling_is_reproducible_and_reparameterized():
    mixture = random_mixture(6)
    assert torch.equal(sample(mixture, 100, 7), sample(mixture, 100, torch.Generator().manual_seed(7)))
    assert not torch.equal(sample(mixture, 100, 7), sample(mixture, 100, 8))
    means = mixture.means.clone().requires_grad_()
    factors = mixture.cholesky.clone().requires_grad_()
    assert gradcheck(lambda m, c: sample(mixture._replace(means=m, cholesky=c.tril()), 6, 3), (means, factors))
    single = DirectionMixture(*(t.float() for t in mixture))
    assert sample(single, 10, 0).dtype == torch.float32


def test_reparameterized_gradient_agrees_with_the_density():
    # d/dmu E[h(p)] by the pathwise estimator and by quadrature of the density
    directions, area = product_quadrature(60, 120)
    covariances = torch.tensor([[0.4, 0.3, 0.2]], dtype=F64)
    mean = torch.tensor([[0.5, -0.2, 0.3]], dtype=F64, requires_grad=True)

    def height(u):
        return u[:, 2] * u[:, 0] + u[:, 1]

    mixture = direction_mixture([1.0], mean, covariances)
    (exact,) = torch.autograd.grad((log_density(mixture, directions).exp() * area * height(directions)).sum(), mean)
    mixture = direction_mixture([1.0], mean, covariances)
    (pathwise,) = torch.autograd.grad(height(sample(mixture, 200_000, 0)).mean(), mean)
    torch.testing.assert_close(pathwise, exact, atol=0.01, rtol=0)


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("weights", "means", "keywords", "named"),
    [
        ([0.0, 1.0], [[0.0] * 3] * 2, {"covariances": [[1.0] * 3] * 2}, "weights"),
        ([-1.0], [[0.0] * 3], {"covariances": [[1.0] * 3]}, "weights"),
        ([1.0], [[0.0] * 3] * 2, {"covariances": [[1.0] * 3] * 2}, "weights"),
        ([float("nan")], [[0.0] * 3], {"covariances": [[1.0] * 3]}, "weights"),
        ([1.0], [[0.0] * 2], {"covariances": [[1.0] * 3]}, "means"),
        ([1.0], [[float("inf"), 0.0, 0.0]], {"covariances": [[1.0] * 3]}, "means"),
        ([1.0], [[0.0, "x", 0.0]], {"covariances": [[1.0] * 3]}, "means"),
        ([1.0], [[0.0] * 3], {"covariances": [[1.0] * 2]}, "covariances"),
        ([0.5, 0.5], [[0.0] * 3] * 2, {"covariances": [[1.0] * 3, [1.0, 1.0, -0.1]]}, r"covariances\[1\]"),
        (
            [1.0],
            [[0.0] * 3],
            {"covariances": [[[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]},
            r"covariances\[0\]",
        ),
        (
            [1.0],
            [[0.0] * 3],
            {"covariances": [[[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]},
            r"covariances\[0\]",
        ),
        ([1.0], [[0.0] * 3], {"covariances": [[1.0] * 3, [[1.0] * 3] * 3]}, "covariances"),
        ([1.0], [[0.0] * 3], {"cholesky": [[[1.0] * 3] * 3]}, "cholesky"),
        ([1.0], [[0.0] * 3], {"cholesky": [[1.0] * 3]}, "cholesky"),
        ([1.0], [[0.0] * 3], {"cholesky": [[[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]}, "cholesky"),
        ([1.0], [[0.0] * 3], {}, "covariances"),
        ([1.0], [[0.0] * 3], {"covariances": [[1.0] * 3], "dtype": torch.float16}, r"means\.dtype"),
    ],
)
def test_bad_mixtures_are_named(weights, means, keywords, named):
    with pytest.raises(SettingError, match=f"^{named} = "):
        direction_mixture(weights, means, **keywords)


def test_lists_keep_their_digits():
    assert float(direction_mixture([1.0], [[0.1, 0.0, 0.0]], [[0.3] * 3], dtype=F64).means[0, 0]) == 0.1


def test_other_errors():
    mixture = direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.01, 0.01, 0.01]])
    with pytest.raises(SettingError, match="reachable"):
        sample(mixture, 10, 0, lambda u: u[:, 0] > 2)
    with pytest.raises(SettingError, match="do not overlap"):
        sample(mixture, 10, 0, lambda u: u[:, 0] < 0)
    with pytest.raises(SettingError, match="predicate"):
        sample(mixture, 10, 0, lambda u: u)
    with pytest.raises(SettingError, match="cells = 0"):
        sample(mixture, 0, 0)
    with pytest.raises(SettingError, match="reachable"):
        sphere_quadrature(100, lambda u: u[:, 0] > 2)
    with pytest.raises(SettingError, match="reachable"):
        reachable_directions(geodesic_directions, 100, lambda u: u[:, 0] > 2)
    for bad in (torch.zeros(2, 3), torch.tensor([float("nan"), 0.0, 1.0]), torch.ones(2)):
        with pytest.raises(SettingError, match="directions"):
            log_density(mixture, bad)
    for make in (
        fibonacci_directions,
        geodesic_directions,
        latitude_longitude_directions,
        truncated_icosahedron_directions,
    ):
        with pytest.raises(SettingError, match="n = 0"):
            make(0)


# ---------------------------------------------------------------- regular topologies and settings


@pytest.mark.parametrize(
    ("make", "n", "count", "uneven"),
    [
        (fibonacci_directions, 1000, 1000, 1.3),
        (geodesic_directions, 12, 12, 1.01),
        (geodesic_directions, 20_000, 20_252, 1.5),
        (truncated_icosahedron_directions, 32, 32, 1.2),
        (truncated_icosahedron_directions, 20_000, 20_282, 1.5),
        (latitude_longitude_directions, 20_000, 20_000, 1e9),
    ],
)
def test_topologies(make, n, count, uneven):
    cells = make(n, dtype=F64)
    assert cells.shape == (count, 3) and make(n).dtype == torch.float32
    torch.testing.assert_close(cells.norm(dim=-1), torch.ones(count, dtype=F64))
    torch.testing.assert_close(cells.mean(0), torch.zeros(3, dtype=F64), atol=2e-3, rtol=0)
    spacing = cKDTree(cells.numpy()).query(cells.numpy(), k=2)[0][:, 1]
    assert spacing.min() > 0.0
    assert spacing.max() / spacing.min() < uneven


def test_truncated_icosahedron_has_twelve_pentagons_and_twenty_hexagons():
    cells = truncated_icosahedron_directions(32, dtype=F64)
    cosine = cells @ cells.T
    # a pentagon's five neighbours are hexagons 37.4 degrees away; a hexagon has three such and three hexagons at 41.8
    neighbours = (cosine > math.cos(math.radians(43))).sum(-1) - 1
    assert sorted(neighbours.tolist()) == [5] * 12 + [6] * 20


@pytest.mark.parametrize("make", [fibonacci_directions, geodesic_directions, latitude_longitude_directions])
def test_reachable_directions_aims_at_a_number(make):
    def reachable(u):
        return (u[:, 0] > 0.6) & (u[:, 2].abs() < 0.6)

    cells = reachable_directions(make, 5000, reachable)
    assert bool(reachable(cells).all()) and abs(len(cells) - 5000) < 150


def test_memory_settings():
    found = {}
    for path in sorted(MEMORY.glob("*.yaml")):
        setting = yaml.safe_load(path.read_text())
        assert setting["name"] == path.stem and setting["cells"] == 20_000
        if "topology" in setting:
            assert setting["topology"] in ("latitude_longitude", "geodesic", "truncated_icosahedron")
        elif setting["means"] is not None:  # some are aimed at a scene's target
            mixture = direction_mixture(setting["weights"], setting["means"], setting["covariances"])
            found[path.stem] = sample(mixture, 4000, 0)
    assert found.keys() >= {"unbiased", "top", "down", "target", "target_printed", "equator", "antipodal", "multifocal"}
    assert float(found["unbiased"].mean(0).norm()) < 0.05
    assert float(found["top"][:, 2].mean()) > 0.5 and float(found["down"][:, 2].mean()) < -0.5
    target = found["target"].mean(0)
    assert math.degrees(math.atan2(target[1], target[0])) == pytest.approx(47.7, abs=1.5)
    assert float(found["equator"][:, 2].abs().mean()) < 0.5 * float(found["equator"][:, 0].abs().mean())
    assert float(found["antipodal"][:, 1].abs().mean()) > 0.8 and abs(float(found["antipodal"][:, 1].mean())) < 0.05
