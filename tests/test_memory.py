"""A memory owns its facts: what is of another chart or prior is refused, and batches of memories come apart again."""

import dataclasses

import pytest
import torch

from torchfovea.memory.egosphere import Fusion, Prior, empty_memory
from torchfovea.memory.moving import motion, move, resample
from torchfovea.memory.nearest import build_index, index_of_set, nearest_cell
from torchfovea.memory.sphere import fibonacci_directions, latitude_longitude_directions
from torchfovea.memory.update import remember
from torchfovea.perception import Observer, decide, new_memory, perceive
from torchfovea.rows import row, stack
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Gaze, eyes, to_ego
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError

PATCHES = Observer(retina=LogPolar(200))
POINTS = dataclasses.replace(PATCHES, fusion=Fusion("aligned"), prior=Prior(4.0, 4.0))
CELLS = fibonacci_directions(60, torch.float32)
ZERO = torch.tensor(0.0)
POSE = eyes(PATCHES.head, Gaze(ZERO, ZERO, ZERO + 0.2))


def look() -> Correspondences:
    px = PATCHES.retina.centers_px()
    sigma = torch.full((len(px),), 0.5)
    return Correspondences(px, px.clone(), sigma, sigma, torch.ones(len(px), dtype=torch.bool))


@pytest.mark.parametrize(("mine", "other"), [(PATCHES, POINTS), (POINTS, PATCHES)], ids=["patches", "points"])
def test_a_memory_of_one_chart_refuses_what_is_of_another(mine, other):
    memory = new_memory(mine, CELLS)
    theirs, own = other.fusion.chart, memory.chart
    seen = observe(look(), POSE, other.camera, torch.ones(200), chart=theirs)
    step = motion(torch.eye(3), torch.zeros(3))
    calls = [
        lambda: perceive(other, memory, look(), POSE),
        lambda: decide(other, memory),
        lambda: remember(memory, seen._replace(chart=own), other.fusion),
        lambda: move(memory, step, other.fusion),
        lambda: resample(memory, CELLS, other.fusion),
    ]
    for call in calls:
        with pytest.raises(SettingError, match=f"fusion.chart = {theirs}: expected {own}, the chart of the memory"):
            call()
    with pytest.raises(SettingError, match=f"observed.chart = {theirs}: expected {own}, the chart of the memory"):
        remember(memory, seen, mine.fusion)


def test_a_memory_of_one_prior_refuses_an_observer_of_another():
    memory, other = new_memory(PATCHES, CELLS), dataclasses.replace(PATCHES, prior=Prior(0.5, 0.2))
    for call in (lambda: perceive(other, memory, look(), POSE), lambda: decide(other, memory)):
        with pytest.raises(SettingError, match=r"prior = Prior\(mean=0.5.*expected Prior\(mean=0.4.* of the memory"):
            call()


def test_a_memory_that_turned_knows_where_it_looked():
    memory = perceive(PATCHES, new_memory(PATCHES, CELLS), look(), POSE)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # the base turns to its left
    after = move(memory, motion(quarter, torch.zeros(3)), PATCHES.fusion)
    x, y, z = memory.axis
    torch.testing.assert_close(after.axis, torch.stack([y, -x, z]))
    assert torch.equal(resample(memory, CELLS[:30], PATCHES.fusion).axis, memory.axis)


def crowded(seed: int) -> torch.Tensor:
    """As many cells, most of them close together, so that the index has branches and chains."""
    noise = 1e-3 * torch.randn(40, 3, generator=torch.Generator().manual_seed(seed))
    grid = latitude_longitude_directions(20).float()[:20]
    return torch.nn.functional.normalize(torch.cat([grid, torch.tensor([0.3, 0.2, 0.9]) + noise]), dim=-1)


@pytest.mark.parametrize("joined", [True, False], ids=["joined", "built together"])
def test_the_index_of_one_set_is_as_good_as_its_own(joined):
    sets = torch.stack([crowded(seed) for seed in range(3)])
    index = stack([build_index(cells) for cells in sets]) if joined else build_index(sets)
    asked = torch.cat([torch.randn(300, 3, generator=torch.Generator().manual_seed(9)), sets[0] + 1e-4])
    for b, cells in enumerate(sets):
        got, want = nearest_cell(index_of_set(index, b), asked), nearest_cell(build_index(cells), asked)
        torch.testing.assert_close(got[1], want[1])
        assert torch.equal(got[0], want[0])
    with pytest.raises(SettingError, match="b = 3"):
        index_of_set(index, 3)


def test_rows_of_a_batch_go_on_by_themselves():
    sets = [crowded(seed) for seed in range(2)]
    whole = stack([new_memory(PATCHES, cells) for cells in sets])
    matches, poses = stack([look(), look()]), stack([POSE, POSE])
    after = perceive(PATCHES, whole, matches, poses)
    for b, cells in enumerate(sets):
        alone = perceive(PATCHES, perceive(PATCHES, new_memory(PATCHES, cells), look(), POSE), look(), POSE)
        again = perceive(PATCHES, row(after, b), look(), POSE)
        assert again.prior == PATCHES.prior and again.chart == "inverse_range" and again.lookup.batch is None
        torch.testing.assert_close(again.information.matrix, alone.information.matrix)
        assert torch.equal(again.looks, alone.looks)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (empty_memory(CELLS, Prior(0.5)), r"rows = .*: expected the same for all"),
        (empty_memory(CELLS, Prior(), "cartesian"), "rows = inverse_range and cartesian"),
        (empty_memory(CELLS[:30], Prior()), r"rows = \[\(30, 3\), \(60, 3\)\]: expected the same shape"),
    ],
    ids=["prior", "chart", "cells"],
)
def test_memories_that_are_no_batch_are_refused(other, message):
    with pytest.raises(SettingError, match=message):
        stack([empty_memory(CELLS, Prior()), other])


@pytest.mark.parametrize("observer", [PATCHES, POINTS], ids=["patches", "points"])
@pytest.mark.parametrize("sample", [None, 120])
def test_leaving_out_what_is_not_valid_changes_nothing(observer, sample):
    observer = dataclasses.replace(observer, retina=LogPolar(600), budget=Budget(shared=0.5, lasting=0.2))
    cells, rng = fibonacci_directions(2000, torch.float64), torch.Generator().manual_seed(0)
    chosen = draw_fields(observer.retina.count, sample, rng)
    px = observer.retina.centers_px(dtype=torch.float64)
    px = px if chosen is None else px[chosen]
    visible = torch.rand(len(px), generator=rng) < 0.6
    pose = eyes(observer.head, Gaze(*torch.tensor([0.1, -0.2, 0.15], dtype=torch.float64)))
    points = pose.t_left + 1.5 * to_ego(pose.R_left, observer.camera.rays(px))
    matches = correspond_points(points, visible, px, pose, observer.camera, observer.retina, observer.budget)
    matches = matches if chosen is None else for_all(matches, observer.retina)
    masked, dropped = (
        perceive(observer, new_memory(observer, cells), part, pose) for part in (matches, matches.take(matches.valid))
    )
    assert int((masked.looks > 0).sum()) > 100
    assert torch.equal(masked.looks, dropped.looks)
    for one, other in zip(masked.information, dropped.information, strict=True):
        torch.testing.assert_close(one, other)


def test_fields_that_stand_for_all_cover_as_much_as_all():
    retina = LogPolar(600)
    px = retina.centers_px(dtype=torch.float64)
    sigma, valid = torch.ones_like(px[:, 0]), torch.ones(len(px), dtype=torch.bool)
    every = Correspondences(px, px, sigma, sigma, valid)
    area = (2 * for_all(every, retina).support_px).square().sum()
    torch.testing.assert_close(area, retina.width_px(px).square().sum())
    some = for_all(every.take(draw_fields(retina.count, 60, torch.Generator().manual_seed(0))), retina)
    torch.testing.assert_close(some.support_px, retina.width_px(some.left_px) / 2 * (retina.count / 60) ** 0.5)
