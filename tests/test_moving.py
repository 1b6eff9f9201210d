"""A memory that moves and one that is drawn anew: closed forms, Monte Carlo and conservation."""

import math

import pytest
import torch

from torchfovea.gaussian import Gaussian, unpack
from torchfovea.memory.egosphere import Fusion, Prior, belief, cartesian_belief, empty_memory
from torchfovea.memory.moving import Motion, motion, move, resample
from torchfovea.memory.pooling import pool, pool_patches
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.update import fuse
from torchfovea.sensing.chart import basis
from torchfovea.setting import SettingError

PRIOR = Prior()
BOX = torch.tensor(
    [[0.4, 0, 0], [-0.5, 0, 0], [0, 0.6, 0], [0, -0.5, 0], [0, 0, 0.7], [0, 0, -1.8]], dtype=torch.float64
)


def turn(yaw: float) -> torch.Tensor:
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


KNOWN = ("bearing", "looks", "lasting", "votes")


def rotation_of(vector: torch.Tensor) -> torch.Tensor:
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    rows = ((o, -z, y), (z, o, -x), (-y, x, o))
    return torch.linalg.matrix_exp(torch.stack([torch.stack(r, -1) for r in rows], -2))


def box(cells: torch.Tensor, planes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Inverse range of the walls q·X = 1 around, and which wall."""
    return (cells @ planes.mT).max(-1)


def known_room(cells: torch.Tensor, std: float = 1e-3, chart: str = "inverse_range"):
    """A memory that saw every cell's wall once around the cell, slopes included."""
    rho, wall = box(cells, BOX)
    memory = empty_memory(cells, PRIOR, chart)
    cell = torch.arange(len(cells))
    if chart == "cartesian":
        cov = torch.tensor([1e-6, 0, 0, 1e-6, 0, 1e-6], dtype=torch.float64).expand(len(cells), 6)
        return fuse(memory, pool(Gaussian(cells / rho[:, None], cov), cell, (len(cells),)))
    e1, e2 = basis(cells)
    for a, b in ((0, 0), (0.05, 0), (-0.05, 0), (0, 0.05), (0, -0.05)):
        direction = torch.nn.functional.normalize(cells + a * e1 + b * e2, dim=-1)
        row = torch.stack([(direction * axis).sum(-1) for axis in (e1, e2, cells)], -1)
        one = torch.ones_like(rho)
        value = (direction * BOX[wall]).sum(-1)
        memory = fuse(memory, pool_patches(value, std**2 * one, 1e4 * one, row, one, cell, (len(cells),)))
    return memory


def moved_planes(step: Motion) -> torch.Tensor:
    return (BOX @ step.rotation) / (1 - BOX @ step.translation)[:, None]


@pytest.mark.parametrize(("chart", "tolerance"), [("inverse_range", 2e-3), ("cartesian", 0.1)])
def test_a_room_stays_where_it_is(chart, tolerance):
    cells = fibonacci_directions(3000, torch.float64)
    fusion = Fusion("inverse_range" if chart == "inverse_range" else "aligned")
    step = motion(turn(0.3), torch.tensor([0.3, -0.1, 0.0]))
    after = move(known_room(cells, chart=chart), step, fusion)
    want, wall = box(cells, moved_planes(step))
    inside = wall == box(torch.nn.functional.normalize(cells + 0.06, dim=-1), moved_planes(step))[1]
    for shift in (-0.06, torch.tensor([0.06, -0.06, 0.06])):
        inside &= wall == box(torch.nn.functional.normalize(cells + shift, dim=-1), moved_planes(step))[1]
    seen = (after.looks > 0) & inside
    assert (after.looks > 0).double().mean() > 0.97
    got = 1 / cartesian_belief(after).mean.norm(dim=-1)
    error = (got / want - 1)[seen].abs()
    assert error.quantile(0.98) < tolerance, error.quantile(torch.tensor([0.5, 0.9, 0.98], dtype=torch.float64))


def test_standing_still_changes_nothing():
    cells = fibonacci_directions(500, torch.float64)
    memory = known_room(cells)
    after = move(memory, motion(torch.eye(3), torch.zeros(3)), Fusion())
    for got, want in zip(
        (*belief(after), after.bearing, after.looks), (*belief(memory), memory.bearing, memory.looks), strict=True
    ):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_covariance_against_monte_carlo(chart, generator):
    """One cell; its own uncertainty and the odometry's, both drawn."""
    cells = torch.nn.functional.normalize(torch.tensor([[1.0, 0.2, -0.3]], dtype=torch.float64), dim=-1)
    memory = known_room(cells, 0.01, chart)
    root = torch.diag(torch.tensor([0.01, 0.004, 0.01, 0.01, 0.005, 0.01], dtype=torch.float64))
    step = motion(turn(0.05), torch.tensor([0.12, 0.03, 0.0]), root @ root)
    memory = memory._replace(spacing_rad=torch.full((1,), 1.0, dtype=torch.float64))
    after = belief(move(memory, step, Fusion() if chart == "inverse_range" else Fusion("aligned")))
    before = belief(memory)
    n = 40000
    draw = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    state = before.mean[0] + draw @ torch.linalg.cholesky(unpack(before.cov[0])).mT
    noise = torch.randn(n, 6, generator=generator, dtype=torch.float64) @ root
    rotation = step.rotation @ rotation_of(noise[:, :3])
    translation = step.translation + noise[:, 3:] @ step.rotation.mT
    if chart == "cartesian":
        found = ((state - translation)[:, None] @ rotation)[:, 0]
    else:
        frame = torch.stack([*(axis[0] for axis in basis(cells)), cells[0]])
        q = state @ frame
        q = (q[:, None] @ rotation)[:, 0] / (1 - (q * translation).sum(-1, keepdim=True))
        found = q @ frame.mT
    cov = torch.cov(found.T)
    scale = cov.diagonal().sqrt()
    torch.testing.assert_close(
        unpack(after.cov[0]) / scale / scale[:, None], cov / scale / scale[:, None], atol=0.04, rtol=0
    )
    assert ((after.mean[0] - found.mean(0)).abs() < 0.1 * scale).all()


def test_of_two_in_one_cell_the_nearer_stays_with_its_covariance():
    """Looking past a post at x = 1 toward a wall at 3 m, then stepping aside so that the two fall into one cell."""
    cells = torch.tensor([[1.0, 0, 0], [1, 0.2, 0], [1, 0.3, 0], [1, -0.1, 0]], dtype=torch.float64)
    cells = torch.nn.functional.normalize(cells, dim=-1)
    post, wall = torch.tensor([[1.0, 0, 0], [3.0, 0.6, 0]], dtype=torch.float64)
    rho = torch.stack([1 / post.norm(), 1 / wall.norm()])
    one, row = torch.ones(2, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(2, 3)
    memory = empty_memory(cells, PRIOR)
    memory = fuse(memory, pool_patches(rho, 1e-6 * one, 1e6 * one, row, one, torch.arange(2), (4,)))
    aside = torch.tensor([0.0, -0.3, 0.0], dtype=torch.float64)  # both now lie at the bearing 0.3
    memory = memory._replace(spacing_rad=torch.full((4,), 0.05, dtype=torch.float64))
    after = move(memory, motion(torch.eye(3), aside), Fusion())
    assert after.looks.tolist() == [0, 0, 1, 0]
    got = belief(after)
    assert got.mean[2, 2].item() == pytest.approx(1 / (post - aside).norm().item(), rel=1e-3)
    assert got.cov[2, 5].sqrt().item() == pytest.approx(1e-3, rel=0.2)  # the post's, and not a mixture of both


def test_back_faces_and_points_behind_are_dropped():
    cells = torch.tensor([[1.0, 0, 0], [-1, 0, 0]], dtype=torch.float64)
    one, row = torch.ones(1, dtype=torch.float64), torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    memory = fuse(
        empty_memory(cells, PRIOR),
        pool_patches(one, 1e-6 * one, one, row, one, torch.zeros(1, dtype=torch.long), (2,)),
    )
    memory = memory._replace(spacing_rad=torch.full((2,), 1.0, dtype=torch.float64))
    through = move(memory, motion(torch.eye(3), torch.tensor([2.0, 0, 0])), Fusion())
    assert through.looks.sum() == 0
    torch.testing.assert_close(through.information.matrix, empty_memory(cells, PRIOR).information.matrix)
    nothing = move(empty_memory(cells, PRIOR), motion(torch.eye(3), torch.zeros(3)), Fusion())
    assert nothing.looks.sum() == 0


def test_thirty_moves_in_float32_stay_positive():
    cells = fibonacci_directions(400, torch.float32)
    memory = known_room(cells.double(), 1e-3)
    known = {name: getattr(memory, name).float() for name in KNOWN}
    memory = empty_memory(cells, PRIOR)._replace(information=memory.information, **known)
    step = motion(turn(0.1), torch.tensor([0.02, 0.0, 0.0]), 1e-5 * torch.eye(6, dtype=torch.float64))
    for _ in range(30):
        memory = move(memory, step, Fusion())
    moments = belief(memory)
    assert bool(torch.isfinite(moments.mean).all()) and bool((moments.cov[:, [0, 3, 5]] > 0).all())


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_resampling_conserves_information(chart):
    old, new = fibonacci_directions(800, torch.float64), fibonacci_directions(500, torch.float64)
    new = torch.cat([new, torch.nn.functional.normalize(new[:40] + 0.01, dim=-1)])
    fusion = Fusion("inverse_range" if chart == "inverse_range" else "aligned", conflict=1e9)
    memory = known_room(old, chart=chart)
    after = resample(memory, new, fusion)
    assert (after.looks > 0).all()

    def learned(m):
        first = empty_memory(m.cells, PRIOR, chart)
        return (m.information.matrix - first.information.matrix)[:, [0, 3, 5]].sum(), (m.bearing - first.bearing).sum()

    for got, want in zip(learned(after), learned(memory), strict=True):
        torch.testing.assert_close(got, want)
    want, wall = box(new, BOX)
    near = torch.cdist(new, old) < 0.15
    inside = ((box(old, BOX)[1] == wall[:, None]) | ~near).all(-1)
    got = 1 / cartesian_belief(after).mean.norm(dim=-1)
    assert ((got / want - 1)[inside].abs() < (2e-3 if chart == "inverse_range" else 0.08)).double().mean() > 0.97


def test_resampling_into_the_same_cells_changes_nothing():
    cells = fibonacci_directions(300, torch.float64)
    memory = known_room(cells)
    after = resample(memory, cells, Fusion())
    torch.testing.assert_close(after.information.matrix, memory.information.matrix)
    torch.testing.assert_close(after.information.vector, memory.information.vector)
    assert torch.equal(after.looks, memory.looks)
    blank = resample(empty_memory(cells, PRIOR), cells[:10], Fusion())
    assert blank.looks.sum() == 0 and len(blank.cells) == 10


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_cells_that_are_drawn_anew_become_of_the_memorys_type(dtype):
    memory = known_room(fibonacci_directions(60, torch.float64))
    memory = memory._replace(**{k: v.to(dtype) for k, v in memory._asdict().items() if k in ("cells", *KNOWN)})
    cells = fibonacci_directions(40, torch.float32)
    after, same = (resample(memory, given, Fusion()) for given in (cells.double(), cells))
    for one, other in zip(after[:5], same[:5], strict=True):
        parts = zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]
        for a, b in parts:
            torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert after.cells.dtype == dtype
    with pytest.raises(SettingError, match=r"cells = \(2, 40, 3\): expected directions of one memory"):
        resample(memory, cells.expand(2, 40, 3), Fusion())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: motion(2 * torch.eye(3), torch.zeros(3)), "motion.rotation"),
        (lambda: motion(-torch.eye(3), torch.zeros(3)), "motion.rotation"),
        (lambda: motion(torch.full((3, 3), math.nan), torch.zeros(3)), "motion.rotation"),
        (lambda: motion(torch.eye(3), torch.tensor([0, math.inf, 0])), "motion.translation"),
        (lambda: motion(torch.eye(3), torch.zeros(2)), "motion.translation"),
        (lambda: motion(torch.eye(3), torch.zeros(3), -torch.eye(6)), "motion.covariance"),
        (lambda: motion(torch.eye(3), torch.zeros(3), torch.eye(3)), "motion.covariance"),
        (
            lambda: resample(empty_memory(fibonacci_directions(9).expand(2, 9, 3), PRIOR), fibonacci_directions(9),
                             Fusion()),
            "one memory",
        ),
    ],
)  # fmt: skip
def test_errors(call, message):
    with pytest.raises(SettingError, match=message):
        call()
