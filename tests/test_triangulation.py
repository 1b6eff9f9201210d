"""Triangulation and the transform through it: SciPy least squares, kornia, Monte Carlo, and laws of both charts."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import triangulate_points
from scipy.optimize import least_squares

from torchfovea.gaussian import Gaussian, quadratic3, unpack
from torchfovea.rows import stack
from torchfovea.sensing import triangulation
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.chart import cartesian_from_inverse_range, inverse_range_coordinates
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Eyes, Gaze, Head, cyclopean, eyes, fixate, rig_frame, to_ego
from torchfovea.sensing.triangulation import observe, triangulate, triangulate_rectified
from torchfovea.sensing.unscented import SigmaPoints, sigma_root
from torchfovea.setting import SettingError

HEAD = Head()
CAMERA = Pinhole.from_fov(90, 100)
HALF = torch.tensor(0.5)


def stereo(points: torch.Tensor, sigma: float, gaze: Gaze | None = None, camera=CAMERA) -> tuple[Correspondences, Eyes]:
    """Exact correspondences of points (N, 3) in E."""
    zero = torch.zeros((), dtype=points.dtype)
    pose = eyes(HEAD, gaze or Gaze(zero, zero, zero + 0.1))
    left = camera.project(to_ego(pose.R_left.mT, points - pose.t_left))
    right = camera.project(to_ego(pose.R_right.mT, points - pose.t_right))
    spread = torch.full(points.shape[:-1], sigma, dtype=points.dtype)
    seen, sure = torch.ones(points.shape[:-1], dtype=torch.bool), torch.ones_like(spread)
    half = HALF.expand_as(spread)
    return Correspondences(left, right, spread, spread, seen, sure, half, torch.zeros_like(spread)), pose


def cloud(
    count: int, seed: int, dtype: torch.dtype = torch.float64, nearest: float = 0.5, farthest: float = 4.0
) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    u = torch.rand(count, 3, generator=rng, dtype=torch.float64)
    x = nearest + (farthest - nearest) * u[:, 0]
    return torch.stack([x, (u[:, 1] - 0.5) * x, (u[:, 2] - 0.5) * x], -1).to(dtype)


def rig_rays(matches: Correspondences, pose: Eyes, camera=CAMERA) -> tuple[torch.Tensor, torch.Tensor]:
    frame, _, _ = rig_frame(pose)
    return (
        to_ego(frame.mT @ pose.R_left, camera.rays(matches.left_px)),
        to_ego(frame.mT @ pose.R_right, camera.rays(matches.right_px)),
    )


@given(seed=st.integers(0, 1000))
def test_exact_rays_meet_at_the_point_in_both_forms(seed):
    points = cloud(20, seed)
    matches, pose = stereo(points, 0.1)
    left, right = to_ego(pose.R_left, CAMERA.rays(matches.left_px)), to_ego(pose.R_right, CAMERA.rays(matches.right_px))
    midpoint, front = triangulate(left, right, pose.t_left, pose.t_right)
    frame, origin, baseline = rig_frame(pose)
    x, w, ahead = triangulate_rectified(*rig_rays(matches, pose), baseline)
    assert bool(front.all() and ahead.all())
    torch.testing.assert_close(midpoint, points, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(to_ego(frame, x / w[..., None]) + origin, points, rtol=1e-8, atol=1e-9)


def test_the_rig_frame_of_a_head_is_cyclopean():
    gaze = Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (0.4, 0.2, 0.3)))
    frame, origin, baseline = rig_frame(eyes(HEAD, gaze))
    want, middle = cyclopean(HEAD, gaze)
    torch.testing.assert_close(frame, want)
    torch.testing.assert_close(origin, middle)
    assert baseline.item() == pytest.approx(HEAD.baseline_m)
    apart = eyes(HEAD, gaze)
    with pytest.raises(SettingError, match="baseline_m = 0"):
        rig_frame(apart._replace(t_right=apart.t_left))


def test_rays_of_any_length_meet_where_they_do_and_nearly_parallel_ones_are_finite(dtype):
    t_left, t_right = (torch.tensor([x, 0.0, 0], dtype=dtype) for x in (-0.1, 0.1))
    left, right = (torch.tensor([x, 0.0, 1], dtype=dtype) for x in (0.1, -0.1))
    for long, short in ((1.0, 1.0), (1e-30, 1e30), (1e-18, 1e-18), (1e15, 1e-20)):
        point, front = triangulate(long * left, short * right, t_left, t_right)
        assert front.item()
        torch.testing.assert_close(point, torch.tensor([0.0, 0, 1], dtype=dtype))
    for tilt in 10.0 ** torch.arange(-45, 0, dtype=torch.float64):
        nearly = torch.stack([tilt, 0 * tilt, tilt**0]).to(dtype).requires_grad_()
        point, front = triangulate(nearly, torch.tensor([0.0, 0, 1], dtype=dtype), t_left, t_right)
        (gradient,) = torch.autograd.grad(point[2], nearly)
        assert bool(point.isfinite().all())
        assert bool(gradient.isfinite().all()) and front.item() == (float(tilt) > torch.finfo(dtype).eps)
        if front:
            assert point[2].item() == pytest.approx(0.2 / float(tilt), rel=1e-5)


def test_vertical_noise_does_not_touch_the_depth():
    left = torch.tensor([[0.3, 0.5, 1.0]], dtype=torch.float64)
    right = torch.tensor([[0.1, 0.5, 1.0]], dtype=torch.float64)
    lifted = right + torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64)
    b = torch.tensor(0.2, dtype=torch.float64)
    for other in (right, lifted):
        x, w, _ = triangulate_rectified(left, other, b)
        assert (x[0, 2] / w[0]).item() == pytest.approx(1.0)


def test_skew_rays_midpoint_is_the_least_squares_point():
    rng = np.random.default_rng(0)
    for _ in range(10):
        tl, tr = rng.normal(size=(2, 3)) * 0.1
        point = np.array([0, 0, 2.0]) + rng.normal(size=3) * 0.3
        dl, dr = point - tl + rng.normal(size=3) * 0.01, point - tr + rng.normal(size=3) * 0.01

        def residual(p, tl=tl, tr=tr, dl=dl, dr=dr):
            return np.concatenate([np.cross(p - t, d / np.linalg.norm(d)) for t, d in ((tl, dl), (tr, dr))])

        got, front = triangulate(*(torch.from_numpy(v) for v in (dl, dr, tl, tr)))
        # the point nearest to both lines is the middle of their common perpendicular
        best = least_squares(residual, point, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        assert front.item()
        np.testing.assert_allclose(got, best, atol=1e-6)


def test_agrees_with_kornia_on_exact_matches():
    points = cloud(30, 3)
    matches, pose = stereo(points, 0.1)
    k = torch.diag(torch.tensor([CAMERA.focal_px, CAMERA.focal_px, 1.0], dtype=torch.float64))
    projections = [
        k @ torch.cat([r.mT, -(r.mT @ t)[:, None]], -1)
        for r, t in ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right))
    ]
    peer = triangulate_points(
        projections[0][None], projections[1][None], matches.left_px[None], matches.right_px[None]
    )[0]
    observed = observe(matches, pose, CAMERA, HALF, SigmaPoints(), "cartesian")
    torch.testing.assert_close(observed.mean, peer, rtol=2e-2, atol=2e-3)  # the UT's mean adds the curvature of 1/D


def test_parallel_and_diverging_rays_are_masked_or_beyond_infinity():
    left = torch.tensor([[0.0, 0, 1], [-0.1, 0, 1], [0.1, 0, 1]], dtype=torch.float64, requires_grad=True)
    right = torch.tensor([[0.0, 0, 1], [0.1, 0, 1], [-0.1, 0, 1]], dtype=torch.float64)
    tl, tr = torch.tensor([-0.1, 0, 0], dtype=torch.float64), torch.tensor([0.1, 0, 0], dtype=torch.float64)
    point, front = triangulate(left, right, tl, tr)
    assert front.tolist() == [False, False, True] and bool(torch.isfinite(point).all())
    x, w, ahead = triangulate_rectified(left, right, torch.tensor(0.2, dtype=torch.float64))
    assert ahead.all() and w[0].item() == 0 and w[1] < 0 < w[2] and bool((x[..., 2] > 0).all())
    (point.sum() + x.sum() + w.sum()).backward()
    assert bool(torch.isfinite(left.grad).all())


@given(left=st.floats(0.01, 3), right=st.floats(0.01, 3))
def test_both_roots_are_roots(left, right):
    sl, sr = torch.tensor(left, dtype=torch.float64), torch.tensor(right, dtype=torch.float64)
    for rotated in (False, True):
        root = sigma_root(sl, sr, rotated)
        want = torch.diag(torch.stack([sl, sl, sr, sr]) ** 2)
        torch.testing.assert_close(root @ root.mT, want, rtol=1e-9, atol=1e-12)
    version = sigma_root(sl, sr)[:, 1]
    assert version[0] == version[2]  # moves both eyes alike


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
@pytest.mark.parametrize("camera", [CAMERA, Fisheye.from_fov(120, 100)])
def test_moments_match_monte_carlo(chart, camera):
    """400,000 samples; disparity noise over disparity is below 5% here."""
    points = torch.tensor([[1.0, 0.2, -0.1], [0.7, -0.3, 0.1]], dtype=torch.float64)
    matches, pose = stereo(points, 0.3, camera=camera)
    observed = observe(matches, pose, camera, HALF, chart=chart)
    rng = torch.Generator().manual_seed(0)
    noise = 0.3 * torch.randn(400_000, 2, 4, generator=rng, dtype=torch.float64)
    left = to_ego(pose.R_left, camera.rays(matches.left_px + noise[..., :2]))
    right = to_ego(pose.R_right, camera.rays(matches.right_px + noise[..., 2:]))
    sample, front = triangulate(left, right, pose.t_left, pose.t_right)
    assert bool(front.all())
    if chart == "inverse_range":
        frame, origin, baseline = rig_frame(pose)
        shaken = matches._replace(left_px=matches.left_px + noise[..., :2], right_px=matches.right_px + noise[..., 2:])
        x, w, _ = triangulate_rectified(*rig_rays(shaken, pose, camera), baseline)
        x = to_ego(frame, x) + w[..., None] * origin
        sample = inverse_range_coordinates(x, w, observed.direction)
    for i in range(2):
        want = np.cov(sample[:, i].numpy().T)
        scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
        np.testing.assert_allclose((unpack(observed.cov[i]).numpy() - want) / scale, 0, atol=0.02)
        np.testing.assert_allclose(
            (observed.mean[i].numpy() - sample[:, i].mean(0).numpy()) / np.sqrt(np.diag(want)), 0, atol=0.02
        )


def test_charts_agree_near_the_axis_and_inverse_range_is_no_worse_beside_it():
    """Beside the axis the midpoint lets vertical noise into the depth; rectified disparity does not."""
    points = cloud(50, 5, farthest=1.5)
    for spread, tolerance in ((0.1, 2e-3), (1.0, 0.05)):
        matches, pose = stereo(points * torch.tensor([1, spread, spread], dtype=torch.float64), 0.02)
        inverse = observe(matches, pose, CAMERA, HALF)
        cartesian = observe(matches, pose, CAMERA, HALF, chart="cartesian")
        converted = cartesian_from_inverse_range(Gaussian(inverse.mean, inverse.cov), inverse.direction)
        torch.testing.assert_close(converted.mean, cartesian.mean, rtol=1e-3, atol=1e-4)
        relative = (converted.cov - cartesian.cov).norm(dim=-1) / cartesian.cov.norm(dim=-1)
        assert relative.max() < tolerance
        along = [quadratic3(c.cov, inverse.direction) for c in (converted, cartesian)]
        assert bool((along[0] < along[1] * 1.001).all())


def test_infinity_is_an_ordinary_place_in_inverse_range_only():
    far = torch.tensor([[1e7, 0.0, 0.1e7]], dtype=torch.float64)
    matches, pose = stereo(far, 0.2)
    inverse, cartesian = (observe(matches, pose, CAMERA, HALF, chart=c) for c in ("inverse_range", "cartesian"))
    assert inverse.valid.item() and not cartesian.valid.item()
    # σ of 1/r: disparity noise √2 0.2 px over f b
    assert inverse.cov[0, 5].sqrt().item() == pytest.approx(
        0.2 * math.sqrt(2) / CAMERA.focal_px / HEAD.baseline_m, rel=0.05
    )


def test_invalid_is_finite_and_float32_is_float64():
    matches, pose = stereo(cloud(40, 2), 0.1)
    broken = matches._replace(
        valid=torch.arange(40) % 2 == 0, right_sigma_px=torch.where(torch.arange(40) == 4, 0.0, matches.right_sigma_px)
    )
    observed = observe(broken, pose, CAMERA, HALF)
    assert observed.valid.sum() == 19 and all(bool(torch.isfinite(x).all()) for x in observed[:6])
    single = observe(
        Correspondences(*(x.float() if x is not None and x.is_floating_point() else x for x in matches)),
        Eyes(*(x.float() for x in pose)),
        CAMERA,
        HALF,
    )
    double = observe(matches, pose, CAMERA, HALF)
    assert single.mean.dtype == torch.float32
    torch.testing.assert_close(single.mean.double(), double.mean, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(single.cov.double(), double.cov, rtol=1e-2, atol=1e-9)


def test_batch_is_loop():
    points = cloud(6, 9)
    gazes = fixate(HEAD, points[:2])[0]
    many = [stereo(points, 0.1, Gaze(*(g[i] for g in gazes))) for i in range(2)]
    matches = stack([m for m, _ in many])
    whole = observe(matches, eyes(HEAD, gazes), CAMERA, HALF)
    for i, (m, pose) in enumerate(many):
        for a, b in zip(whole[:6], observe(m, pose, CAMERA, HALF)[:6], strict=True):
            torch.testing.assert_close(a[i], b)


def general(monkeypatch):
    """Make `observe` take the path through the images of the sigma points, as for any camera."""
    monkeypatch.setattr(triangulation, "Pinhole", type(None))


@pytest.mark.parametrize("points", [SigmaPoints(), SigmaPoints.paper(), SigmaPoints.midpoint()])
@pytest.mark.parametrize("rotated", [True, False])
def test_the_bilinear_form_is_the_transform_point_by_point(points, rotated, monkeypatch):
    """Two eyes with other cameras, rolled against each other; some rays leave the view, some σ are none."""
    every = cloud(400, 7, nearest=0.35, farthest=40.0)
    matches, pose = stereo(every, 0.5)
    roll = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, 0.02], [0.1, 0, 0.03], [-0.02, -0.03, 0]]).double())
    pose = pose._replace(R_right=pose.R_right @ roll, t_right=pose.t_right + 0.02)
    other = Pinhole(83.0, 4.0, -3.0)
    seen = other.project(to_ego(pose.R_right.mT, every - pose.t_right))
    rng = torch.Generator().manual_seed(2)
    spread = 0.2 + torch.rand(2, 400, generator=rng, dtype=torch.float64)
    spread[0, :20], spread[1, 20:40] = 0.0, 300.0
    matches = matches._replace(right_px=seen, left_sigma_px=spread[0], right_sigma_px=spread[1])
    cameras, kind = (Pinhole(CAMERA.focal_px, 1.5, 2.5), other), {"points": points, "rotated": rotated}
    quick = observe(matches, pose, cameras, HALF, **kind)
    general(monkeypatch)
    slow = observe(matches, pose, cameras, HALF, **kind)
    assert 0 < int((~slow.valid).sum()) < 200
    for name, a, b in zip(slow._fields[:6], quick[:6], slow[:6], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-10, msg=lambda said, name=name: f"{name}: {said}")


def test_float32_is_as_good_by_the_bilinear_form(monkeypatch):
    matches, pose = stereo(cloud(2000, 4), 0.1)
    single = Correspondences(*(x.float() if x is not None and x.is_floating_point() else x for x in matches))
    rough = Eyes(*(x.float() for x in pose))
    truth, quick = observe(matches, pose, CAMERA, HALF), observe(single, rough, CAMERA, HALF)
    general(monkeypatch)
    slow = observe(single, rough, CAMERA, HALF)
    std = unpack(truth.cov).diagonal(dim1=-2, dim2=-1).sqrt()
    for part in (0, 1):
        error = [
            ((seen[part].double() - truth[part]) / (std if part == 0 else truth.cov.norm(dim=-1)[:, None])).square()
            for seen in (quick, slow)
        ]
        assert float(error[0].mean()) < float(error[1].mean())


def test_pieces_are_the_whole(monkeypatch):
    points = cloud(101, 8)
    gazes = fixate(HEAD, points[:3])[0]
    many = [stereo(points, 0.1, Gaze(*(g[i] for g in gazes))) for i in range(3)]
    matches = stack([m for m, _ in many])
    for chart in ("inverse_range", "cartesian"):
        whole = observe(matches, eyes(HEAD, gazes), CAMERA, HALF, chart=chart)
        for block in (1, 40, 302):
            with monkeypatch.context() as patch:
                patch.setattr(triangulation, "BLOCK", block)
                pieces = observe(matches, eyes(HEAD, gazes), CAMERA, HALF, chart=chart)
            for a, b in zip(pieces[:6], whole[:6], strict=True):
                torch.testing.assert_close(a, b)
    cut = (None if t is None else t[..., :0, :] if t.dim() == 3 else t[..., :0] for t in matches)
    none = observe(Correspondences(*cut), eyes(HEAD, gazes), CAMERA, HALF)
    assert none.mean.shape == (3, 0, 3) and none.cov.shape == (3, 0, 6) and none.valid.shape == (3, 0)


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_gradients(chart):
    matches, pose = stereo(cloud(3, 1, farthest=1.5), 0.1)

    def through(left, right, sigma):
        o = observe(
            matches._replace(left_px=left, right_px=right, left_sigma_px=sigma), pose, CAMERA, HALF, chart=chart
        )
        return o.mean, o.cov

    inputs = (matches.left_px, matches.right_px, matches.left_sigma_px)
    assert torch.autograd.gradcheck(
        lambda *poses: observe(matches, Eyes(*poses), CAMERA, HALF, chart=chart)[:2],
        tuple(x.detach().clone().requires_grad_() for x in pose),
    )
    assert torch.autograd.gradcheck(through, tuple(x.detach().clone().contiguous().requires_grad_() for x in inputs))


NAN, INF = math.nan, math.inf


@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
@pytest.mark.parametrize("camera", [CAMERA, Fisheye.from_fov(120.0, 100.0)], ids=["pin", "fish"])
def test_what_is_not_valid_has_no_part_in_a_gradient(chart, camera):
    """One ordinary match has the same gradients beside masked nonsense, and beside a claimed match without a sigma."""
    clean, _ = stereo(torch.tensor([[1.2, 0.2, -0.1]], dtype=torch.float64), 0.3, camera=camera)
    places = torch.tensor([[0.0, 0], [NAN, 3], [INF, 3], [3, -INF], [1e300, 0]], dtype=torch.float64)
    place = places.repeat(5, 1)
    sigma = torch.tensor([0.0, 0.3, NAN, INF, 1e300], dtype=torch.float64).repeat_interleave(5)
    claimed = torch.arange(25) == 0
    parts = (place, -place, sigma, sigma, claimed, *[torch.ones_like(sigma)] * 3, None)
    pairs = zip(clean, parts, strict=True)
    mixed = Correspondences(*(None if one is None else torch.cat((one, other)) for one, other in pairs))

    def gradients(matches):
        gaze = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in (0.05, -0.02, 0.12)]
        leaves = [t.clone().requires_grad_() for t in matches[:4]]
        seen = observe(Correspondences(*leaves, *matches[4:]), eyes(HEAD, Gaze(*gaze)), camera, HALF, chart=chart)
        assert seen.valid.tolist() == [True] + [False] * (len(seen.valid) - 1)
        total = sum((part * part.detach()).sum() for part in seen[:4])
        return seen, torch.autograd.grad(total, [*gaze, *leaves])

    (_, alone), (seen, among) = gradients(clean), gradients(mixed)
    for a, b in zip(alone[:3], among[:3], strict=True):
        torch.testing.assert_close(b, a)
    for a, b in zip(alone[3:], among[3:], strict=True):
        torch.testing.assert_close(b[:1], a)
        assert bool((b[1:] == 0).all())
    plain = observe(mixed, eyes(HEAD, Gaze(*torch.tensor([0.05, -0.02, 0.12]).double())), camera, HALF, chart=chart)
    assert bool(plain.mean.isfinite().all()) and bool(plain.cov.isfinite().all())
    for part, learned in zip(plain[:4], seen[:4], strict=True):
        torch.testing.assert_close(part[0], learned[0])


def test_unknown_chart_is_an_error():
    matches, pose = stereo(cloud(1, 0), 0.1)
    with pytest.raises(SettingError, match="chart = polar"):
        observe(matches, pose, CAMERA, HALF, chart="polar")
