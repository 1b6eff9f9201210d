"""Pictures drawn as tensors are the pictures that MuJoCo's rays and NumPy draw, pixel by pixel."""

import sys
from functools import partial

import first_pictures
import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.setting import SettingError
from torchfovea.sim import volume
from torchfovea.sim.drawing import draw_pictures, paint_scenes
from torchfovea.sim.model import EgoPose
from torchfovea.sim.noise import ImageNoise
from torchfovea.sim.rays import cast, render
from torchfovea.sim.room import CAN, Room
from torchfovea.sim.scene import AttentionWorld, Cans, build_scene, stand_at
from torchfovea.sim.texture import colour
from torchfovea.sim.world import World, images_together

SIZE = 100
CAMERAS = [Pinhole.from_fov(135, 100), Pinhole.from_fov(40, 100), Fisheye.from_fov(220, 100)]


@pytest.fixture(scope="module")
def scenes():
    moved = stand_at(build_scene(AttentionWorld(), 1), EgoPose(0.2, -0.3, 0.7))
    return [build_scene(Cans(), 5), moved]


def pose_of(pan, tilt, vergence):
    return eyes(Head(), Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (pan, tilt, vergence))))


@pytest.mark.parametrize("camera", CAMERAS, ids=["wide", "narrow", "fisheye"])
@pytest.mark.parametrize("gaze", [(0.0, 0.0, 0.0), (-0.7, 0.4, 0.3), (0.5, 0.6, 0.1)])
def test_the_picture_that_rays_draw(scenes, camera, gaze):
    camera, pose = image_camera(camera, 100, SIZE), pose_of(*gaze)
    for scene in scenes:
        image, hits = first_pictures.picture(scene, pose.R_left, pose.t_left, camera, SIZE)
        frame = render(scene, pose.R_left, pose.t_left, camera, SIZE)
        same = frame.geom == hits.geom.view(SIZE, SIZE)
        # an edge may lie on either side of a pixel's centre
        assert same.double().mean() > 0.9995
        away = (frame.range_m.double() - hits.range_m.view(SIZE, SIZE)).abs()[same]
        assert away.max() < 2e-5 and away.median() < 1e-6
        error = (frame.image - image).abs().amax(0)[same]
        # a two hundredth of white where a texture is cut off, nothing elsewhere
        assert error.median() < 1e-4 and error.quantile(0.99) < 3e-3 and error.max() < 0.015


def test_wallpaper_repeats_and_plain_walls_are_plain():
    """The texture of the same wall, at places that its period is apart, and elsewhere."""
    generator = torch.Generator().manual_seed(0)
    walls, far = torch.rand(3, 20, 30, generator=generator) * 2 - 1, torch.full((20, 30), 1e-3)
    geom, normal = (
        torch.zeros(20, 30, dtype=torch.int64),
        (torch.zeros(20, 30), torch.zeros(20, 30), torch.ones(20, 30)),
    )

    def painted(room, shift_m):
        paint = build_scene(Cans(room=room), 5).paint
        return colour(paint, geom, tuple(walls + shift_m), normal, far)

    for room, same in ((Room(), False), (Room(repeat_m=0.25), True)):
        here = painted(room, 0.0)
        for shift_m in (0.25, -0.75):
            off = (painted(room, shift_m) - here).abs()
            # places within rounding of a seam may lie on either side of it
            assert (off < 1e-3).double().mean() > 0.99 if same else off.median() > 0.02
        assert (painted(room, 0.1) - here).abs().median() > 0.02
    spread = [float(painted(Room(contrast=c), 0.0).log().std()) for c in (1.0, 0.1)]
    assert spread[1] < 0.6 * spread[0]


def test_along_the_axes(scenes):
    """The middle pixel looks exactly along an axis, level and straight down, beside and above cans."""
    camera = image_camera(Pinhole.from_fov(90, 100), 100, 33)
    level = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    down = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64).T
    scene = scenes[0]
    places = [torch.tensor(s.position_m, dtype=torch.float64) for s in scene.solids if s.kind == CAN]
    index = torch.arange(33, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    rays = camera.rays(torch.stack([u, v], -1)).reshape(-1, 3)
    for place in places:
        eye = place + torch.tensor([0.0, 0.0, 0.4]) - torch.tensor([0.0, 0.0, scene.head.ego_height_m])
        for R in (level, down):
            frame = render(scene, R, eye, camera, 33)
            hits = cast(scene, eye, rays @ R.T)
            assert (frame.geom.view(-1) == hits.geom).double().mean() > 0.997
            assert (frame.range_m.view(-1).double() - hits.range_m).abs().quantile(0.99) < 1e-5
            assert torch.isfinite(frame.image).all()


def test_together_is_alone(scenes):
    """Scenes of other sizes, each with an eye of its own."""
    camera, poses = image_camera(CAMERAS[0], 100, 52), [pose_of(0.0, 0.3, 0.2), pose_of(-0.4, 0.0, 0.1)]
    chosen = [scenes[0], scenes[1], scenes[0]]
    turns, places = [], []
    for k, scene in enumerate(chosen):
        rotation, translation = (torch.from_numpy(part) for part in scene.world_from_ego)
        pose = poses[k % 2]
        turns.append(rotation @ pose.R_right)
        places.append(rotation @ pose.t_right + translation)
    together = draw_pictures(paint_scenes(chosen), torch.stack(turns), torch.stack(places), camera, 52)
    for k, scene in enumerate(chosen):
        alone = render(scene, poses[k % 2].R_right, poses[k % 2].t_right, camera, 52)
        assert torch.equal(together.geom[k], alone.geom)
        assert torch.allclose(together.range_m[k], alone.range_m, atol=1e-6)
        assert (together.image[k] - alone.image).abs().quantile(0.999) < 2e-3


def test_both_eyes_are_drawn_at_once(scenes):
    """As a configuration names the renderer, and as a function of one's own that calls it for each eye."""
    gaze = Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (0.2, 0.1, 0.3)))
    named, each = (
        World(scenes[1], renderer=renderer, source_px=52).images(gaze)
        for renderer in (partial(render), lambda *given: render(*given))
    )
    for a, b in zip(named, each, strict=True):
        assert torch.equal(a.geom, b.geom)
        assert (a.image - b.image).abs().quantile(0.999) < 2e-3


def test_with_and_without_opencv(scenes, monkeypatch):
    camera, pose = image_camera(CAMERAS[0], 100, 64), pose_of(0.1, 0.2, 0.2)
    images = []
    for exact in (True, False):
        monkeypatch.setattr(volume, "_exact", lambda exact=exact: exact)
        images.append(render(scenes[0], pose.R_left, pose.t_left, camera, 64).image)
    assert (images[0] - images[1]).abs().max() < 2e-3


def test_worlds_that_are_drawn_together_are_drawn_as_one_by_one(scenes):
    """In more than one batch, each with noise of its own; and one by one where one differs in kind."""

    def worlds():
        kinds = [{"noise": ImageNoise(), "seed": 3}, {}, {"noise": ImageNoise(), "seed": 4}, {}]
        return [World(scenes[k % 2], source_px=250 if k < 3 else 64, **kind) for k, kind in enumerate(kinds)]

    gazes = [Gaze(*(torch.tensor(a) for a in (0.2 * k, 0.1, 0.05))) for k in range(4)]
    for count in (3, 4):
        expected = [world.images(gaze) for world, gaze in zip(worlds()[:count], gazes[:count], strict=True)]
        together = images_together(worlds()[:count], gazes[:count])
        for pair, own in zip(together, expected, strict=True):
            for frame, alone in zip(pair, own, strict=True):
                assert (frame.geom == alone.geom).double().mean() > 0.9995
                assert (frame.image - alone.image).abs().quantile(0.99) < 1e-4
                assert (frame.range_m - alone.range_m).abs().quantile(0.99) < 1e-4


def test_a_volume_repeats():
    """What OpenCV and PyTorch find is what NumPy finds, in any period."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((4, 8, 8, 8)).astype(np.float32)
    lookup = volume.PeriodicVolume(values, torch.device("cpu"))
    place = torch.from_numpy(rng.uniform(-2, 3, (3, 70, 64)).astype(np.float32))
    x, y, z = (place.double().numpy() % 1) * 8
    expected = np.zeros((4, 70, 64))
    whole = [np.floor(part).astype(int) for part in (x, y, z)]
    for corner in np.ndindex(2, 2, 2):
        weight, index = 1.0, []
        for part, low, step in zip((x, y, z), whole, corner, strict=True):
            weight = weight * (1 - np.abs(part - low - step))
            index.append((low + step) % 8)
        expected += weight * values[:, index[2], index[1], index[0]]
    assert np.abs(torch.stack(lookup.at(place)).numpy() - expected).max() < 1e-3
    assert np.abs(torch.stack(lookup._by_torch(place - place.floor(), 3)).numpy() - expected[:3]).max() < 1e-3


def test_without_opencv_pytorch_looks_up(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    volume._exact.cache_clear()
    try:
        assert not volume._exact()
    finally:
        volume._exact.cache_clear()


def test_an_eye_outside_of_the_room_is_named(scenes):
    with pytest.raises(SettingError, match="origin = an eye outside of the room"):
        render(scenes[0], torch.eye(3), torch.tensor([50.0, 0.0, 0.0]), Pinhole(10.0), 8)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA here")
def test_the_same_on_cuda(scenes):
    camera, pose = image_camera(CAMERAS[0], 100, 64), pose_of(0.1, 0.2, 0.2)
    here = render(scenes[0], pose.R_left, pose.t_left, camera, 64)
    there = render(scenes[0], pose.R_left.cuda(), pose.t_left.cuda(), camera, 64)
    assert there.image.device.type == "cuda"
    assert (there.geom.cpu() == here.geom).double().mean() > 0.999
    assert (there.image.cpu() - here.image).abs().quantile(0.99) < 3e-3
