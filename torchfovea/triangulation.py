"""From correspondences to 3-D Gaussians in the ego frame: triangulation and the unscented transform through it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.camera import Camera
from torchfovea.chart import basis, inverse_range_coordinates
from torchfovea.correspondence import Correspondences
from torchfovea.gaussian import columns, positive_definite
from torchfovea.head import Eyes, to_ego as turn
from torchfovea.setting import require
from torchfovea.unscented import SigmaPoints, unscented_transform

__all__ = ["Observations", "observe", "rig_frame", "sigma_root", "triangulate", "triangulate_rectified"]


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

    It is `triangulate` where the rays meet. Where noise keeps them apart it leaves the vertical mismatch out of the depth
    (which is what the likelihood of isotropic noise on a rectified pair says), and numerator and denominator keep their
    signs through parallel rays, where the shortest segment between skew rays would jump toward the eyes.

    Args:
        left: directions (..., 3) of any length, x along the baseline from left to right, z ahead.
        right: directions (..., 3).
        baseline_m: broadcastable to (...).

    Returns:
        X (..., 3) and w (...), the point being X/w about the baseline's middle (w < 0 beyond infinity), and whether both
        rays look ahead: bool (...). Where they do not, X and w are finite and meaningless.

    Differentiable.
    """
    xl, yl, zl = left.unbind(-1)
    xr, yr, zr = right.unbind(-1)
    ahead = (zl > 0) & (zr > 0)
    across, back = xl * zr, xr * zl
    half = baseline_m / 2
    x = columns(half * (across + back), half * torch.addcmul(yl * zr, yr, zl), baseline_m * (zl * zr))
    w = across - back
    if not bool(ahead.all()):
        x = torch.where(ahead[..., None], x, torch.ones_like(x))
        w = torch.where(ahead, w, torch.ones_like(w))
    return x, w, ahead


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
    if not rotated:
        rows = [[left_sigma, zero, zero, zero], [zero, left_sigma, zero, zero]]
        rows += [[zero, zero, right_sigma, zero], [zero, zero, zero, right_sigma]]
    else:
        scale = (left_sigma * left_sigma + right_sigma * right_sigma).rsqrt()
        left, right, both = left_sigma**2 * scale, -(right_sigma**2) * scale, left_sigma * right_sigma * scale
        rows = [
            [left, both, zero, zero],
            [zero, zero, left, both],
            [right, both, zero, zero],
            [zero, zero, right, both],
        ]
    flat = [entry for row in rows for entry in row]
    return columns(*flat).unflatten(-1, (4, 4))


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
        points: sigma points of four dimensions; None: `SigmaPoints()`.
        chart: `inverse_range` or `cartesian`.
        rotated: see `sigma_root`.
        right_camera: where the right eye has another.

    Returns:
        Observations. Valid are those whose nine sigma points all lie in front of both eyes (in inverse range: whose
        rays look ahead, for infinity is an ordinary place there) and whose covariance is positive definite.

    Raises:
        SettingError: for an unknown chart.

    Differentiable in the correspondences, their sigmas and the poses.
    """
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    points = points or SigmaPoints()
    mean = columns(*matches.left_px.unbind(-1), *matches.right_px.unbind(-1))
    in_front = torch.ones((), dtype=torch.bool)
    direction = torch.empty(())
    frame, origin, baseline = rig_frame(eyes)
    to_left, to_right = frame.mT @ eyes.R_left, frame.mT @ eyes.R_right

    def rays(px: Tensor) -> tuple[Tensor, Tensor]:
        left, right = camera.rays(px[..., :2]), (right_camera or camera).rays(px[..., 2:])
        return turn(to_left, left), turn(to_right, right)

    def cartesian(px: Tensor) -> Tensor:
        nonlocal in_front, direction
        half = torch.stack([baseline / 2, torch.zeros_like(baseline), torch.zeros_like(baseline)], -1).unsqueeze(-2)
        point, in_front = triangulate(*rays(px), -half, half)
        point = turn(frame, point) + origin.unsqueeze(-2)
        direction = point[0] * (point[0] * point[0]).sum(-1, keepdim=True).rsqrt()
        return point

    def inverse_range(px: Tensor) -> Tensor:
        nonlocal in_front, direction
        x, w, in_front = triangulate_rectified(*rays(px), baseline.unsqueeze(-1))
        # the origin of E, seen in the rig's axes: there the sigma points stay, and the few directions come to them
        shift = turn(frame.mT, origin.unsqueeze(-2))
        x = torch.addcmul(x, w[..., None], shift)
        ahead = x[0] * (x[0] * x[0]).sum(-1, keepdim=True).rsqrt()
        direction = turn(frame, ahead)
        return inverse_range_coordinates(x, w, ahead, tuple(turn(frame.mT, e) for e in basis(direction)))

    root = sigma_root(matches.left_sigma_px, matches.right_sigma_px, rotated)
    value, cov, _ = unscented_transform(cartesian if chart == "cartesian" else inverse_range, mean, root, points)
    valid = matches.valid & in_front.all(0) & positive_definite(cov) & torch.isfinite(value).all(-1)
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
