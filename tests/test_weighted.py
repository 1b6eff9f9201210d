"""Acquisitions with weights: a loop by NumPy and SciPy, laws, and what a gradient of them is."""

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from scipy.stats import norm

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.kinds import check_kinds
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.commands.tune.command import build_problem
from torchfovea.deciding import acquisition, strategies
from torchfovea.deciding.weighted import Terms, Weighting, joined, saccades_left, weighted_score
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, decide, new_memory
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import cyclopean
from torchfovea.setting import SettingError
from torchfovea.tuning import rivals
from torchfovea.tuning.baselines import SEARCHES, hand, table_1
from torchfovea.tuning.bias import Shape, decode, features, fix_vector, nudged, with_weights
from torchfovea.tuning.estimators import policy_difference, slopes
from torchfovea.tuning.problem import Problem, play, play_each, prepare
from torchfovea.tuning.scenes import Distribution, draw_scenes, stream
from torchfovea.tuning.simulator import Resumed, simulate
from torchfovea.tuning.study import reads_scenes
from torchfovea.tuning.train import ESTIMATORS, Schedule, train
from torchfovea.tuning.worlds import Known, Task

ALL = Weighting(0.7, 0.8, -0.6, 0.4, 0.3, 0.2, 0.01)
TUNED = ("by_time", "by_unseen", "improvement", "information", "cost_per_deg")


def terms_of(rows=3, cells=7):
    draw = partial(torch.rand, rows, cells, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mean, std, degrees, information, doubt = draw(), 0.1 + draw(), 60 * draw(), draw(), draw()
    return Terms(mean, std, mean[:, 0].clone(), draw()[:, 0], draw()[:, 0], degrees, information, doubt)


def test_the_score_is_that_of_a_loop():
    terms, w = terms_of(), ALL
    found = weighted_score(w, terms)
    for b, j in np.ndindex(*found.shape):
        mean, std = float(terms.mean[b, j]), float(terms.std[b, j])
        z = (mean - float(terms.incumbent[b])) / std
        alpha = w.alpha * math.exp(
            w.by_time * (float(terms.left[b]) - 0.5) + w.by_unseen * (float(terms.unseen[b]) - 0.5)
        )
        wanted = mean + alpha * std + w.improvement * std * (z * norm.cdf(z) + norm.pdf(z))
        wanted += w.information * float(terms.information[b, j]) + w.doubt * float(terms.doubt[b, j])
        assert float(found[b, j]) == pytest.approx(wanted - w.cost_per_deg * float(terms.degrees[b, j]), rel=1e-12)


def test_it_is_differentiable_in_weights_and_terms():
    terms = terms_of(2, 3)

    def score(*given):
        rows = Weighting(*(weight.expand(2) for weight in given[:7]))
        return weighted_score(rows, Terms(*given[7:]))

    weights = [torch.tensor(v, dtype=torch.float64) for v in ALL.numbers.values()]
    assert torch.autograd.gradcheck(score, [*(t.clone().requires_grad_() for t in (*weights, *terms))])


@pytest.mark.parametrize("alpha", [0.0, 1.5, math.inf])
def test_alpha_alone_is_the_upper_confidence_bound(alpha):
    terms = terms_of()._replace(unseen=None, degrees=None, information=None, doubt=None)
    bound = acquisition.upper_confidence_bound(terms.mean, terms.std, alpha)
    assert torch.equal(weighted_score(Weighting(alpha), terms), bound)


def test_rows_of_weights_are_the_weights_of_rows():
    terms, parts = terms_of(2), (ALL, replace(ALL, alpha=0.1, improvement=-1.0))
    rows = [Weighting(*(torch.tensor([v], dtype=torch.float64) for v in part.numbers.values())) for part in parts]
    together = weighted_score(joined(rows), terms)
    for b, part in enumerate(parts):
        one = Terms(*(t[b] if isinstance(t, torch.Tensor) else t for t in terms))
        torch.testing.assert_close(weighted_score(part, one), together[b])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Weighting(-1.0), r"acquisition\.alpha = -1"),
        (lambda: Weighting(improvement=math.inf), r"acquisition\.improvement = inf"),
        (lambda: Weighting(by_time="much"), r"acquisition\.by_time = much"),
        (lambda: weighted_score(Weighting(cost_per_deg=1.0), terms_of()._replace(degrees=None)), "cost_per_deg = 1"),
        (lambda: weighted_score(Weighting(by_unseen=1.0), terms_of()._replace(unseen=None)), "unseen = None"),
        (lambda: Shape(tuned=("alpha",)), "tune_weights = alpha: expected each once, any of by_time"),
        (lambda: Shape(tuned=("by_time", "by_time")), "tune_weights = by_time"),
        (lambda: Shape(weights=Weighting(cost_per_deg=0.5), tuned=("cost_per_deg",)), r"cost_per_deg = 0\.5"),
        (lambda: Shape(weights=Weighting(doubt=1.0)), r"acquisition\.doubt = 1"),
        (lambda: Distribution(told_spread=0.5), r"distribution\.told_spread = 0\.5"),
    ],
)
def test_what_is_no_weight_is_named(make, message):
    with pytest.raises(SettingError, match=message):
        make()


def test_a_search_counts_its_saccades_and_what_it_has_not_seen():
    assert [saccades_left(made, 5) for made in range(6)] == [1.0, pytest.approx(2 / 3), pytest.approx(1 / 3), 0, 0, 0]
    observer = Observer(camera=Pinhole.from_fov(90.0, 100.0))
    memory = new_memory(observer, fibonacci_directions(60, torch.float64))
    views = []

    def seen(view):
        views.append(view)
        return strategies.weighted(view, Weighting(1.0, by_time=2.0, by_unseen=1.0, cost_per_deg=0.01), 5)

    first = decide(observer, memory, strategy=seen)
    assert (first.state.made, decide(observer, memory, before=first, strategy=seen).state.made) == (1, 2)
    half = memory._replace(looks=(torch.arange(60) % 2).to(memory.looks))
    view = views[1]._replace(memory=half)
    unseen = float((view.eligible & (half.looks == 0)).sum() / view.eligible.sum())
    assert 0.3 < unseen < 0.7
    alpha = math.exp(2.0 * (2 / 3 - 0.5) + unseen - 0.5)
    degrees = torch.rad2deg(torch.acos((view.directions @ view.line_of_sight).clamp(-1, 1)))
    torch.testing.assert_close(seen(view)[0], view.mean + alpha * view.std - 0.01 * degrees, atol=1e-6, rtol=1e-6)


def test_it_is_a_setting_and_information_is_that_of_infomax():
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        names = ["acquisition=weighted", "acquisition.information=1.0", "acquisition.alpha=0", "saccades=7"]
        cfg, plain = (compose("search", overrides=o) for o in (names, ["acquisition=infomax"]))
        with pytest.raises(SettingError, match=r"acquisition.doubt = 1"):
            build_strategy(compose("search", overrides=["acquisition=weighted", "acquisition.doubt=1"]), Observer())
    observer = build_observer(cfg)
    memory = new_memory(observer, fibonacci_directions(50, torch.float64))
    both = []
    for one in (cfg, plain):
        strategy = build_strategy(one, observer)
        decide(observer, memory, strategy=lambda view, s=strategy: both.append((view, s(view)[0])) or view.mean)
    (view, score), (_, gain) = both
    torch.testing.assert_close(score, view.mean + gain / 50)


# ---- in tuning


def problem(saccades=6, cells=25, cost=0.0, distribution=None, weights=None, **shape):
    task = Task(Observer(camera=Pinhole.from_fov(70.0, 100.0)), saccades, saccade_cost=cost)
    own = distribution or Distribution(cans=3)
    given = Shape(
        1, own.conditioned, weights=weights or Weighting(), task_numbers=own.task_numbers, **{"tuned": TUNED, **shape}
    )
    return Problem(task, own, given, cells, torch.float64)


def test_a_vector_holds_the_weights():
    p = problem(weights=Weighting(cost_per_deg=0.004, by_time=0.5))
    x = table_1(p.shape, "target", 0.6)
    assert p.shape.size == 9 + 1 + 5 == len(x)
    found = decode(p.shape, x, torch.zeros(1, 2)).weights
    assert [float(getattr(found, n)) for n in ("alpha", "by_time", "cost_per_deg")] == pytest.approx([0.6, 0.5, 0.004])
    moved = with_weights(p.shape, x, information=0.25, alpha=0.2)
    torch.testing.assert_close(fix_vector(p.shape, moved), moved)
    assert float(decode(p.shape, moved, torch.zeros(1, 2)).weights.information) == pytest.approx(0.25)
    offset = 0.1 * torch.arange(12, dtype=torch.float64).reshape(2, 6)
    rows = nudged(p.shape, found, offset)
    for k in range(2):
        by_vector = x.clone()
        by_vector[p.shape.policy] += offset[k]
        wanted = decode(p.shape, by_vector, torch.zeros(1, 2)).weights
        for name in ("alpha", *TUNED):
            torch.testing.assert_close(getattr(rows, name)[k], getattr(wanted, name))


def test_episodes_with_weights_are_the_same_alone_together_and_resumed():
    p = problem(cost=0.01)
    x = with_weights(p.shape, table_1(p.shape, "down"), by_time=1.0, improvement=1.0)
    vectors = [
        with_weights(p.shape, x, information=information, cost_per_deg=cost)
        for information, cost in ((0.5, 0.002), (0.0, 0.01))
    ]
    batch = p.batch(5, stream("training", 0))
    runs = [play(p, v, batch) for v in vectors]
    assert not torch.equal(runs[0].cell, runs[1].cell)
    assert play_each(p, vectors, batch) == pytest.approx([float(run.value.mean()) for run in runs])
    bias = p.bias(vectors[0], batch.scenes)
    world = prepare(p, bias, batch)
    whole = simulate(p.task, batch.scenes, world, bias.weights, keep=True)
    made, row = torch.tensor([0, 3, 1, 4, 2]), torch.arange(5)
    memory = Known(*(torch.stack(parts)[made, row] for parts in zip(*whole.memories, strict=True)))
    later = simulate(p.task, batch.scenes, world, bias.weights, Resumed(memory, made, whole.reward, whole.gaze))
    torch.testing.assert_close(later.value, whole.value)
    # what the saccades cost
    axis = cyclopean(p.task.observer.head, whole.gaze)[0][..., 2].numpy()
    turned = np.degrees(np.arccos(np.clip((axis[:, 1:] * axis[:, :-1]).sum(-1), -1, 1))).mean(1)
    free = simulate(p.task._replace(saccade_cost=0.0), batch.scenes, world, bias.weights)
    np.testing.assert_allclose(free.value - whole.value, 0.01 * turned, atol=1e-6)


def test_signs_of_all_numbers_at_once_give_each_its_slope():
    """Over all patterns of signs the estimate is exact for a linear function."""
    gradient = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    steps = torch.tensor([0.05, 0.1, 0.1], dtype=torch.float64)
    offsets = steps * torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    torch.testing.assert_close(slopes(offsets, offsets @ gradient, -offsets @ gradient), gradient)


def test_a_weight_s_slope_is_that_of_its_difference():
    """One number alone: the same as a difference by hand on the same cells, scenes and noise."""
    p = problem(tuned=("cost_per_deg",), tune_alpha=False, cost=0.01)
    x, batch = with_weights(p.shape, table_1(p.shape, "down"), cost_per_deg=0.01), p.batch(16, stream("training", 1))
    world = prepare(p, p.bias(x, batch.scenes), batch)
    slope, spent, _ = policy_difference(p, x, batch, world)
    step = torch.zeros_like(x)
    step[-1] = 0.1
    wanted = (play(p, x + step, batch).value - play(p, x - step, batch).value).mean() / 0.2
    assert float(wanted) != 0
    torch.testing.assert_close(slope, wanted[None])
    assert spent == 32


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_every_estimator_has_the_slopes_of_the_weights(name):
    p = problem(5, 20, cost=0.01)
    x = with_weights(p.shape, table_1(p.shape, "down"), cost_per_deg=0.01)
    batch = p.batch(6, stream("training", 0))
    found = ESTIMATORS[name](p, x, batch, alpha_share=1.0)
    assert found.vector.shape == (p.shape.size,) and torch.isfinite(found.vector).all()
    if name != "myopic":  # which plays one cell less
        slope = policy_difference(p, x, batch, prepare(p, p.bias(x, batch.scenes), batch))[0]
        torch.testing.assert_close(found.vector[p.shape.policy], slope)
        assert bool((slope != 0).all())
    assert name != "policy" or bool((found.vector[: p.shape.body] == 0).all())


def test_the_policy_alone_is_tuned_and_the_bias_stays():
    p = problem(4, 10, tuned=("cost_per_deg",), cost=0.02)
    start = fix_vector(p.shape, table_1(p.shape, "down"))
    state = train(p, start, Schedule(episodes=64, estimator="policy", warm_episodes=0, validation_scenes=8))
    torch.testing.assert_close(state.vector[: p.shape.body], start[: p.shape.body])
    assert not torch.equal(state.vector[p.shape.policy], start[p.shape.policy])
    spent, vector = next(iter(SEARCHES["random"](p, start, 8, 0, 4)))
    assert spent == 4 and len(vector) == p.shape.size


def test_weights_are_settings_of_tune():
    def built(*overrides):
        with initialize_config_dir(conf_dir(), version_base="1.3"):
            cfg = compose("tune", overrides=list(overrides))
        check_kinds(cfg, "tune")
        return build_problem(cfg)

    p = built("acquisition=weighted", "acquisition.improvement=0.5", "tune_weights=[by_time]", "saccade_cost=0.01")
    assert (p.shape.tuned, p.shape.weights.improvement, p.task.saccade_cost) == (("by_time",), 0.5, 0.01)
    for given, message in (
        (("tune_weights=[by_time]",), r"tune_weights = \['by_time'\]: expected \[\] without acquisition=weighted"),
        (("acquisition=weighted", "tune_weights=by_time"), "tune_weights = by_time: expected a list"),
        (("acquisition=ei",), "acquisition = ei: expected ucb, whose alpha is tuned, or weighted"),
        (("saccade_cost=-1",), "saccade_cost = -1"),
    ):
        with pytest.raises(SettingError, match=message):
            built(*given)


TOLD = Distribution(cans=3, conditioned=True, told_spread=3.0, regions=((-20.0, 20.0, -14.0, 0.0),))


def test_a_task_may_tell_how_sure_it_is():
    scenes = draw_scenes(TOLD, Observer().head, 4000, stream("training", 0), torch.float64)
    assert scenes.task.shape == (4000, 4) and float(scenes.task.abs().max()) <= 1
    azimuth = torch.rad2deg(torch.atan2(scenes.y, scenes.x))[:, 0]
    apart = (azimuth - 20 * scenes.task[:, 0]).abs() / (8 * 3 ** scenes.task[:, 2])
    assert float(apart.max()) <= 1 + 1e-9
    unsure, sure = (apart[part] for part in (scenes.task[:, 2] > 0.5, scenes.task[:, 2] < -0.5))
    assert float(unsure.mean()) == pytest.approx(0.5, abs=0.04) == pytest.approx(float(sure.mean()), abs=0.04)


def test_four_numbers_have_fifteen_monomials_and_a_fit_follows_their_spread():
    task = 2 * torch.rand(600, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1
    pairs = [task[:, i] * task[:, j] for i in range(4) for j in range(i, 4)]
    torch.testing.assert_close(features(task), torch.stack([torch.ones(600).double(), *task.unbind(1), *pairs], 1))
    shape = Shape(conditioned=True, task_numbers=4)
    assert shape.size == 9 * 15 + 1
    noise = torch.randn(600, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean = torch.tensor([0.9, 0.1, -0.2], dtype=torch.float64)
    u = mean + 0.2 * torch.stack([torch.ones(600).double(), 3 ** task[:, 2], 3 ** task[:, 3]], 1) * noise
    bias = decode(
        shape, rivals.fit_vector(shape, u, task, 1.0), torch.tensor([[0, 0, -1.0, 0], [0, 0, 1.0, 0]]).double()
    )
    diagonal = bias.cholesky[:, 0].diagonal(dim1=-2, dim2=-1)
    ratio = (diagonal[1] / diagonal[0]).log() / math.log(3)
    torch.testing.assert_close(ratio, torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64), atol=0.25, rtol=0)
    p = problem(3, 6, distribution=TOLD, tuned=())
    assert torch.isfinite(hand(p, 1.0, 4, (0.2,))[0]).all()


def test_methods_say_whether_they_read_the_scenes():
    assert all(map(reads_scenes, ("fitted", "covered", "covered+none", "counterfactual", "counterfactual+coverage")))
    assert not any(map(reads_scenes, ("remembered", "counterfactual+none", "policy+none", "cma_es", "cma_es@8", "tpe")))
