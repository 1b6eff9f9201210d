"""Two images with their cameras as one value: what it tells, what it refuses, and that every matcher reads it alike."""

import math

import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import SettingError
from torchfovea.stereo.external import External, match_external
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.meeting import met
from torchfovea.stereo.rectification import frame_to_match
from torchfovea.stereo.rig import StereoRig, posed, verged
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep, match_sweep
from torchfovea.stereo.views import posed_views, rectified_views, verged_views

RETINA, SIZE = Uniform(3000), (130, 170)
NORMAL, AWAY = torch.tensor([-0.25, 0.1, 1.0], dtype=torch.float64), 1.2  # a plane, n·X = d, in the left camera


def drawn(camera, rotation, origin, size=SIZE):
    """A textured plane's image (1, H, W); X = rotation X_camera + origin."""
    row, column = (torch.arange(n, dtype=torch.float64) for n in size)
    rays = camera.rays(torch.stack(torch.broadcast_tensors(column, row[:, None]), -1)) @ rotation.mT
    point = origin + rays * ((AWAY - origin @ NORMAL) / (rays @ NORMAL))[..., None]
    generator = torch.Generator().manual_seed(0)
    wave = 120 * torch.rand(3, 60, dtype=torch.float64, generator=generator) - 60
    value = torch.cos(point @ wave + 6 * torch.rand(60, dtype=torch.float64, generator=generator)).sum(-1)
    return (0.5 + 0.06 * value).clamp(0, 1)[None]


def turned(pan, tilt, roll):
    """A rotation by three small angles."""
    x, y, z = torch.tensor([tilt, pan, roll], dtype=torch.float64).tolist()
    return torch.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


def calibrated(gaze_px=None):
    """Two cameras that differ and stand askew, and what they see; their rotation and translation."""
    left, right = Pinhole(150.0, 88.0, 61.0), Pinhole(163.0, 80.0, 68.0)
    rotation, shift = turned(-0.12, 0.03, 0.04), torch.tensor([0.15, 0.01, -0.02], dtype=torch.float64)
    same, here = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    images = drawn(left, same, here), drawn(right, rotation, shift)
    return posed_views(*images, left, right, posed(rotation, shift), gaze_px), rotation, shift


def truth(views, rotation, shift, retina):
    """Where the right eye sees the plane that the left receptive fields look at, and whether it does."""
    left, right = views.cameras(retina)
    rays = left.rays(retina.centers_px(dtype=torch.float64))
    point = rays * (AWAY / (rays @ NORMAL))[:, None]
    there = (point - shift) @ rotation
    place = right.project(there)
    inner = retina.inside(1.05 * place) & views.holds(place, retina, -2.0)
    return place, inner & views.holds(retina.centers_px(dtype=torch.float64), retina) & right.in_view(there)


# ----------------------------------------------------------------------------------------------------- every matcher


@pytest.mark.parametrize("gaze_px", [None, (95.0, 60.0)], ids=["middle", "aside"])
@pytest.mark.parametrize("retina", [LogPolar(3000), RETINA], ids=["log_polar", "uniform"])
@pytest.mark.parametrize("params", [SGBM(), Sweep()], ids=["sgbm", "sweep"])
def test_any_calibrated_pair(params, retina, gaze_px):
    """Cameras that differ and stand askew, looked at anywhere: the plane's true places, ray-traced in this file."""
    views, rotation, shift = calibrated(gaze_px)
    place, seen = truth(views, rotation, shift, retina)
    matches, _ = Matcher(params, 0.5)(views, retina, Budget())
    both = matches.valid & seen
    assert seen.double().mean() > 0.5 and both.sum() > 0.9 * seen.sum()
    error = (matches.right_px - place)[both].abs().quantile(0.5, dim=0)
    assert (error < 0.35 / views.scale(retina)).all()
    assert (matches.valid & ~views.holds(matches.right_px, retina)).sum() == 0


@pytest.mark.parametrize("params", [SGBM(), Sweep(), External()], ids=["sgbm", "sweep", "external"])
def test_a_rectified_pair_is_two_eyes_that_look_straight_ahead(params):
    """The same images and cameras as rectified views and as any pair give the same places."""
    left, right = Pinhole(150.0, 80.0, 64.0), Pinhole(150.0, 80.0, 64.0)
    same, shift = torch.eye(3, dtype=torch.float64), torch.tensor([0.15, 0, 0], dtype=torch.float64)
    images = drawn(left, same, 0 * shift), drawn(right, same, shift)
    rectified = rectified_views(*images, left, right, 0.15)
    straight = posed_views(*images, left, right, StereoRig(same, same, 0.15))
    assert rectified.rectified and not straight.rectified
    answers = []
    for views in (rectified, straight):
        if isinstance(params, External):
            whole = lambda left, right: torch.full(left.shape[:2], 150 * 0.15 / 1.2)  # noqa: E731
            answers.append(match_external(whole, views, RETINA, params)[0])
        else:
            answers.append(Matcher(params, 0.5)(views, RETINA, Budget())[0])
    both = answers[0].valid & answers[1].valid
    assert (answers[0].valid == answers[1].valid).double().mean() > 0.95 and both.double().mean() > 0.6
    for one, other in zip(answers[0][:4], answers[1][:4], strict=True):
        assert (one - other)[both].abs().median() < (1e-9 if not isinstance(params, SGBM) else 0.02)


@pytest.mark.parametrize("camera", [Pinhole.from_fov(90, 100.0), Fisheye.from_fov(120, 100.0)], ids=["pin", "fish"])
def test_eyes_and_their_cameras_in_image_pixels_are_the_same(camera):
    """verged_views knows the image's camera; posed_views is told it."""
    left, right = torch.rand(2, 3, 60, 60, generator=torch.Generator().manual_seed(0))
    rig, retina = verged(0.1, 0.2), LogPolar(600)
    eyes = verged_views(left, right, rig, camera, retina.radius_px)
    told = posed_views(left, right, eyes.camera_left, eyes.camera_right, rig)
    assert eyes[2:] == told[2:] and eyes.gaze_px == (29.5, 29.5)
    for one, other in zip(match_sgbm(eyes, retina)[0], match_sgbm(told, retina)[0], strict=True):
        assert one is other is None or torch.equal(one, other)


@pytest.mark.parametrize("params", [SGBM(), Sweep()], ids=["sgbm", "sweep"])
def test_eyes_that_look_at_one_thing_see_it_sharply(params):
    """With the right retina where the right eye sees what the left one fixates, no fovea looks at a periphery."""
    straight, rotation, shift = calibrated((95.0, 60.0))
    ray = straight.camera_left.rays(torch.tensor([95.0, 60.0], dtype=torch.float64))
    there = straight.camera_right.project((ray * (AWAY / (ray @ NORMAL)) - shift) @ rotation)
    views = posed_views(*straight[:5], straight.gaze_px, tuple(there.tolist()))
    assert views.gazes_px == ((95.0, 60.0), tuple(there.tolist())) and views.whole().span_px >= straight.whole().span_px
    scores, away = [], straight._replace(gaze_right_px=(50.0, 100.0))
    for pair in (away, views):
        place, seen = truth(pair, rotation, shift, LogPolar(3000))
        matches, _ = Matcher(params, 0.5)(pair, LogPolar(3000), Budget())
        both = matches.valid & seen & (matches.left_px.norm(dim=-1) < 20)
        scores.append((matches.right_px - place)[both].norm(dim=-1).median())
    assert both.sum() > 0.9 * (seen & (matches.left_px.norm(dim=-1) < 20)).sum()
    assert scores[1] < 0.1 / views.scale(RETINA) and scores[1] < 0.5 * scores[0]
    middle = views.cameras(RETINA)[1].project((ray * (AWAY / (ray @ NORMAL)) - shift) @ rotation)
    assert middle.abs().max() < 1e-9


def test_a_glance_finds_where_the_right_eye_has_the_left_ones_thing():
    straight, rotation, shift = calibrated((95.0, 60.0))
    ray = straight.camera_left.rays(torch.tensor([95.0, 60.0], dtype=torch.float64))
    there = straight.camera_right.project((ray * (AWAY / (ray @ NORMAL)) - shift) @ rotation)
    found = met(straight, 0.5)
    assert torch.tensor(found.gaze_right_px) == pytest.approx(there, abs=0.7)
    assert found._replace(gaze_right_px=None) == straight
    # what it sees to the left of the right image, it looks for at the border
    border = met(straight._replace(gaze_px=(2.0, 60.0)), 0.5).gazes_px[1]
    assert border[0] >= 0 and 50 < border[1] < 80
    grey = torch.full_like(straight.left, 0.5)
    blank = straight._replace(left=grey, right=grey)
    assert met(blank, 0.5) == blank


# ---------------------------------------------------------------------------------------------------- what it tells


@pytest.mark.parametrize("gaze_px", [None, (20.0, 33.5)])
@pytest.mark.parametrize("kind", [Pinhole, Fisheye])
def test_a_camera_looks_alike_in_both_kinds_of_pixels(kind, gaze_px):
    image, cameras = torch.rand(1, 50, 70), (kind(40.0, 33.0, 26.0), kind(45.0, 36.0, 24.0))
    views = posed_views(image, image, *cameras, verged(0.0, 0.1), gaze_px)
    px = torch.rand(20, 2, dtype=torch.float64) * 100 - 50
    u, v = gaze_px or (34.5, 24.5)
    assert views.scale(RETINA) == 0.25 and views.scale(None) == 1 and views.source_px == 50
    place = px * 0.25 + torch.tensor([u, v], dtype=torch.float64)
    for own, retinal in zip(cameras, views.cameras(RETINA), strict=True):
        torch.testing.assert_close(own.rays(place), retinal.rays(px))
    assert views.cameras(None) == cameras
    within = (place[:, 0] >= -0.5) & (place[:, 0] <= 69.5) & (place[:, 1] >= -0.5) & (place[:, 1] <= 49.5)
    assert torch.equal(views.holds(px, RETINA), within)


def test_an_eyes_camera_may_be_off_its_retinas_middle():
    image, camera = torch.rand(1, 60, 80), Pinhole(100.0, 3.0, -5.0)
    views = verged_views(image, image, verged(0.1, 0.2), camera, 100.0, Pinhole(90.0))
    for told, asked in zip(views.cameras(RETINA), (camera, Pinhole(90.0)), strict=True):
        assert [told.focal_px, told.cx_px, told.cy_px] == pytest.approx([asked.focal_px, asked.cx_px, asked.cy_px])


CALIBRATED = Pinhole(30.0, 24.5, 19.5), Pinhole(30.0, 24.5, 19.5), verged(0.1, 0.1)


def test_images_become_of_one_kind():
    left, right = torch.randint(0, 256, (3, 20, 30)).byte(), torch.rand(1, 20, 30, dtype=torch.float64)
    views = verged_views(left.numpy(), right, verged(0.1, 0.2), Pinhole(100.0), 100.0)
    assert views.left.dtype == views.right.dtype == torch.float32 and views.left.max() <= 1
    grey = views.grey()
    assert grey.shape == (2, 1, 20, 30) and views.colour().shape == (2, 3, 20, 30)
    torch.testing.assert_close(grey[1], right.float())
    weights = torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(grey[0, 0], (left.float() / 255 * weights[:, None, None]).sum(0))
    batch = torch.rand(4, 3, 20, 30)
    both = verged_views(batch, 1 - batch, verged(0.1, 0.2), Pinhole(100.0), 100.0).grey()
    torch.testing.assert_close(both[:4] + both[4:], torch.ones(8, 1, 20, 30)[:4])


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
@pytest.mark.parametrize("params", [SGBM(), Sweep()], ids=["sgbm", "sweep"])
def test_half_precision_is_that_of_the_pixels_alone(params, half):
    """Nor does mixed precision around a matcher change what it finds."""
    left = torch.rand(1, 40, 50, generator=torch.Generator().manual_seed(0)).to(half)
    pair = left, left.roll(-3, -1)
    find = lambda *pair: Matcher(params)(posed_views(*pair, *CALIBRATED), LogPolar(200, 20.0), Budget())[0]  # noqa: E731
    expected = find(*(image.float() for image in pair))
    with torch.autocast("cpu", half):
        again = find(*(image.float() for image in pair))
    assert expected.valid.double().mean() > 0.3
    for found in (find(*pair), again):
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_gradients_reach_the_images():
    left = torch.rand(3, 20, 30, dtype=torch.float64, requires_grad=True)
    views = verged_views(left, left, verged(0.1, 0.2), Pinhole(100.0), 100.0)
    assert torch.autograd.gradcheck(lambda image: views._replace(left=image, right=image).grey(), left, fast_mode=True)


def test_the_budget_is_told_the_images_size():
    image = torch.rand(1, 60, 80)
    views = rectified_views(image, image, Pinhole(50.0), Pinhole(50.0), 0.1)
    assert views.told(None) == Budget(source_px=60) and views.told(Budget(source_px=None)).source_px is None


def test_where_the_eye_looks_is_on_its_image():
    """A retina that looks aside reaches beyond the image; nothing is seen there."""
    views, _, _ = calibrated((150.0, 64.5))
    frame = frame_to_match(views, RETINA, 0.5, 140.0, (-1, 47))
    left_px, right_px, ahead = frame.seen(views.grey())
    assert right_px.shape == left_px.shape == (*frame.size, 2)
    looks = frame.looked_at(left_px, ahead)
    assert looks.any() and views.holds(left_px, RETINA, 0.5)[looks].all() and RETINA.inside(left_px)[looks].all()


# ------------------------------------------------------------------------------------------------------------ errors

GOOD, CAMERA, RIG = torch.rand(3, 40, 40), Pinhole(100.0), verged(0.1, 0.2)
MAKERS = {
    "verged": lambda left, right: verged_views(left, right, RIG, CAMERA, 100.0),
    "rectified": lambda left, right: rectified_views(left, right, CAMERA, CAMERA, 0.2),
    "posed": lambda left, right: posed_views(left, right, CAMERA, CAMERA, RIG),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (torch.rand(2, 40, 40), GOOD, "left.shape"),
        (torch.rand(40, 40), GOOD, "left.shape"),
        (GOOD, torch.rand(40, 40), "right.shape"),
        (GOOD, torch.rand(3, 40, 41), "right.shape"),
        (GOOD, torch.rand(3, 0, 40), "right.shape"),
        (GOOD[None], GOOD, "right.shape"),
        (GOOD * math.nan, GOOD, "left = NaN"),
        (GOOD, GOOD / 0, "right = NaN"),
        (GOOD * 255, GOOD, r"left = .*\[0, 1\]"),
        (GOOD, GOOD - 0.5, r"right = .*\[0, 1\]"),
        (GOOD.long(), GOOD, "left.dtype"),
    ],
)
def test_bad_images_are_named(make, left, right, message):
    with pytest.raises(SettingError, match=message):
        make(left, right)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: verged_views(GOOD, GOOD, RIG, 100.0, 100.0), "camera = 100"),
        (lambda: verged_views(GOOD, GOOD, RIG, CAMERA, 0.0), "radius_px = 0"),
        (lambda: verged_views(GOOD, GOOD, 0.1, CAMERA, 100.0), "rig = float"),
        (lambda: verged_views(GOOD, GOOD, RIG._replace(baseline_m=-1.0), CAMERA, 100.0), "baseline_m = -1"),
        (lambda: verged_views(GOOD, GOOD, RIG._replace(R_left=torch.eye(2)), CAMERA, 100.0), "rig.R_left.shape"),
        (
            lambda: verged_views(GOOD, GOOD, RIG._replace(R_right=torch.eye(3).expand(2, 3, 3)), CAMERA, 100.0),
            "rig.R_right.shape",
        ),
        (lambda: posed_views(GOOD, GOOD, CAMERA, None, RIG), "camera_right = None"),
        (lambda: posed_views(GOOD, GOOD, CAMERA, CAMERA, RIG, (math.inf, 0.0)), "gaze_px"),
        (lambda: rectified_views(GOOD, GOOD, CAMERA, Pinhole(3.0), 0.1), "camera_right"),
        (lambda: rectified_views(GOOD, GOOD, CAMERA, Pinhole(100.0, 0.0, 1.0), 0.1), "camera_right"),
        (lambda: rectified_views(GOOD, GOOD, Fisheye(100.0), CAMERA, 0.1), "camera_left"),
        (lambda: rectified_views(GOOD, GOOD, CAMERA, CAMERA, 0.0), "baseline_m = 0"),
        (lambda: rectified_views(GOOD, GOOD, CAMERA, CAMERA, 0.1, (math.nan, 0)), "gaze_px"),
        (lambda: match_sweep(verged_views(GOOD, GOOD, RIG, CAMERA, 100.0), None), "sensor.layout = every_pixel"),
    ],
)
def test_bad_cameras_and_rigs_are_named(make, message):
    with pytest.raises(SettingError, match=message):
        make()
