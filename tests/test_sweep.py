import math

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve
from test_loops import CLOSE, both

from torchfovea.sensing.camera import Fisheye, Pinhole, image_camera
from torchfovea.sensing.correspondence import Budget, eye_sigma_px
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.stereo.costs import left_eye
from torchfovea.stereo.matchers import Matcher, match_all
from torchfovea.stereo.rig import posed, verged
from torchfovea.stereo.semiglobal import aggregate
from torchfovea.stereo.sheets import average, nearest_rf, read_sheet, sheets
from torchfovea.stereo.surfaces import win
from torchfovea.stereo.sweep import Sweep, Volume, match_sweep
from torchfovea.stereo.views import batched_views, rectified_views, verged_views

BASELINE_M = 0.2
RETINAS = [LogPolar(3000), Uniform(3000), LogPolar(3000, uniform_fovea=True)]
IDS = ["log_polar", "uniform", "uniform_fovea"]


def texture(points, seed=0, waves=80, finest_m=0.06):
    """A smooth random pattern in space, (..., 3) to (...), 0 to 1."""
    rng = np.random.default_rng(seed)
    k = torch.from_numpy(rng.normal(size=(waves, 3)))
    k = (
        k
        / k.norm(dim=-1, keepdim=True)
        * torch.from_numpy(2 * math.pi / (finest_m * 8 ** rng.uniform(size=(waves, 1))))
    )
    phase = torch.from_numpy(rng.uniform(0, 2 * math.pi, waves))
    return 0.5 + 0.45 * torch.tanh(torch.cos(points @ k.T + phase).mean(-1) * math.sqrt(waves))


def plane_hit(origin, directions, normal, distance):
    """The range along rays (..., 3) at which they meet the plane normal · X = distance; infinite if they do not."""
    along = (distance - origin @ normal) / (directions @ normal)
    return torch.where(along > 0, along, torch.full_like(along, math.inf))


class Room:
    """Textured planes in the rectified frame, seen by two eyes at (∓baseline/2, 0, 0)."""

    def __init__(self, planes, vergence=0.15, camera=None, seed=0):
        self.planes = [(torch.tensor(n, dtype=torch.float64), d, test) for n, d, test in planes]
        self.rig = verged(vergence, BASELINE_M)
        self.camera = camera or Pinhole.from_fov(90.0, 100.0)
        self.seed = seed

    def cast(self, origin, directions):
        ranges = []
        for normal, distance, inside in self.planes:
            along = plane_hit(origin, directions, normal, distance)
            point = origin + along.clamp(max=1e3)[..., None] * directions
            ranges.append(torch.where(inside(point), along, torch.full_like(along, math.inf)))
        return torch.stack(ranges).amin(0)

    def eye(self, which):
        side = -0.5 if which == 0 else 0.5
        return torch.tensor([side * BASELINE_M, 0.0, 0.0], dtype=torch.float64), self.rig[which]

    def images(self, size=160):
        x = torch.arange(size, dtype=torch.float64)
        px = torch.stack(torch.broadcast_tensors(x, x[:, None]), -1)
        out = []
        for which in (0, 1):
            origin, rotation = self.eye(which)
            rays = image_camera(self.camera, 100.0, size).rays(px) @ rotation.T
            out.append(texture(origin + self.cast(origin, rays).clamp(max=50)[..., None] * rays, self.seed)[None])
        return out

    def views(self, *images):
        """The images of both eyes, or of a size, for retinas with a radius of 100 px."""
        return verged_views(*(images if len(images) == 2 else self.images(*images)), self.rig, self.camera, 100.0)

    def truth(self, left_px):
        """Right pixels, inverse range from the left eye and visibility, by ray casting."""
        origin, rotation = self.eye(0)
        rays = self.camera.rays(left_px.double()) @ rotation.T
        rays = rays / rays.norm(dim=-1, keepdim=True)
        along = self.cast(origin, rays)
        point = origin + along[:, None] * rays
        other, turned = self.eye(1)
        line = point - other
        seen = self.cast(other, line) > 1 - 1e-6
        right = self.camera.project(line @ turned)
        return right, 1 / along, seen & (right.norm(dim=-1) <= 100) & self.camera.in_view(line @ turned)


def everywhere(point):
    return torch.ones_like(point[..., 0], dtype=torch.bool)


WALL = ((0.2, 0.1, 1.0), 1.3, everywhere)
BOARD = ((0.0, 0.0, 1.0), 0.8, lambda p: (p[..., 0].abs() < 0.22) & (p[..., 1].abs() < 0.25))


def widths(retina, px, size):
    return retina.width_px(px).clamp(min=2 * retina.radius_px / size).double()


@pytest.mark.parametrize("retina", RETINAS, ids=IDS)
@pytest.mark.parametrize("camera", [Pinhole.from_fov(90.0, 100.0), Fisheye.from_fov(120.0, 100.0)], ids=["pin", "fish"])
def test_a_slanted_wall(retina, camera):
    room = Room([WALL], camera=camera)
    matches, found = match_sweep(room.views(), retina)
    assert torch.equal(matches.left_px, retina.centers_px(dtype=torch.float64))
    right, rho, seen = room.truth(matches.left_px)
    inner = seen & (right.norm(dim=-1) < 90)
    assert matches.valid[inner].double().mean() > 0.95
    both = matches.valid & seen
    error = (matches.right_px - right).norm(dim=-1)[both] / widths(retina, right, 160)[both]
    assert error.median() < 0.15
    assert (error > 1).double().mean() < 0.02
    assert ((found.inverse_range - rho)[both].abs() / rho[both]).median() < 0.03
    own = eye_sigma_px(Budget(source_px=160), retina, matches.right_px)
    assert (matches.right_sigma_px >= own).all()
    assert torch.equal(found.valid, matches.valid)
    assert (found.inverse_range[~found.valid] == 0).all()


def test_the_variance_follows_the_noise():
    room = Room([WALL])
    generator = torch.Generator().manual_seed(1)
    left, right = room.images()
    spreads, errors = [], []
    for noise in (0.0, 0.06):
        noisy = [
            (i + noise * torch.randn(i.shape, generator=generator, dtype=i.dtype)).clamp(0, 1) for i in (left, right)
        ]
        matches, found = match_sweep(room.views(*noisy), LogPolar(3000))
        _, rho, seen = room.truth(matches.left_px)
        both = found.valid & seen
        spreads.append(found.sigma[both].median())
        errors.append(((found.inverse_range - rho)[both] / found.sigma[both]).abs().median())
    assert spreads[1] > 1.3 * spreads[0]
    assert 0.2 < errors[1] < 1.5  # 0.67 for a perfect Gaussian


def test_what_the_right_eye_cannot_see_is_mostly_rejected():
    room = Room([WALL, BOARD])
    retina = Uniform(6000)
    matches, _ = match_sweep(room.views(200), retina)
    right, _, seen = room.truth(matches.left_px)
    hidden = ~seen & (right.norm(dim=-1) < 90)
    assert hidden.sum() > 50
    assert matches.valid[seen & (right.norm(dim=-1) < 90)].double().mean() > 0.93
    unchecked, _ = match_sweep(room.views(200), retina, Sweep(left_right=False))
    assert matches.valid[hidden].double().mean() < 0.6 * unchecked.valid[hidden].double().mean()


def test_a_volume_of_interest_settles_what_repeats():
    """A wall of equal stripes fits at many depths; the memory knows which."""
    room = Room([((0.0, 0.0, 1.0), 1.0, everywhere)], vergence=0.1)
    size = 160
    x = torch.arange(size, dtype=torch.float64)
    px = torch.stack(torch.broadcast_tensors(x, x[:, None]), -1)
    images = []
    for which in (0, 1):
        origin, rotation = room.eye(which)
        rays = image_camera(room.camera, 100.0, size).rays(px) @ rotation.T
        point = origin + room.cast(origin, rays)[..., None] * rays
        images.append(
            (0.5 + 0.3 * torch.sin(point[..., 0] * 2 * math.pi / 0.12) + 0.1 * torch.sin(60 * point[..., 1]))[None]
        )
    retina = Uniform(3000)
    _, rho, seen = room.truth(retina.centers_px(dtype=torch.float64))
    volume = Volume(rho - 0.2, rho + 0.4)
    _, found = match_sweep(room.views(*images), retina, volume=volume)
    both = found.valid & seen
    assert both.double().sum() > 0.8 * seen.double().sum()
    assert ((found.inverse_range - rho)[both].abs() < 0.1).double().mean() > 0.95
    assert ((found.inverse_range - (rho + 0.1)).abs()[found.valid] <= 0.31 + 0.1).all()
    wide = Volume(torch.zeros(retina.count), torch.full((retina.count,), math.inf))
    free = match_sweep(room.views(*images), retina)[1]
    assert torch.equal(match_sweep(room.views(*images), retina, volume=wide)[1].valid, free.valid)


def test_a_rectified_pair_with_different_centres():
    """Truth: a plane at 2 m; the right camera's axis is 7 px aside, and the retinas look off centre."""
    focal, baseline, size = 180.0, 0.2, (120, 160)
    left_camera, right_camera = Pinhole(focal, 82.0, 60.5), Pinhole(focal, 89.0, 60.5)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    images = []
    for camera, shift in ((left_camera, 0.0), (right_camera, baseline)):
        point = 2.0 * camera.rays(torch.stack([x, y], -1))
        point[..., 0] += shift
        images.append(texture(point)[None])
    retina = LogPolar(2000)
    views = rectified_views(*images, left_camera, right_camera, baseline, gaze_px=(70.0, 55.0))
    found, along = match_sweep(views, retina)
    true = focal * baseline / 2.0 - 7.0
    scale = 120 / 200
    shift = ((found.left_px - found.right_px)[:, 0] * scale)[found.valid]
    assert found.valid.double().mean() > 0.6
    assert (shift - true).abs().median() < 0.2  # RFs are at least 1 px wide
    eye = views.cameras(retina)[0]
    assert eye.focal_px == pytest.approx(focal / scale)
    rays = eye.rays(found.left_px)
    depth = rays[:, 2] / rays.norm(dim=-1) / along.inverse_range
    assert (depth[found.valid] - 2.0).abs().median() < 0.05


@pytest.mark.parametrize("retina", [LogPolar(1200), Uniform(1200)], ids=["log_polar", "uniform"])
def test_batch_is_a_loop(retina):
    """Of pairs that try different hypotheses, with volumes of interest and without, whatever else they share."""
    rooms = [Room([WALL], vergence=0.1), Room([WALL, BOARD], vergence=0.25, seed=3), Room([BOARD], vergence=0.1)]
    views = [room.views(64) for room in rooms]
    alone = [match_sweep(view, retina) for view in views]
    volumes = [
        Volume((found.inverse_range - near).clamp(min=0), found.inverse_range + far)
        for near, far, (_, found) in zip((0.3, 0.2, 9.0), (0.5, math.inf, math.inf), alone, strict=True)
    ]
    for chosen in ([None] * 3, volumes, [None, *volumes[1:]]):
        matchers = [Matcher(Sweep(), volume=volume) for volume in chosen]
        one = [match(view, retina, Budget()) for match, view in zip(matchers, views, strict=True)]
        many = match_all(matchers, views, retina, Budget())
        for (matches, found), (same, like) in zip(one, many, strict=True):
            assert torch.equal(matches.valid, same.valid) and matches.valid.any()
            parts = zip((*matches, *found[:3], *found.clues), (*same, *like[:3], *like.clues), strict=True)
            for part, other in parts:
                torch.testing.assert_close(part, other, rtol=1e-9, atol=1e-9)


def test_what_cannot_be_one_batch_is_matched_one_by_one():
    room, retina = Room([WALL]), Uniform(500)
    small, large, told = room.views(48), room.views(64), []

    def foreign(views, retina, budget):
        told.append(views.left.shape)
        return "matches", "found"

    assert match_all([foreign] * 2, [small, large], retina, Budget()) == [("matches", "found")] * 2
    assert told == [small.left.shape, large.left.shape]
    sweep, other = Matcher(Sweep()), Matcher(Sweep(window=2))
    assert batched_views([small, large]) is None and batched_views([small, small]).left.shape == (2, *small.left.shape)
    for matchers, views in (([sweep] * 2, [small, large]), ([sweep, other], [small] * 2), ([sweep], [large])):
        found = match_all(matchers, views, retina, Budget())
        for matcher, view, (matches, _) in zip(matchers, views, found, strict=True):
            assert torch.equal(matches.right_px, match_sweep(view, retina, matcher.params, Budget())[0].right_px)


@pytest.mark.parametrize("retina", [LogPolar(3000), Uniform(2000)], ids=["log_polar", "uniform"])
@pytest.mark.parametrize("camera", [Pinhole.from_fov(90.0, 100.0), Fisheye.from_fov(120.0, 100.0)], ids=["pin", "fish"])
@pytest.mark.parametrize(
    "params", [Sweep(uniqueness=1.0), Sweep(window=2, per_width=0.5, smooth_large=0.3)], ids=["own", "other"]
)
def test_loops_choose_the_winners_of_the_definition(retina, camera, params, dtype):
    """Of two pairs with as many hypotheses as each needs, everywhere and within bounds; long and closed lines too."""
    rooms = [Room([WALL], vergence=v, camera=camera, seed=k) for k, v in enumerate((0.1, 0.25))]
    generator, clear = torch.Generator().manual_seed(0), []
    noisy = [[i + 0.2 * torch.rand(i.shape, generator=generator) for i in room.images(64)] for room in rooms]
    views = batched_views(
        [r.views(*(i.to(dtype).clamp(0, 1) for i in own)) for r, own in zip(rooms, noisy, strict=True)]
    )
    eye = left_eye(views.grey(), views, retina)
    low = torch.rand(2, retina.count, generator=generator, dtype=dtype)
    for sheet in sheets(retina, 1 / eye.scale, torch.device("cpu"), dtype):
        for bounds in ((low.new_zeros(1, 1), low.new_full((1, 1), 3.0)), (low, low + 0.4)):
            one, other = both(lambda: win(eye, sheet, params, *bounds))  # noqa: B023
            clear.append(one.clear.double().mean())
            # rounding settles ties, and which quarter of a hypothesis is the nearest
            assert (one.clear == other.clear).double().mean() >= 0.998
            slack = CLOSE[dtype]["rtol"] * one.step
            near = ((one.rho - other.rho).abs() <= slack) & ((one.step - other.step).abs() <= slack)
            assert near.double().mean() >= 0.995
    assert 0.3 < sum(clear) / len(clear) < 0.995


def test_precision_and_colour(dtype):
    room = Room([WALL])
    left, right = (i.to(dtype) for i in room.images(96))
    retina = LogPolar(1200)
    grey, found = match_sweep(room.views(left, right), retina)
    assert all(t.dtype == dtype for t in (*grey[:4], *found[:3]))
    assert grey.valid.double().mean() > 0.6
    colour, _ = match_sweep(room.views(left.expand(3, -1, -1), right.expand(3, -1, -1)), retina)
    assert (colour.valid == grey.valid).double().mean() > 0.99
    bytes_ = [(i * 255).round().byte().numpy() for i in (left, right)]
    eight, _ = match_sweep(room.views(*bytes_), retina)
    assert (eight.valid == grey.valid).double().mean() > 0.95


def test_a_posed_rig_equals_a_verged_one():
    room = Room([WALL])
    R_left, R_right = room.rig[:2]
    other = posed(R_left.T @ R_right, R_left.T @ torch.tensor([BASELINE_M, 0.0, 0.0], dtype=torch.float64))
    images, retina = room.images(96), Uniform(800)
    a, b = (match_sweep(verged_views(*images, rig, room.camera, 100.0), retina)[0] for rig in (room.rig, other))
    torch.testing.assert_close(a.right_px, b.right_px, atol=1e-6, rtol=0)


@torch.no_grad()
def steady(function, inputs):
    """Which rows of the result stand on no border of a choice (of a winner, of what is valid): bool (N,).

    A step across a border changes a row by some 1e-2. On one surface second differences of these steps stay below 1e-6.
    """
    generator, here = torch.Generator().manual_seed(0), function(*inputs)
    keep = torch.ones(len(here), dtype=torch.bool)
    for step in (1e-7, 1e-6, 1e-5) * 4:
        moves = [step * torch.randn(i.shape, generator=generator, dtype=i.dtype) for i in inputs]
        ahead, back = (function(*(i + sign * m for i, m in zip(inputs, moves, strict=True))) for sign in (1, -1))
        keep &= ((ahead - 2 * here + back).abs() < 1e-5).all(-1)
    return keep


@pytest.mark.parametrize("retina", [LogPolar(120, rho_min_px=8.0), Uniform(120)], ids=["log_polar", "uniform"])
def test_differentiable_from_images_to_gaussians(retina):
    room = Room([WALL], vergence=0.1)
    left, right = room.images(24)
    origin = [room.eye(k)[0] for k in (0, 1)]
    eyes = Eyes(room.rig.R_left, origin[0], room.rig.R_right, origin[1])
    support = retina.width_px(retina.centers_px(dtype=torch.float64)) / 2

    def gaussians(left, right):
        matches, found = match_sweep(room.views(left, right), retina)
        seen = observe(matches, eyes, room.camera, support)
        values = seen.mean, seen.cov * 1e3, found.inverse_range[:, None], found.sigma[:, None]
        return seen.valid, torch.cat(values, -1)

    inputs = [i.clamp(0.02, 0.98).requires_grad_() for i in (left, right)]
    valid, _ = gaussians(*inputs)
    keep = valid & steady(lambda *images: gaussians(*images)[1], inputs)
    assert keep.sum() > 20 and keep.sum() > 0.9 * valid.sum()
    fixed = lambda *images: gaussians(*images)[1][keep]  # noqa: E731
    assert torch.autograd.gradcheck(fixed, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)
    gradients = torch.autograd.grad(fixed(*inputs).sum(), inputs)
    assert all(g.isfinite().all() and g.abs().sum() > 0 for g in gradients)


@pytest.mark.parametrize("image", [torch.full((1, 64, 64), 0.4), torch.zeros(1, 64, 64)], ids=["grey", "black"])
def test_without_texture_nothing_is_valid(image):
    room = Room([WALL])
    retina = LogPolar(600)
    image = image.clone().requires_grad_()
    matches, found = match_sweep(room.views(image, image), retina)
    assert not matches.valid.any()
    assert all(t.isfinite().all() for t in (*matches[:4], *found[:3]))
    origin = [room.eye(k)[0].float() for k in (0, 1)]
    eyes = Eyes(room.rig.R_left.float(), origin[0], room.rig.R_right.float(), origin[1])
    seen = observe(matches, eyes, room.camera, retina.width_px(matches.left_px) / 2)
    assert not seen.valid.any()
    assert seen.mean.isfinite().all() and seen.cov.isfinite().all()
    gradient = torch.autograd.grad(matches.right_px.sum() + matches.right_sigma_px.sum(), image)[0]
    assert (gradient == 0).all()


def test_unrelated_images_match_nowhere():
    generator = torch.Generator().manual_seed(0)
    left, right = torch.rand(2, 1, 120, 120, generator=generator)
    views = verged_views(left, right, verged(0.1, 0.2), Pinhole.from_fov(90.0, 100.0), 100.0)
    matches, _ = match_sweep(views, LogPolar(2000))
    assert matches.valid.double().mean() < 0.5
    assert all(t.isfinite().all() for t in matches[:4])


def test_bad_input_is_named():
    camera, retina, rig = Pinhole.from_fov(90.0, 100.0), LogPolar(600), verged(0.1, 0.2)
    good = torch.rand(1, 64, 64)
    cases = [
        ((good[:, :4], good[:, :4]), {}, "left.shape"),
        ((good, good), {"nearest_range_m": 0.0}, "nearest_range_m"),
        ((good, good), {"farthest_range_m": 0.2}, "farthest_range_m"),
        ((good, good), {"volume": Volume(torch.ones(3), torch.ones(3))}, "volume.least.shape"),
        ((good, good), {"volume": Volume(torch.ones(retina.count), torch.zeros(retina.count))}, "volume.most"),
        ((good, good), {"volume": Volume(torch.full((retina.count,), torch.nan), torch.ones(retina.count))}, "NaN"),
    ]
    for images, options, message in cases:
        with pytest.raises(SettingError, match=message):
            match_sweep(verged_views(*images, rig, camera, 100.0), retina, **options)
    with pytest.raises(SettingError, match="every_pixel"):
        match_sweep(rectified_views(good, good, camera, camera, 0.2), None)
    for name, value in {
        "window": 0, "refine_window": 4, "per_width": 0.0, "hypotheses": 3, "smooth_small": -1.0, "smooth_large": 0.1,
        "correlation": 1.0, "uniqueness": -0.1, "contrast": 0.0, "noise": 0.0,
        "winner_widths": 0.0, "temperature": 0.0, "volume_sigmas": 0.0,
    }.items():  # fmt: skip
        with pytest.raises(SettingError, match=f"matcher.{name}"):
            Sweep(**{name: value})


@pytest.mark.parametrize("retina", [*RETINAS, LogPolar(31416), Uniform(31416), LogPolar(300)], ids=str)
@pytest.mark.parametrize("pitch", [0.5, 3.0])
def test_sheets_hold_every_rf_once_at_its_place(retina, pitch):
    cut = sheets(retina, pitch, torch.device("cpu"), torch.float64)
    assert torch.equal(torch.cat([s.rf for s in cut]).sort().values, torch.arange(retina.count))
    for sheet in cut:
        one = torch.ones(1, *sheet.width_px.shape, dtype=torch.float64)
        px, found = read_sheet(sheet, sheet.px.movedim(-1, 0)[None], 0 * one, one > 0, one)
        assert found.all()
        centers = retina.centers_px(dtype=torch.float64)[sheet.rf]
        torch.testing.assert_close(px[0].T, centers, atol=1e-4, rtol=0)
        assert (sheet.width_px >= pitch).all()
        width, _ = read_sheet(sheet, sheet.width_px[None, None], 0 * one, one > 0, one)
        torch.testing.assert_close(width[0, 0], retina.width_px(centers).clamp(min=pitch), rtol=0.1, atol=0)


def test_sheets_do_not_average_over_edges():
    sheet = sheets(LogPolar(3000), 0.5, torch.device("cpu"), torch.float64)[0]
    values = (sheet.px[..., 0] > 0).double()[None]
    valid = torch.ones_like(values) > 0
    limit = torch.full_like(values, 0.5)
    out, found = read_sheet(sheet, values[:, None], values, valid, limit)
    assert found.all()
    assert set(out.unique().tolist()) == {0.0, 1.0}
    out, found = read_sheet(sheet, values[:, None], values, values > 0, limit)
    assert (out[:, 0][found] == 1).all() and (out[:, 0][~found] == 0).all()


@pytest.mark.parametrize("radius", [1, 2, 3])
@pytest.mark.parametrize("closed", [False, True])
def test_average_is_repeated_convolution(radius, closed, generator):
    values = torch.rand(2, 7, 9, generator=generator, dtype=torch.float64)
    expected = values.numpy()
    kernel = np.ones((1, 3, 1)) / 3
    for _ in range(radius):
        expected = convolve(expected, kernel, mode="nearest")
        expected = convolve(expected, kernel.transpose(0, 2, 1), mode="wrap" if closed else "nearest")
    np.testing.assert_allclose(average(values, radius, closed).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("retina", RETINAS, ids=IDS)
def test_nearest_rf(retina, generator):
    px = 140 * (torch.rand(500, 2, generator=generator, dtype=torch.float64) - 0.5)
    centers = retina.centers_px(dtype=torch.float64)
    found = (px - centers[nearest_rf(retina, 0.5, px)]).norm(dim=-1)
    best = (px[:, None] - centers).norm(dim=-1).amin(1)
    assert (found <= best + 0.5).all()


def aggregate_by_loops(cost, values, small, large, contrast):
    """Hirschmüller's recursion on one (D, R, S) volume, written out."""
    depth, rows, columns = cost.shape
    total = np.zeros_like(cost)
    for dr, dc in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        passed = np.zeros_like(cost)
        for r in range(rows)[:: dr or 1]:
            for c in range(columns)[:: dc or 1]:
                p, q = r - dr, c - dc
                passed[:, r, c] = cost[:, r, c]
                if 0 <= p < rows and 0 <= q < columns:
                    last = passed[:, p, q]
                    bound = max(large / (1 + abs(values[r, c] - values[p, q]) / contrast), small)
                    for d in range(depth):
                        near = [last[d]] + [last[e] + small for e in (d - 1, d + 1) if 0 <= e < depth]
                        passed[d, r, c] += min(*near, last.min() + bound) - last.min()
        total += passed / 4
    return total


def test_aggregation_against_loops(generator):
    cost = torch.rand(2, 6, 8, 10, generator=generator, dtype=torch.float64)
    values = torch.rand(2, 8, 10, generator=generator, dtype=torch.float64)
    out = aggregate(cost, values, False, 0.1, 0.6, 0.3)
    for b in range(2):
        expected = aggregate_by_loops(cost[b].numpy(), values[b].numpy(), 0.1, 0.6, 0.3)
        np.testing.assert_allclose(out[:, b].numpy(), expected, atol=1e-12)


def test_aggregation_in_segments_is_nearly_the_whole(generator):
    cost = torch.rand(1, 8, 3, 230, generator=generator, dtype=torch.float64)
    values = torch.rand(1, 3, 230, generator=generator, dtype=torch.float64)
    expected = aggregate_by_loops(cost[0].numpy(), values[0].numpy(), 0.2, 1.0, 0.2)
    out = aggregate(cost, values, False, 0.2, 1.0, 0.2)[:, 0].numpy()
    # paths forget: the first steps of a whole line have no predecessor, a segment's have a copy
    np.testing.assert_allclose(out[..., 12:-12], expected[..., 12:-12], atol=0.02)


def test_aggregation_on_a_closed_grid_has_no_seam(generator):
    cost = torch.rand(1, 5, 4, 96, generator=generator, dtype=torch.float64)
    values = torch.rand(1, 4, 96, generator=generator, dtype=torch.float64)
    out = aggregate(cost, values, True, 0.2, 1.0, 0.2)
    turned = aggregate(cost.roll(48, -1), values.roll(48, -1), True, 0.2, 1.0, 0.2)
    torch.testing.assert_close(turned, out.roll(48, -1))
