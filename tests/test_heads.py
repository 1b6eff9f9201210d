"""Heads that do not verge, that do not turn, and kinematics of one's own."""

from dataclasses import replace

import pytest
import torch

from torchfovea.cli import main
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, new_memory
from torchfovea.search import search
from torchfovea.sensing import head as heads
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, Head, Kinematics, can_fixate, cyclopean, eyes, fixate, gaze_point
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import SettingError
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.sgbm import SGBM

PAN_TILT = Head(baseline_m=0.12, vergence_max_deg=0.0, pan_limit_deg=90.0)
FIXED = Head(vergence_max_deg=0.0, pan_limit_deg=0.0, tilt_up_deg=0.0, tilt_down_deg=0.0, sight_deg=30.0)
POINTS = torch.tensor([[1.0, 0.3, -0.2], [0.5, -0.4, 0.1], [3.0, 0.0, 0.0], [-1.0, 0.1, 0.0]], dtype=torch.float64)


class Own:
    """Vizzy's kinematics as a stranger would bring them."""

    ego_height_m = Head().ego_height_m
    encoder_deg = 0.0

    def eyes(self, gaze):
        return heads.eyes(Head(), gaze)

    def fixate(self, points):
        return heads.fixate(Head(), points)


def own():
    """What `head.source` names."""
    return Own()


def test_parallel_eyes_are_turned_to_the_point():
    gaze, reached = fixate(PAN_TILT, POINTS)
    assert reached.tolist() == [True, True, True, False]
    assert float(gaze.vergence.abs().max()) == 0.0
    pose = eyes(PAN_TILT, gaze)
    torch.testing.assert_close(pose.R_left, pose.R_right, atol=0, rtol=0)
    rotation, origin = cyclopean(PAN_TILT, gaze)
    off = torch.linalg.cross(POINTS - origin, rotation[..., 2])[:3]
    assert float(off.abs().max()) < 1e-12
    assert bool(torch.isinf(gaze_point(PAN_TILT, gaze)).any(-1).all())
    torch.testing.assert_close(rig_at(PAN_TILT, Gaze(*(a[0] for a in gaze))).R_left, torch.eye(3, dtype=torch.float64))
    near = torch.tensor([0.11, 0.0, 0.0], dtype=torch.float64)  # where Vizzy's eyes cannot meet
    assert bool(fixate(replace(PAN_TILT, eyes_up_m=0.0), near)[1])
    assert not bool(fixate(Head(eyes_up_m=0.0), near)[1])


def test_a_fixed_pair_looks_at_what_lies_ahead():
    angles = torch.tensor([-31.0, -29.0, 0.0, 29.0, 31.0], dtype=torch.float64).deg2rad()
    zero = torch.zeros_like(angles)
    for ray in ((angles.cos(), angles.sin(), zero), (angles.cos(), zero, angles.sin())):
        head = replace(FIXED, eyes_up_m=0.0, eyes_forward_m=0.0)
        gaze, reached = fixate(head, 2 * torch.stack(ray, -1))
        assert reached.tolist() == [False, True, True, True, False]
        assert can_fixate(head, 2 * torch.stack(ray, -1)).tolist() == reached.tolist()
        assert all(bool((angle == 0).all()) for angle in gaze)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"pan_limit_deg": 0.0}, "head.pan_limit_deg = 0: expected some range, or some head.sight_deg"),
        ({"vergence_max_deg": -1.0}, "head.vergence_max_deg = -1.0"),
        ({"sight_deg": 90.0}, "head.sight_deg = 90.0"),
    ],
)
def test_heads_that_cannot_be(settings, line):
    with pytest.raises(SettingError, match=line):
        Head(**settings)
    with pytest.raises(SettingError, match="head = vizzy: expected a Head, or Kinematics"):
        Observer(head="vizzy")


def test_kinematics_of_ones_own_search_as_the_head_they_copy():
    assert isinstance(Own(), Kinematics)
    generator = torch.Generator().manual_seed(0)
    gaze = Gaze(*(0.5 * torch.rand(3, 4, generator=generator, dtype=torch.float64)))
    torch.testing.assert_close(gaze_point(Own(), gaze), gaze_point(Head(), gaze))
    for one, other in zip(cyclopean(Own(), gaze), cyclopean(Head(), gaze), strict=True):
        torch.testing.assert_close(one, other)
    straight = Gaze(*(angle * 0 for angle in gaze))
    assert bool(torch.isinf(gaze_point(Own(), straight)).any(-1).all())
    first = Gaze(*(angle[0] for angle in gaze))
    for one, other in zip(rig_at(Own(), first), rig_at(Head(), first), strict=True):
        torch.testing.assert_close(one, other)
    found = {}
    cells = fibonacci_directions(800)
    for name, head in (("ours", Head()), ("own", Own())):
        observer = Observer(head=head, camera=Pinhole.from_fov(90, 100), retina=LogPolar(400))
        world = World(build_scene(Cans(), 0), camera=observer.camera, source_px=64)
        memory = new_memory(observer, cells[fixate(head, cells)[1]])
        robot = SimulatedArena(world, observer, Matcher(SGBM()))
        *_, last = search(robot, observer, memory, 3, torch.Generator().manual_seed(0))
        found[name] = last.step
    torch.testing.assert_close(found["own"].points.mean, found["ours"].points.mean, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("head", ["pan_tilt", "fixed"])
def test_the_command_searches_with_every_head(head, tmp_path, capsys):
    small = ["sensor.receptive_fields=300", "memory.cells=150", "budget=ours", "picture=false", "scene=cans"]
    more = ["episodes=1", "saccades=3", "sensor.source_px=64", "motion=path", f"head={head}"]
    assert main(["search", *small, *more, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert float((tmp_path / "run" / "saccades.csv").read_text().splitlines()[1].split(",")[4]) == 0.0
    capsys.readouterr()
    own = ["head=external", f"head.source={__name__}:own"]
    assert main(["search", *small, *own, f"hydra.run.dir={tmp_path / 'own'}"]) == 1
    assert "head = Own: expected one that the simulator knows" in capsys.readouterr().err
