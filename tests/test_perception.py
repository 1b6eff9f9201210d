"""Strategies on a memory that knows something, and what is drawn when only some receptive fields look."""

import dataclasses
import inspect
import math
from functools import partial

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.named import targets_of
from torchfovea.commands.shared.strategy import build_stop, build_strategy
from torchfovea.deciding import acquisition, strategies
from torchfovea.deciding.reward import nearest_to
from torchfovea.deciding.strategies import View
from torchfovea.deciding.worth import worth_of_cells
from torchfovea.gaussian import Information
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Eligibility, Observer, decide, gaze_at, new_memory, perceive
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Gaze, Head, eyes, gaze_point
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.retina import fovea
from torchfovea.setting import SettingError
from torchfovea.sim.cans import Cans
from torchfovea.sim.room import Room
from torchfovea.sim.scene import AttentionWorld


def view_of(rows: int = 2, count: int = 40, dtype=torch.float64, seed: int = 0) -> View:
    generator = torch.Generator().manual_seed(seed)
    mean = torch.rand(rows, count, generator=generator, dtype=dtype)
    std = 0.1 + torch.rand(rows, count, generator=generator, dtype=dtype)
    directions = fibonacci_directions(count, dtype).expand(rows, -1, -1)
    eligible = torch.rand(rows, count, generator=generator) > 0.2
    return View(
        mean,
        std,
        torch.where(eligible, mean, mean.amin(-1, keepdim=True)).amax(-1),
        eligible,
        directions,
        directions[:, 0],
        torch.full((rows,), -1),
        [torch.Generator().manual_seed(k) for k in range(rows)],
    )


def configured(*overrides: str):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("search", overrides=list(overrides))


BROUGHT = {"external", "trained"}  # are what a user brings: test_extensions, test_envs


@pytest.mark.parametrize("name", sorted(set(targets_of("acquisition", "name")) - BROUGHT))
def test_each_strategy_scores_a_batch_as_its_rows(name, dtype):
    cfg = configured(f"acquisition={name}")
    observer = build_observer(cfg)
    best = fibonacci_directions(7, dtype)[3:5]
    both, view = build_strategy(cfg, observer, best), view_of(dtype=dtype)
    generators, states, state = [torch.Generator().manual_seed(k) for k in range(2)], [None, None], None
    lasts = torch.full((2,), -1)
    for _ in range(3):
        alone = []
        for b in range(2):
            row = View(*(part[b] for part in view[:6]), lasts[b], generators[b], states[b])
            score, states[b] = strategies.evaluate(build_strategy(cfg, observer, best[b]), row)
            alone.append(acquisition.choose(score, row.eligible, generators[b]))
        score, state = strategies.evaluate(both, view._replace(state=state, last=lasts))
        assert score.shape == (2, 40) and not score.isnan().any()
        lasts = acquisition.choose(score, view.eligible, view.generator)
        assert torch.equal(lasts, torch.stack(alone))
        assert bool(view.eligible.gather(1, lasts[:, None]).all())


def test_alpha_may_differ_between_rows():
    view = view_of(3)
    together = strategies.upper_confidence_bound(view, torch.tensor([0.0, 2.0, math.inf], dtype=torch.float64))
    assert torch.equal(together[0], view.mean[0]) and torch.equal(together[2], view.std[2])
    assert torch.allclose(together[1], view.mean[1] + 2 * view.std[1])


def test_costs_keep_the_gaze_near():
    view = view_of(1)._replace(eligible=torch.ones(1, 40, dtype=torch.bool))
    dear = strategies.upper_confidence_bound_less_cost(view, 1.0, weight=100.0)
    assert int(dear.argmax()) == 0  # it stays where it looks
    free = strategies.upper_confidence_bound_less_cost(view, 1.0, weight=0.0)
    assert torch.equal(free, strategies.upper_confidence_bound(view, 1.0))
    per = strategies.expected_improvement_per_cost(view, 10.0, "seconds")
    plain = strategies.log_expected_improvement(view)
    assert bool((per <= plain - math.log(10.0) + 1e-12).all())
    with pytest.raises(SettingError, match=r"acquisition.unit = hours"):
        strategies.expected_improvement_per_cost(view, 1.0, "hours")


def test_hedge_learns_who_was_right():
    good, bad = (partial(strategies.oracle, best=v) for v in torch.eye(3, dtype=torch.float64)[:2])
    view = view_of(1, 200)
    view = view._replace(eligible=torch.ones(1, 200, dtype=torch.bool), mean=view.directions[..., 0].clone())
    state = None
    for _ in range(12):
        _, state = strategies.evaluate(
            partial(strategies.hedge, members=(good, bad), eta=1.0), view._replace(state=state)
        )
    gains = state.gains.gains[0]
    assert gains[0] > gains[1] + 5


def test_infomax_prefers_what_is_unknown_and_sharp_eyes():
    observer = Observer(camera=Pinhole.from_fov(90, 100), retina=LogPolar(2000))
    law = strategies.inverse_range_acuity(observer.camera, observer.retina, observer.budget, observer.head.baseline_m)
    angles = torch.tensor([0.0, 0.1, 0.4, 0.7], dtype=torch.float64)
    assert bool((law(angles).diff() > 0).all())
    # on the axis: √2 σ/(f b)
    sigma = float(law(angles[:1]))
    width = float(observer.retina.width_px(torch.zeros(2)))
    budget = math.sqrt((width / 6) ** 2 + 0.25 * ((1 / 6) ** 2 + 0.15**2))
    assert sigma == pytest.approx(
        math.sqrt(2) * budget / (observer.camera.focal_px * observer.head.baseline_m), rel=1e-3
    )
    view = view_of(1, 400)
    known = view._replace(std=torch.where(view.directions[..., 0] > 0, 1e-4, 1.0), eligible=torch.ones(1, 400).bool())
    gain, _ = strategies.information_gain(known, law, math.radians(45))
    assert float(known.directions[0, int(gain.argmax()), 0]) < 0


def test_first_glance_stays_and_random_needs_chance():
    view = view_of(2)
    score, state = strategies.first_glance(view)
    first = acquisition.choose(score, view.eligible)
    later = view_of(2, seed=5)._replace(eligible=view.eligible, state=state)
    assert torch.equal(acquisition.choose(strategies.first_glance(later)[0], view.eligible), first)
    with pytest.raises(SettingError, match="generator"):
        strategies.random(view._replace(generator=None))


def test_decide_hands_over_what_it_knows():
    seen = []

    def spy(view: View):
        seen.append(view)
        return view.mean, len(seen)

    observer = Observer()
    memory = new_memory(observer, fibonacci_directions(60, torch.float64))
    zero = torch.zeros((), dtype=torch.float64)
    first = decide(observer, memory, strategy=spy)
    second = decide(observer, memory, None, Gaze(zero + 0.3, zero, zero), first, spy)
    assert seen[0].state is None and seen[0].last == -1 and seen[1].state == 1 and second.state == 2
    assert seen[1].last == first.cell
    assert torch.allclose(seen[0].line_of_sight, torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose(seen[1].line_of_sight, torch.tensor([math.cos(0.3), math.sin(0.3), 0], dtype=torch.float64))


def test_gaze_at_no_cell_is_straight_ahead():
    gazes = Gaze(*(torch.arange(1.0, 4.0) for _ in range(3)))
    assert gaze_at(gazes, torch.tensor(1)).pan == 2 and gaze_at(gazes, torch.tensor(-1)).tilt == 0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["acquisition=ucb", "acquisition.alpha=-1"], r"acquisition.alpha = -1"),
        (["acquisition=raster", "acquisition.spacing_deg=-1"], r"acquisition.spacing_deg = -1"),
        (["acquisition=ei_cost", "acquisition.overhead=0"], r"acquisition.overhead = 0"),
        (["acquisition=ucb_cost", "acquisition.unit=hours"], r"acquisition.unit = hours"),
        (["acquisition=hedge", "acquisition.eta=lots"], r"acquisition.eta = lots"),
        (["acquisition.name=best"], r"acquisition.name = best: expected one of ei"),
    ],
)
def test_a_bad_strategy_names_its_setting(overrides, message):
    cfg = configured(*overrides)
    with pytest.raises(SettingError, match=message):
        build_strategy(cfg, build_observer(cfg))


def test_the_stop_rule_is_read():
    assert build_stop(configured()) is None
    assert build_stop(configured("stop.probability=0.1", "stop.tolerance=0.2")) == (0.2, 0.1)
    with pytest.raises(SettingError, match=r"stop.probability = 2"):
        build_stop(configured("stop.probability=2"))


def test_the_configuration_has_the_defaults_of_the_dataclasses():
    cfg = configured("scene=cans", "budget=ours")  # search takes the budget calibrated for its sensor and matcher
    observer = build_observer(cfg)
    plain = Observer()
    for field in dataclasses.fields(Observer):
        assert getattr(observer, field.name) == getattr(plain, field.name), field.name
    strategy = build_strategy(cfg, observer)
    assert strategy.func is strategies.upper_confidence_bound
    default = inspect.signature(strategies.upper_confidence_bound).parameters["alpha"].default
    assert strategy.keywords == {"alpha": default}
    for kind, node in (
        (Head, cfg.head), (Budget, cfg.budget), (Fusion, cfg.fusion), (Prior, cfg.prior),
        (Eligibility, cfg.eligibility), (LogPolar, cfg.sensor), (Cans, cfg.scene),
        (AttentionWorld, configured().scene), (Room, cfg.scene.room),
    ):  # fmt: skip
        for field in dataclasses.fields(kind):
            if field.name in node and field.name not in ("room", "source_px"):
                value = OmegaConf.to_container(OmegaConf.create({"v": node[field.name]}))["v"]
                value = tuple(value) if isinstance(value, list) else value
                assert value == getattr(kind(), field.name), f"{kind.__name__}.{field.name}"


def known_memory(observer: Observer, cells: torch.Tensor, rho: torch.Tensor, votes: tuple[float, float]):
    """A memory that has seen every other cell at inverse ranges (Nx,), with these votes for and against."""
    memory = new_memory(observer, cells)
    seen = (torch.arange(len(cells)) % 2 == 0).to(cells)
    if observer.fusion.chart == "cartesian":
        points = cells / rho[:, None]
        matrix = torch.tensor([1.0, 0, 0, 1, 0, 1]).to(cells) * 1e4
        information = Information(seen[:, None] * 1e4 * points, seen[:, None] * matrix)
    else:
        vector = torch.stack([0 * rho, 0 * rho, 1e4 * rho], -1)
        information = Information(
            seen[:, None] * vector, seen[:, None] * torch.tensor([0.0, 0, 0, 0, 0, 1e4]).to(cells)
        )
    total = Information(*(a + b for a, b in zip(memory.information, information, strict=True)))
    counted = seen[:, None] * torch.tensor(votes).to(cells)
    return memory._replace(information=total, looks=seen, votes=counted)


@pytest.mark.parametrize("fusion", ["inverse_range", "aligned"])
def test_a_function_of_points_is_a_reward_as_good_as_a_named_one(fusion):
    cells = fibonacci_directions(60)
    prior = Prior() if fusion == "inverse_range" else Prior(4.0, 4.0)
    named = Observer(fusion=Fusion(fusion), prior=prior, reward="range")
    own = dataclasses.replace(named, reward=lambda x: -x.norm(dim=-1))
    memory = known_memory(
        named, cells, 0.3 + torch.rand(60, generator=torch.Generator().manual_seed(0)).to(cells), (1.0, 0.0)
    )
    for a, b in zip(*(worth_of_cells(memory, one.reward)[1] for one in (named, own)), strict=True):
        torch.testing.assert_close(a, b)
    point = torch.tensor([0.5, 0.3, -0.2], dtype=cells.dtype)
    near = dataclasses.replace(named, reward=nearest_to(point))
    points, reward, _ = worth_of_cells(memory, near.reward)
    torch.testing.assert_close(reward.mean[::2], -(points.mean - point).norm(dim=-1)[::2])
    assert int(decide(near, memory).cell) >= 0


def test_a_surface_is_worth_as_much_as_it_is_believed():
    cells, observer = fibonacci_directions(60), Observer()
    rho = torch.full((60,), 1.5, dtype=cells.dtype)
    memories = (known_memory(observer, cells, rho, votes) for votes in ((3.0, 0.0), (0.3, 2.7)))
    sure, doubtful = (worth_of_cells(memory, observer.reward)[1] for memory in memories)
    prior = observer.prior
    std = doubtful.std[0].item()
    torch.testing.assert_close(sure.mean[::2], rho[::2], rtol=1e-3, atol=0)
    torch.testing.assert_close(doubtful.mean[::2], 0.1 * sure.mean[::2] + 0.9 * prior.mean)
    assert std == pytest.approx(0.1 * sure.std[0].item() + 0.9 * prior.std / math.sqrt(3.7))
    for reward in (sure, doubtful):  # what no look reached is as it was
        assert (reward.mean[1::2] == prior.mean).all() and (reward.std[1::2] == prior.std).all()


def test_the_eyes_do_not_meet_at_a_surface_that_is_doubted():
    cells = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    observer = Observer()
    rho = torch.tensor([1.5], dtype=torch.float64)
    for votes, range_m in (((2.0, 0.0), 1 / 1.5), ((0.2, 1.8), 1 / observer.prior.mean)):
        step = decide(observer, known_memory(observer, cells, rho, votes))
        assert gaze_point(observer.head, step.gaze).norm().item() == pytest.approx(range_m, rel=1e-3)


def test_a_strategy_is_no_part_of_an_observer():
    expected = r"Observer\(acquisition\) = raster: expected decide\(..., strategy=\) or search"
    with pytest.raises(SettingError, match=expected):
        Observer(acquisition=strategies.raster)
    assert dataclasses.replace(Observer(), reward="range").reward == "range"


def test_arrays_and_numbers_in_place_of_tensors_are_named():
    observer = Observer(retina=LogPolar(600))
    memory, px = new_memory(observer, fibonacci_directions(20)), observer.retina.centers_px()
    matches = Correspondences(px, px, px[:, 0].abs() + 1, px[:, 0].abs() + 1, px[:, 0] > 0)
    gaze, image = Gaze(*torch.zeros(3)), torch.zeros(1, 3, 32, 32)
    for call, line in (
        (lambda: fovea(np.zeros((1, 3, 32, 32)), None, observer.retina), "image = ndarray: expected a tensor"),
        (lambda: fovea(image, [16.0, 16.0], observer.retina), "gaze_px = list: expected a tensor"),
        (lambda: new_memory(observer, np.eye(3)), "cells = ndarray: expected a tensor"),
        (lambda: eyes(observer.head, Gaze(0.0, 0.0, 0.0)), "gaze = float: expected a Gaze of tensors"),
        (lambda: perceive(observer, memory, matches, gaze), "eyes = Gaze: expected a torchfovea.Eyes"),
        (
            lambda: perceive(observer, memory, px, eyes(observer.head, gaze)),
            "matches = Tensor: expected a torch",
        ),
    ):
        with pytest.raises(SettingError, match=f"^{line}"):
            call()
