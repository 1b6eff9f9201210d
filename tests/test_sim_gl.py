"""The OpenGL renderer against the rays, and what happens without any OpenGL."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.sensing.head import eyes, fixate
from torchfovea.setting import SettingError
from torchfovea.sim import backend, gl, rays, world
from torchfovea.sim.room import Room
from torchfovea.sim.scene import Cans, build_scene

needs_gl = pytest.mark.skipif(gl.available_gl() is None, reason="this machine has neither EGL nor OSMesa")


@pytest.fixture(scope="module")
def scene():
    # little furniture: textures are baked for every solid
    return build_scene(Cans(cans=3, room=Room(furniture=False)), 1)


@needs_gl
def test_gl_sees_what_rays_see(scene):
    size = 200
    camera = image_camera(Pinhole.from_fov(90, 100), 100, size)
    pose = eyes(scene.head, fixate(scene.head, scene.nearest_point_e)[0])
    a = rays.render(scene, pose.R_left, pose.t_left, camera, size)
    b = gl.render(scene, pose.R_left, pose.t_left, camera, size)
    assert (a.geom == b.geom).double().mean() > 0.995
    error = (a.range_m - b.range_m).abs()
    # half a pixel of offset would give some 1e-2
    assert error.median() < 1e-4
    assert error[a.geom == b.geom].quantile(0.99) < 3e-3
    # the same textures, a little softer
    assert torch.corrcoef(torch.stack([a.image.flatten(), b.image.flatten()]))[0, 1] > 0.9
    assert abs(float(a.image.mean() - b.image.mean())) < 0.02
    # another eye, the same context; and both eyes see different pictures
    c = gl.render(scene, pose.R_right, pose.t_right, camera, size)
    assert (c.image - b.image).abs().mean() > 0.01
    again = gl.render(scene, pose.R_left, pose.t_left, camera, size)
    assert torch.equal(again.image, b.image)
    half = gl.render(scene, pose.R_left, pose.t_left, image_camera(Pinhole.from_fov(60, 100), 100, 64), 64)
    assert half.image.shape == (3, 64, 64)


@needs_gl
def test_a_world_renders_with_gl(scene):
    left, right = world.World(scene, renderer="gl", source_px=32).images()
    assert left.image.shape == right.image.shape == (3, 32, 32)


def test_without_gl_the_setting_is_named(scene, monkeypatch):
    monkeypatch.setattr(gl, "available_gl", lambda: None)
    with pytest.raises(SettingError, match="renderer = gl: expected a machine with EGL or OSMesa"):
        world.World(scene, renderer="gl")
    other = build_scene(Cans(cans=2, room=Room(furniture=False)), 0)
    with pytest.raises(SettingError, match="renderer = gl: expected a machine with EGL or OSMesa"):
        gl.render(other, torch.eye(3), torch.zeros(3), image_camera(Pinhole(50.0), 100, 8), 8)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"camera": Fisheye(50.0, 3.5, 3.5)}, "renderer"),
        ({"camera": Pinhole(50.0, 1.0, 3.5)}, "camera.cx_px"),
        ({"size_px": 1}, "size_px"),
        ({"size_px": 4000}, "size_px"),
        ({"R": torch.eye(2)}, "R"),
        ({"t": torch.ones(2)}, "t"),
    ],
)
def test_bad_pictures_are_named(scene, change, named):
    arguments = {"R": torch.eye(3), "t": torch.zeros(3), "camera": Pinhole(50.0, 3.5, 3.5), "size_px": 8, **change}
    with pytest.raises(SettingError, match=named):
        gl.render(scene, **arguments)


def run(code, **env):
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **env}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("asked", ["osmesa", ""])
def test_rays_work_whatever_gl_was_asked_for(asked):
    """A MUJOCO_GL that names a missing library breaks `import mujoco`; not here."""
    out = run(
        "from torchfovea.sim.scene import *; from torchfovea.sim.world import World\n"
        "print(World(build_scene(AttentionWorld(room=Room(furniture=False)))).fixated().range_m)",
        MUJOCO_GL=asked,
    )
    assert abs(float(out) - 4.0019) < 1e-3


def test_a_broken_mujoco_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SettingError, match="mujoco = "):
        backend.load_mujoco()


def test_a_missing_library_is_not_loadable(monkeypatch):
    monkeypatch.setitem(backend._LIBRARIES, "egl", ("libNoSuchThing.so.1",))
    assert not backend.loadable_gl("egl")


def test_a_cube_map_has_six_square_faces(scene):
    solid = scene.solids[-1]
    sheet = gl._texture(scene, len(scene.solids) - 1, solid)
    assert sheet.dtype == np.uint8 and sheet.shape[0] == 6 * sheet.shape[1]
