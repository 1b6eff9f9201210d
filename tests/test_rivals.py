"""Rivals of the gradient: fits against moments and regressions by NumPy, and what they may and may not see."""

import math

import numpy as np
import pytest
import torch

from torchfovea.memory.sphere import direction_mixture, log_density
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, cyclopean
from torchfovea.setting import SettingError
from torchfovea.tuning import rivals
from torchfovea.tuning.baselines import hand, table_1
from torchfovea.tuning.bias import Shape, decode, features, mixture_of
from torchfovea.tuning.problem import Problem, evaluate_bias, play
from torchfovea.tuning.scenes import Distribution, first_surfaces, stream
from torchfovea.tuning.simulator import Run
from torchfovea.tuning.study import Heldout, check_methods, curves
from torchfovea.tuning.train import Schedule
from torchfovea.tuning.worlds import Task

NO_TASK = torch.zeros(1, 2)


def problem(**shape):
    task = Task(Observer(camera=Pinhole.from_fov(90.0, 100.0)), 6)
    return Problem(task, Distribution(cans=3), Shape(**shape), 40)


def around(centre, n, spread=0.15, seed=0):
    v = torch.tensor(centre, dtype=torch.float64)
    v = v + spread * torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(v, dim=-1)


def test_one_component_has_the_moments_of_the_directions():
    u = around([0.8, 0.4, -0.3], 60)
    found = mixture_of(Shape(), rivals.fit_vector(Shape(), u, NO_TASK.expand(60, 2), 0.3))
    x = u.numpy()
    covariance = np.cov(x.T, bias=True) + 0.05**2 * np.eye(3)
    wanted = direction_mixture([1.0], [x.mean(0).tolist()], torch.from_numpy(covariance)[None], dtype=torch.float64)
    elsewhere = around([0.5, 0.0, 0.0], 40, 0.5, seed=1)
    torch.testing.assert_close(log_density(found, elsewhere), log_density(wanted, elsewhere))


def test_two_components_find_two_heaps():
    heaps = [around([0.8, 0.5, -0.3], 40, 0.05), around([0.8, -0.5, 0.2], 120, 0.05, seed=1)]
    shape = Shape(2)
    found = mixture_of(shape, rivals.fit_vector(shape, torch.cat(heaps), NO_TASK.expand(160, 2), 1.0))
    weights = found.logits.softmax(-1)
    order = weights.argsort()
    torch.testing.assert_close(weights[order], torch.tensor([0.25, 0.75], dtype=torch.float64), atol=1e-3, rtol=0)
    for m, heap in zip(order, heaps, strict=True):
        assert float(torch.nn.functional.cosine_similarity(found.means[m], heap.mean(0), dim=0)) > 1 - 1e-6


@pytest.mark.parametrize("components", [1, 2])
def test_a_conditioned_mean_follows_the_task(components):
    rng = torch.Generator().manual_seed(0)
    task = 2 * torch.rand(80, 2, generator=rng, dtype=torch.float64) - 1
    coefficients = torch.tensor(
        [[0.9, 0.1, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3], [-0.1, 0, 0], [0, 0.05, 0], [0, 0, 0.1]]
    )
    u = features(task) @ coefficients.double()
    shape = Shape(components, conditioned=True)
    bias = decode(shape, rivals.fit_vector(shape, u, task, 1.0), task[:5])
    wanted = torch.from_numpy(np.linalg.lstsq(features(task).numpy(), u.numpy(), rcond=None)[0])
    torch.testing.assert_close(bias.means, (features(task[:5]) @ wanted)[:, None].expand(-1, components, -1))
    assert float(bias.weights.alpha) == pytest.approx(1.0)


def test_what_cannot_be_fitted_is_named():
    one = around([0.8, 0.4, -0.3], 1).expand(9, 3)
    with pytest.raises(SettingError, match="directions to fit = 1: expected at least 2 different"):
        rivals.fit_vector(Shape(), one, NO_TASK.expand(9, 2), 1.0)
    with pytest.raises(SettingError, match="directions to fit = 3: expected at least 4"):
        rivals.fit_vector(Shape(3), around([0.8, 0.4, 0], 3), NO_TASK.expand(3, 2), 1.0)
    with pytest.raises(SettingError, match="tasks to fit = 9"):
        rivals.fit_vector(Shape(conditioned=True), around([0.8, 0.4, 0], 9), NO_TASK.expand(9, 2), 1.0)


def test_what_is_noted_is_the_surface_that_the_gaze_met():
    p = problem()
    batch = p.batch(12, stream("training", 0))
    run = play(p, table_1(p.shape, "target"), batch)
    noted = rivals.note_best(p, batch.scenes, run)
    time = run.reward.argmax(1)
    gaze = Gaze(*(angle.gather(1, time[:, None])[:, 0] for angle in run.gaze))
    rotation, origin = cyclopean(p.task.observer.head, gaze)
    axis = rotation[..., 2]
    point = origin + first_surfaces(batch.scenes, origin[:, None], axis[:, None]).range_m * axis
    torch.testing.assert_close(noted.range_m, point.norm(dim=-1))
    torch.testing.assert_close(noted.direction, torch.nn.functional.normalize(point, dim=-1))


def test_nothing_to_remember_is_named():
    p = problem()
    scenes = p.batch(3, stream("training", 0)).scenes
    gaze = Gaze(*torch.zeros(3, 3, 6))
    blind = Run(torch.zeros(3), torch.full((3, 6), -p.task.far_m), torch.zeros(3, 6), torch.zeros(3, 6), gaze, [])
    noted = rivals.note_best(p, scenes, blind)
    assert len(noted.range_m) == 0
    with pytest.raises(SettingError, match="fixations to remember = 0: expected at least one episode"):
        rivals.nearest_share(noted)


def test_the_farthest_fifth_is_forgotten():
    noted = rivals.Noted(around([1, 0, 0], 10), torch.arange(10.0).flip(0), torch.zeros(10, 2))
    assert sorted(rivals.nearest_share(noted).range_m.tolist()) == list(range(8))


@pytest.mark.parametrize("name", ["fitted", "remembered"])
def test_rivals_gain_much_in_few_episodes(name, monkeypatch):
    p = problem()
    start = table_1(p.shape, "unbiased")
    if name == "remembered":  # it never asks where the target stands

        def hidden(*_):
            raise AssertionError

        monkeypatch.setattr(rivals, "nearest_point", hidden)
    spent, vectors = zip(*rivals.RIVALS[name](p, start, 128, 0), strict=True)
    assert list(spent) == sorted(spent) and spent[-2] < 128 <= spent[-1]
    before, after = (float(evaluate_bias(p, v, p.exam("heldout", 1, 128)).mean()) for v in (start, vectors[-2]))
    assert after > before + 0.05
    again = dict(rivals.RIVALS[name](p, start, 128, 0))
    assert all(torch.equal(again[k], v) for k, v in zip(spent, vectors, strict=True))


def test_alpha_is_the_best_on_validation_scenes():
    p = problem()
    vector = table_1(p.shape, "target")
    chosen, score = rivals.best_alpha(p, vector, 32, (0.1, 1.0, 2.5))
    scores = [
        float(evaluate_bias(p, rivals.with_alpha(p.shape, vector, a), p.exam("validation", 0, 32)).mean())
        for a in (0.1, 1.0, 2.5)
    ]
    assert score == max(scores)
    assert math.exp(float(chosen[p.shape.body])) == pytest.approx((0.1, 1.0, 2.5)[scores.index(max(scores))])
    by_hand, _ = hand(p, 1.0, 32, (0.2,))
    assert min(abs(math.exp(float(by_hand[p.shape.body])) - alpha) for alpha in rivals.ALPHAS) < 1e-6
    fixed = problem(tune_alpha=False, alpha=0.7)
    assert torch.equal(rivals.best_alpha(fixed, table_1(fixed.shape, "target"), 8)[0], table_1(fixed.shape, "target"))


def test_rivals_have_learning_curves():
    p = problem()
    schedule = Schedule(episodes=128, validation_scenes=16)
    found = curves(p, table_1(p.shape, "unbiased"), ["fitted", "remembered"], 1, schedule, Heldout(16, 1))
    assert [[row[:3] for row in curve] for curve in found] == [
        [(name, 0, 64), (name, 0, 128)] for name in ("fitted", "remembered")
    ]
    with pytest.raises(SettingError, match="methods = fitted@8"):
        check_methods(["fitted@8"])
