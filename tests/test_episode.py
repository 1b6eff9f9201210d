"""The step and the episode in a world of spheres whose rays are known in closed form."""

import math
from functools import partial

import pytest
import torch

from torchfovea.arena import Arenas, Fixation, Truth
from torchfovea.deciding.strategies import expected_improvement, probability_of_improvement, upper_confidence_bound
from torchfovea.episode import Rules, run_episode, run_episodes
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Eligibility, Observer, decide, new_memory, perceive
from torchfovea.rows import stack
from torchfovea.search import Look, Move, search
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.geometric import correspond_points, with_noise
from torchfovea.sensing.head import Gaze, Head, clamp_gaze, cyclopean, eyes, fixate, to_ego
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError

HEAD = Head()
ROOM_M = 3.0
BALL, RADIUS_M = torch.tensor([0.6, 0.5, -0.1], dtype=torch.float64), 0.12


def meet(origin: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """First surface on rays (..., 3): the ball or the room around E; the point and whether it is the ball."""
    direction = direction / direction.norm(dim=-1, keepdim=True)
    shift = origin - BALL
    b = (shift * direction).sum(-1)
    root = b * b - (shift * shift).sum(-1) + RADIUS_M**2
    near = -b - root.clamp(min=0).sqrt()
    ball = (root > 0) & (near > 0)
    b = (origin * direction).sum(-1)
    far = -b + (b * b - (origin * origin).sum(-1) + ROOM_M**2).sqrt()
    return origin + torch.where(ball, near, far)[..., None] * direction, ball


class Spheres:
    """A ball in a spherical room."""

    def __init__(self, observer: Observer) -> None:
        self.observer = observer

    def saccade(self, gaze: Gaze) -> Move:
        return Move(clamp_gaze(HEAD, Gaze(*(a.double() for a in gaze))), 0.1, 1.0)

    def look(self, gaze: Gaze, generator: torch.Generator) -> Look:
        o, dtype = self.observer, gaze.pan.dtype
        pose = eyes(HEAD, gaze)
        px = o.retina.centers_px(dtype=dtype)
        points, _ = meet(pose.t_left.double(), to_ego(pose.R_left, o.camera.rays(px)).double())
        again, _ = meet(pose.t_right.double(), points - pose.t_right.double())
        visible = (again - points).norm(dim=-1) < 1e-6
        matches = correspond_points(points.to(dtype), visible, px, pose, o.camera, o.retina, o.budget)
        return Look(with_noise(matches, o.retina, generator))

    def fixation(self, gaze: Gaze) -> Fixation:
        rotation, origin = cyclopean(HEAD, Gaze(*(a.double() for a in gaze)))
        point, ball = meet(origin, rotation[:, 2])
        return Fixation(point, float(point.norm()), False, bool(ball))

    def truth(self, cells: torch.Tensor) -> Truth:
        nearest = BALL * (1 - RADIUS_M / BALL.norm())
        points, _ = meet(torch.zeros(3, dtype=torch.float64), cells.double())
        return Truth(float(nearest.norm()), nearest.to(cells), points.to(cells))


def small(**changes) -> Observer:
    settings = {"camera": Pinhole.from_fov(90, 100), "retina": LogPolar(1500), **changes}
    return Observer(head=HEAD, **settings)


def cells_in_reach(count: int, dtype=torch.float64) -> torch.Tensor:
    directions = fibonacci_directions(count, dtype)
    return directions[fixate(HEAD, directions)[1]]


def run(observer: Observer, seed: int = 0, saccades: int = 8, dtype=torch.float64, cells: int = 4000, **rules):
    arena, memory = Spheres(observer), new_memory(observer, cells_in_reach(cells, dtype))
    generator = torch.Generator().manual_seed(seed)
    return run_episode(observer, memory, arena, arena.truth(memory.cells), generator, Rules(saccades, **rules))


@pytest.mark.parametrize("retina", [LogPolar(1500), Uniform(1500)], ids=["log_polar", "uniform"])
@pytest.mark.parametrize(
    "acquisition", [partial(upper_confidence_bound, alpha=1.0), probability_of_improvement, expected_improvement]
)
def test_finds_the_ball(retina, acquisition):
    episode = run(small(retina=retina), strategy=acquisition)
    assert bool(episode.hit.any()) and episode.moves <= 7
    assert episode.gap[-1] > 0.9 and episode.target_error_m < 0.05
    assert bool((episode.gap.diff() >= 0).all()) and bool((episode.global_information.diff() > 0).all())


@pytest.mark.parametrize("name", ["printed", "aligned"])
def test_the_other_fusions_run_to_the_end(name):
    fusion = Fusion(name)
    episode = run(
        small(
            fusion=fusion,
            prior=Prior(4.0, 4.0),
            reward="range",
            points=SigmaPoints.paper(),
            rotated=False,
            budget=Budget.printed,
        ),
        saccades=4,
    )
    assert all(bool(torch.isfinite(x).all()) for x in (episode.gap, episode.regret, episode.global_information))


def test_metrics_are_those_of_the_truth():
    observer = small()
    episode = run(observer, saccades=5)
    best, reward = -(BALL.norm() - RADIUS_M).item(), episode.reward
    for t in range(5):
        gap = (reward[: t + 1].max() - reward[0]) / (best - reward[0])
        assert episode.gap[t].item() == pytest.approx(min(1.0, gap.item()), abs=1e-6)
        assert episode.regret[t].item() == pytest.approx(best - reward[: t + 1].mean().item(), abs=1e-6)
    first = int(episode.hit.float().argmax()) if bool(episode.hit.any()) else 5
    assert episode.moves == first
    assert reward[0].item() == pytest.approx(-ROOM_M, abs=0.2)


def test_same_seed_same_episode_and_another_seed_another():
    observer = small()
    one, two, other = run(observer, 3), run(observer, 3), run(observer, 4)
    for a, b in zip(one.gaze, two.gaze, strict=True):
        assert torch.equal(a, b)
    assert torch.equal(one.global_information, two.global_information)
    assert not torch.equal(one.global_information, other.global_information)


def test_float32_follows_float64():
    single, double = (run(small(), dtype=d, saccades=3) for d in (torch.float32, torch.float64))
    assert single.step.points.mean.dtype == torch.float32
    assert single.global_information[0].item() == pytest.approx(double.global_information[0].item(), abs=0.3)


def test_ground_is_no_object_and_too_near_is_not_looked_at():
    observer = small(eligibility=Eligibility(nearest_m=2.9, ground_z_m=-10))
    assert not run(observer, saccades=4).hit.any()  # the ball is nearer than 2.9 m
    ground = run(small(eligibility=Eligibility(ground_z_m=10)), saccades=2)
    seen = ground.step.memory.looks > 0
    assert not (ground.step.eligible & seen).any()


def test_nothing_seen_and_nothing_eligible():
    observer = small()
    memory = new_memory(observer, cells_in_reach(2000))
    px = torch.zeros(5, 2, dtype=torch.float64)
    blind = Correspondences(px, px, px[:, 0], px[:, 0], torch.zeros(5, dtype=torch.bool))
    zero = torch.zeros((), dtype=torch.float64)
    after = perceive(observer, memory, blind, eyes(HEAD, Gaze(zero, zero, zero)))
    assert after.looks.sum() == 0
    step = decide(observer, after, torch.Generator().manual_seed(0))
    assert step.cell >= 0 and bool(torch.isfinite(step.points.cov).all())
    # ties among unseen cells are broken by the generator
    others = {int(decide(observer, after, torch.Generator().manual_seed(s)).cell) for s in range(5)}
    assert len(others) > 1
    none = decide(small(eligibility=Eligibility(nearest_m=100)), after)
    assert none.cell == -1 and none.gaze.pan == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: run(small(), saccades=0), "saccades = 0"),
        (lambda: small(reward="profit"), "reward = profit"),
        (lambda: Eligibility(nearest_m=-1), "eligibility.nearest_m = -1"),
        (lambda: new_memory(small(), torch.zeros(0, 3)), "cells"),
    ],
)
def test_errors_name_the_setting(call, message):
    with pytest.raises(SettingError, match=message):
        call()


def test_alpha_infinity_is_pure_exploration():
    episode = run(small(), saccades=4, strategy=partial(upper_confidence_bound, alpha=math.inf))
    greedy = run(small(), saccades=4, strategy=partial(upper_confidence_bound, alpha=0.0))
    assert episode.global_information[-1] > greedy.global_information[-1]


def test_a_batch_is_its_episodes_one_by_one():
    observer = small(retina=LogPolar(800))
    memories = [new_memory(observer, cells_in_reach(n)[:350]) for n in (3000, 3300)]
    arena = Spheres(observer)
    alone = [
        run_episode(
            observer,
            memory,
            arena,
            arena.truth(memory.cells),
            torch.Generator().manual_seed(seed),
            Rules(4, partial(upper_confidence_bound, alpha=2.0)),
        )
        for seed, memory in enumerate(memories)
    ]
    settings = torch.tensor([2.0, 2.0], dtype=torch.float64)
    together = run_episodes(
        observer,
        stack(memories),
        Arenas([arena, arena]),
        [arena.truth(memory.cells) for memory in memories],
        [torch.Generator().manual_seed(seed) for seed in range(2)],
        Rules(4, partial(upper_confidence_bound, alpha=settings)),
    )
    for one, of_many in zip(alone, together, strict=True):
        for a, b in zip(one.gaze, of_many.gaze, strict=True):
            assert torch.allclose(a, b, atol=1e-9)
        assert torch.allclose(one.global_information, of_many.global_information, atol=1e-9)
        assert one.moves == of_many.moves and one.degrees == pytest.approx(of_many.degrees)
        assert one.target_error_m == pytest.approx(of_many.target_error_m)


def test_the_stop_rule_ends_on_the_best_cell():
    observer = small(retina=LogPolar(800))
    arena, memory = Spheres(observer), new_memory(observer, cells_in_reach(1500))

    def judged(stop):
        generator = torch.Generator().manual_seed(0)
        return run_episode(observer, memory, arena, arena.truth(memory.cells), generator, Rules(9, stop=stop))

    easy, never = judged((10.0, 0.5)), judged(None)
    assert easy.looks == 1 and never.looks == 9
    # after the last look the best cell is fixated, and then nothing changes
    assert len(easy.gap) == 9 and bool((easy.gaze.pan[1:] == easy.gaze.pan[1]).all())
    assert torch.equal(easy.global_information, easy.global_information[:1].expand(9))
    assert easy.degrees < never.degrees


@pytest.mark.parametrize("stop", [None, (0.2, 0.05)])
def test_a_robot_that_knows_no_truth_searches_as_the_judged_one(stop):
    observer = small(retina=LogPolar(800))
    arena, memory = Spheres(observer), new_memory(observer, cells_in_reach(1500))
    told = run_episode(
        observer, memory, arena, arena.truth(memory.cells), torch.Generator().manual_seed(0), Rules(6, stop=stop)
    )

    class Blindfolded:
        """The same robot, without `fixation` and `truth`."""

        saccade, look = arena.saccade, arena.look

    glances = list(search(Blindfolded(), observer, memory, 6, torch.Generator().manual_seed(0), stop=stop))
    assert sum(glance.look is not None for glance in glances) == told.looks
    for t, glance in enumerate(glances):
        assert glance.step.memory.cells.shape == memory.cells.shape
        for a, b in zip(glance.move.gaze, told.gaze, strict=True):
            torch.testing.assert_close(a, b[t])
        if t + 1 < len(glances):
            assert all(map(torch.equal, glances[t + 1].move.gaze, clamp_gaze(HEAD, glance.step.gaze)))
    torch.testing.assert_close(glances[-1].step.points.mean, told.step.points.mean)
    if stop is not None:
        assert len(glances) < 6 and glances[-1].look is None and not glances[-1].looked


def test_a_robot_is_asked_for_what_it_promised():
    observer = small(retina=LogPolar(300))
    memory, arena = new_memory(observer, cells_in_reach(300)), Spheres(observer)

    class Odd:
        saccade = staticmethod(lambda gaze: gaze)
        look = arena.look

    class Talker:
        saccade = arena.saccade
        look = staticmethod(lambda gaze, generator: "nothing")

    for robot, message in ((Odd(), "robot.saccade = Gaze: expected"), (Talker(), "robot.look = str: expected")):
        with pytest.raises(SettingError, match=message):
            next(search(robot, observer, memory, 3))
    with pytest.raises(SettingError, match="saccades = 0"):
        search(arena, observer, memory, 0)  # at once, and not at the first glance
    with pytest.raises(SettingError, match="far_m = nan"):
        Rules(3, far_m=math.nan)
