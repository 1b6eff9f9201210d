"""Gradient estimators against explicit removal and finite differences; training, resuming and its refusals."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_cells
from torchfovea.deciding.weighted import Weighting
from torchfovea.memory.egosphere import Prior
from torchfovea.memory.sphere import direction_mixture, log_density, log_normalizer, sphere_quadrature
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Head
from torchfovea.setting import SettingError
from torchfovea.tuning import train as training
from torchfovea.tuning.baselines import SEARCHES, hand, table_1
from torchfovea.tuning.bias import (
    Bias,
    Shape,
    decode,
    encode,
    fix_vector,
    fov_of,
    mixture_of,
)
from torchfovea.tuning.cells import draw_cells, reachable
from torchfovea.tuning.check import Sample, agreement, estimate_gradient, finite_differences, slope_along
from torchfovea.tuning.density import log_density_each, log_normalizer_each
from torchfovea.tuning.estimators import counterfactual, policy_difference
from torchfovea.tuning.pathwise import panorama
from torchfovea.tuning.prior_field import fit_by_gradient, fit_closed_form, look_up
from torchfovea.tuning.problem import Problem, evaluate_bias, play, play_each, prepare
from torchfovea.tuning.scenes import Distribution, draw_scenes, first_surfaces, stream
from torchfovea.tuning.simulator import simulate
from torchfovea.tuning.study import Heldout, budgets_up_to, curves, episodes_to_reach, student
from torchfovea.tuning.train import ESTIMATORS, Schedule, gradient, train
from torchfovea.tuning.worlds import Task

HEAD = Head()
MEAN = [0.8, 0.4, -0.2]


def problem(cells=30, saccades=6, distribution=None, dtype=torch.float32, **shape):
    task = Task(Observer(camera=Pinhole.from_fov(90.0, 100.0)), saccades)
    return Problem(task, distribution or Distribution(cans=3), Shape(**shape), cells, dtype)


def vector(shape, mean=MEAN, variance=0.1, alpha=1.0):
    return encode(shape, direction_mixture([1.0], [mean], [[variance] * 3], dtype=torch.float64), alpha)


def test_densities_are_those_of_the_sphere():
    mixture = direction_mixture(
        [0.3, 0.7], [MEAN, [0.2, -0.5, 0.1]], [[0.1, 0.2, 0.05], [0.3, 0.1, 0.2]], dtype=torch.float64
    )
    bias = Bias(*(part[None] for part in mixture), Weighting())
    direction = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(log_density_each(bias, direction[None])[0], log_density(mixture, direction))
    quadrature = sphere_quadrature(3000, lambda d: reachable(HEAD, d), torch.float64)
    torch.testing.assert_close(log_normalizer_each(bias, quadrature)[0], log_normalizer(mixture, quadrature))


@pytest.mark.parametrize("components", [1, 3])
def test_a_vector_is_its_mixture(components):
    shape = Shape(components)
    x = torch.randn(shape.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.5
    fixed = fix_vector(shape, x)
    torch.testing.assert_close(fix_vector(shape, fixed), fixed)
    before, after = (decode(shape, v, torch.zeros(1, 2)) for v in (x, fixed))
    direction = torch.nn.functional.normalize(torch.randn(1, 40, 3, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(log_density_each(before, direction), log_density_each(after, direction))
    assert float(after.weights.alpha) == pytest.approx(float(before.weights.alpha))
    again = encode(shape, mixture_of(shape, fixed), float(after.weights.alpha))
    torch.testing.assert_close(again, fixed)


def test_a_conditioned_start_is_the_same_for_every_task():
    shape = Shape(conditioned=True)
    assert shape.size == 55
    x = vector(shape)
    bias = decode(shape, x, torch.tensor([[0.0, 0.0], [1.0, -0.7]], dtype=torch.float64))
    torch.testing.assert_close(bias.means[0], bias.means[1])
    moved = x.clone()
    moved[9] = 0.3  # the first mean's slope in the task's azimuth
    bias = decode(shape, moved, torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64))
    assert float(bias.means[1, 0, 0] - bias.means[0, 0, 0]) == pytest.approx(0.3)


def test_cells_are_within_reach_and_follow_the_bias():
    shape = Shape()
    bias = decode(shape, vector(shape), torch.zeros(1, 2))
    cells = draw_cells(bias, 4, 500, HEAD, torch.Generator().manual_seed(0))
    assert reachable(HEAD, cells).all()
    torch.testing.assert_close(cells.norm(dim=-1), torch.ones(4, 500, dtype=cells.dtype))
    quadrature = sphere_quadrature(20000, lambda d: reachable(HEAD, d), torch.float64)
    density = (log_density_each(bias, quadrature.directions[None])[0] - log_normalizer_each(bias, quadrature)).exp()
    mean = (density * quadrature.solid_angle_sr) @ quadrature.directions
    torch.testing.assert_close(cells.flatten(0, 1).mean(0), mean, atol=0.02, rtol=0)
    beside = decode(shape, vector(shape) + 1e-6, torch.zeros(1, 2))
    near = draw_cells(beside, 4, 500, HEAD, torch.Generator().manual_seed(0))
    assert float((near - cells).abs().median()) < 1e-5


def test_a_start_out_of_reach_is_refused():
    shape = Shape()
    behind = vector(shape, [-1.0, 0.0, 0.0], 0.001)
    with pytest.raises(SettingError, match="do not overlap"):
        train(problem(), behind, Schedule(episodes=32, warm_episodes=0, validation_scenes=2))


def test_same_seed_same_episodes():
    p = problem()
    x = vector(p.shape)
    first, second = (play(p, x, p.batch(5, stream("training", 3))) for _ in range(2))
    assert torch.equal(first.cell, second.cell) and torch.equal(first.value, second.value)
    assert not torch.equal(first.value, play(p, x, p.batch(5, stream("training", 4))).value)


def test_without_strictness_cells_out_of_reach_are_missing_and_the_others_as_before():
    p = problem(cells=12, saccades=4, distribution=Distribution(cans=3, conditioned=True), conditioned=True)
    x = vector(p.shape)
    lost = x.clone()
    lost[9], lost[10:12], lost[3:6], lost[12:15] = -2.0, 0.0, -2.0, 0.0  # the task's azimuth turns the mean back
    batch = p.batch(40, stream("training", 0))
    with pytest.raises(SettingError, match="do not overlap"):
        play(p, lost, batch)
    world = prepare(p, p.bias(lost, batch.scenes), batch, strict=False)
    there = world.allowed.all(1)
    assert 0 < there.sum() < 40 and not world.allowed[batch.scenes.task[:, 0] > 0.9].any()
    value = play(p, lost, batch, strict=False).value
    assert torch.isfinite(value).all() and float(value[there].mean()) > float(value[~there].mean())
    assert torch.equal(play(p, x, batch, strict=False).value, play(p, x, batch).value)


@pytest.mark.parametrize("shape", [{}, {"conditioned": True}, {"fov_deg": 80.0}], ids=str)
def test_several_vectors_are_played_as_each(shape):
    p = problem(cells=12, saccades=4, distribution=Distribution(cans=3, conditioned="conditioned" in shape), **shape)
    batch = p.batch(5, stream("training", 0))
    vectors = [vector(p.shape), vector(p.shape, [-1.0, 0.0, 0.0], 1e-3), vector(p.shape, alpha=0.3)]
    first, out, last = play_each(p, vectors, batch)
    assert out == -1
    assert (first, last) == tuple(pytest.approx(float(play(p, v, batch).value.mean())) for v in vectors[::2])
    assert play_each(p, vectors[1:2], batch) == [-1.0]


def test_a_cell_is_worth_what_its_removal_costs():
    """Restarted counterfactuals equal whole episodes without the cell; cells never fixated are worth nothing."""
    from torchfovea.tuning.estimators import _removals

    p = problem(cells=12, saccades=5, dtype=torch.float64)
    batch = p.batch(3, stream("training", 0))
    bias = p.bias(vector(p.shape), batch.scenes)
    removals = _removals(p, bias, batch, 0.7)
    world, value, credit = removals.world, removals.value, removals.credit
    assert 3 < removals.episodes <= removals.runs == 3 + len(credit.scene) + 4
    slope, spent, _ = policy_difference(p, vector(p.shape), batch, world, 0.7)
    assert removals.slope.tolist() == pytest.approx(slope.tolist()) and spent == 4
    found = {}
    for scene, direction, weight in zip(*credit, strict=True):
        cell = int((world.direction[scene] @ direction).argmax())
        found[int(scene), cell] = float(weight)
    for b in range(3):
        for i in range(12):
            one = world._replace(allowed=world.allowed.clone())
            one.allowed[b, i] = False
            loss = float((value - simulate(p.task, batch.scenes, one, bias.weights).value)[b])
            assert found.get((b, i), 0.0) == pytest.approx(loss, abs=1e-12)


def test_leaving_one_out_is_unbiased_where_all_draws_can_be_listed():
    """Three draws from four directions: the mean of Σ ∇log p(i) (R(P) − R(P∖i)) over all 64 is ∇E[R]."""
    rng = np.random.default_rng(0)
    worth = rng.random(4)

    def value(drawn):  # of a set of cells, in their order: a greedy policy that may be misled
        best, total = 0.0, 0.0
        for cell in sorted(drawn, key=lambda c: -(worth[c] + 0.5 * (c % 2)))[:2]:
            best = max(best, worth[cell])
            total += best
        return total

    logits = torch.tensor([0.3, -0.2, 0.5, 0.0], dtype=torch.float64, requires_grad=True)
    log_p = logits.log_softmax(0)
    expected = torch.zeros((), dtype=torch.float64)
    estimate = torch.zeros(4, dtype=torch.float64)
    for drawn in np.ndindex(4, 4, 4):
        probability = log_p[list(drawn)].sum().exp()
        expected = expected + probability * value(drawn)
        for k, cell in enumerate(drawn):
            rest = value(drawn[:k] + drawn[k + 1 :])
            slope = torch.autograd.grad(log_p[cell], logits, retain_graph=True)[0]
            estimate += float(probability.detach()) * slope * (value(drawn) - rest)
    torch.testing.assert_close(estimate, torch.autograd.grad(expected, logits)[0])


@pytest.mark.slow
def test_the_gradient_is_that_of_finite_differences():
    p = problem(cells=40, saccades=6)
    x = vector(p.shape, [0.8, 0.1, 0.0], 0.15)
    estimate = estimate_gradient(p, x, "covered", 640)
    unit = torch.nn.functional.normalize(estimate.mean, dim=0)
    slope = slope_along(p, x, unit, 2560, step=0.2)
    check = agreement(estimate, finite_differences(p, x, 640, step=0.2), (unit, slope))
    assert check["cosine"] > 0.9
    assert abs(check["norm_ratio"] - 1) < 0.1 + 3 * check["norm_ratio_error"]


def test_agreement_sees_through_noise():
    rng = torch.Generator().manual_seed(0)
    truth = torch.tensor([3.0, 4.0, 0.0, 0.0], dtype=torch.float64)

    def noisy(factor, rows):
        return Sample(factor * truth + 20 * torch.randn(rows, 4, generator=rng, dtype=torch.float64), 32.0)

    unit = truth / 5
    slope = Sample(5 + torch.randn(400, 1, generator=rng, dtype=torch.float64))
    found = agreement(noisy(1.2, 4000), noisy(1.0, 400), (unit, slope))
    assert found["norm"] == pytest.approx(5, abs=3 * found["norm_error"] + 0.3)
    assert found["norm_ratio"] == pytest.approx(1.2, abs=3 * found["norm_ratio_error"] + 0.1)
    assert found["cosine"] < 0.98 and found["cosine_without_noise"] == pytest.approx(1, abs=0.25)
    assert found["snr_32_episodes"] == pytest.approx(6 / 40, rel=0.2)
    alone = agreement(noisy(1.2, 4000), noisy(1.0, 4000))
    assert alone["norm"] == pytest.approx(5, abs=3 * alone["norm_error"]) and alone["cosine"] > 0.9


@pytest.mark.parametrize("alpha", [True, False])
def test_the_field_of_view_is_tuned_by_common_random_numbers(alpha):
    p = problem(cells=30, saccades=5, fov_deg=50.0, tune_alpha=alpha)
    x = vector(p.shape)
    assert len(x) == p.shape.size == 10 + alpha and fov_of(p.shape, x) == pytest.approx(50)
    torch.testing.assert_close(fix_vector(p.shape, fix_vector(p.shape, x)), fix_vector(p.shape, x))
    wide = x.clone()
    wide[-1] = 9.0
    assert fov_of(p.shape, fix_vector(p.shape, wide)) == pytest.approx(150)
    wide[-1] = math.log(math.tan(math.radians(50)))
    plain = Problem(
        Task(Observer(camera=Pinhole.from_fov(100.0, 100.0)), 5), p.distribution, Shape(tune_alpha=alpha), 30
    )
    batch = p.batch(64, stream("training", 0))
    torch.testing.assert_close(play(p, wide, batch).value, play(plain, wide[:-1], batch).value)
    found = gradient(p, "coverage", x, batch, 0.5)
    assert found.vector[-1] > 0 and found.episodes == 64 + 64 * (1 + alpha)
    best = train(p, x, Schedule(160, scenes=4, warm_episodes=0, validations=2, validation_scenes=32)).vector
    assert fov_of(p.shape, best) > 60


@pytest.mark.parametrize("name", list(ESTIMATORS))
@pytest.mark.parametrize("shape", [{}, {"components": 2}, {"conditioned": True}, {"tune_alpha": False}], ids=str)
def test_every_estimator_is_finite_and_counts(name, shape):
    p = problem(cells=10, saccades=4, distribution=Distribution(cans=3, conditioned="conditioned" in shape), **shape)
    p.quadrature  # noqa: B018 - built once
    if name == "policy" and not p.shape.tune_alpha:
        with pytest.raises(SettingError, match="estimator = policy: expected tune_alpha=true or tune_weights"):
            ESTIMATORS[name](p, vector(p.shape), p.batch(2, stream("training", 0)))
        return
    found = ESTIMATORS[name](p, vector(p.shape), p.batch(2, stream("training", 0)), alpha_share=0.5)
    assert found.vector.shape == (p.shape.size,) and torch.isfinite(found.vector).all()
    assert found.episodes >= 2 and found.runs >= 2


def test_the_control_variate_leaves_the_mean_and_lowers_the_spread():
    p = problem(cells=40, saccades=5)
    x = vector(p.shape, [0.8, 0.45, -0.25], 0.05)
    found = {n: [] for n in ("counterfactual", "covered")}
    for k in range(30):
        for name, parts in found.items():
            parts.append(ESTIMATORS[name](p, x, p.batch(16, stream("training", 0, k)), alpha_share=0.0).vector)
    plain, covered = (torch.stack(found[name]) for name in ("counterfactual", "covered"))
    assert float(covered.std(0).norm()) < 0.9 * float(plain.std(0).norm())
    difference = (plain - covered).mean(0)
    error = (plain - covered).std(0) / math.sqrt(30)
    assert float(difference.norm()) < 3 * float(error.norm())


def test_training_gains_resumes_and_never_ends_below_its_start(tmp_path):
    p = problem()
    start = table_1(p.shape, "unbiased")
    schedule = Schedule(episodes=160, scenes=4, warm_episodes=40, validations=2, validation_scenes=48)
    whole = train(p, start, schedule, tmp_path / "whole.pt")
    assert whole.best_value > whole.history[0][1] + 0.05
    assert whole.best_value == max(v for _, v, _ in whole.history)

    class Stopped(Exception):
        pass

    def stop(state, value):
        if len(state.history) == 2:
            raise Stopped

    with pytest.raises(Stopped):
        train(p, start, schedule, tmp_path / "part.pt", stop)
    again = train(p, start, schedule, tmp_path / "part.pt")
    assert torch.equal(again.vector, whole.vector) and torch.equal(again.best, whole.best)
    assert again.history == whole.history and again.episodes == whole.episodes
    with pytest.raises(SettingError, match="checkpoint schedule"):
        train(p, start, Schedule(episodes=161), tmp_path / "part.pt")
    task, seer = p.task, p.task.observer
    narrow = replace(seer, camera=Pinhole.from_fov(60.0, 100.0))
    for name, other in {
        "saccades": task._replace(saccades=3), "far_m": task._replace(far_m=3.0),
        "metric": task._replace(metric="gap_final"), "camera": task._replace(observer=narrow),
        "head": task._replace(observer=replace(seer, head=Head(baseline_m=0.1))),
        "prior": task._replace(observer=replace(seer, prior=Prior(std=0.3))),
    }.items():  # fmt: skip
        with pytest.raises(SettingError, match=f"checkpoint {name} = "):
            train(Problem(other, p.distribution, p.shape, p.cells), start, schedule, tmp_path / "part.pt")
    kept = torch.load(tmp_path / "part.pt", weights_only=True)
    for name, wrong in {
        "vector": torch.full_like(start, torch.nan), "first": torch.zeros(2), "best": "abc", "history": [],
        "curve": None, "step": 99, "best_value": None, "episodes": math.inf, "unknown": 1,
    }.items():  # fmt: skip
        torch.save({**kept, "state": {**kept["state"], name: wrong}}, tmp_path / "bad.pt")
        with pytest.raises(SettingError, match=r"checkpoint = .*bad\.pt: expected a checkpoint of torchfovea tune"):
            train(p, start, schedule, tmp_path / "bad.pt")
    for content in (b"no checkpoint", b"", (tmp_path / "part.pt").read_bytes()[:-200]):
        (tmp_path / "bad.pt").write_bytes(content)
        with pytest.raises(SettingError, match=r"bad\.pt"):
            train(p, start, schedule, tmp_path / "bad.pt")


def test_a_step_that_is_not_finite_stops_and_keeps_the_checkpoint(tmp_path, monkeypatch):
    p = problem()
    real, calls = ESTIMATORS["counterfactual"], []

    def spoiled(*args, **settings):
        calls.append(1)
        found = real(*args, **settings)
        return found if len(calls) < 3 else found._replace(vector=found.vector * math.nan)

    monkeypatch.setitem(training.ESTIMATORS, "counterfactual", spoiled)
    schedule = Schedule(1000, 2, "counterfactual", warm_episodes=0, validations=500, validation_scenes=4)
    with pytest.raises(SettingError, match="not finite at step 2"):
        train(p, vector(p.shape), schedule, tmp_path / "c.pt")
    kept = torch.load(tmp_path / "c.pt", weights_only=True)["state"]
    assert kept["step"] == 2 and torch.isfinite(kept["vector"]).all()


def test_bad_schedules_and_shapes():
    for settings, words in (
        ({"estimator": "magic"}, "estimator = magic"),
        ({"rate": 0.0}, "rate"),
        ({"scenes": 0}, "scenes"),
        ({"alpha_share": 2.0}, "alpha_share"),
    ):
        with pytest.raises(SettingError, match=words):
            Schedule(**settings)
    with pytest.raises(SettingError, match="components"):
        Shape(0)
    with pytest.raises(SettingError, match=r"acquisition\.alpha"):
        vector(Shape(), alpha=0.0)
    with pytest.raises(SettingError, match="components"):
        encode(Shape(), direction_mixture([1.0, 1.0], [MEAN, MEAN], [[0.1] * 3] * 2), 1.0)


@pytest.mark.parametrize("name", list(SEARCHES))
def test_searches_spend_their_budget(name):
    pytest.importorskip({"cma_es": "cma", "tpe": "optuna"}.get(name, "torch"))
    p = problem(cells=8, saccades=3)
    seen = list(SEARCHES[name](p, table_1(p.shape, "unbiased"), 48, 0, per_evaluation=4))
    assert seen[-1][0] >= 48 and all(a < b for (a, _), (b, _) in pairwise(seen))
    assert all(x.shape == (p.shape.size,) and torch.isfinite(x).all() for _, x in seen)


def test_curves_and_hand():
    assert budgets_up_to(600) == [64, 128, 256, 512, 600]
    p = problem(cells=20, saccades=4)
    by_hand, sigma = hand(p, scenes=64, sigmas=(0.05, 0.16, 0.5))
    assert sigma == 0.16
    start = table_1(p.shape, "top")
    better, worse = (evaluate_bias(p, x, p.exam("heldout", 0, 64)) for x in (by_hand, start))
    assert float((better - worse).mean()) > 0.1
    schedule, heldout = Schedule(episodes=150, validation_scenes=16), Heldout(16, 1)
    whole = list(curves(p, start, ["coverage+none", "random@16"], 2, schedule, heldout))
    assert [[row[:3] for row in curve] for curve in whole[:2]] == [
        [("coverage+none", s, b) for b in (64, 128, 150)] for s in (0, 1)
    ]
    for curve in whole:
        assert all(a.validation <= b.validation for a, b in pairwise(curve))
    rest = list(
        curves(p, start, ["coverage+none", "random@16"], 2, schedule, heldout, {("coverage+none", 0), ("random@16", 0)})
    )
    assert rest == whole[1::2]


def test_an_incumbent_is_not_credited_before_its_episodes_are_spent(monkeypatch):
    p = problem(cells=8, saccades=3)
    start, later = table_1(p.shape, "top"), hand(p, scenes=16, sigmas=(0.16,))[0]
    monkeypatch.setitem(SEARCHES, "random", lambda *_: iter([(65, later), (200, start)]))
    (curve,) = curves(p, start, ["random"], 1, Schedule(episodes=256, validation_scenes=64), Heldout(64, 1))
    before, after, _ = (row.heldout for row in curve)
    assert before == float(evaluate_bias(p, start, p.exam("heldout", 1, 64)).mean())
    assert after == float(evaluate_bias(p, later, p.exam("heldout", 1, 64)).mean()) > before
    assert curve[2].heldout == after and curve[2].heldout_last == before


def test_an_incumbent_out_of_reach_scores_nothing_and_a_method_that_fails_ends(monkeypatch):
    p = problem(cells=8, saccades=3)
    start, behind = table_1(p.shape, "top"), vector(p.shape, [-1.0, 0.0, 0.0], 1e-3)
    monkeypatch.setitem(SEARCHES, "random", lambda *_: iter([(65, behind)]))
    schedule = Schedule(episodes=130, validation_scenes=16, warm_episodes=0)
    (curve,) = curves(p, start, ["random"], 1, schedule, Heldout(16, 1))
    assert curve[-1].heldout_last == 0 and curve[-1].heldout == curve[0].heldout > 0

    def failing(problem, x, batch, alpha_share):
        raise SettingError("reachable = nothing: expected something")

    monkeypatch.setitem(ESTIMATORS, "coverage", failing)
    (curve,) = curves(p, start, ["coverage"], 1, schedule, Heldout(16, 1))
    assert {row.heldout_last for row in curve} == {curve[0].heldout}


def test_means_over_seeds_and_episodes_to_reach():
    mean, low, high = student([1.0, 2.0, 3.0])
    assert (mean, high - mean) == (2.0, pytest.approx(4.30 / math.sqrt(3))) and low == pytest.approx(4 - high)
    assert student([0.5]) == (0.5, 0.5, 0.5)
    found = episodes_to_reach({64: [0.1, 0.3], 128: [0.3, 0.5], 256: [0.5, 0.7]}, 0.5)
    assert found["episodes"] == pytest.approx(128 * math.sqrt(2)) and found["low"] <= found["episodes"] <= found["high"]
    assert found["low"] == 128 and found["high"] == 256
    assert episodes_to_reach({64: [0.1]}, 0.5)["episodes"] == math.inf


def test_the_prior_field_is_the_moments_of_what_there_is():
    scenes = draw_scenes(Distribution(cans=3), HEAD, 60, stream("training", 0))
    direction = sphere_quadrature(3000, lambda d: reachable(HEAD, d)).directions
    field = fit_closed_form(scenes, direction)
    hits = first_surfaces(scenes, torch.zeros(60, 1, 3), direction.expand(60, -1, -1))
    rho = np.where(hits.floor, 1 / 6, 1 / hits.range_m.numpy())
    kernel = np.exp(150 * (direction @ direction.T - 1).numpy())
    kernel /= kernel.sum(1, keepdims=True)
    np.testing.assert_allclose(field.mean, kernel @ rho.mean(0), rtol=1e-4)
    assert (field.std > 0).all()
    mean, std = look_up(field, direction[None, :7])
    assert mean.shape == std.shape == (1, 7)
    learned = fit_by_gradient(scenes, direction, steps=30)
    assert float((learned.mean - field.mean).abs().mean()) < 0.1
    p = problem()
    informed = Problem(p.task, p.distribution, p.shape, p.cells, field=field)
    batch = informed.batch(3, stream("training", 0))
    world = prepare(informed, informed.bias(vector(p.shape), batch.scenes), batch)
    assert float(world.prior_mean.std()) > 0
    assert np.isfinite(counterfactual(informed, vector(p.shape), batch).value)


def test_the_blurred_panorama_has_a_gradient():
    scenes = draw_scenes(Distribution(cans=3), HEAD, 2, stream("training", 0), torch.float64)
    direction = torch.nn.functional.normalize(torch.tensor([[[1.0, 0.5, -0.2]], [[1.0, 0.4, -0.3]]]).double(), dim=-1)
    direction.requires_grad_()
    rho, floor = panorama(scenes, direction)
    assert 0 <= float(floor.detach().min()) and float(floor.detach().max()) <= 1 + 1e-12
    slope = torch.autograd.grad(rho.sum(), direction)[0]
    assert torch.isfinite(slope).all() and float(slope.abs().max()) > 0


def test_the_command_keeps_its_contract(tmp_path, capsys):
    small = ["profile=quick", "episodes=40", "scenes=2", "memory.cells=12", "saccades=4", "validation_scenes=8"]
    small += ["heldout_scenes=12", "check_episodes=8", "distribution.cans=3", "warm_episodes=8"]
    study = ["study=curves", "methods=[coverage,random]", "seeds=2"]
    folder = tmp_path / "run"
    again = ["tune", *small, *study, f"hydra.run.dir={folder}"]
    assert main(again) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(folder)
    result = json.loads((folder / "result.json").read_text())
    table = (folder / "curves.csv").read_text()
    # killed in the middle of a curve: it goes on, to the same end
    (folder / "curves.csv").write_text("".join(table.splitlines(keepends=True)[:3]))
    (folder / "result.json").unlink()
    assert main(again) == 0
    assert (folder / "curves.csv").read_text() == table and json.loads((folder / "result.json").read_text()) == result
    assert main([*again, "seeds=3"]) == 1
    assert "made with other settings" in capsys.readouterr().err
    rivals = ("hand", "fitted", "remembered", "prior_field", "tuned_with_prior_field")
    for policy in ("unbiased", "top", "down", "target", "tuned", *rivals):
        low, mid, high = (result[f"heldout.{policy}.{k}"] for k in ("ci_low", "gap_per_saccade", "ci_high"))
        assert 0 <= low <= mid <= high <= 1
    assert result["episodes_used"] >= 40 and result["curves.random.heldout"] > 0
    drawn = ("bias.png", "learning.png", "curves.png")
    for name in (*drawn, "curves.csv", "curves_summary.csv", "reach.csv", "tuning.csv", "checkpoint.pt"):
        assert (folder / name).stat().st_size > 0
    memory = OmegaConf.load(folder / "memory" / "tuned.yaml")
    memory.cells = 30
    cells = build_cells(OmegaConf.create({"memory": memory}), HEAD, torch.Generator().manual_seed(0))
    assert cells.shape == (30, 3) and reachable(HEAD, cells).all()
    assert OmegaConf.load(folder / "memory" / "hand.yaml").name == "hand"
    # the full simulator takes memory and scenes
    tuned = ["memory=tuned", "scene=left_below", "scene.cans=3", "fidelity=geometric", "memory.cells=50"]
    tuned += ["sensor.receptive_fields=500", "sensor.fov_deg=90", "episodes=1", "saccades=2", "picture=false"]
    assert main(["search", "--config-dir", str(folder), *tuned, f"hydra.run.dir={tmp_path}/search"]) == 0
    assert (tmp_path / "search" / "result.json").exists()


def test_the_gradients_study(tmp_path):
    small = ["profile=quick", "episodes=40", "scenes=2", "memory.cells=12", "saccades=4", "validation_scenes=8"]
    small += ["heldout_scenes=12", "check_episodes=256", "distribution.cans=3", "prior_field=false"]
    study = ["study=gradients", "estimators=[counterfactual,coverage]"]
    assert main(["tune", *small, *study, f"hydra.run.dir={tmp_path}/run"]) == 0
    rows = (tmp_path / "run" / "gradients.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 2 and rows[1].startswith("start,counterfactual,")
    assert (tmp_path / "run" / "gradients.png").stat().st_size > 0


def test_the_commands_mistakes_are_one_line(tmp_path, capsys):
    for settings, words in (
        (["resume=nowhere.pt"], "resume = nowhere.pt"),
        (["estimator=magic"], "estimator = magic"),
        (["start=magic"], "start = magic: expected one of memory, hand, fitted, remembered"),
        (["start_episodes=3"], "start_episodes = 3"),
        (["tune_fov=true", "sensor.fov_deg=170"], "sensor.fov_deg = 170"),
        (["memory=geodesic"], "memory = geodesic"),
        (["distribution.regions=[[100,120,0,10]]"], "distribution.regions"),
        (["study=true"], "study = True"),
        (
            ["study=curves", "methods=[magic]", "episodes=1", "validation_scenes=1", "heldout_scenes=2"],
            "methods = magic",
        ),
        (["study=gradients", "estimators=[random]", "episodes=1", "heldout_scenes=2"], "estimators = random"),
    ):
        assert main(["tune", "profile=quick", "prior_field=false", *settings, f"hydra.run.dir={tmp_path}/bad"]) == 1
        assert words in capsys.readouterr().err
