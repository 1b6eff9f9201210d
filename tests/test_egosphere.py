"""The memory: Eq. 34-35 against filterpy, laws of pooling, and what each fusion does to the range."""

import math

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.gaussian import Gaussian, columns, inverse3, pack, positive_definite, unpack
from torchfovea.memory.association import associate, in_front
from torchfovea.memory.egosphere import (
    Fusion,
    Prior,
    belief,
    cartesian_belief,
    empty_memory,
    forget,
    inverse_range_belief,
    prior_information,
)
from torchfovea.memory.nearest import build_index
from torchfovea.memory.pooling import add_common, nearness, pool, pool_patches
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.update import fuse, remember
from torchfovea.rows import row, stack
from torchfovea.sensing.chart import basis, cartesian_from_inverse_range
from torchfovea.sensing.triangulation import Observations
from torchfovea.setting import SettingError

AHEAD = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)


def gaussians(count: int, seed: int, dtype=torch.float64) -> Gaussian:
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(count, 3, 3, generator=rng, dtype=torch.float64) * 0.2
    mean = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return Gaussian(mean.to(dtype), pack(root @ root.mT + 0.01 * torch.eye(3, dtype=torch.float64)).to(dtype))


def observed_at(
    direction: torch.Tensor, gaussian: Gaussian, support: float = 0.01, chart: str = "inverse_range"
) -> Observations:
    shape = direction.shape[:-1]
    support_rad = torch.full(shape, support, dtype=direction.dtype)
    valid = torch.ones(shape, dtype=torch.bool)
    return Observations(gaussian.mean, gaussian.cov, direction, support_rad, valid, valid.to(direction), chart)


def nearnesses(rho: torch.Tensor, std: float, bearing_std: float = 1e-3) -> Gaussian:
    """Observations of inverse range about their own directions."""
    zero = torch.zeros_like(rho)
    fine, coarse = zero + bearing_std**2, zero + std**2
    return Gaussian(columns(zero, zero, rho), columns(fine, zero, zero, fine, zero, coarse))


def around(cell: torch.Tensor, angle: float, count: int, seed: int) -> torch.Tensor:
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=cell.dtype)
    return torch.nn.functional.normalize(cell + angle * noise, dim=-1)


def enter(cells, observed, fusion, prior=None, times=1, common=None):
    """A new memory after some equal saccades, the observations being of its chart."""
    observed = observed._replace(chart=fusion.chart)
    prior = prior or Prior()
    memory = empty_memory(cells, prior, fusion.chart)
    for _ in range(times):
        memory = remember(memory, observed, fusion, common)
    return memory


@given(seed=st.integers(0, 1000))
def test_points_fuse_as_in_a_kalman_filter_one_observation_at_a_time(seed):
    cells = fibonacci_directions(4, torch.float64)
    memory = empty_memory(cells, Prior(mean=2.0, std=3.0), "cartesian")
    found = gaussians(12, seed)
    cell = torch.randint(0, 3, (12,), generator=torch.Generator().manual_seed(seed))
    after = fuse(memory, pool(found, cell, (4,)))
    got = belief(after)
    for i in range(4):
        peer = KalmanFilter(3, 3)
        peer.F = peer.H = np.eye(3)
        peer.x, peer.P = 2.0 * cells[i].numpy()[:, None], 9.0 * np.eye(3)
        for k in (cell == i).nonzero().flatten().tolist():
            peer.update(found.mean[k].numpy()[:, None], R=unpack(found.cov[k]).numpy())
        np.testing.assert_allclose(got.mean[i], peer.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(unpack(got.cov[i]), peer.P, atol=1e-9)
    assert after.looks.tolist() == [float(bool((cell == i).any())) for i in range(4)]


@given(seed=st.integers(0, 1000))
def test_inverse_ranges_fuse_as_in_a_kalman_filter_of_the_patch(seed):
    prior = Prior(mean=0.5, std=0.3, slope_std=1.2, bearing_std=0.2)
    direction = around(AHEAD[0], 0.05, 15, seed)
    rho = 0.6 + 0.1 * torch.randn(15, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    got = enter(AHEAD, observed_at(direction, nearnesses(rho, 0.02)), Fusion(conflict=math.inf, gate_deg=30), prior)
    peer = KalmanFilter(3, 1)
    peer.F = np.eye(3)
    peer.x, peer.P = np.array([[0], [0], [0.5]]), np.diag([1.2**2, 1.2**2, 0.3**2])
    frame = torch.stack([*(axis[0] for axis in basis(AHEAD)), AHEAD[0]])
    for k in range(15):
        row = (frame @ direction[k]).numpy()[None]
        peer.update(rho[k].numpy()[None, None], R=np.array([[0.02**2 + 1.2**2 * 2e-6]]), H=row)
    moments = belief(got)
    np.testing.assert_allclose(moments.mean[0], peer.x[:, 0], atol=1e-8)
    np.testing.assert_allclose(unpack(moments.cov[0]), peer.P, atol=1e-8)
    assert got.bearing.item() == pytest.approx(1 / 0.04 + 15e6)


@given(seed=st.integers(0, 1000))
def test_nearness_is_the_marginal_of_the_whole_patch(seed):
    found = gaussians(5, seed)
    information = type(empty_memory(AHEAD, Prior()).information)(found.mean, found.cov)
    mean, variance = nearness(information)
    cov = inverse3(found.cov)
    torch.testing.assert_close(variance, cov[:, 5])
    torch.testing.assert_close(mean, (unpack(cov) @ found.mean[..., None])[:, 2, 0])


@given(seed=st.integers(0, 1000))
def test_the_belief_in_inverse_range_is_that_of_the_whole_patch(seed):
    found = gaussians(5, seed)
    memory = empty_memory(AHEAD.expand(5, 3).contiguous(), Prior())
    lasting = torch.rand(5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    memory = memory._replace(information=type(memory.information)(found.mean, found.cov), lasting=lasting)
    rho, variance = inverse_range_belief(memory)
    whole = belief(memory)
    torch.testing.assert_close(rho, whole.mean[:, 2])
    torch.testing.assert_close(variance, whole.cov[:, 5])


def test_order_does_not_matter_and_unseen_cells_stay():
    found, cell = gaussians(50, 1), torch.arange(50) % 7
    turned = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    one = pool(found, cell, (9,))
    two = pool(Gaussian(found.mean[turned], found.cov[turned]), cell[turned], (9,))
    torch.testing.assert_close(one.information.matrix, two.information.matrix)
    memory = empty_memory(fibonacci_directions(9, torch.float64), Prior(), "cartesian")
    after = fuse(memory, one)
    assert torch.equal(after.information.matrix[7:], memory.information.matrix[7:])


def test_common_covariance_is_a_floor_that_no_averaging_removes():
    """1,000 observations that share an error of 1 cm stay 1 cm uncertain; without the term they claim 0.3 mm."""
    memory = empty_memory(AHEAD, Prior(mean=2.0, std=100.0), "cartesian")
    single = pack(1e-4 * torch.eye(3, dtype=torch.float64))
    found = Gaussian(torch.tensor([[2.0, 0, 0]], dtype=torch.float64).expand(1000, 3), single.expand(1000, 6))
    pooled = pool(found, torch.zeros(1000, dtype=torch.long), (1,))
    with_common = belief(fuse(memory, add_common(pooled, single[None], "cartesian")))
    without = belief(fuse(memory, pooled))
    assert with_common.cov[0, 0].sqrt().item() == pytest.approx(0.01, rel=0.01)
    assert without.cov[0, 0].sqrt().item() == pytest.approx(0.01 / math.sqrt(1000), rel=0.01)


def test_common_covariance_of_patches_is_added_to_the_pooled_moments():
    rng = torch.Generator().manual_seed(0)
    row = torch.nn.functional.normalize(torch.randn(8, 3, generator=rng, dtype=torch.float64), dim=-1)
    ones = torch.ones(8, dtype=torch.float64)
    zero = torch.zeros(8, dtype=torch.long)
    pooled = pool_patches(0.5 * ones, 0.01 * ones, 100 * ones, row, ones, zero, (1,))
    common = torch.tensor([[1e-4, 0, 0, 3e-4, 0, 2e-3]], dtype=torch.float64)
    after = add_common(pooled, common, "inverse_range", slope_std=1.5)
    before = unpack(inverse3(pooled.information.matrix))
    wider = before + torch.diag(torch.tensor([0, 0, 2e-3 + 2.25 * 4e-4], dtype=torch.float64))
    torch.testing.assert_close(unpack(inverse3(after.information.matrix)), wider)
    mean = [torch.linalg.solve(unpack(p.information.matrix), p.information.vector) for p in (pooled, after)]
    torch.testing.assert_close(mean[0], mean[1])
    torch.testing.assert_close(1 / after.bearing, 1 / pooled.bearing + 2e-4)
    # where nothing came there is nothing to add to
    empty = pool_patches(*(x[:0] for x in (ones, ones, ones, row, ones, zero)), (1,))
    assert add_common(empty, common, "inverse_range").information.matrix.abs().sum() == 0


@pytest.mark.parametrize("name", ["inverse_range", "aligned", "printed"])
def test_common_given_as_a_function_gets_the_points_that_the_saccade_found(name):
    fusion = Fusion(name, fill=False, gate_deg=10)
    cells = fibonacci_directions(30, torch.float64)
    direction = around(cells[3], 0.01, 40, 0)
    gaussian = nearnesses(torch.full((40,), 0.5, dtype=torch.float64), 1e-3)
    if fusion.chart == "cartesian":
        gaussian = cartesian_from_inverse_range(gaussian, direction)
    asked = []

    def common(points):
        asked.append(points)
        return pack(1e-4 * torch.eye(3, dtype=torch.float64)).expand(30, 6)

    enter(cells, observed_at(direction, gaussian), fusion, common=common)
    assert asked[0].shape == (30, 3) and bool(torch.isfinite(asked[0]).all())
    assert asked[0][3].norm().item() == pytest.approx(2.0, abs=0.05)


def test_batches_of_memories_are_loops():
    cells = torch.stack([fibonacci_directions(20, torch.float64), -fibonacci_directions(20, torch.float64)])
    direction = torch.stack([around(cells[b, 3], 0.05, 30, b) for b in range(2)])
    rho = 0.5 + torch.rand(2, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen = observed_at(direction, nearnesses(rho, 0.05, 0.01), 0.2)
    for fusion in (Fusion(fill=False), Fusion(), Fusion("aligned")):
        whole = enter(cells, seen, fusion)
        for b in range(2):
            one = enter(cells[b], row(seen, b), fusion)
            for a, c in zip(whole.information, one.information, strict=True):
                torch.testing.assert_close(a[b], c)
            assert torch.equal(whole.looks[b], one.looks)


@pytest.mark.parametrize(
    ("name", "low", "high"), [("inverse_range", 0.99, 1.01), ("aligned", 0.9, 1.1), ("printed", 0.0, 0.6)]
)
def test_rays_of_one_cell_do_not_pull_it_to_the_eye_unless_printed(name, low, high):
    """A sphere of 2 m around the observer: 400 thin long Gaussians on different rays of one cell."""
    direction = around(AHEAD[0], 0.03, 400, 0)
    noise = torch.randn(400, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    inverse = nearnesses(0.5 + 0.05 * noise, 0.05)
    fusion = Fusion(name, fill=False, gate_deg=10)
    gaussian = inverse if name == "inverse_range" else cartesian_from_inverse_range(inverse, direction)
    prior = Prior(0.3, 1.0) if name == "inverse_range" else Prior(1000.0, 1000.0)
    memory = enter(AHEAD, observed_at(direction, gaussian), fusion, prior)
    ratio = cartesian_belief(memory).mean.norm().item() / 2
    assert low < ratio < high, ratio


def test_a_slanted_floor_is_neither_biased_nor_overconfident():
    """Observations on one side of the cell of a steep plane: the error stays within what is claimed, in the mean."""
    q = torch.tensor([0.5, 1.2, -0.8], dtype=torch.float64)
    z = []
    for seed in range(200):
        rng = torch.Generator().manual_seed(seed)
        side = torch.tensor([0.0, 0.01, -0.01], dtype=torch.float64)
        direction = around(AHEAD[0] + side, 0.01, 30, seed)
        rho = direction @ q + 0.01 * torch.randn(30, generator=rng, dtype=torch.float64)
        moments = belief(enter(AHEAD, observed_at(direction, nearnesses(rho, 0.01, 1e-5)), Fusion(gate_deg=10)))
        z.append((moments.mean[0, 2] - q[0]) / moments.cov[0, 5].sqrt())
    z = torch.stack(z)
    assert 0.8 < z.square().mean() < 1.2 and z.mean().abs() < 0.25


def test_what_a_nearer_surface_hides_is_left_out_whatever_comes_first():
    direction = around(AHEAD[0], 0.002, 60, 0)
    near = torch.arange(60) % 3 == 0
    noise = 0.01 * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    both = nearnesses(torch.where(near, 1.5, 0.3) + noise, 0.01)

    def rho(*masks):
        fusion = Fusion(gate_deg=5)
        memory = empty_memory(AHEAD, Prior())
        for mask in masks:
            seen = observed_at(direction, both)._replace(valid=mask)
            memory = remember(memory, seen, fusion)
        return belief(memory).mean[0, 2].item()

    every = torch.ones_like(near)
    assert rho(every) == pytest.approx(1.5, abs=0.02)
    # the memory gives way to a majority of looks, whichever is nearer
    assert rho(~near, near) == pytest.approx(0.3, abs=0.02)
    assert rho(~near, near, near) == pytest.approx(1.5, abs=0.02)
    assert rho(near, ~near) == pytest.approx(1.5, abs=0.02)
    assert rho(near, ~near, ~near) == pytest.approx(0.3, abs=0.02)
    # however long it believed the other
    assert rho(*[near] * 50, *[~near] * 5) == pytest.approx(0.3, abs=0.02)
    unheeded = enter(AHEAD, observed_at(direction, both), Fusion(gate_deg=5, conflict=math.inf))
    assert 0.4 < belief(unheeded).mean[0, 2].item() < 1.2


def test_z_buffer_against_a_loop():
    rng = torch.Generator().manual_seed(0)
    rho, std = torch.rand(200, generator=rng), 0.05 * torch.rand(200, generator=rng)
    cell = torch.randint(0, 10, (200,), generator=rng)
    kept = in_front(rho, std, cell, 10, 3.0)
    for k in range(200):
        rivals = cell == cell[k]
        assert bool(kept[k]) == bool((rho[k] + 3 * std[k] >= (rho - 3 * std)[rivals]).all())


def gate_case():
    cells = torch.tensor([[1.0, 0, 0], [1, 0.03, 0], [1, 0, 0.2], [0, 1, 0]], dtype=torch.float64)
    cells = torch.nn.functional.normalize(cells, dim=-1)
    direction = torch.tensor([[1.0, 0.001, 0], [1, 0, 0.14], [-1, 0, 0]], dtype=torch.float64)
    rho = torch.full((3,), 0.5, dtype=torch.float64)
    return cells, torch.nn.functional.normalize(direction, dim=-1), nearnesses(rho, 0.01, 0.01)


def test_gate_and_fill():
    cells, direction, gaussian = gate_case()
    spacing = torch.full((4,), 0.01, dtype=torch.float64)

    def looks(support, valid=True, **options):
        seen = observed_at(direction, gaussian, support)
        seen = seen._replace(valid=seen.valid & valid)
        memory = empty_memory(cells, Prior())._replace(spacing_rad=spacing)
        after = remember(memory, seen, Fusion(**options))
        if not valid:
            assert torch.equal(after.information.matrix, memory.information.matrix)
        return after.looks.tolist()

    assert looks(0.001, gate_deg=1.2) == [1, 0, 0, 0]  # 3.4 degrees off is out of a gate of 1.2
    assert looks(0.1, gate_deg=1.2) == [1, 1, 1, 0]  # a receptive field of 0.1 rad covers its neighbour too
    assert looks(0.1, gate_deg=1.2, fill=False) == [1, 0, 1, 0]
    assert looks(0.1, valid=False) == [0, 0, 0, 0]


def test_pairs_count_through_the_batches():
    cells, direction, gaussian = gate_case()
    two = stack([observed_at(direction, gaussian, 0.1)] * 2)
    both = torch.stack([cells, cells.roll(1, 0)])
    spacing = torch.full((2, 4), 0.01, dtype=torch.float64)
    pairs = associate(both, build_index(both), spacing, two, 0.02, 2.0, True)
    got = sorted(zip(pairs.observation.tolist(), pairs.cell.tolist(), strict=True))
    assert got == [(0, 0), (0, 1), (1, 2), (3, 5), (3, 6), (4, 7)]


@pytest.mark.parametrize("name", ["inverse_range", "aligned", "printed"])
@pytest.mark.parametrize("fault", ["nan_mean", "inf_cov", "indefinite", "nan_direction", "long_direction", "none"])
def test_bad_observations_are_left_out(name, fault):
    cells, direction, gaussian = gate_case()
    seen = observed_at(direction, gaussian, 0.1)
    mean, cov, bad = seen.mean.clone(), seen.cov.clone(), direction.clone()
    if fault == "nan_mean":
        mean[1, 2] = torch.nan
    elif fault == "inf_cov":
        cov[1] = torch.inf
    elif fault == "indefinite":
        cov[1, 1] = 1.0
    elif fault == "nan_direction":
        bad[1] = torch.nan
    elif fault == "long_direction":
        bad[1] *= 2
    fusion = Fusion(name, gate_deg=1.2)
    got = enter(cells, seen._replace(mean=mean, cov=cov, direction=bad), fusion)
    valid = torch.tensor([True, fault == "none", True])
    want = enter(cells, seen._replace(valid=valid), fusion)
    assert bool(torch.isfinite(got.information.matrix).all())
    torch.testing.assert_close(got.information.matrix, want.information.matrix)
    torch.testing.assert_close(got.information.vector, want.information.vector)


def test_no_observations_at_all():
    cells = fibonacci_directions(10)
    none = Observations(
        torch.zeros(0, 3), torch.zeros(0, 6), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, dtype=bool)
    )
    assert enter(cells, none, Fusion()).looks.sum() == 0


def test_a_million_fusions_in_float32_stay_positive_and_near_float64():
    found = gaussians(1000, 4)
    direction = around(AHEAD[0], 0.003, 1000, 0)
    row = torch.stack([(direction * axis).sum(-1) for axis in (*basis(AHEAD), AHEAD)], -1)
    cell, ones = torch.zeros(1000, dtype=torch.long), torch.ones(1000, dtype=torch.float64)
    results = {"cartesian": [], "inverse_range": []}
    for dtype in (torch.float32, torch.float64):
        x, ahead = ones.to(dtype), AHEAD.to(dtype)
        pooled = {
            "cartesian": pool(Gaussian(*(part.to(dtype) for part in found)), cell, (1,)),
            "inverse_range": pool_patches(0.7 * x, 1e-3 * x, 1e4 * x, row.to(dtype), x, cell, (1,)),
        }
        for chart, got in results.items():
            memory = empty_memory(ahead, Prior(), chart)
            for _ in range(1000):
                memory = fuse(memory, pooled[chart])
            got.append(belief(memory))
    for small, exact in results.values():
        assert bool(positive_definite(small.cov).all())
        scale = exact.cov[0, [0, 3, 5]].sqrt()
        unit = torch.stack([scale[i] * scale[j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])
        torch.testing.assert_close(small.cov.double() / unit, exact.cov / unit, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(small.mean.double(), exact.mean, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_forgetting_halves_what_was_learned(chart):
    fusion = Fusion("inverse_range" if chart == "inverse_range" else "aligned", half_life=3.0)
    direction = around(AHEAD[0], 0.002, 20, 0)
    gaussian = nearnesses(torch.full((20,), 0.8, dtype=torch.float64), 0.05, 0.01)
    if chart == "cartesian":
        gaussian = cartesian_from_inverse_range(gaussian, direction)
    seen, prior = observed_at(direction, gaussian, chart=chart), Prior(0.5, 0.5)
    memory, empty = enter(AHEAD, seen, fusion, prior), empty_memory(AHEAD, prior, chart)
    nothing = seen._replace(valid=torch.zeros(20, dtype=torch.bool))
    later = memory
    for _ in range(3):
        later = remember(later, nothing, fusion)
    for now, then, first in zip(later.information, memory.information, empty.information, strict=True):
        torch.testing.assert_close(now - first, 0.5 * (then - first))
    torch.testing.assert_close(later.bearing - empty.bearing, 0.5 * (memory.bearing - empty.bearing))
    gone = forget(memory, 0.0)
    torch.testing.assert_close(gone.information.matrix, empty.information.matrix)


def test_gradients():
    cells = fibonacci_directions(3, torch.float64)
    cell = torch.tensor([0, 0, 2])
    found = gaussians(3, 0)

    def through_points(mean, cov, common):
        pooled = add_common(pool(Gaussian(mean, cov), cell, (3,)), common, "cartesian")
        return tuple(belief(fuse(empty_memory(cells, Prior(), "cartesian"), pooled)))

    common = pack(0.01 * torch.eye(3, dtype=torch.float64)).expand(3, 6)
    leaves = [x.clone().contiguous().requires_grad_() for x in (*found, common)]
    assert torch.autograd.gradcheck(through_points, leaves)

    row = torch.nn.functional.normalize(found.mean, dim=-1)
    ones = torch.ones(3, dtype=torch.float64)

    def through_patches(rho, variance, bearing, row, common):
        pooled = add_common(pool_patches(rho, variance, bearing, row, ones, cell, (3,)), common, "inverse_range", 1.0)
        memory = fuse(empty_memory(cells, Prior()), pooled)
        return (*belief(memory), *cartesian_belief(memory))

    leaves = [x.clone().contiguous().requires_grad_() for x in (0.7 * ones, 0.1 * ones, 50 * ones, row, common)]
    assert torch.autograd.gradcheck(through_patches, leaves)


@pytest.mark.parametrize("fusion", [Fusion(gate_deg=10), Fusion("aligned", gate_deg=10)])
def test_gradients_of_a_whole_saccade(fusion):
    direction = around(AHEAD[0], 0.01, 5, 0)
    gaussian = nearnesses(torch.linspace(0.6, 0.7, 5, dtype=torch.float64), 0.1, 0.02)
    if fusion.chart == "cartesian":
        gaussian = cartesian_from_inverse_range(gaussian, direction)

    def through(mean, cov):
        seen = observed_at(direction, Gaussian(mean, cov), chart=fusion.chart)
        memory = empty_memory(AHEAD, Prior(), fusion.chart)
        return tuple(belief(remember(memory, seen, fusion)))

    leaves = [x.clone().contiguous().requires_grad_() for x in gaussian]
    assert torch.autograd.gradcheck(through, leaves)


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_an_empty_memory_believes_the_prior(chart, dtype):
    cells = fibonacci_directions(10, dtype)
    memory = empty_memory(cells, Prior(0.5, 0.2, 0.1), chart)
    moments, points = belief(memory), cartesian_belief(memory)
    assert moments.mean.dtype == points.cov.dtype == dtype
    torch.testing.assert_close(moments.cov[:, 5], torch.full((10,), 0.04, dtype=dtype))
    torch.testing.assert_close(inverse3(memory.information.matrix).to(dtype), moments.cov)
    if chart == "cartesian":
        torch.testing.assert_close(moments.mean, 0.5 * cells)
        return
    torch.testing.assert_close(moments.mean[:, 2], torch.full((10,), 0.5, dtype=dtype))
    variance = torch.tensor([0.01, 0.01, 0.04], dtype=dtype)
    plain = Gaussian(moments.mean * torch.tensor([0.0, 0, 1], dtype=dtype), pack(torch.diag(variance)).expand(10, 6))
    for got, want in zip(points, cartesian_from_inverse_range(plain, cells), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5)


def test_a_million_cells(generator):
    cells = torch.nn.functional.normalize(torch.randn(1_000_000, 3, generator=generator), dim=-1)
    information, bearing = prior_information(cells, Prior())
    zero = torch.zeros(1_000_000)
    known = {"information": information, "bearing": bearing, "looks": zero, "lasting": columns(zero, zero)}
    memory = empty_memory(cells[:1], Prior())._replace(cells=cells, **known)  # fusing asks no index
    ones, cell = torch.ones(5000), torch.arange(5000) * 199
    row = torch.tensor([0.0, 0, 1]).expand(5000, 3)
    after = fuse(memory, pool_patches(0.5 * ones, 1e-4 * ones, 1e4 * ones, row, ones, cell, (1_000_000,)))
    assert int(after.looks.sum()) == 5000
    torch.testing.assert_close(belief(after).mean[cell, 2], torch.full((5000,), 0.5), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Fusion("average"), "fusion.name = average: expected one of"),
        (lambda: Fusion(gate_deg=-1), "fusion.gate_deg = -1"),
        (lambda: Fusion(conflict=0), "fusion.conflict = 0"),
        (lambda: Fusion(window=0.5), "fusion.window = 0.5"),
        (lambda: Fusion(nearest_m=0), "fusion.nearest_m = 0"),
        (lambda: Fusion(half_life=0), "fusion.half_life = 0"),
        (lambda: Prior(std=0), "prior.std = 0"),
        (lambda: Prior(mean=math.inf), "prior.mean = inf"),
        (lambda: Prior(slope_std=-1), "prior.slope_std = -1"),
        (lambda: empty_memory(torch.zeros(0, 3), Prior()), "memory.cells = 0"),
        (lambda: empty_memory(torch.ones(2, 3), Prior()), "finite unit vectors"),
        (lambda: empty_memory(torch.full((2, 3), torch.nan), Prior()), "finite unit vectors"),
        (lambda: empty_memory(torch.ones(2, 2), Prior()), "cells = \\(2, 2\\)"),
        (lambda: forget(empty_memory(AHEAD, Prior()), 1.5), "keep = 1.5"),
    ],
)
def test_errors_name_the_setting(call, message):
    with pytest.raises(SettingError, match=message):
        call()


@pytest.mark.parametrize("fusion", ["inverse_range", "aligned"])
def test_a_memory_keeps_its_dtype(fusion):
    cells = fibonacci_directions(40).float()
    how = Fusion(name=fusion)
    seen = observed_at(fibonacci_directions(40), gaussians(40, 0), chart=how.chart)
    memory = empty_memory(cells, Prior(), how.chart)
    common = torch.full((40, 6), 1e-6, dtype=torch.float64)
    numbers = ("mean", "cov", "direction", "support_rad", "inlier")
    rough = seen._replace(**{name: getattr(seen, name).float() for name in numbers})
    double = remember(memory, seen, how, common)
    single = remember(memory, rough, how, common.float())
    for a, b in zip(double.information, single.information, strict=True):
        assert a.dtype == torch.float64
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    kept = (double.bearing, double.looks, double.lasting, double.votes, belief(double).cov)
    assert {part.dtype for part in kept} == {torch.float32}


def test_priors_and_charts_that_float32_cannot_hold_are_named():
    for name in ("mean", "std", "bearing_std", "slope_std"):
        for value in (1e20, 1e-20, 0.0, math.nan, math.inf):
            with pytest.raises(SettingError, match=f"prior.{name}"):
                Prior(**{name: value})
    cells = fibonacci_directions(20).float()
    for size in (1e-9, 1e9):
        prior = Prior(std=size, bearing_std=size, slope_std=size)
        for chart in ("inverse_range", "cartesian"):
            moments = belief(empty_memory(cells, prior, chart))
            assert all(bool(part.isfinite().all()) for part in moments)
    with pytest.raises(SettingError, match="chart = polar"):
        empty_memory(cells, Prior(), "polar")
    with pytest.raises(SettingError, match=r"fusion.fill = no"):
        Fusion(fill="no")
