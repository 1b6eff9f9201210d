"""A base that moves while its head searches: where it is, what odometry tells, and that the judge goes along."""

import math

import pytest
import torch

from torchfovea.cli import main
from torchfovea.episode import Rules, run_episode
from torchfovea.memory.egosphere import belief, trust
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, new_memory
from torchfovea.recordings.folder import Folder
from torchfovea.search import search, steadied
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, Head, fixate, gaze_point
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import SettingError
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.model import EgoPose
from torchfovea.sim.scene import Cans, build_scene, stand_at
from torchfovea.sim.walk import Odometry, Route
from torchfovea.sim.world import World

HEAD = Head()


def pose_matrix(pose: EgoPose) -> torch.Tensor:
    c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return torch.tensor([[c, -s, 0, pose.x_m], [s, c, 0, pose.y_m], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)


def test_a_route_is_gone_at_an_even_pace():
    route = Route([[0, 0, 0], [0.3, 0.4, 90], [0.3, 0.0, 90]], step_m=0.25)
    assert route.pose(0) == EgoPose()
    for pose, expected in zip((route.pose(1), route.pose(3)), ((0.15, 0.2, 45), (0.3, 0.15, 90)), strict=True):
        assert (pose.x_m, pose.y_m, math.degrees(pose.yaw_rad)) == pytest.approx(expected)
    assert route.pose(9) == route.pose(50) == EgoPose(0.3, 0.0, math.pi / 2)
    for wrong, line in (
        ({"waypoints": []}, "motion.waypoints = "),
        ({"waypoints": [[0, 0]]}, r"motion.waypoints\[0\]"),
        ({"step_m": 0.0}, "motion.step_m = 0.0"),
    ):
        with pytest.raises(SettingError, match=line):
            Route(**wrong)
    with pytest.raises(SettingError, match=r"motion.turn_deg = -1"):
        Odometry(turn_deg=-1)


def test_odometry_errs_as_it_says():
    odometry, generator = Odometry(0.02, 2.0), torch.Generator().manual_seed(0)
    before, after = EgoPose(0.3, -0.2, 0.4), EgoPose(0.5, 0.1, 0.9)
    true = torch.linalg.inv(pose_matrix(before)) @ pose_matrix(after)
    errors = []
    for _ in range(3000):
        told = odometry.tell(before, after, generator)
        turn = true[:3, :3].mT @ told.rotation
        shift = true[:3, :3].mT @ (told.translation - true[:3, 3])
        errors.append(torch.stack([torch.atan2(turn[1, 0], turn[0, 0]), shift[0], shift[1]]))
    errors = torch.stack(errors)
    index = [2, 3, 4]
    sigma = told.covariance.diagonal()[index].sqrt()
    torch.testing.assert_close(errors.std(0), sigma, rtol=0.05, atol=0)
    assert bool((errors.mean(0).abs() < 4 * sigma / 3000**0.5).all())
    exact = Odometry(0.0, 0.0).tell(before, after, generator)
    torch.testing.assert_close(exact.rotation, true[:3, :3])
    torch.testing.assert_close(exact.translation, true[:3, 3])


def test_the_gaze_stays_on_its_point():
    point = torch.tensor([[1.0, 0.3, -0.2], [2.0, -0.4, 0.1]], dtype=torch.float64)
    step = Odometry(0.0, 0.0).tell(EgoPose(), EgoPose(0.1, 0.2, 0.15), torch.Generator())
    after = gaze_point(HEAD, steadied(HEAD, fixate(HEAD, point)[0], step))
    torch.testing.assert_close(after @ step.rotation.mT + step.translation, point)
    zero = torch.zeros((), dtype=torch.float64)
    horizon = steadied(HEAD, Gaze(zero, zero, zero), step)
    assert float(horizon.pan) == pytest.approx(-0.15, abs=1e-3) and float(horizon.vergence) < 1e-4


@pytest.fixture(scope="module")
def place():
    observer = Observer(head=HEAD, camera=Pinhole.from_fov(90, 100), retina=LogPolar(2000))
    cells = fibonacci_directions(3000)
    route = Route([[0, 0, 0], [0, 0.4, 20]], step_m=0.1)
    scene = build_scene(Cans(), 0, HEAD)

    def arena():
        return SimulatedArena(World(scene, camera=observer.camera), observer, None, route=route)

    return observer, new_memory(observer, cells[fixate(HEAD, cells)[1]]), route, scene, arena


def test_the_judge_goes_along(place):
    observer, memory, route, scene, arena = place
    one = arena()
    episode = run_episode(observer, memory, one, one.truth(memory.cells), torch.Generator().manual_seed(0), Rules(5))
    best = torch.tensor([-stand_at(scene, route.pose(t)).nearest_range_m for t in range(5)], dtype=torch.float64)
    lost = (best - episode.reward).cumsum(0) / torch.arange(1, 6)
    torch.testing.assert_close(episode.regret, lost)
    gained = episode.reward.cummax(0).values - episode.reward[0]
    torch.testing.assert_close(episode.gap, (gained / (best.max() - episode.reward[0])).clamp(0, 1))
    # where it looked at last is where a ray from the last pose ends
    last = World(stand_at(scene, route.pose(4)), camera=observer.camera)
    seen = last.fixated(Gaze(*(angle[-1] for angle in episode.gaze)))
    assert seen.range_m == pytest.approx(float(episode.range_m[-1]))


def test_what_is_remembered_goes_along(place):
    """Ranges are as right as they are said to be, where the robot stands; not where it stood."""
    observer, memory, route, scene, arena = place
    *_, last = search(arena(), observer, memory, 5, torch.Generator().manual_seed(0))
    known = last.step.memory
    seen = (known.looks > 0) & (trust(known) > 0.9)
    patches = belief(known)
    inside = {}
    for t in (0, 4):
        world = World(stand_at(scene, route.pose(t)), camera=observer.camera)
        truth = 1 / world.panorama(known.cells[seen].double()).range_m
        z = (patches.mean[seen, 2] - truth) / patches.cov[seen, 5].sqrt()
        inside[t] = float((z.abs() < 1.96).double().mean())
    assert int(seen.sum()) > 200
    assert inside[4] > 0.85 and inside[0] < inside[4] - 0.05


def test_the_command_walks_and_records_its_steps(tmp_path, capsys):
    small = ["sensor.receptive_fields=300", "memory.cells=200", "budget=ours", "picture=false", "scene=cans"]
    more = ["motion=path", "episodes=1", "saccades=4", "record=true", "sensor.source_px=64"]
    assert main(["search", *small, *more, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    moments = list(Folder(tmp_path / "run" / "recording").frames(lambda error: None))
    assert [moment.base is None for moment in moments] == [True, False, False, False]
    assert 0.05 < float(moments[2].base.translation.norm()) < 0.15
    assert float(moments[2].base.covariance[3, 3]) == pytest.approx(0.005**2)
    path = f"recording={tmp_path / 'run' / 'recording'}"
    assert main(["replay", *small[:4], path, f"hydra.run.dir={tmp_path / 'again'}"]) == 0
    capsys.readouterr()
    assert main(["search", "motion=path", "motion.waypoints=[[0,0]]", f"hydra.run.dir={tmp_path / 'odd'}"]) == 1
    assert "motion.waypoints[0] = [0, 0]: expected three finite numbers" in capsys.readouterr().err
