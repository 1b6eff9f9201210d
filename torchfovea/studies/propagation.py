"""Ways to carry retinal uncertainty through triangulation, compared with Monte Carlo on the same correspondences.

What decides how well a way works is e = σ_D/D, the disparity's noise over the disparity. D is taken in the rectified
view of a head that looks straight ahead, where a plane at distance Z has D = b/Z; σ_D is its first-order standard
deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import Gaussian, columns, pack, quadratic3, unpack
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.chart import inverse_range_coordinates
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Eyes, rig_frame, to_ego
from torchfovea.sensing.triangulation import triangulate, triangulate_rectified
from torchfovea.sensing.unscented import SigmaPoints, sigma_root, unscented_transform
from torchfovea.setting import require
from torchfovea.studies.characterization import PlaneSensor, correspond_plane, elementwise_jacobian, straight_eyes

__all__ = [
    "Comparison",
    "Sampled",
    "StereoCases",
    "chart_point",
    "compare_gaussians",
    "first_order",
    "noise_ratio",
    "sample_moments",
    "stereo_cases",
    "unscented",
]

# from +x towards +y: up and to the temporal side, so that the right eye sees what a strongly converged left eye sees
MERIDIAN_RAD = 2.5


class StereoCases(NamedTuple):
    """Correspondences of planes, C of them, each with its own pose.

    Attributes:
        matches: (C, 1, ...).
        eyes: (C, ...).
        camera: of both eyes.
        direction: nominal unit directions in E, (C, 1, 3).
        distance_m: the planes, (C,).
        ratio: e = σ_D/D, (C,).
        vergence_rad: (C,).
        eccentricity_rad: of the left receptive field, (C,).
    """

    matches: Correspondences
    eyes: Eyes
    camera: Camera
    direction: Tensor
    distance_m: Tensor
    ratio: Tensor
    vergence_rad: Tensor
    eccentricity_rad: Tensor


class Sampled(NamedTuple):
    """Moments of Monte Carlo samples.

    Attributes:
        moments: mean (C, 3) and packed covariance (C, 6), float64.
        kept: share of the samples with D > 0, to which the moments are restricted, (C,).
        range_error: standard error of the range's variance over itself, (C,).
    """

    moments: Gaussian
    kept: Tensor
    range_error: Tensor


class Comparison(NamedTuple):
    """How far a Gaussian is from a reference; each (...).

    Attributes:
        range_variance: its variance along the range over the reference's, less 1.
        covariance: ‖L⁻¹ Σ L⁻ᵀ − I‖/√3 (Frobenius) with L Lᵀ the reference: the error of all six entries in the
            coordinates that whiten the reference. Where Σ is the reference times 1 + δ it is |δ|.
        mean: distance of the means in the reference's standard deviations (Mahalanobis).
    """

    range_variance: Tensor
    covariance: Tensor
    mean: Tensor


def chart_point(
    px: Tensor, eyes: Eyes, camera: Camera, chart: str, direction: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Triangulate correspondences into chart coordinates, as `torchfovea.sensing.triangulation.observe` does.

    Args:
        px: (*any, ..., N, 4): left and right place [retinal px].
        eyes: poses (...).
        camera: of both eyes.
        chart: `cartesian` or `inverse_range`.
        direction: nominal unit directions, broadcastable to (..., N, 3); for inverse range.

    Returns:
        Coordinates (*any, ..., N, 3) and whether D > 0, so that the rays meet in front of the eyes; bool.

    Raises:
        SettingError: for an unknown chart, or inverse range without a direction.

    Differentiable in the places.
    """
    require(chart in ("cartesian", "inverse_range"), "chart", chart, "cartesian or inverse_range")
    left, right = to_ego(eyes.R_left, camera.rays(px[..., :2])), to_ego(eyes.R_right, camera.rays(px[..., 2:]))
    t_left, t_right = eyes.t_left.unsqueeze(-2), eyes.t_right.unsqueeze(-2)
    if chart == "cartesian":
        return triangulate(left, right, t_left, t_right)
    require(direction is not None, "direction", None, "the nominal directions of the inverse-range chart")
    assert direction is not None
    frame, origin, baseline = rig_frame(eyes)
    x, w, ahead = triangulate_rectified(to_ego(frame.mT, left), to_ego(frame.mT, right), baseline.unsqueeze(-1))
    x = to_ego(frame, x) + w[..., None] * origin.unsqueeze(-2)
    return inverse_range_coordinates(x, w, direction), ahead & (w > 0)


def _disparity(px: Tensor, eyes: Eyes, camera: Camera) -> Tensor:
    left, right = to_ego(eyes.R_left, camera.rays(px[..., :2])), to_ego(eyes.R_right, camera.rays(px[..., 2:]))
    return right[..., 1] / right[..., 0] - left[..., 1] / left[..., 0]


def noise_ratio(matches: Correspondences, eyes: Eyes, camera: Camera) -> Tensor:
    """Noise over disparity, e = σ_D/D, of correspondences (..., N), to first order; D is for a unit focal length."""
    px = torch.cat([matches.left_px, matches.right_px], -1)
    gradient = elementwise_jacobian(lambda place: _disparity(place, eyes, camera)[..., None], px).squeeze(-2)
    left, right = gradient[..., :2].square().sum(-1), gradient[..., 2:].square().sum(-1)
    sigma = (left * matches.left_sigma_px**2 + right * matches.right_sigma_px**2).sqrt()
    return sigma / _disparity(px, eyes, camera)


def stereo_cases(sensor: PlaneSensor, ratios: Tensor, vergence_rad: Tensor, eccentricity: Tensor) -> StereoCases:
    """Every combination of e, vergence and eccentricity: what one receptive field sees of planes far enough for that e.

    Args:
        sensor: the eyes and their error budget.
        ratios: wanted e = σ_D/D, (E,), > 0.
        vergence_rad: (V,).
        eccentricity: of the left place on `MERIDIAN_RAD`, as shares of the retina's radius (K,).

    Returns:
        At most E·V·K cases in float64, in this order: those whose plane the right eye sees too.

    Raises:
        SettingError: for ratios that are not positive, places outside the retina, or if no case is left.
    """
    require(bool((ratios > 0).all()), "ratios", ratios.tolist(), "positive numbers")
    within = bool(((eccentricity >= 0) & (eccentricity <= 1)).all())
    require(within, "eccentricities", eccentricity.tolist(), "shares of the retina's radius, 0 to 1")
    grid = torch.cartesian_prod(ratios.double(), vergence_rad.double(), eccentricity.double())
    ratio, vergence, share = grid.reshape(-1, 3).unbind(-1)
    rho = share * sensor.retina.radius_px
    angle = torch.full_like(rho, -MERIDIAN_RAD)
    left_px = columns(rho * torch.cos(angle), rho * torch.sin(angle)).unsqueeze(-2)
    pose = straight_eyes(sensor.baseline_m, vergence, torch.float64)
    distance = torch.full_like(ratio, 100 * sensor.baseline_m)
    matches, points = correspond_plane(sensor, left_px, pose, distance[:, None])
    for _ in range(30):  # e grows with the distance nearly in proportion: a few rounds would do
        distance = distance * ratio / noise_ratio(matches, pose, sensor.camera).squeeze(-1)
        matches, points = correspond_plane(sensor, left_px, pose, distance[:, None])
    # where the right eye sees no such plane nothing converges
    reached = noise_ratio(matches, pose, sensor.camera).squeeze(-1)
    found = matches.valid.squeeze(-1) & ((reached / ratio - 1).abs() < 1e-3)
    require(bool(found.any()), "ratios", ratios.tolist(), "disparities that some place of both retinas can show")
    ray = sensor.camera.rays(left_px)[:, 0]
    return StereoCases(
        matches.take(found),
        Eyes(*(part[found] for part in pose)),
        sensor.camera,
        (points / points.norm(dim=-1, keepdim=True))[found],
        distance[found],
        ratio[found],
        vergence[found],
        torch.atan2(ray[..., :2].norm(dim=-1), ray[..., 2])[found],
    )


def _mean_px(cases: StereoCases) -> Tensor:
    return torch.cat([cases.matches.left_px, cases.matches.right_px], -1)


def _through(cases: StereoCases, chart: str) -> Callable[[Tensor], Tensor]:
    """From places of cases to coordinates in a chart."""
    return lambda px: chart_point(px, cases.eyes, cases.camera, chart, cases.direction)[0]


def first_order(cases: StereoCases, chart: str) -> Gaussian:
    """The mean's image and J Σ Jᵀ with the Jacobian of automatic differentiation; (C, 3) and packed (C, 6)."""
    px, through = _mean_px(cases), _through(cases, chart)
    left, right = cases.matches.left_sigma_px, cases.matches.right_sigma_px
    scaled = elementwise_jacobian(through, px) * torch.stack([left, left, right, right], -1).unsqueeze(-2)
    return Gaussian(through(px).squeeze(-2), pack(scaled @ scaled.mT).squeeze(-2))


def unscented(cases: StereoCases, chart: str, points: SigmaPoints, rotated: bool) -> Gaussian:
    """The unscented transform with some sigma points and root; (C, 3) and packed (C, 6)."""
    root = sigma_root(cases.matches.left_sigma_px, cases.matches.right_sigma_px, rotated)
    mean, cov, _ = unscented_transform(_through(cases, chart), _mean_px(cases), root, points)
    return Gaussian(mean.squeeze(-2), cov.squeeze(-2))


def sample_moments(
    cases: StereoCases,
    charts: tuple[str, ...],
    samples: int,
    generator: torch.Generator,
    chunk: int = 1 << 14,
    done: Callable[[], None] | None = None,
) -> dict[str, Sampled]:
    """Monte Carlo restricted to D > 0; all cases and charts share one set of standard normal numbers.

    Args:
        cases: the correspondences.
        charts: `cartesian`, `inverse_range`.
        samples: how many, at least 16.
        generator: draws them.
        chunk: so many at a time.
        done: called without arguments after each chunk.

    Returns:
        Moments by chart. Sums are taken about the central image, in float64.
    """
    require(samples >= 16, "samples", samples, "at least 16")
    mean = _mean_px(cases).squeeze(-2)
    left, right = cases.matches.left_sigma_px, cases.matches.right_sigma_px
    sigma = torch.stack([left, left, right, right], -1).squeeze(-2)
    sizes = [min(chunk, samples - first) for first in range(0, samples, chunk)]
    parts: dict[str, list[Tensor]] = {chart: [] for chart in charts}
    for size in sizes:
        z = torch.randn(4, size, generator=generator, dtype=mean.dtype).movedim(0, -1)
        for chart in charts:
            parts[chart].append(
                torch.stack([_power_sums(cases, k, chart, mean[k] + sigma[k] * z) for k in range(len(mean))])
            )
        if done is not None:
            done()
    return {chart: _moments(cases, chart, torch.stack(part), samples) for chart, part in parts.items()}


def _one(cases: StereoCases, k: int) -> tuple[Eyes, Tensor]:
    return Eyes(*(part[k] for part in cases.eyes)), cases.direction[k]


def _power_sums(cases: StereoCases, k: int, chart: str, px: Tensor) -> Tensor:
    """Count, first and second moments about the central image and of the range, of one case's samples; (12,)."""
    pose, direction = _one(cases, k)
    point, kept = chart_point(px, pose, cases.camera, chart, direction)
    centre = chart_point(_mean_px(cases)[k], pose, cases.camera, chart, direction)[0]
    delta = torch.where(kept[..., None], point - centre, torch.zeros_like(point))
    return torch.cat([kept.sum(-1, keepdim=True).to(delta), delta.sum(0), pack(delta.mT @ delta)])


def _moments(cases: StereoCases, chart: str, sums: Tensor, samples: int) -> Sampled:
    """From sums (chunks, C, 10)."""
    total = sums.sum(0)
    centre = chart_point(_mean_px(cases), cases.eyes, cases.camera, chart, cases.direction)[0].squeeze(-2)
    moments = _about_mean(total)
    along = _along_range(cases, chart)
    # standard error from up to 16 groups of whole chunks
    groups = torch.stack([group.sum(0) for group in sums.tensor_split(min(16, len(sums)))])
    each = quadratic3(_about_mean(groups).cov, along)
    error = each.std(0) / len(groups) ** 0.5 if len(groups) > 1 else torch.zeros_like(each[0])
    return Sampled(
        Gaussian(centre + moments.mean, moments.cov), total[..., 0] / samples, error / quadratic3(moments.cov, along)
    )


def _about_mean(sums: Tensor) -> Gaussian:
    count = sums[..., :1].clamp(min=1)
    first, second = sums[..., 1:4] / count, sums[..., 4:] / count
    x, y, z = first.unbind(-1)
    return Gaussian(first, second - columns(x * x, x * y, x * z, y * y, y * z, z * z))


def _along_range(cases: StereoCases, chart: str) -> Tensor:
    """The unit vector in chart coordinates along which the range varies, (C, 3)."""
    direction = cases.direction.squeeze(-2)
    return direction if chart == "cartesian" else direction.new_tensor([0.0, 0.0, 1.0]).expand_as(direction)


def compare_gaussians(cases: StereoCases, chart: str, belief: Gaussian, reference: Gaussian) -> Comparison:
    """Errors of a way's moments against the reference's, both of `cases` in `chart`; see `Comparison`."""
    along = _along_range(cases, chart)
    root = torch.linalg.cholesky(unpack(reference.cov))
    half = torch.linalg.solve_triangular(root, unpack(belief.cov), upper=False)
    white = torch.linalg.solve_triangular(root, half.mT, upper=False)
    gap = torch.linalg.solve_triangular(root, (belief.mean - reference.mean)[..., None], upper=False)
    return Comparison(
        quadratic3(belief.cov, along) / quadratic3(reference.cov, along) - 1,
        torch.linalg.matrix_norm(white - torch.eye(3, dtype=white.dtype, device=white.device)) / 3**0.5,
        torch.linalg.vector_norm(gap.squeeze(-1), dim=-1),
    )
