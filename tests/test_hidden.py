"""A target behind a screen: nothing of it is seen from the first place, all of it from where the base goes."""

import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.commands.shared.build import build_arena, build_head, build_observer, build_scene_of
from torchfovea.commands.shared.config import conf_dir
from torchfovea.sensing.head import Gaze, eyes, fixate
from torchfovea.setting import SettingError
from torchfovea.sim.model import EgoPose
from torchfovea.sim.room import Room
from torchfovea.sim.scene import Cans, Hidden, build_scene, stand_at


@pytest.fixture(scope="module")
def cfg():
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("search", overrides=["family=hidden", "fidelity=geometric", "sensor.receptive_fields=400"])


def passes_through(start, ends, solid):
    """Whether segments meet a box that is turned about the vertical: the slabs of its own frame."""
    c, s = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    a, b = (np.asarray(start) - solid.position_m) @ turn, (np.asarray(ends) - solid.position_m) @ turn
    with np.errstate(divide="ignore"):
        near, far = (np.array([-1, 1])[:, None, None] * solid.size_m - a) / (b - a)
    enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return (enter <= leave) & (leave >= 0) & (enter <= 1)


def test_the_screen_stands_before_all_of_the_target(cfg):
    head = build_head(cfg)
    scene = build_scene_of(cfg, head, 0)
    (screen,) = [s for s in scene.solids if s.name == "screen"]
    (target,) = [scene.solids[g] for g in scene.target_geoms]
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(-1, 1, 7))
    radius, half = target.size_m
    skin = np.stack([radius * np.cos(angle), radius * np.sin(angle), half * height], -1).reshape(-1, 3)
    skin += target.position_m
    up = np.array([0, 0, head.ego_height_m])
    pose = eyes(head, fixate(head, torch.tensor(target.position_m).double() - torch.from_numpy(up))[0])
    for place in (np.zeros(3), pose.t_left.numpy(), pose.t_right.numpy()):
        assert passes_through(place + up, skin, screen).all()
    assert scene.nearest.geom not in scene.target_geoms
    x, y, yaw = cfg.scene.seen_from
    there = stand_at(scene, EgoPose(x, y, math.radians(yaw)))
    assert there.nearest.geom in there.target_geoms and there.nearest.range_m > 0.5
    assert torch.equal(build_scene_of(cfg, head, 0).nearest_point_e, scene.nearest_point_e)


def test_the_base_goes_to_where_it_is_seen(cfg):
    observer = build_observer(cfg)
    arena = build_arena(cfg, observer, 0)
    zero = torch.zeros((), dtype=torch.float64)
    for _ in range(cfg.saccades):
        arena.saccade(Gaze(zero, zero, zero))
    gaze = fixate(observer.head, arena.world.scene.nearest_point_e * 1.001)[0]
    assert arena.fixation(arena.saccade(gaze).gaze).is_target


def test_what_cannot_be_hidden_is_named():
    with pytest.raises(SettingError, match=r"scene.screen_half_m = 0: expected 0.05 to 1 metre"):
        Hidden(screen_half_m=0)
    with pytest.raises(SettingError, match=r"scene.seen_from = .*expected three finite numbers"):
        Hidden(seen_from=(0.0, math.inf, 0.0))
    cans = Cans(cans=2, tries=3, range_m=(1.5, 2.6), room=Room(furniture=False))
    with pytest.raises(SettingError, match="expected a place from which a can behind a screen is the nearest"):
        build_scene(Hidden(cans, seen_from=(0.0, 0.0, 0.0)))
