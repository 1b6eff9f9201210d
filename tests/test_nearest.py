import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from torchfovea.memory.nearest import (
    _by_all_pairs,
    _by_tree,
    build_index,
    join_indices,
    nearest_cell,
    nearest_observation,
    neighbour_spacing_rad,
)
from torchfovea.memory.sphere import (
    direction_mixture,
    fibonacci_directions,
    geodesic_directions,
    latitude_longitude_directions,
    sample,
    truncated_icosahedron_directions,
)
from torchfovea.setting import SettingError

F64 = torch.float64
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def unit(v: torch.Tensor) -> torch.Tensor:
    return v / v.norm(dim=-1, keepdim=True)


def random_directions(n: int, seed: int, dtype: torch.dtype = F64) -> torch.Tensor:
    return unit(torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)).to(dtype)


def cluster(n: int, seed: int, spread: float) -> torch.Tensor:
    return unit(torch.tensor([0.61, 0.67, -0.43], dtype=F64) + spread * random_directions(n, seed))


def circle(n: int) -> torch.Tensor:
    angle = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    return torch.stack((angle.cos(), angle.sin(), torch.zeros(n, dtype=F64)), -1)


def octants() -> torch.Tensor:
    signs = torch.tensor([-1.0, 1.0], dtype=F64)
    return unit(torch.cartesian_prod(signs, signs, signs))


SETS = {
    "random": random_directions(2000, 0),
    "target": sample(direction_mixture([1.0], [[0.61, 0.67, -0.43]], [[0.05] * 3], dtype=F64), 2000, 0),
    "cap": sample(direction_mixture([1.0], [[0.0] * 3], [[1.0] * 3], dtype=F64), 2000, 0, lambda u: u[:, 0] > 0.8),
    "two clusters": torch.cat((cluster(500, 1, 1e-3), -cluster(500, 2, 1e-2))),
    "tight cluster": cluster(500, 3, 1e-5),
    "tightest cluster": cluster(200, 3, 1e-9),
    "latitude longitude": latitude_longitude_directions(1000, dtype=F64),
    "geodesic": geodesic_directions(1000, dtype=F64),
    "truncated icosahedron": truncated_icosahedron_directions(1000, dtype=F64),
    "fibonacci": fibonacci_directions(1000, dtype=F64),
    "corners and axes of the cube": torch.cat((octants(), torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64))),
    "circle": circle(500),
    "duplicates": random_directions(5, 4).repeat(100, 1),
    "one": random_directions(1, 5),
    "two": torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=F64),
    "three": random_directions(3, 6),
}


def queries(cells: torch.Tensor, seed: int) -> torch.Tensor:
    """Directions everywhere, around cells, half-way between cells, and on the seams of the cube."""
    g = torch.Generator().manual_seed(seed)
    some = cells[torch.randint(len(cells), (400,), generator=g)]
    others = cells[torch.randint(len(cells), (400,), generator=g)]
    near = [some + 10.0**-k * random_directions(400, seed + k) for k in (1, 2, 3, 5, 8)]
    between = some + others + 1e-12 * random_directions(400, seed + 9)
    seams = torch.cat((octants(), circle(8), circle(8)[:, [1, 2, 0]], circle(8)[:, [2, 0, 1]]))
    return torch.cat((random_directions(2000, seed), *near, between, some, seams))


def excess(cells: torch.Tensor, directions: torch.Tensor, cell: torch.Tensor) -> float:
    """By how much the best cosine of all exceeds that of the returned cell, in float64."""
    cosine = unit(directions.double()) @ unit(cells.double()).T
    return float((cosine.amax(-1) - cosine.gather(-1, cell[..., None]).squeeze(-1)).max())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("name", SETS)
def test_the_nearest_cell_is_never_wrong(name, dtype, device):
    cells = SETS[name].to(device, dtype)
    directions = queries(SETS[name], 7).to(device, dtype)
    cell, cosine = nearest_cell(build_index(cells), directions)
    assert cell.dtype == torch.int64 and cosine.dtype == dtype and cell.shape == cosine.shape == directions.shape[:-1]
    eps = torch.finfo(dtype).eps
    assert excess(cells, directions, cell) <= 4 * eps
    truth = (unit(directions.double()) * unit(cells.double())[cell]).sum(-1)
    assert float((cosine.double() - truth).abs().max()) <= 8 * eps


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 100_000),
    st.integers(1, 400),
    st.sampled_from(["random", "cluster", "lattice", "circle", "mixed"]),
    st.floats(-7, 0),
)
def test_the_nearest_cell_is_never_wrong_for_any_set(seed, n, kind, log_spread):
    g = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=F64))[0]
    cells = {
        "random": lambda: random_directions(n, seed),
        "cluster": lambda: cluster(n, seed, 10**log_spread),
        "lattice": lambda: latitude_longitude_directions(n, dtype=F64),
        "circle": lambda: circle(n),
        "mixed": lambda: torch.cat((random_directions(n, seed), cluster(n, seed, 10**log_spread), circle(n))),
    }[kind]()
    cells = cells @ rotation if seed % 2 else cells
    directions = torch.cat(
        (random_directions(300, seed + 1), cells[:50] + 10**log_spread * random_directions(50, 1)[: len(cells)])
    )
    cell, _ = nearest_cell(build_index(cells), directions)
    assert excess(cells, directions, cell) <= 1e-15


def test_float32_separates_cells_closer_than_its_cosines_can():
    # cosines of directions 1e-4 apart differ by 5e-9 from 1, which float32 cannot tell; differences of cells can
    cells = cluster(500, 3, 1e-4).float()
    directions = unit(cells.double() + 1e-6 * random_directions(500, 4)).float()
    cell, _ = nearest_cell(build_index(cells), directions)
    exact = cKDTree(unit(cells.double()).numpy()).query(unit(directions.double()).numpy())[0]
    mine = (unit(directions.double()) - unit(cells.double())[cell]).norm(dim=-1).numpy()
    assert (mine - exact).max() < 3e-6


def test_the_size_of_the_paper_agrees_with_a_kd_tree():
    cells = random_directions(20_000, 0, torch.float32)
    directions = random_directions(31_416, 1, torch.float32)
    cell, _ = nearest_cell(build_index(cells), directions)
    distance, _ = cKDTree(unit(cells.double()).numpy()).query(unit(directions.double()).numpy())
    mine = (unit(directions.double()) - unit(cells.double())[cell]).norm(dim=-1).numpy()
    assert (mine - distance).max() < 1e-7


@pytest.mark.slow
def test_a_million_cells():
    cells = random_directions(1_000_000, 0, torch.float32)
    directions = random_directions(20_000, 1, torch.float32)
    cell, _ = nearest_cell(build_index(cells), directions)
    distance, _ = cKDTree(unit(cells.double()).numpy()).query(unit(directions.double()).numpy())
    mine = (unit(directions.double()) - unit(cells.double())[cell]).norm(dim=-1).numpy()
    assert (mine - distance).max() < 1e-7


def test_a_batch_is_a_loop():
    cells = torch.stack((SETS["random"], SETS["target"], SETS["cap"]))
    directions = random_directions(3 * 2 * 100, 3).reshape(3, 2, 100, 3)
    cell, cosine = nearest_cell(build_index(cells), directions)
    assert cell.shape == (3, 2, 100)
    for i in range(3):
        one, cosine_of_one = nearest_cell(build_index(cells[i]), directions[i])
        assert torch.equal(cell[i], one) and torch.equal(cosine[i], cosine_of_one)
    single = build_index(cells[:1])
    assert torch.equal(nearest_cell(single, directions[:1])[0], cell[:1])


def test_many_sets_are_built_together():
    # more sets than the roots of a build take at a time
    cells = random_directions(40 * 3000, 0).reshape(40, 3000, 3)
    directions = random_directions(40 * 20, 1).reshape(40, 20, 3)
    cell, _ = nearest_cell(build_index(cells), directions)
    assert torch.equal(cell, torch.einsum("bnx,bkx->bnk", directions, cells).argmax(-1))


def test_indices_joined_find_what_one_built_together_finds():
    sets = torch.stack([SETS[name][:200] for name in ("random", "tight cluster", "latitude longitude")])
    joined, together = join_indices([build_index(cells) for cells in sets]), build_index(sets)
    directions = random_directions(3000, 5).view(3, 1000, 3)
    for a, b in zip(nearest_cell(joined, directions), nearest_cell(together, directions), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(SettingError, match="indices"):
        join_indices([build_index(sets[0]), build_index(sets[1, :9])])


def test_any_shape_and_length():
    index = build_index(7.0 * SETS["random"])
    directions = random_directions(24, 2)
    flat, cosine = nearest_cell(index, directions)
    shaped, _ = nearest_cell(index, directions.reshape(2, 3, 4, 3))
    assert torch.equal(shaped, flat.reshape(2, 3, 4))
    for scale in (1e-200, 1e200):
        cell, scaled = nearest_cell(index, scale * directions)
        assert torch.equal(cell, flat)
        torch.testing.assert_close(scaled, cosine)
    assert nearest_cell(index, directions[0])[0].shape == ()
    assert nearest_cell(index, directions[:0])[0].shape == (0,)
    columns = directions.T.contiguous().T
    assert torch.equal(nearest_cell(index, columns)[0], flat)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_invalid_directions_pass_no_gate(dtype):
    index = build_index(SETS["random"].to(dtype))
    nan, inf = math.nan, math.inf
    bad = torch.tensor(
        [[0.0, 0.0, 0.0], [nan, 1.0, 0.0], [nan, nan, nan], [inf, 0.0, 1.0], [0.0, -inf, nan]], dtype=dtype
    )
    cell, cosine = nearest_cell(index, torch.cat((bad, SETS["random"][:3].to(dtype))))
    assert cell[:5].tolist() == [0] * 5 and cosine[:5].tolist() == [-1.0] * 5
    assert cell[5:].tolist() == [0, 1, 2]
    batch = build_index(SETS["random"].to(dtype)[None])
    assert nearest_cell(batch, bad[None])[0].tolist() == [[0] * 5]


# ---------------------------------------------------------------- nearest observation


def check_observations(directions, cells, gate, wanted=None):
    number, cosine = nearest_observation(directions, cells, gate, wanted)
    chord = torch.from_numpy(cKDTree(directions.double().numpy()).query(cells.double().numpy())[0])
    angle = 2 * torch.asin(chord / 2)
    mine = (directions.double()[number] - cells.double()).norm(dim=-1)
    gates = torch.as_tensor(gate, dtype=F64).broadcast_to(angle.shape)
    tolerance = 1e-6 if directions.dtype == torch.float32 else 1e-12
    found = cosine > -1
    looks = torch.ones_like(found) if wanted is None else wanted
    assert bool((found == (looks & (angle <= gates)))[(angle - gates).abs() > tolerance].all())
    assert float((mine - chord)[found].max()) < tolerance if bool(found.any()) else True
    torch.testing.assert_close(cosine[found].double(), angle[found].cos(), atol=tolerance, rtol=0)
    assert bool((number[~found] == 0).all()) and bool((cosine[~found] == -1).all())
    return found


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("gate", [0.001, 0.014, 0.09, 0.5, math.pi])
@pytest.mark.parametrize("spread", [None, 0.3, 1e-3])
def test_nearest_observation_agrees_with_a_kd_tree(dtype, gate, spread):
    directions = random_directions(1500, 0) if spread is None else cluster(1500, 0, spread)
    cells = torch.cat((random_directions(800, 1), cluster(200, 2, spread or 0.1), octants(), circle(8)))
    check_observations(unit(directions).to(dtype), cells.to(dtype), gate)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 100_000), st.integers(1, 300), st.floats(-2.5, 0.4), st.floats(-4, 0))
def test_nearest_observation_with_gates_of_many_sizes(seed, n, log_gate, log_spread):
    g = torch.Generator().manual_seed(seed)
    directions = cluster(n, seed, 10**log_spread)
    cells = torch.cat((random_directions(100, seed + 1), cluster(100, seed + 2, 10**log_spread)))
    gates = 10 ** (log_gate + torch.rand(200, generator=g, dtype=F64) - 0.5)
    check_observations(directions, cells, gates, torch.rand(200, generator=g) < 0.7)


def test_a_retina_before_a_memory():
    # log-polar: dense where the cells have their observations, sparse where they look for them
    ring = 100 ** ((torch.arange(76, dtype=F64) + 0.5) / 76)
    angle = torch.arange(103, dtype=F64) * (2 * math.pi / 103)
    y, z = (ring[:, None] * angle.cos()).reshape(-1), (ring[:, None] * angle.sin()).reshape(-1)
    directions = unit(torch.stack((torch.full_like(y, 100.0), y, z), -1)).float()
    cells = sample(direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.3] * 3]), 5000, 0)
    gate = (2 * neighbour_spacing_rad(cells)).clamp(min=math.radians(0.8))
    found = check_observations(directions, cells, gate)
    assert 0.1 < float(found.float().mean()) < 0.9


def test_observations_of_a_batch_are_those_of_a_loop():
    directions = torch.stack((random_directions(300, 0), cluster(300, 1, 0.3), random_directions(300, 2)))
    cells = torch.stack((random_directions(200, 3), random_directions(200, 4), cluster(200, 5, 0.3)))
    directions[1, :250] = 0
    directions[2] = math.nan
    for gate in (0.05, 0.4):
        number, cosine = nearest_observation(directions, cells, gate)
        for i in range(3):
            one = nearest_observation(directions[i], cells[i], gate)
            assert torch.equal(number[i], one[0]) and torch.equal(cosine[i], one[1])
        assert bool((number[1][cosine[1] > -1] >= 250).all())
        assert bool((cosine[2] == -1).all())


def test_many_cells_without_a_gate():
    check_observations(cluster(4000, 0, 0.2), random_directions(4000, 1), math.pi)


def test_no_observation_and_no_cell():
    cells = random_directions(4, 0)
    number, cosine = nearest_observation(torch.zeros(0, 3, dtype=F64), cells, 0.1)
    assert number.tolist() == [0] * 4 and cosine.tolist() == [-1.0] * 4
    number, cosine = nearest_observation(cells, cells, 0.1, torch.zeros(4, dtype=torch.bool))
    assert cosine.tolist() == [-1.0] * 4
    assert nearest_observation(cells, cells[:0], 0.1)[0].shape == (0,)


def test_of_equally_near_observations_one_always_the_same():
    directions = random_directions(5, 0).repeat(3, 1)
    first, again = (nearest_observation(directions, directions[:5], 0.05)[0] for _ in range(2))
    assert (first % 5).tolist() == [0, 1, 2, 3, 4] and torch.equal(first, again)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_all_pairs_find_what_the_tree_finds(dtype):
    # what a GPU does, on the CPU
    directions = torch.stack((random_directions(300, 0), cluster(300, 1, 0.3))).to(dtype).double()
    cells = torch.stack((random_directions(200, 3), cluster(200, 4, 0.3)))
    asks, gate = torch.rand(2, 200, generator=torch.Generator().manual_seed(0)) < 0.7, torch.tensor(0.2, dtype=F64)
    (a, far), (b, chord) = _by_tree(directions, cells, asks, gate), _by_all_pairs(directions, cells, asks)
    near = far < math.inf
    assert bool(near.any()) and torch.equal(near, asks & (chord <= far[near].max()))
    assert torch.equal(a[near], b[near])
    torch.testing.assert_close(far[near], chord[near])


# ---------------------------------------------------------------- spacing and errors


def test_neighbour_spacing():
    cells = random_directions(300, 0)
    angle = torch.acos((cells @ cells.T).clamp(-1, 1)).fill_diagonal_(10.0)
    expected = angle.sort(-1).values[:, :6].quantile(0.5, dim=-1)
    torch.testing.assert_close(neighbour_spacing_rad(cells), expected)
    torch.testing.assert_close(neighbour_spacing_rad(cells, 1), angle.amin(-1))
    batch = neighbour_spacing_rad(cells.reshape(3, 100, 3).float())
    assert batch.shape == (3, 100) and batch.dtype == torch.float32
    torch.testing.assert_close(batch[1], neighbour_spacing_rad(cells[100:200]).float())
    assert neighbour_spacing_rad(cells[:1]).tolist() == [math.pi]
    two = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(neighbour_spacing_rad(two), math.pi / 2, rtol=1e-6)


def test_errors():
    good = random_directions(4, 0)
    for bad in (good[0], good[:0], good[:, :2], good[None, None], torch.zeros(4, 3), torch.full((4, 3), math.nan)):
        with pytest.raises(SettingError, match="cells"):
            build_index(bad)
    with pytest.raises(SettingError, match="directions"):
        nearest_cell(build_index(good), good[:, :2])
    with pytest.raises(SettingError, match="directions"):
        nearest_cell(build_index(good[None]), good)
    with pytest.raises(SettingError, match="cells"):
        nearest_observation(good[None], good, 0.1)
    with pytest.raises(SettingError, match="cells"):
        nearest_observation(good[0], good[0], 0.1)
    for gate in (0.0, -1.0, math.nan):
        with pytest.raises(SettingError, match="gate_rad"):
            nearest_observation(good, good, gate)
    with pytest.raises(SettingError, match="cells"):
        neighbour_spacing_rad(good[0])
    with pytest.raises(SettingError, match="neighbours"):
        neighbour_spacing_rad(good, 0)
