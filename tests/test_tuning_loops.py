"""The loops in C of tuning's simulator do what the Python that defines them does."""

import math

import pytest
import torch
from test_heads import Own
from test_loops import CLOSE, both, same
from test_tuning_simulator import HEAD, directions, observer, small

from torchfovea.compiling import compiling
from torchfovea.deciding.weighted import Weighting
from torchfovea.perception import Observer
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.tuning.bias import Bias
from torchfovea.tuning.cells import draw_cells
from torchfovea.tuning.density import log_density_each
from torchfovea.tuning.episodes import episode_loops
from torchfovea.tuning.scenes import Distribution, draw_scenes, first_surfaces, stream
from torchfovea.tuning.simulator import Resumed, simulate
from torchfovea.tuning.worlds import Known, glance, look


def found(run):
    """A run as `same` wants it: lists as tuples, and what is not finite, where there is no cell, as 0."""
    assert torch.equal(torch.isfinite(run.score), run.cell >= 0)
    return run._replace(memories=tuple(run.memories), score=run.score.nan_to_num(neginf=0))


def nearly(one, other):
    """In single precision a ray may meet another thing, a draw fall out of reach: hardly any does."""
    differs = (one.double() - other.double()).abs() > 1e-4 * (1 + one.double().abs())
    assert float(differs.double().mean()) < 2e-3


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("origins", [1, 300])
def test_rays_meet_what_the_definition_says(origins, dtype):
    scenes = draw_scenes(Distribution(), HEAD, 4, stream("training", 3), dtype)
    at = torch.stack((scenes.x, scenes.y, scenes.high), -1).repeat(1, 22, 1)
    jitter = 0.06 * torch.randn(4, 154, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    aimed = torch.nn.functional.normalize(at + jitter.to(dtype), dim=-1)
    level = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0]], dtype=dtype).expand(4, 4, 3)
    direction = torch.cat((aimed, level, directions((4, 142), dtype=dtype)), 1)
    origin = torch.tensor([0.05, -0.02, 0.12], dtype=dtype) + 0.01 * directions((4, origins), 1, dtype)
    hits, quick = both(lambda: first_surfaces(scenes, origin, direction))
    assert 20 < int(hits.floor.sum()) and len(hits.can.unique()) == 8
    if dtype == torch.float64:
        same(hits, quick)
    else:
        for one, other in zip(hits, quick, strict=True):
            nearly(one, other)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize(("mixtures", "components"), [(1, 1), (1, 3), (5, 2)])
def test_cells_are_drawn_as_the_definition_says(mixtures, components, dtype):
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(mixtures, components, 12, generator=generator, dtype=torch.float64).to(dtype)
    factor = torch.tril(0.2 * draw[..., 3:].unflatten(-1, (3, 3)))
    means = draw[..., :3] * 0.3 + torch.tensor([0.8, 0.3, -0.3], dtype=dtype)
    bias = Bias(draw[..., 0], means, factor, Weighting())
    cells, quick = both(lambda: draw_cells(bias, 5, 200, HEAD, torch.Generator().manual_seed(1)))
    assert float(cells.norm(dim=-1).sub(1).abs().max()) < 1e-5
    (same if dtype == torch.float64 else nearly)(cells, quick)
    behind = bias._replace(means=means - 100)
    none, quick = both(lambda: draw_cells(behind, 5, 4, HEAD, torch.Generator().manual_seed(1), strict=False))
    assert bool((none == 0).all()) and torch.equal(none, quick)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("retina", [LogPolar(1000), LogPolar(2000, uniform_fovea=True, rho_min_px=4.0), Uniform(500)])
@pytest.mark.parametrize("source_px", [400, None])
def test_a_glance_tells_what_the_definition_says(retina, source_px, dtype):
    seer = observer(75.0, retina=retina, budget=Budget(source_px=source_px))
    generator = torch.Generator().manual_seed(4)
    gaze = Gaze(*(0.3 * torch.rand(3, generator=generator, dtype=torch.float64).to(dtype) for _ in range(3)))
    range_m = 0.6 + 2 * torch.rand(3, 400, generator=generator, dtype=torch.float64).to(dtype)
    seen, quick = both(lambda: glance(seer, eyes(HEAD, gaze), directions((3, 400), dtype=dtype), range_m))
    assert 0.2 < float(seen[0].double().mean()) < 0.95
    same(seen, quick, dtype)


@pytest.mark.parametrize("reward", ["inverse_range", "range"])
@pytest.mark.parametrize(
    "weights",
    [
        {"alpha": 0.7},
        {"alpha": math.inf},
        {"alpha": torch.tensor([0.1, 1.0, 5.0, 0.5]).double(), "by_time": 1.5, "by_unseen": -1.0, "cost_per_deg": 0.01},
    ],
)
def test_episodes_go_as_the_definition_says(weights, reward):
    task, scenes, world = small(scenes=4, cells=60, saccades=7, reward=reward)
    world.allowed[1, ::2] = False
    world.allowed[2] = False
    weights = Weighting(**weights)
    assert episode_loops(task.observer, world, weights) is None
    with compiling("on"):
        assert episode_loops(task.observer, world, weights) is not None
    whole, quick = both(lambda: simulate(task, scenes, world, weights, keep=True))
    assert len(whole.cell.unique()) > 6 and bool((whole.cell[2] == -1).all())
    same(found(whole), found(quick))
    made, row = torch.tensor([3, 0, 5, 2]), torch.arange(4)
    memory = Known(*(torch.stack(parts)[made, row] for parts in zip(*whole.memories, strict=True)))
    other = world.take(row)
    other.allowed[row[:2], whole.cell[row[:2], made[:2] + 1]] = False
    later, quick = both(lambda: simulate(task, scenes, other, weights, Resumed(memory, made, whole.reward, whole.gaze)))
    assert not torch.equal(later.cell, whole.cell)
    same(found(later), found(quick))


def test_what_no_loop_knows_is_played_as_written():
    task, scenes, world = small(scenes=2, cells=30, saccades=4)
    rich = Weighting(0.5, improvement=2.0)
    with compiling("on"):
        assert episode_loops(task.observer, world, rich) is None
        assert episode_loops(Observer(head=Own()), world, Weighting()) is None
    same(*map(found, both(lambda: simulate(task, scenes, world, rich))))
    direction = world.direction.clone().requires_grad_()
    gaze = Gaze(*(torch.full((2,), 0.1, dtype=torch.float64) for _ in range(3)))
    with compiling("on"):
        known = look(task, world._replace(direction=direction), Known(*world[-2:], world.allowed), eyes(HEAD, gaze), 0)
    assert known.precision.requires_grad


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize(("mixtures", "components", "rows"), [(1, 1, 1), (1, 3, 4), (4, 2, 4), (3, 1, 3)])
def test_densities_and_their_slopes_are_those_of_the_definition(mixtures, components, rows, dtype):
    """Directions everywhere, so that most are deep in a tail; the same for all, or each mixture its own."""
    generator = torch.Generator().manual_seed(mixtures + components)
    draw = torch.randn(mixtures, components, 13, generator=generator, dtype=torch.float64).to(dtype)
    lower, diagonal = torch.tril(draw[..., 4:].unflatten(-1, (3, 3)), -1), torch.eye(3, dtype=dtype)
    numbers = [draw[..., 0], draw[..., 1:4], 0.2 * lower + 0.3 * diagonal]
    way = torch.nn.functional.normalize(torch.randn(rows, 50, 3, generator=generator, dtype=torch.float64), dim=-1)
    way, weigh = way.to(dtype), torch.randn(rows, 50, generator=generator, dtype=torch.float64).to(dtype)
    way = way[:1].expand(rows, -1, -1) if components == 1 else way

    def ascent():
        given = [part.clone().requires_grad_() for part in numbers]
        value = log_density_each(Bias(*given, Weighting()), way)
        return value.detach(), *torch.autograd.grad((weigh * value).sum(), given)

    written, quick = both(ascent)
    same(written, quick, dtype)
    if dtype == torch.float64:
        with compiling("on"):
            given = [part.clone().requires_grad_() for part in numbers]
            assert torch.autograd.gradcheck(lambda *x: log_density_each(Bias(*x, Weighting()), way), given)
