"""The memory: Eq. 34-35 against filterpy, laws of pooling, and what each fusion does to the range."""

import math

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.chart import cartesian_from_inverse_range
from torchfovea.egosphere import Fusion, Prior, belief, cartesian_belief, fuse, new_egosphere, pool, remember
from torchfovea.gaussian import Gaussian, columns, inverse3, pack, positive_definite, unpack
from torchfovea.nearest import build_index, neighbour_spacing_rad
from torchfovea.setting import SettingError
from torchfovea.sphere import fibonacci_directions
from torchfovea.triangulation import Observations


def gaussians(count: int, seed: int, dtype=torch.float64) -> Gaussian:
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(count, 3, 3, generator=rng, dtype=torch.float64) * 0.2
    mean = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return Gaussian(mean.to(dtype), pack(root @ root.mT + 0.01 * torch.eye(3, dtype=torch.float64)).to(dtype))


def observed_at(direction: torch.Tensor, gaussian: Gaussian, support: float = 0.01) -> Observations:
    count = direction.shape[:-1]
    return Observations(
        gaussian.mean,
        gaussian.cov,
        direction,
        torch.full(count, support, dtype=direction.dtype),
        torch.ones(count, dtype=torch.bool),
    )


def around(cell: torch.Tensor, angle: float, count: int, seed: int) -> torch.Tensor:
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=cell.dtype)
    return torch.nn.functional.normalize(cell + angle * noise, dim=-1)


@given(seed=st.integers(0, 1000))
def test_pool_and_fuse_are_a_kalman_filter_one_observation_at_a_time(seed):
    cells = fibonacci_directions(4, torch.float64)
    prior = Prior(mean=2.0, std=3.0)
    memory = new_egosphere(cells, prior, "cartesian")
    found = gaussians(12, seed)
    cell = torch.randint(0, 3, (12,), generator=torch.Generator().manual_seed(seed))
    valid = torch.arange(12) != 5
    after = fuse(memory, *pool(found, cell, valid, 4))
    got = belief(after)
    for i in range(4):
        peer = KalmanFilter(3, 3)
        peer.F = peer.H = np.eye(3)
        peer.x, peer.P = 2.0 * cells[i].numpy()[:, None], 9.0 * np.eye(3)
        for k in range(12):
            if cell[k] == i and valid[k]:
                peer.update(found.mean[k].numpy()[:, None], R=unpack(found.cov[k]).numpy())
        np.testing.assert_allclose(got.mean[i], peer.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(unpack(got.cov[i]), peer.P, atol=1e-9)
    assert after.looks.tolist() == [float(bool(((cell == i) & valid).any())) for i in range(4)]


def test_order_does_not_matter_and_unseen_cells_stay():
    found, cell, valid = gaussians(50, 1), torch.arange(50) % 7, torch.ones(50, dtype=torch.bool)
    turned = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    one = pool(found, cell, valid, 9)
    two = pool(Gaussian(found.mean[turned], found.cov[turned]), cell[turned], valid, 9)
    torch.testing.assert_close(one[0].matrix, two[0].matrix)
    memory = new_egosphere(fibonacci_directions(9, torch.float64), Prior(), "cartesian")
    after = fuse(memory, *one)
    assert torch.equal(after.information.matrix[7:], memory.information.matrix[7:])


def test_common_covariance_is_a_floor_that_no_averaging_removes():
    """1,000 observations that share an error of 1 cm stay 1 cm uncertain; without the term they claim 0.3 mm."""
    cells = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    memory = new_egosphere(cells, Prior(mean=2.0, std=100.0), "cartesian")
    single = pack(1e-4 * torch.eye(3, dtype=torch.float64))
    found = Gaussian(torch.tensor([[2.0, 0, 0]], dtype=torch.float64).expand(1000, 3), single.expand(1000, 6))
    pooled = pool(found, torch.zeros(1000, dtype=torch.long), torch.ones(1000, dtype=torch.bool), 1)
    with_common = belief(fuse(memory, *pooled, common=single[None]))
    without = belief(fuse(memory, *pooled))
    assert with_common.cov[0, 0].sqrt().item() == pytest.approx(0.01, rel=0.01)
    assert without.cov[0, 0].sqrt().item() == pytest.approx(0.01 / math.sqrt(1000), rel=0.01)


def test_batches_of_memories_are_loops():
    cells = torch.stack([fibonacci_directions(20, torch.float64), -fibonacci_directions(20, torch.float64)])
    direction = torch.stack([around(cells[b, 3], 0.05, 30, b) for b in range(2)])
    rho = 0.5 + torch.rand(2, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    zero = torch.zeros_like(rho)
    cov = pack(torch.diag(torch.tensor([1e-4, 1e-4, 1e-3], dtype=torch.float64))).expand(2, 30, 6)
    seen = observed_at(direction, Gaussian(columns(zero, zero, rho), cov))
    fusion = Fusion(fill=False)
    whole = remember(new_egosphere(cells, Prior()), build_index(cells), neighbour_spacing_rad(cells), seen, fusion)
    for b in range(2):
        part = Observations(*(x[b] for x in seen))
        one = remember(
            new_egosphere(cells[b], Prior()), build_index(cells[b]), neighbour_spacing_rad(cells[b]), part, fusion
        )
        torch.testing.assert_close(whole.information.matrix[b], one.information.matrix)
        torch.testing.assert_close(whole.information.vector[b], one.information.vector)


@pytest.mark.parametrize(
    ("name", "low", "high"), [("inverse_range", 0.99, 1.01), ("aligned", 0.9, 1.1), ("printed", 0.0, 0.6)]
)
def test_rays_of_one_cell_do_not_pull_it_to_the_eye_unless_printed(name, low, high):
    """A sphere of 2 m around the observer: 400 thin long Gaussians on different rays of one cell."""
    cell = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    direction = around(cell[0], 0.03, 400, 0)
    zero = torch.zeros(400, dtype=torch.float64)
    noise = torch.randn(400, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    fine = torch.full_like(zero, 1e-6)
    inverse = Gaussian(
        columns(zero, zero, 0.5 + 0.05 * noise), columns(fine, zero, zero, fine, zero, torch.full_like(zero, 0.05**2))
    )
    fusion = Fusion(name, slant=0.0, fill=False, gate_deg=10)
    chart = fusion.chart
    gaussian = inverse if chart == "inverse_range" else cartesian_from_inverse_range(inverse, direction)
    prior = Prior(0.3, 1.0) if chart == "inverse_range" else Prior(1000.0, 1000.0)
    memory = remember(
        new_egosphere(cell, prior, chart),
        build_index(cell),
        neighbour_spacing_rad(cell),
        observed_at(direction, gaussian),
        fusion,
    )
    ratio = cartesian_belief(memory, chart).mean.norm().item() / 2
    assert low < ratio < high, ratio


def test_a_patch_is_less_certain_than_a_point():
    cell = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    direction = around(cell[0], 0.02, 50, 0)
    zero = torch.zeros(50, dtype=torch.float64)
    small = torch.full_like(zero, 1e-8)
    seen = observed_at(
        direction, Gaussian(columns(zero, zero, zero + 0.5), columns(small, zero, zero, small, zero, small))
    )
    index, spacing = build_index(cell), neighbour_spacing_rad(cell)
    std = [
        belief(remember(new_egosphere(cell, Prior()), index, spacing, seen, Fusion(slant=s, gate_deg=10)))
        .cov[0, 5]
        .sqrt()
        .item()
        for s in (0, 1)
    ]
    assert std[0] == pytest.approx(1e-4 / math.sqrt(50), rel=1e-2) and std[1] > 2 * std[0]


def test_gate_and_fill():
    cells = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0, 0], [1, 0.03, 0], [1, 0, 0.2], [0, 1, 0]], dtype=torch.float64), dim=-1
    )
    index, spacing = build_index(cells), torch.full((4,), 0.01, dtype=torch.float64)
    direction = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.001, 0], [1, 0, 0.14], [-1, 0, 0]], dtype=torch.float64), dim=-1
    )
    zero = torch.zeros(3, dtype=torch.float64)
    small = torch.full_like(zero, 1e-4)
    gaussian = Gaussian(columns(zero, zero, zero + 0.5), columns(small, zero, zero, small, zero, small))
    narrow = remember(
        new_egosphere(cells, Prior()), index, spacing, observed_at(direction, gaussian, 0.001), Fusion(gate_deg=1.2)
    )
    assert narrow.looks.tolist() == [1, 0, 0, 0]  # 3.4 degrees off is out of a gate of 1.2
    wide = remember(
        new_egosphere(cells, Prior()), index, spacing, observed_at(direction, gaussian, 0.1), Fusion(gate_deg=1.2)
    )
    assert wide.looks.tolist() == [1, 1, 1, 0]  # a receptive field of 0.1 rad covers its neighbour too
    unfilled = remember(
        new_egosphere(cells, Prior()),
        index,
        spacing,
        observed_at(direction, gaussian, 0.1),
        Fusion(gate_deg=1.2, fill=False),
    )
    assert unfilled.looks.tolist() == [1, 0, 1, 0]
    none = remember(
        new_egosphere(cells, Prior()),
        index,
        spacing,
        observed_at(direction, gaussian)._replace(valid=torch.zeros(3, dtype=torch.bool)),
        Fusion(),
    )
    assert none.looks.sum() == 0 and torch.equal(
        none.information.matrix, new_egosphere(cells, Prior()).information.matrix
    )


def test_a_million_fusions_in_float32_stay_positive_and_near_float64():
    found = gaussians(1000, 4)
    cell, valid = torch.zeros(1000, dtype=torch.long), torch.ones(1000, dtype=torch.bool)
    results = []
    for dtype in (torch.float32, torch.float64):
        memory = new_egosphere(torch.tensor([[1.0, 0, 0]], dtype=dtype), Prior(), "cartesian")
        pooled, count = pool(Gaussian(found.mean.to(dtype), found.cov.to(dtype)), cell, valid, 1)
        for _ in range(1000):
            memory = fuse(memory, pooled, count)
        results.append(belief(memory))
    assert bool(positive_definite(results[0].cov).all())
    scale = results[1].cov[0, [0, 3, 5]].sqrt().max()
    torch.testing.assert_close(results[0].cov.double(), results[1].cov, rtol=1e-3, atol=float(1e-3 * scale**2))
    torch.testing.assert_close(results[0].mean.double(), results[1].mean, rtol=1e-3, atol=1e-3)


def test_gradients():
    cells = fibonacci_directions(3, torch.float64)
    memory = new_egosphere(cells, Prior(), "cartesian")
    cell, valid = torch.tensor([0, 0, 2, 1]), torch.tensor([True, True, True, False])
    found = gaussians(4, 0)

    def through(mean, cov, common):
        return tuple(belief(fuse(memory, *pool(Gaussian(mean, cov), cell, valid, 3), common)))

    common = pack(0.01 * torch.eye(3, dtype=torch.float64)).expand(3, 6)
    assert torch.autograd.gradcheck(through, tuple(x.clone().contiguous().requires_grad_() for x in (*found, common)))


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_an_empty_memory_believes_the_prior(chart, dtype):
    cells = fibonacci_directions(10, dtype)
    memory = new_egosphere(cells, Prior(0.5, 0.2), chart)
    moments = belief(memory)
    assert moments.mean.dtype == dtype
    if chart == "cartesian":
        torch.testing.assert_close(moments.mean, 0.5 * cells)
    else:
        torch.testing.assert_close(moments.mean[:, 2], torch.full((10,), 0.5, dtype=dtype))
    torch.testing.assert_close(moments.cov[:, 5], torch.full((10,), 0.04, dtype=dtype))
    torch.testing.assert_close(inverse3(memory.information.matrix), moments.cov)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Fusion("average"), "fusion = average: expected one of"),
        (lambda: Fusion(gate_deg=-1), "fusion.gate_deg = -1"),
        (lambda: Prior(std=0), "prior.std = 0"),
        (lambda: new_egosphere(torch.zeros(0, 3), Prior()), "memory.cells = 0"),
        (lambda: new_egosphere(torch.ones(2, 3), Prior()), "finite unit vectors"),
        (lambda: new_egosphere(torch.full((2, 3), torch.nan), Prior()), "finite unit vectors"),
        (lambda: new_egosphere(torch.ones(2, 2), Prior()), "cells = \\(2, 2\\)"),
    ],
)
def test_errors_name_the_setting(call, message):
    with pytest.raises(SettingError, match=message):
        call()
