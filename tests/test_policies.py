"""The portfolio and the trivial policies against plain loops."""

import math

import pytest
import torch

from torchfovea.deciding import acquisition as aq
from torchfovea.deciding import policies as po
from torchfovea.deciding.infomax import saccade_degrees
from torchfovea.setting import SettingError


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def belief(*shape, dtype=torch.float64, seed=0):
    g = generator(seed)
    return torch.randn(*shape, generator=g, dtype=dtype), torch.rand(*shape, generator=g, dtype=dtype) + 0.1


def directions(n, seed=0, dtype=torch.float64):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator(seed), dtype=dtype), dim=-1)


def test_hedge_follows_the_probabilities_and_learns():
    state = po.Hedge(torch.tensor([0.0, math.log(2.0), math.log(5.0)]).expand(20000, 3))
    nominees = torch.tensor([7, 8, 9]).expand(20000, 3)
    cell, followed = po.hedge_choose(state, nominees, 1.0, generator())
    assert torch.equal(cell, followed + 7)
    assert (torch.bincount(followed) / 20000).tolist() == pytest.approx([1 / 8, 2 / 8, 5 / 8], abs=0.015)

    mean = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    state, good = po.hedge_start((), 3, mean), 0
    for g in map(generator, range(200)):
        nominees = torch.tensor([0, 2, -1])
        _, followed = po.hedge_choose(state, nominees, math.sqrt(8 * math.log(3) / 200), g)
        good += int(followed == 1)
        state = po.hedge_update(state, nominees, mean)
    assert state.gains.tolist() == [0, 200, 0]
    assert good > 170
    assert po.hedge_start((2, 5), 3, mean).gains.shape == (2, 5, 3)
    with pytest.raises(SettingError, match=r"acquisition\.eta"):
        po.hedge_choose(state, nominees, -1.0, generator())


def test_hedge_update_is_a_loop():
    mean, _ = belief(2, 6)
    nominees = torch.tensor([[0, 5, 5], [3, -1, 2]])
    gains = po.hedge_update(po.hedge_start((2,), 3, mean), nominees, mean).gains
    expected = [[mean[b, c].item() if c >= 0 else 0.0 for c in row] for b, row in enumerate(nominees.tolist())]
    assert gains.tolist() == expected


def test_raster_visits_row_by_row_and_cycles():
    pan, tilt = torch.meshgrid(torch.linspace(-50, 50, 41), torch.linspace(-36, 18, 23), indexing="ij")
    pan, tilt = torch.deg2rad(pan.flatten()), torch.deg2rad(tilt.flatten())
    cells = torch.stack([tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), tilt.sin()], -1).double()
    ranks = po.raster_ranks(cells, 20.0)
    order = ranks.argsort()[-int((ranks >= 0).sum()) :]
    assert ranks[order].tolist() == list(range(len(order)))
    steps = saccade_degrees(cells[order][:-1], cells[order][1:, None])[:, 0]
    assert steps.max() < 32 and steps.mean() > 12
    assert (cells @ cells[order].T).max(1).values.min() > math.cos(math.radians(16))
    assert tilt[order[0]] > tilt[order[-1]]
    eligible = torch.ones(len(cells), dtype=torch.bool)
    last, seen = torch.tensor(-1), []
    for _ in range(len(order) + 1):
        last = aq.choose(po.raster_scores(ranks, last), eligible, generator())
        seen.append(last.item())
    assert seen == [*order.tolist(), order[0].item()]
    eligible[order[1]] = False
    assert aq.choose(po.raster_scores(ranks, order[0]), eligible) == order[2]
    batch = po.raster_scores(ranks, order[:2])
    assert torch.equal(batch[1], po.raster_scores(ranks, order[1]))
    off = int((ranks < 0).nonzero()[0])
    assert aq.choose(po.raster_scores(ranks, torch.tensor(-1)), torch.arange(len(cells)) == off) == off
    assert aq.choose(po.raster_scores(ranks, torch.tensor(off)), ranks >= 0) == order[0]
    for bad in (0.0, -3.0, 180.0, math.nan):
        with pytest.raises(SettingError, match="spacing_deg"):
            po.raster_ranks(cells, bad)


def test_random_first_glance_and_oracle():
    mean, _ = belief(3, 50)
    everything = torch.ones(50, dtype=torch.bool)
    picks = [aq.choose(po.random_scores(mean, generator(i)), everything, generator(i))[0].item() for i in range(300)]
    assert len(set(picks)) == 50 or len(set(picks)) > 45
    chosen = aq.choose(po.first_glance_scores(mean, torch.full((3,), -1)), everything, generator())
    assert torch.equal(chosen, mean.argmax(-1))
    later, _ = belief(3, 50, seed=1)
    assert torch.equal(aq.choose(po.first_glance_scores(later, chosen), everything, generator()), chosen)
    cells = directions(50)
    best = directions(3, 9)
    expected = [max(range(50), key=lambda j, b=b: float(cells[j] @ b)) for b in best]
    assert po.oracle_scores(cells, best).argmax(-1).tolist() == expected
