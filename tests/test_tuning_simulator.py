"""The fast simulator against NumPy loops, its sensor law against `observe`, its scenes against their promises."""

import math

import numpy as np
import pytest
import torch

from torchfovea.deciding.weighted import Weighting
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.geometric import correspond_points
from torchfovea.sensing.head import Eyes, Gaze, Head, cyclopean, eyes, fixate, to_ego
from torchfovea.sensing.layout import Uniform
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.tuning.bias import Shape
from torchfovea.tuning.problem import Problem
from torchfovea.tuning.scenes import Distribution, Scenes, draw_scenes, first_surfaces, stream
from torchfovea.tuning.simulator import Resumed, best_cell, score, simulate
from torchfovea.tuning.worlds import Known, Task, empty, glance, look, world_of

HEAD = Head()


def observer(fov_deg=90.0, **settings):
    return Observer(camera=Pinhole.from_fov(fov_deg, 100.0), **settings)


def directions(shape, seed=0, dtype=torch.float64):
    rng = torch.Generator().manual_seed(seed)
    spread = torch.randn(*shape, 3, generator=rng, dtype=torch.float64) * torch.tensor([0.2, 0.6, 0.3])
    return torch.nn.functional.normalize(spread + torch.tensor([1.0, 0, -0.2]), dim=-1).to(dtype)


@pytest.mark.parametrize("fov_deg", [60.0, 135.0])
@pytest.mark.parametrize("uniform", [False, True])
def test_the_variance_law_is_that_of_observe(fov_deg, uniform):
    seer = observer(fov_deg, **({"retina": Uniform()} if uniform else {}))
    rng = torch.Generator().manual_seed(0)
    point = torch.randn(2000, 3, generator=rng, dtype=torch.float64) * torch.tensor([0.4, 0.7, 0.4])
    point = point + torch.tensor([1.4, 0.3, 0.0])
    gaze = fixate(HEAD, torch.tensor([1.0, 0.4, -0.2], dtype=torch.float64))[0]
    pose = eyes(HEAD, gaze)
    seen = to_ego(pose.R_left.mT, point - pose.t_left)
    left = seer.camera.project(seen)
    visible = seer.retina.inside(left) & seer.camera.in_view(seen)
    matches = correspond_points(point, visible, left, pose, seer.camera, seer.retina, seer.budget)
    expected = observe(matches, pose, seer.camera, seer.retina.width_px(left) / 2)
    range_m = point.norm(dim=-1)
    batch = Eyes(*(part[None] for part in pose))
    found, variance = glance(seer, batch, (point / range_m[:, None])[None], range_m[None])
    assert torch.equal(found[0], expected.valid)
    ratio = (variance[0] / expected.cov[:, 5])[expected.valid]
    assert expected.valid.sum() > 300
    assert 0.93 < float(ratio.min()) and float(ratio.max()) < 1.07
    assert abs(float(ratio.median()) - 1) < 2e-3


def ray_by_loop(scenes, b, origin, direction):
    """First surface by marching over every candidate intersection, in plain Python."""
    front, back, side, floor, ceiling = scenes.walls
    best, kind = math.inf, "wall"
    for axis, limits in enumerate(((-back, front), (-side, side), (floor, ceiling))):
        for limit in limits:
            if abs(direction[axis]) > 1e-12:
                t = (limit - origin[axis]) / direction[axis]
                if 1e-9 < t < best:
                    best, kind = t, "floor" if axis == 2 and limit == floor else "wall"
    for i in range(scenes.x.shape[1]):
        x, y, low, high, radius = (float(f[b, i]) for f in scenes[:5])
        p = np.array([origin[0] - x, origin[1] - y])
        d = np.array(direction[:2])
        roots = np.roots([d @ d, 2 * p @ d, p @ p - radius**2])
        for t in (r.real for r in roots if abs(r.imag) < 1e-12):
            if 0 < t < best and low <= origin[2] + t * direction[2] <= high:
                best, kind = t, i
        for level in (low, high) if direction[2] != 0 else ():
            t = (level - origin[2]) / direction[2]
            if 0 < t < best and np.hypot(*(p + t * d)) <= radius:
                best, kind = t, i
    return best, kind


def test_rays_are_those_of_a_loop():
    scenes = draw_scenes(Distribution(), HEAD, 6, stream("training", 3), torch.float64)
    # half of the rays at the cans, whose caps are seen from above
    at = torch.stack((scenes.x, scenes.y, scenes.high), -1)
    jitter = 0.06 * torch.randn(6, 28, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    aim = at - torch.tensor([0.05, -0.02, 0.14])
    aimed = torch.nn.functional.normalize(aim.repeat(1, 4, 1) + jitter, dim=-1)
    direction = torch.cat((directions((6, 30)), aimed), 1)
    origin = torch.tensor([0.05, -0.02, 0.12], dtype=torch.float64).expand(6, 1, 3)
    hits = first_surfaces(scenes, origin, direction)
    cans = 0
    for b in range(6):
        for k in range(direction.shape[1]):
            far, kind = ray_by_loop(scenes, b, origin[b, 0].numpy(), direction[b, k].numpy())
            assert float(hits.range_m[b, k]) == pytest.approx(far, rel=1e-9)
            assert bool(hits.floor[b, k]) == (kind == "floor")
            assert int(hits.can[b, k]) == (kind if isinstance(kind, int) else -1)
            cans += isinstance(kind, int)
    assert cans > 40


def test_rays_are_differentiable_where_the_surface_stays():
    scenes = draw_scenes(Distribution(), HEAD, 2, stream("training", 4), torch.float64)
    direction = directions((2, 3), seed=5).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d: first_surfaces(scenes, torch.zeros(2, 1, 3).double(), d).range_m, direction
    )


def episode_by_loop(task, scenes, b, world, alpha):
    """One episode, cell by cell, in Python, with the same sensor law."""
    head, limits = task.observer.head, task.observer.eligibility
    cells = world.direction.shape[1]
    precision = [task.observer.prior.std**-2] * cells
    vector = [task.observer.prior.mean * p for p in precision]
    seen = [False] * cells
    gaze = Gaze(*(torch.zeros(1, dtype=torch.float64) for _ in range(3)))
    rewards, chosen = [], []
    for t in range(task.saccades):
        R, o = (a[0].numpy() for a in cyclopean(head, gaze))
        far, kind = ray_by_loop(scenes, b, o, R[:, 2])
        point = o + far * R[:, 2]
        rewards.append(-task.far_m if kind == "floor" else -min(np.linalg.norm(point), task.far_m))
        for i in range(cells):
            direction, range_m = world.direction[b, i], world.range_m[b, i]
            visible, variance = glance(task.observer, eyes(head, gaze), direction[None, None], range_m[None, None])
            if bool(visible):
                v = float(variance)
                precision[i] += 1 / v
                vector[i] += (1 / float(range_m) + math.sqrt(v) * float(world.noise[t, b, i])) / v
                seen[i] = True
        best, which = -math.inf, -1
        for i in range(cells):
            mean = vector[i] / precision[i]
            place = world.direction[b, i] / max(mean, 1e-3)
            unsure = abs(float(world.direction[b, i, 2])) / max(mean, 1e-3) ** 2 / math.sqrt(precision[i])
            surely = float(place[2]) - limits.ground_sigmas * unsure
            ground = seen[i] and surely + head.ego_height_m < limits.ground_z_m
            if bool(fixate(head, place)[1]) and float(place.norm()) > limits.nearest_m and not ground:
                value = mean + alpha / math.sqrt(precision[i])
                if value > best:
                    best, which, aim = value, i, place
        chosen.append(which)
        gaze = Gaze(*(a[None] for a in fixate(head, aim)[0])) if which >= 0 else gaze._replace(pan=gaze.pan * 0)
    nearest = float(scenes.nearest_m[b])
    gaps = [(max(rewards[: t + 1]) - rewards[0]) / (-nearest - rewards[0]) for t in range(task.saccades)]
    return float(np.clip(gaps, 0, 1).mean()), rewards, chosen[:-1]


def small(dtype=torch.float64, scenes=3, cells=25, saccades=5, **settings):
    task = Task(observer(75.0, **settings), saccades)
    drawn = draw_scenes(Distribution(), HEAD, scenes, stream("training", 1), dtype)
    noise = torch.randn(saccades, scenes, cells, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return task, drawn, world_of(task, drawn, directions((scenes, cells), dtype=dtype), noise.to(dtype))


def test_an_episode_is_that_of_a_loop():
    task, scenes, world = small()
    run = simulate(task, scenes, world, Weighting(torch.tensor(0.7, dtype=torch.float64)))
    for b in range(3):
        value, rewards, chosen = episode_by_loop(task, scenes, b, world, 0.7)
        assert run.cell[b, 1:].tolist() == chosen
        np.testing.assert_allclose(run.reward[b], rewards, rtol=1e-9)
        assert float(run.value[b]) == pytest.approx(value, rel=1e-9)


def test_a_batch_is_its_episodes(dtype):
    task, scenes, world = small(dtype, scenes=5)
    weights = Weighting(torch.tensor(0.3, dtype=dtype))
    together = simulate(task, scenes, world, weights)
    for b in range(5):
        one = torch.tensor([b])
        alone = simulate(task, scenes.take(one), world.take(one), weights)
        assert torch.equal(alone.cell[0], together.cell[b])
        torch.testing.assert_close(alone.value[0], together.value[b])


def test_a_later_start_goes_on_as_the_whole_run():
    task, scenes, world = small(scenes=6, saccades=7)
    weights = Weighting(torch.tensor(0.5, dtype=torch.float64))
    whole = simulate(task, scenes, world, weights, keep=True)
    made = torch.tensor([0, 4, 2, 5, 1, 2])
    row = torch.arange(6)
    memory = Known(*(torch.stack(parts)[made, row] for parts in zip(*whole.memories, strict=True)))
    later = simulate(task, scenes, world, weights, Resumed(memory, made, whole.reward, whole.gaze))
    torch.testing.assert_close(later.value, whole.value)
    torch.testing.assert_close(later.reward, whole.reward)


def test_the_reward_in_range_is_a_setting():
    task, _, world = small(reward="range")
    memory = look(task, world, empty(world), eyes(HEAD, Gaze(*(torch.zeros(3).double(),) * 3)), 0)
    value = score(task, world, memory, Weighting(0.0))[0]
    eligible = torch.isfinite(value)
    torch.testing.assert_close(value[eligible], -(memory.precision / memory.vector)[eligible])


def test_nothing_eligible_looks_ahead():
    task, scenes, world = small()
    world = world._replace(allowed=torch.zeros_like(world.allowed))
    run = simulate(task, scenes, world, Weighting(1.0))
    assert (run.cell == -1).all() and torch.isfinite(run.value).all()
    assert best_cell(torch.tensor([[1.0, 3.0, 3.0], [-math.inf] * 3]))[1].tolist() == [1, -1]


@pytest.mark.parametrize("name", ["left_below", "bimodal", "conditioned"])
def test_scenes_keep_their_promises(name):
    regions = {
        "left_below": ((15.0, 45.0, -23.0, -7.0),),
        "bimodal": ((20.0, 45.0, -23.0, -9.0), (-45.0, -20.0, -4.0, 8.0)),
        "conditioned": ((-42.0, 42.0, -20.0, 6.0),),
    }[name]
    distribution = Distribution(name=name, regions=regions, conditioned=name == "conditioned")
    scenes = draw_scenes(distribution, HEAD, 200, stream("validation", 0), torch.float64)
    azimuth = torch.rad2deg(torch.atan2(scenes.y[:, 0], scenes.x[:, 0]))
    middle = (scenes.low + scenes.high)[:, 0] / 2
    elevation = torch.rad2deg(torch.atan2(middle, torch.hypot(scenes.x[:, 0], scenes.y[:, 0])))
    if name == "conditioned":
        assert (azimuth - 42 * scenes.task[:, 0]).abs().max() <= 8 + 1e-9
        assert scenes.task.abs().max() <= 1
    else:
        inside = [(azimuth >= a) & (azimuth <= b) & (elevation >= c) & (elevation <= d) for a, b, c, d in regions]
        assert torch.stack(inside).any(0).all() and all(mode.any() for mode in inside)
        assert (scenes.task == 0).all()
    # the target is nearest, in sight from E
    flat = torch.hypot(scenes.x, scenes.y) - scenes.radius
    nearest = torch.hypot(flat, torch.zeros_like(flat).clamp(min=scenes.low, max=scenes.high))
    assert (nearest[:, 1:] >= nearest[:, :1] + distribution.margin_m - 1e-9).all()
    torch.testing.assert_close(nearest[:, 0], scenes.nearest_m)


def test_splits_share_nothing():
    drawn = {s: torch.rand(3, generator=stream(s, 0)).tolist() for s in ("training", "validation", "heldout")}
    assert len({tuple(v) for v in drawn.values()}) == 3
    assert torch.rand(3, generator=stream("training", 0)).tolist() == drawn["training"]
    with pytest.raises(SettingError, match="split = test"):
        stream("test", 0)


def test_bad_distributions_say_so():
    for settings, words in (
        ({"regions": ((100.0, 120.0, 0.0, 10.0),)}, "distribution.regions"),
        ({"cans": 1}, "distribution.cans"),
        ({"regions": ()}, "at least one region"),
        ({"range_m": (3.0, 1.0)}, "distribution.range_m"),
        ({"regions": ((0.0, 1.0, 0.0, 1.0),) * 2, "conditioned": True}, "one region"),
        ({"azimuth_deg": (0.0, 0.5), "elevation_deg": (0.0, 0.5), "cans": 19}, "distribution.cans"),
    ):
        with pytest.raises(SettingError, match=words):
            draw_scenes(Distribution(**{"tries": 20, **settings}), HEAD, 4, stream("training", 0))


def test_observers_that_are_not_modelled_are_refused():
    with pytest.raises(SettingError, match="pinhole"):
        Problem(Task(Observer(camera=Fisheye.from_fov(90.0, 100.0))), Distribution(), Shape())
    for settings, words in (({"cells": 1}, "memory.cells"),):
        with pytest.raises(SettingError, match=words):
            Problem(Task(observer()), Distribution(), Shape(), **settings)
    with pytest.raises(SettingError, match="metric"):
        Problem(Task(observer(), metric="speed"), Distribution(), Shape())


def test_scenes_are_taken_by_index():
    scenes = draw_scenes(Distribution(), HEAD, 4, stream("training", 0))
    part = scenes.take(torch.tensor([2, 0]))
    assert isinstance(part, Scenes) and torch.equal(part.x, scenes.x[[2, 0]]) and part.walls == scenes.walls
