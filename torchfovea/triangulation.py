"""From correspondences to 3-D Gaussians in the ego frame: triangulation and the unscented transform through it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.camera import Camera
from torchfovea.chart import basis
from torchfovea.correspondence import Correspondences
from torchfovea.gaussian import columns, positive_definite
from torchfovea.head import Eyes
from torchfovea.head import to_ego as turn
from torchfovea.setting import require
from torchfovea.unscented import SigmaPoints, moments, sigma_components

__all__ = ["Observations", "observe", "rig_frame", "sigma_root", "triangulate", "triangulate_rectified"]

BLOCK = 8192
Components = tuple[Tensor, ...]


class Observations(NamedTuple):
    """Gaussian points in a chart, one for each receptive field.

    Attributes:
        mean: (..., N, 3), chart coordinates (see `torchfovea.chart`).
        cov: packed, (..., N, 6).
        direction: unit directions in E, (..., N, 3); the nominal ones of the inverse-range chart.
        support_rad: half the width that the receptive field covers, seen from the eye, (..., N).
        valid: bool (..., N); the others are finite but mean nothing.
    """

    mean: Tensor
    cov: Tensor
    direction: Tensor
    support_rad: Tensor
    valid: Tensor


def _dot(a: Components, b: Components) -> Tensor:
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def _turned(rotation: Tensor, vector: Components) -> Components:
    """`torchfovea.head.to_ego` by components: R v, rotation (..., 3, 3) and v's (*any, ..., N)."""
    row = [[rotation[..., i, j].unsqueeze(-1) for j in range(3)] for i in range(3)]
    return tuple(torch.addcmul(torch.addcmul(r[2] * vector[2], r[0], vector[0]), r[1], vector[1]) for r in row)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    x, y, z = a.unbind(-1)
    u, v, w = b.unbind(-1)
    return columns(y * w - z * v, z * u - x * w, x * v - y * u)


def triangulate(left: Tensor, right: Tensor, t_left: Tensor, t_right: Tensor) -> tuple[Tensor, Tensor]:
    """Midpoint of the shortest segment between two rays (Eq. 8), in cross-product form.

    With c = dₗ × dᵣ and the baseline b, the rays' parameters are s = (b × dᵣ)·c/|c|² and t = (b × dₗ)·c/|c|²; forming c
    itself keeps float32 as good as float64, where the textbook's ac − b² does not.

    Args:
        left: directions dₗ (..., 3) of any length, in one frame with all others.
        right: directions dᵣ (..., 3).
        t_left: the left eye's centre, broadcastable to (..., 3) [m].
        t_right: the right eye's centre.

    Returns:
        Points (..., 3) [m] and whether they lie in front of both eyes, bool (...). Where they do not (parallel rays
        included) the point is finite and meaningless.

    Differentiable where in front; zero gradient elsewhere.

    References:
        Wang, Liu (2007), for the midpoint method.
    """
    baseline = t_right - t_left
    c = _cross(left, right)
    square = (c * c).sum(-1)
    s, t = (_cross(baseline, right) * c).sum(-1), (_cross(baseline, left) * c).sum(-1)
    in_front = (s > 0) & (t > 0) & (square > 0)
    inverse = 1 / torch.where(in_front, square, torch.ones_like(square))
    point = (t_left + t_right + (s * inverse)[..., None] * left + (t * inverse)[..., None] * right) / 2
    return torch.where(in_front[..., None], point, torch.ones_like(point)), in_front


def triangulate_rectified(left: Tensor, right: Tensor, baseline_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The point between two rays in the rig's own frame, in homogeneous form: depth from horizontal disparity alone.

    With the eyes at ∓b/2 on the x axis, rays (x, y, z) and (x', y', z'):

        X = b/2 (x z' + x' z, y z' + y' z, 2 z z'),   w = x z' − x' z.

    It is `triangulate` where the rays meet. Where noise keeps them apart it leaves the vertical mismatch out of it
    (which is what the likelihood of isotropic noise on a rectified pair says), and numerator and denominator keep their
    signs through parallel rays, where the shortest segment between skew rays would jump toward the eyes.

    Args:
        left: directions (..., 3) of any length, x along the baseline from left to right, z ahead.
        right: directions (..., 3).
        baseline_m: broadcastable to (...).

    Returns:
        X (..., 3) and w (...), the point being X/w about the baseline's middle (w < 0 beyond infinity), and whether
        both rays look ahead: bool (...). Where they do not, X and w are finite and meaningless.

    Differentiable.
    """
    (x, y, z), w, least = _rectified(left.unbind(-1), right.unbind(-1))
    half, ahead = baseline_m / 2, least > 0
    seen = ahead[..., None]
    point = columns(half * x, half * y, half * z)
    return torch.where(seen, point, torch.ones_like(point)), torch.where(ahead, w, torch.ones_like(w)), ahead


def _rectified(left: Components, right: Components) -> tuple[Components, Tensor, Tensor]:
    """2 X/b and w of `triangulate_rectified`, and how far ahead the rays look (> 0: both do)."""
    xl, yl, zl = left
    xr, yr, zr = right
    across, back = xl * zr, xr * zl
    return (
        (across + back, torch.addcmul(yl * zr, yr, zl), 2 * (zl * zr)),
        across - back,
        torch.minimum(zl, zr),
    )


def rig_frame(eyes: Eyes) -> tuple[Tensor, Tensor, Tensor]:
    """The rectified frame of two eyes: x along the baseline to the right, z midway between the optical axes.

    For a head it is the cyclopean frame.

    Args:
        eyes: poses in E, (...).

    Returns:
        Its axes in E as the columns of R (..., 3, 3), its origin midway between the eyes t (..., 3) and the baseline
        (...) [m].

    Raises:
        SettingError: for a baseline of no length.

    Differentiable.
    """
    across = eyes.t_right - eyes.t_left
    baseline = across.square().sum(-1).sqrt()
    require(bool((baseline > 0).all()), "baseline_m", 0.0, "eyes some distance apart")
    x = across / baseline[..., None]
    z = eyes.R_left[..., 2] + eyes.R_right[..., 2]
    z = z - (z * x).sum(-1, keepdim=True) * x
    z = z / z.square().sum(-1, keepdim=True).sqrt()
    return torch.stack([x, torch.linalg.cross(z, x), z], -1), (eyes.t_left + eyes.t_right) / 2, baseline


def sigma_root(left_sigma: Tensor, right_sigma: Tensor, rotated: bool = True) -> Tensor:
    """A square root of Σ = diag(σₗ², σₗ², σᵣ², σᵣ²) over (uₗ, vₗ, uᵣ, vᵣ) (Eq. 7).

    Args:
        left_sigma: (...) [px].
        right_sigma: (...) [px].
        rotated: turn the root so that its columns are disparity and version, horizontal and vertical: the version
            columns move both eyes alike and leave the disparity alone, so that the whole curvature of triangulation
            lies along one axis, where the sigma points integrate it. False: the diagonal (Cholesky) root.

    Returns:
        (..., 4, 4), Σ = root rootᵀ. Differentiable.
    """
    zero = torch.zeros_like(left_sigma)
    rows = _root_rows(left_sigma, right_sigma, rotated)
    return columns(*(zero if entry is None else entry for row in rows for entry in row)).unflatten(-1, (4, 4))


def _root_rows(left: Tensor, right: Tensor, rotated: bool) -> list[list[Tensor | None]]:
    """The rows of `sigma_root`, None for zero."""
    if not rotated:
        return [
            [left, None, None, None],
            [None, left, None, None],
            [None, None, right, None],
            [None, None, None, right],
        ]
    scale = (left * left + right * right).rsqrt()
    there, back, both = left * left * scale, -(right * right) * scale, left * right * scale
    return [
        [there, both, None, None],
        [None, None, there, both],
        [back, both, None, None],
        [None, None, back, both],
    ]


def observe(
    matches: Correspondences,
    eyes: Eyes,
    camera: Camera,
    support_px: Tensor,
    points: SigmaPoints | None = None,
    chart: str = "inverse_range",
    rotated: bool = True,
    right_camera: Camera | None = None,
) -> Observations:
    """Correspondences as Gaussian points in E: the unscented transform through triangulation (Eq. 6-18, 22-27).

    Args:
        matches: correspondences (..., N) with their retinal standard deviations.
        eyes: poses of the cameras in E, (...).
        camera: both eyes' camera, or the left one's, in retinal pixels.
        support_px: half the width of each left receptive field, (..., N) or (N,) [px].
        points: sigma points of four dimensions; None: `SigmaPoints()`, in the Cartesian chart
            `SigmaPoints.midpoint()`.
        chart: `inverse_range` or `cartesian`.
        rotated: see `sigma_root`.
        right_camera: where the right eye has another.

    Returns:
        Observations. Valid are those whose nine sigma points all lie in front of both eyes (in inverse range: whose
        rays look ahead, for infinity is an ordinary place there), whose standard deviations are positive and whose
        covariance is positive definite.

    Raises:
        SettingError: for an unknown chart.

    Differentiable in the correspondences, their sigmas and the poses.
    """
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    points = points or (SigmaPoints.midpoint() if chart == "cartesian" else SigmaPoints())
    count = matches.valid.shape[-1]
    learning = torch.is_grad_enabled() and any(t.requires_grad for t in (*matches[:4], *eyes))
    if count <= BLOCK or learning or not matches.valid.device.type == "cpu":
        return _observe(matches, eyes, camera, support_px, points, chart, rotated, right_camera or camera)
    # nine sigma points of a few thousand receptive fields stay in the processor's cache; of all of them they do not
    axes = (-2, -2, -1, -1, -1)
    parts = []
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        part = Correspondences(*(t.narrow(axis, start, size) for t, axis in zip(matches, axes, strict=True)))
        support = support_px.narrow(-1, start, size)
        parts.append(_observe(part, eyes, camera, support, points, chart, rotated, right_camera or camera))
    means, covs, directions, supports, valids = zip(*parts, strict=True)
    return Observations(_join(means), _join(covs), _join(directions), torch.cat(supports, -1), torch.cat(valids, -1))


def _join(parts: tuple[Tensor, ...]) -> Tensor:
    """Join (..., n, k) along n, each component contiguous as `columns` makes it."""
    return torch.cat([part.movedim(-1, 0) for part in parts], -1).movedim(0, -1)


def _observe(
    matches: Correspondences,
    eyes: Eyes,
    camera: Camera,
    support_px: Tensor,
    points: SigmaPoints,
    chart: str,
    rotated: bool,
    right_camera: Camera,
) -> Observations:
    frame, origin, baseline = rig_frame(eyes)
    root = _root_rows(matches.left_sigma_px, matches.right_sigma_px, rotated)
    places = sigma_components((*matches.left_px.unbind(-1), *matches.right_px.unbind(-1)), root, points)
    left = _turned(frame.mT @ eyes.R_left, camera.ray_components(*places[:2]))
    right = _turned(frame.mT @ eyes.R_right, right_camera.ray_components(*places[2:]))
    if chart == "cartesian":
        half = torch.stack([baseline / 2, torch.zeros_like(baseline), torch.zeros_like(baseline)], -1).unsqueeze(-2)
        point, both = triangulate(columns(*left), columns(*right), -half, half)
        in_front = both.all(0)
        point = turn(frame, point) + origin.unsqueeze(-2)
        direction = point[0] * (point[0] * point[0]).sum(-1, keepdim=True).rsqrt()
        first, second = moments(point.unbind(-1), points)
    else:
        x, w, least = _rectified(left, right)
        in_front = least.amin(0) > 0
        w = w * (2 / baseline.unsqueeze(-1))
        # the origin of E joins in the rig's axes: the few directions come to the sigma points, not these to E
        shift = turn(frame.mT, origin.unsqueeze(-2)).unbind(-1)
        x = tuple(torch.addcmul(c, w, s) for c, s in zip(x, shift, strict=True))
        ahead = columns(*(c[0] for c in x))
        ahead = ahead * (ahead * ahead).sum(-1, keepdim=True).rsqrt()
        direction = turn(frame, ahead)
        tangents = [turn(frame.mT, e).unbind(-1) for e in basis(direction)]
        # (a, b, ρ) of `torchfovea.chart`, by components
        depth = 1 / _dot(ahead.unbind(-1), x)
        offsets = [_dot(e, x) * depth for e in tangents]
        first, second = moments((*offsets, w * _dot(x, x).rsqrt()), points)
    value, cov = columns(*first), columns(*second)
    sure = torch.minimum(matches.left_sigma_px, matches.right_sigma_px) > 0
    valid = matches.valid & sure & in_front & positive_definite(cov) & torch.isfinite(value).all(-1)
    safe = columns(*(torch.full_like(valid, float(k in (0, 3, 5)), dtype=cov.dtype) for k in range(6)))
    centre = camera.rays(matches.left_px)
    support = support_px / camera.focal_px * (centre * centre).sum(-1).rsqrt()
    return Observations(
        torch.where(valid[..., None], value, torch.ones_like(value)),
        torch.where(valid[..., None], cov, safe),
        direction,
        support.expand(valid.shape),
        valid,
    )
