"""A thing that somebody has moved: it stands elsewhere and looks the same, and everything else is as it was."""

import pytest
import torch

from torchfovea.sensing.camera import Pinhole, image_camera
from torchfovea.sensing.head import Head, eyes, fixate
from torchfovea.setting import SettingError
from torchfovea.sim.cans import point_in_sight
from torchfovea.sim.compile import displaced
from torchfovea.sim.rays import cast, render
from torchfovea.sim.scene import Cans, build_scene

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def picture(scene, point):
    """What the left eye sees of a point that it looks at."""
    pose = eyes(scene.head, fixate(scene.head, point)[0])
    camera = Pinhole.from_fov(20.0, 40.0)
    return render(scene, pose.R_left, pose.t_left, image_camera(camera, 40.0, 80), 80)


def test_a_thing_is_moved_and_nothing_else():
    before = build_scene(Cans(cans=4), 3, Head())
    (geom,) = before.target_geoms
    name = before.solids[geom].name
    shift = (0.0, 0.0, 0.02)
    after = displaced(before, [name], shift)
    assert after.pose == before.pose and after.nearest.geom == geom
    near, now = before.nearest_point_e, after.nearest_point_e
    assert float((now - near).norm()) <= 0.02 + 1e-6 and not torch.equal(now, near)
    others = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    a, b = cast(before, zero, others), cast(after, zero, others)
    same = (a.geom != geom) & (b.geom != geom)
    assert bool(same.float().mean() > 0.9)
    torch.testing.assert_close(a.range_m[same], b.range_m[same])
    old, new = picture(before, near), picture(after, near)
    rest = (old.geom != geom) & (new.geom != geom)
    torch.testing.assert_close(old.image[:, rest], new.image[:, rest], atol=1e-5, rtol=0)
    # its own colours went along: the same place of the can, seen under all but the same angle
    place = slice(38, 43)
    there, here = (
        picture(scene, p).image[:, place, place] for scene, p in ((before, near), (after, near + shift[2] * UP))
    )
    assert float((there - here).abs().mean()) < 0.015  # 0.004; with the texture left behind 0.056


def test_what_is_taken_away_is_seen_nowhere():
    before = build_scene(Cans(cans=4), 3, Head())
    (geom,) = before.target_geoms
    gone = displaced(before, [before.solids[geom].name], (0.0, 0.0, -100.0))
    assert point_in_sight(before) is not None
    assert gone.nearest.geom != geom and gone.nearest_range_m > before.nearest_range_m
    with pytest.raises(SettingError, match="names = a hat: expected a solid of the scene"):
        displaced(before, ["a hat"], (0.0, 0.0, 1.0))
