"""From correspondences to 3-D Gaussians in the ego frame: triangulation and the unscented transform through it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns, definiteness
from torchfovea.machine import loops
from torchfovea.rounding import unrounded
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.chart import in_tangent_frame
from torchfovea.sensing.correspondence import Correspondences, check_valid
from torchfovea.sensing.head import Eyes, rig_frame
from torchfovea.sensing.head import to_ego as turn
from torchfovea.sensing.pinhole import form_moments, form_of, observe_by_loops
from torchfovea.sensing.two_rays import EyePair, Moments, placed, rectified, turned
from torchfovea.sensing.unscented import SigmaPoints, moments, root_rows, sigma_components
from torchfovea.setting import require

__all__ = ["Observations", "observe", "triangulate", "triangulate_rectified"]

BLOCK = 16384  # receptive fields at once, a thread: intermediate results stay in its cache; half of them point by point


class Observations(NamedTuple):
    """Gaussian points in a chart, one for each receptive field.

    Attributes:
        mean: (..., N, 3), chart coordinates (see `torchfovea.sensing.chart`).
        cov: packed, (..., N, 6).
        direction: unit directions in E, (..., N, 3); the nominal ones of the inverse-range chart.
        support_rad: half the width that the receptive field covers, seen from the eye, (..., N).
        valid: bool (..., N); the others are finite but mean nothing.
        inlier: (..., N), see `torchfovea.sensing.correspondence.Correspondences`; None: certain.
        chart: `inverse_range` or `cartesian`; a memory takes those of its own.
    """

    mean: Tensor
    cov: Tensor
    direction: Tensor
    support_rad: Tensor
    valid: Tensor
    inlier: Tensor | None = None
    chart: str = "inverse_range"


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
        included, as far as their dtype can tell) the point is finite and meaningless.

    Differentiable where in front; zero gradient elsewhere.

    References:
        Wang, Liu (2007), for the midpoint method.
    """
    baseline = t_right - t_left
    # by their largest components, so that products keep within the dtype's range
    sizes = (d.detach().abs().amax(-1, keepdim=True) for d in (left, right))
    left, right = (d / torch.where(n > 0, n, torch.ones_like(n)) for d, n in zip((left, right), sizes, strict=True))
    c = _cross(left, right)
    square = (c * c).sum(-1)
    s, t = (_cross(baseline, right) * c).sum(-1), (_cross(baseline, left) * c).sum(-1)
    in_front = (s > 0) & (t > 0) & (square > torch.finfo(square.dtype).eps ** 2)
    inverse = 1 / torch.where(in_front, square, torch.ones_like(square))
    point = (t_left + t_right + (s * inverse)[..., None] * left + (t * inverse)[..., None] * right) / 2
    return torch.where(in_front[..., None], point, torch.ones_like(point)), in_front


def triangulate_rectified(left: Tensor, right: Tensor, baseline_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The point between two rays in the rig's own frame, in homogeneous form: depth from horizontal disparity alone.

    With the eyes at ∓b/2 on the x axis and rays (x, y, z), (x', y', z') it is X/w, with w = x z' − x' z and

        X = b/2 (x z' + x' z, y z' + y' z, 2 z z').

    It is `triangulate` where the rays meet. Where noise keeps them apart it leaves the vertical mismatch out of it
    (as the likelihood of isotropic noise on a rectified pair does), and X and w keep their signs through parallel rays,
    where the shortest segment between skew rays would jump toward the eyes.

    Args:
        left: directions (..., 3) of any length, x along the baseline from left to right, z ahead.
        right: directions (..., 3).
        baseline_m: broadcastable to (...).

    Returns:
        X (..., 3) and w (...), the point being X/w about the baseline's middle (w < 0 beyond infinity), and whether
        both rays look ahead: bool (...). Where they do not, X and w are finite and meaningless.

    Differentiable.
    """
    (x, y, z), w, least = rectified(left.unbind(-1), right.unbind(-1))
    half, ahead = baseline_m / 2, least > 0
    seen = ahead[..., None]
    point = columns(half * x, half * y, half * z)
    return torch.where(seen, point, torch.ones_like(point)), torch.where(ahead, w, torch.ones_like(w)), ahead


@unrounded
def observe(
    matches: Correspondences,
    eyes: Eyes,
    camera: Camera | tuple[Camera, Camera],
    support_px: Tensor,
    points: SigmaPoints | None = None,
    chart: str = "inverse_range",
    rotated: bool = True,
) -> Observations:
    """Correspondences as Gaussian points in E: the unscented transform through triangulation (Eq. 6-18, 22-27).

    Args:
        matches: correspondences (..., N) with their retinal standard deviations.
        eyes: poses of the cameras in E, (...).
        camera: both eyes' camera, or the left one's and the right one's, in retinal pixels.
        support_px: half the width of each left receptive field, (..., N) or (N,) [px].
        points: sigma points of four dimensions; None: `SigmaPoints()`, in the Cartesian chart
            `SigmaPoints.midpoint()`.
        chart: `inverse_range` or `cartesian`.
        rotated: see `torchfovea.sensing.unscented.sigma_root`.

    Returns:
        Observations. Valid are those whose nine sigma points all lie in front of both eyes (in inverse range: whose
        rays look ahead, for infinity is an ordinary place there), whose standard deviations are positive and whose
        covariance is positive definite.

    Raises:
        SettingError: for an unknown chart, or sigma points of other than four dimensions.

    Differentiable in the correspondences, their sigmas and the poses.
    """
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    check_valid(matches)
    points = points or (SigmaPoints.midpoint() if chart == "cartesian" else SigmaPoints())
    require(len(points.weights[0]) == 9, "points.dimensions", points.dimensions, "4, two places' coordinates")
    batch, count = matches.valid.shape[:-1], matches.valid.shape[-1]
    eyes = Eyes(*(part.expand(*batch, *part.shape[-k:]) for part, k in zip(eyes, (2, 1, 2, 1), strict=True)))
    cameras = camera if isinstance(camera, tuple) else (camera, camera)
    left, right = cameras
    pinholes = None
    if chart == "inverse_range" and isinstance(left, Pinhole) and isinstance(right, Pinhole):
        pinholes = left, right
        library = loops(*matches[:4], *eyes, support_px)
        found = library and observe_by_loops(library, matches, eyes, pinholes, support_px, points, rotated)
        if found:
            value, direction, support, valid = found
            return _observations(matches, value, direction, support, valid, chart)
    frame, origin, baseline = rig_frame(eyes)
    rig = EyePair(frame, origin, baseline, frame.mT @ eyes.R_left, frame.mT @ eyes.R_right, *cameras)
    transform = partial(_transform, rig=rig, points=points, chart=chart, rotated=rotated)
    if pinholes is not None:
        transform = partial(form_moments, form=form_of(rig, *pinholes), points=points, rotated=rotated)
    learning = torch.is_grad_enabled() and any(t.requires_grad for t in (*matches[:4], *eyes))
    if learning:
        matches = _safe(matches, cameras, transform)
    block = BLOCK if pinholes is not None else -(-BLOCK // 2)
    blocks = max(1, round(matches.valid.numel() / (block * torch.get_num_threads())))
    size = count if learning or matches.valid.device.type != "cpu" else -(-count // blocks)
    parts = []
    for start in range(0, max(count, 1), max(size, 1)):
        axes = zip(matches[:5], (-2, -2, -1, -1, -1), strict=True)
        part = Correspondences(*(t.narrow(axis, start, min(size, count - start)) for t, axis in axes))
        parts.append(_settled(part, *transform(part)))
    value, direction, valid = (p[0] if len(p) == 1 else torch.cat(p, -1) for p in zip(*parts, strict=True))
    x, y, z = left.ray_components(*matches.left_px.unbind(-1))
    support = support_px / left.focal_px * torch.addcmul(torch.addcmul(z * z, x, x), y, y).rsqrt()
    return _observations(matches, value, direction, support.expand(valid.shape), valid, chart)


def _observations(
    matches: Correspondences, value: Tensor, direction: Tensor, support: Tensor, valid: Tensor, chart: str
) -> Observations:
    """What components (9, ..., N) and (3, ..., N) say."""
    mean, cov = value[:3].movedim(0, -1), value[3:].movedim(0, -1)
    inlier = valid.to(mean.dtype) if matches.inlier is None else matches.inlier
    return Observations(mean, cov, direction.movedim(0, -1), support, valid, inlier, chart)


def _safe(
    matches: Correspondences, cameras: tuple[Camera, Camera], transform: Callable[[Correspondences], Moments]
) -> Correspondences:
    """Ordinary values in place of those that will not be valid, whose gradients might not be finite even times 0."""
    with torch.no_grad():
        keep = _settled(matches, *transform(matches))[2]
    ahead = [matches.left_px.new_tensor([camera.cx_px, camera.cy_px]) for camera in cameras]
    left, right = (torch.where(keep[..., None], px, a) for px, a in zip(matches[:2], ahead, strict=True))
    sigma_l, sigma_r = (torch.where(keep, sigma, torch.ones_like(sigma)) for sigma in matches[2:4])
    return Correspondences(left, right, sigma_l, sigma_r, keep, matches.inlier)


def _transform(matches: Correspondences, rig: EyePair, points: SigmaPoints, chart: str, rotated: bool) -> Moments:
    """The transform point by point (Eq. 10-18), for any camera and chart."""
    root = root_rows(matches.left_sigma_px, matches.right_sigma_px, rotated)
    places = sigma_components((*matches.left_px.unbind(-1), *matches.right_px.unbind(-1)), root, points)
    left = turned(rig.left, rig.left_camera.ray_components(*places[:2]))
    right = turned(rig.right, rig.right_camera.ray_components(*places[2:]))
    if chart == "cartesian":
        zero = torch.zeros_like(rig.baseline)
        half = torch.stack([rig.baseline / 2, zero, zero], -1).unsqueeze(-2)
        point, both = triangulate(columns(*left), columns(*right), -half, half)
        point = turn(rig.frame, point) + rig.origin.unsqueeze(-2)
        direction = point[0] * (point[0] * point[0]).sum(-1, keepdim=True).rsqrt()
        return *moments(point.unbind(-1), points), direction.movedim(-1, 0), both.all(0).to(direction.dtype)
    x, w, least = rectified(left, right)
    x = placed(rig, x, w := w * (2 / rig.baseline.unsqueeze(-1)))
    direction = torch.stack([c[0] for c in x])
    direction = direction * (direction * direction).sum(0).rsqrt()
    a, b, ahead = in_tangent_frame(direction.unbind(0), x)
    rho = w * torch.addcmul(torch.addcmul(x[0] * x[0], x[1], x[1]), x[2], x[2]).rsqrt()
    return *moments((a / ahead, b / ahead, rho), points), direction, least.amin(0)


def _settled(
    matches: Correspondences, first: list[Tensor], second: list[Tensor], direction: Tensor, ahead: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and covariance (9, ..., N), of unit size where not valid; the direction; and what is valid."""
    # positive where all conditions hold, not a number where anything is not finite: comparing once is faster
    with torch.no_grad():
        sure = torch.minimum(matches.left_sigma_px, matches.right_sigma_px)
        keep = torch.minimum(torch.minimum(ahead, sure), definiteness(second))
        keep = (keep > 0) & matches.valid
        gone = 1 - keep.to(ahead.dtype)
    value = torch.stack([*first, *second])
    unit = value.new_tensor([1.0, 1, 1, 1, 0, 0, 1, 0, 1]).reshape(-1, *[1] * gone.dim())
    return torch.addcmul((value * (1 - gone)).nan_to_num(0.0, 0.0, 0.0), unit, gone), direction, keep
