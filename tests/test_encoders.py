"""Encoder errors against Monte Carlo: look with one gaze, believe another, triangulate."""

import math

import pytest
import torch

from torchfovea.gaussian import unpack
from torchfovea.memory.encoders import encoder_covariance, encoder_jacobian
from torchfovea.sensing.chart import inverse_range_coordinates
from torchfovea.sensing.head import Gaze, Head, eyes, fixate, to_ego
from torchfovea.sensing.triangulation import triangulate
from torchfovea.setting import SettingError

HEAD = Head()
SIGMA = tuple(math.radians(a) for a in (0.1, 0.07, 0.12))
POINTS = torch.tensor([[0.7, 0.3, -0.3], [2.0, -1.0, 0.4], [0.6, -0.05, 0.1], [3.5, 1.0, 0.05]], dtype=torch.float64)


def believed(points, gaze, error):
    """Points triangulated with the gaze that the encoders tell, from rays of the true one."""
    true = eyes(HEAD, gaze)
    rays = [to_ego(r.mT, points - t) for r, t in ((true.R_left, true.t_left), (true.R_right, true.t_right))]
    pose = eyes(HEAD, Gaze(*(a + e for a, e in zip(gaze, error.unbind(-1), strict=True))))
    left, right = (
        r @ ray[..., None] for r, ray in zip((pose.R_left, pose.R_right), (x[:, None] for x in rays), strict=True)
    )
    found, ahead = triangulate(left[..., 0], right[..., 0], pose.t_left, pose.t_right)
    assert bool(ahead.all())
    return found


@pytest.mark.parametrize("chart", ["cartesian", "inverse_range"])
def test_covariance_against_monte_carlo(chart, generator):
    gaze = fixate(HEAD, POINTS[0])[0]
    error = torch.randn(20000, 3, generator=generator, dtype=torch.float64) * torch.tensor(SIGMA, dtype=torch.float64)
    found = believed(POINTS, gaze, error)
    if chart == "inverse_range":
        direction = (POINTS / POINTS.norm(dim=-1, keepdim=True))[:, None].expand_as(found)
        found = inverse_range_coordinates(found, torch.ones_like(found[..., 0]), direction)
    got = unpack(encoder_covariance(POINTS, eyes(HEAD, gaze), SIGMA, chart))
    for k in range(len(POINTS)):
        want = torch.cov(found[k].T)
        scale = want.diagonal().sqrt()
        torch.testing.assert_close(got[k] / scale / scale[:, None], want / scale / scale[:, None], atol=0.03, rtol=0)


def test_jacobian_against_differences():
    gaze = fixate(HEAD, POINTS[1])[0]
    step = 1e-6 * torch.eye(3, dtype=torch.float64)
    for k, got in enumerate(encoder_jacobian(POINTS, eyes(HEAD, gaze))):
        ahead, back = (believed(POINTS, gaze, sign * step[k : k + 1])[:, 0] for sign in (1, -1))
        torch.testing.assert_close(got, (ahead - back) / 2e-6, rtol=1e-6, atol=1e-7)


def test_batches_dtypes_and_gradients(dtype):
    gazes = fixate(HEAD, POINTS)[0]
    points = POINTS.to(dtype).expand(4, 4, 3)
    pose = eyes(HEAD, Gaze(*(a.to(dtype) for a in gazes)))
    whole = encoder_covariance(points, pose, SIGMA)
    assert whole.dtype == dtype and whole.shape == (4, 4, 6)
    for b in range(4):
        torch.testing.assert_close(whole[b], encoder_covariance(points[b], type(pose)(*(x[b] for x in pose)), SIGMA))
    single = eyes(HEAD, Gaze(*(a[0] for a in gazes)))
    leaf = POINTS.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: encoder_covariance(x, single, (1.0, 0.7, 1.2)), (leaf,))


@pytest.mark.parametrize(
    ("sigma", "chart", "message"), [((-1, 0, 0), "cartesian", "sigma_rad"), (SIGMA, "polar", "chart = polar")]
)
def test_errors(sigma, chart, message):
    with pytest.raises(SettingError, match=message):
        encoder_covariance(POINTS, eyes(HEAD, fixate(HEAD, POINTS[0])[0]), sigma, chart)


@pytest.mark.parametrize("chart", ["cartesian", "inverse_range"])
def test_the_origin_and_the_baseline_are_finite(chart, dtype):
    """Beside them, where rounding does not reach, it is the ordinary covariance."""
    pose = eyes(HEAD, Gaze(*torch.zeros(3, dtype=dtype)))
    axis = pose.t_right - pose.t_left
    points = torch.stack([0 * axis, pose.t_left - axis, pose.t_left, 1e-20 * axis, POINTS[0].to(dtype)])
    leaf = points.clone().requires_grad_()
    cov = encoder_covariance(leaf, pose, SIGMA, chart)
    (gradient,) = torch.autograd.grad(cov.sum(), leaf)
    assert bool(cov.isfinite().all()) and bool(gradient.isfinite().all())
    torch.testing.assert_close(cov[4], encoder_covariance(POINTS[:1].to(dtype), pose, SIGMA, chart)[0])
    turns = encoder_jacobian(points, pose)
    assert bool((turns[0][0] == 0).all()) and bool((turns[1][0] == 0).all())
