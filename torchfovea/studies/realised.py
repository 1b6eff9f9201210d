"""Predicted uncertainty beside the actual errors of matched images: a textured plane seen by both eyes.

The truth lies on the left receptive field's ray, which leaves one degree of freedom: the error of the inverse range.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import verged
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.views import verged_views
from torchfovea.studies.characterization import PlaneSensor, correspond_plane, solid_angle_sr, straight_eyes
from torchfovea.studies.plane import draw_plane

__all__ = [
    "PlaneSight",
    "Ring",
    "look_at_plane",
    "off_lattice_distances",
    "pool_sights",
    "realised_information",
    "rings_of_error",
]

ROBUST = 1.4826  # standard deviation over median absolute deviation, for a Gaussian


class PlaneSight(NamedTuple):
    """What the left receptive fields (N,) measured of a plane.

    Attributes:
        error: inverse range less the truth [1/m].
        sigma: predicted with the full error budget [1/m].
        sigma_printed: predicted from the retina alone, as the paper does [1/m].
        range_m: the truth.
        eccentricity_rad: of the receptive field.
        solid_angle_sr: that it covers.
        visible: bool, the plane is in view of both eyes.
        matched: bool, the matcher found it; elsewhere error and sigmas mean nothing.
    """

    error: Tensor
    sigma: Tensor
    sigma_printed: Tensor
    range_m: Tensor
    eccentricity_rad: Tensor
    solid_angle_sr: Tensor
    visible: Tensor
    matched: Tensor


class Ring(NamedTuple):
    """Errors of the receptive fields between two eccentricities; the figures are 0 where none is matched.

    Attributes:
        receptive_fields: in view of both eyes.
        matched_fraction: share of these that the matcher found.
        error_m: median |range error|.
        predicted_m: the same of a Gaussian with the full budget's σ.
        printed_m: the same with the paper's σ.
        scale: actual over predicted standard deviation of the inverse range (robust, by the median).
        coverage_95: share within 1.96 predicted σ.
    """

    receptive_fields: int
    matched_fraction: float
    error_m: float
    predicted_m: float
    printed_m: float
    scale: float
    coverage_95: float


def off_lattice_distances(sensor: PlaneSensor, size_px: int, distance_m: float, count: int = 3) -> list[float]:
    """Distances near a given one whose disparities spread evenly between whole pixels.

    A fronto-parallel plane has one disparity in the rectified view. At a whole number of pixels matchers are exact, and
    would be judged by luck.

    Args:
        sensor: the eyes.
        size_px: side of the images.
        distance_m: wanted, > 0.
        count: how many.
    """
    reach = sensor.camera.focal_px * size_px / (2 * sensor.retina.radius_px) * sensor.baseline_m
    whole = math.floor(reach / distance_m)
    return [reach / (whole + (k + 0.5) / count) for k in range(count)]


def pool_sights(sights: list[PlaneSight]) -> PlaneSight:
    """Several sights as one."""
    return PlaneSight(*(torch.cat(parts) for parts in zip(*sights, strict=True)))


def look_at_plane(
    sensor: PlaneSensor, size_px: int, distance_m: float, vergence_rad: float, seed: int, matcher: Matcher | None = None
) -> PlaneSight:
    """Draw a textured plane for both eyes, match the images through the retinas, and measure every receptive field.

    Args:
        sensor: the eyes; their budget's `source_px` is replaced by the image's size.
        size_px: side of the images.
        distance_m: the plane, > 0.
        vergence_rad: angle between the optical axes.
        seed: of the texture.
        matcher: any; it searches from 0.7 times the distance to infinity.

    Raises:
        SettingError: for impossible settings, and without OpenCV.
    """
    camera, retina = sensor.camera, sensor.retina
    pose = straight_eyes(sensor.baseline_m, vergence_rad)
    left, right = draw_plane(camera, retina.radius_px, size_px, pose, distance_m, seed)
    budget = replace(sensor.budget, source_px=size_px)
    rig = verged(vergence_rad, sensor.baseline_m)
    near = (matcher or Matcher(SGBM()))._replace(nearest_m=0.7 * distance_m)
    matches, _ = near(verged_views(left, right, rig, camera, retina.radius_px), retina, budget)
    px = retina.centers_px(dtype=left.dtype)
    true, points = correspond_plane(replace(sensor, budget=budget), px, pose, distance_m)
    rho, sigma, valid = _inverse_range(sensor, matches, pose, px)
    alone = replace(sensor, budget=Budget(sensor.budget.sigma_over_width, None, 0.0))
    _, printed, _ = _inverse_range(sensor, correspond_plane(alone, px, pose, distance_m)[0], pose, px)
    ray = camera.rays(px)
    eccentricity = torch.atan2(ray[..., :2].norm(dim=-1), ray[..., 2])
    reach = points.norm(dim=-1)
    return PlaneSight(
        rho - 1 / reach,
        sigma,
        printed,
        reach,
        eccentricity,
        solid_angle_sr(camera, retina, px),
        true.valid,
        valid & true.valid,
    )


def _inverse_range(
    sensor: PlaneSensor, matches: Correspondences, pose: Eyes, px: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    half = sensor.retina.width_px(px) / 2
    seen = observe(matches, pose, sensor.camera, half, SigmaPoints(), "inverse_range")
    return seen.mean[..., 2], seen.cov[..., 5].sqrt(), seen.valid


def rings_of_error(sight: PlaneSight, edges_rad: Tensor) -> list[Ring]:
    """Sum up the errors between eccentricities.

    Args:
        sight: from `look_at_plane`.
        edges_rad: increasing, (K + 1,).

    Returns:
        K rings.
    """
    rings = []
    for low, high in pairwise(edges_rad):
        here = sight.visible & (sight.eccentricity_rad >= low) & (sight.eccentricity_rad < high)
        found, total = here & sight.matched, int(here.sum())
        if not bool(found.any()):
            rings.append(Ring(total, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            continue
        error, sigma, reach = sight.error[found], sight.sigma[found], sight.range_m[found]
        z = (error / sigma).abs()
        metres = reach * reach  # |dr| = r² |d(1/r)|, to first order
        rings.append(
            Ring(
                total,
                int(found.sum()) / total,
                float((error.abs() * metres).median()),
                float((sigma * metres).median()) / ROBUST,
                float((sight.sigma_printed[found] * metres).median()) / ROBUST,
                ROBUST * float(z.median()),
                float((z < 1.96).double().mean()),
            )
        )
    return rings


def realised_information(sight: PlaneSight, edges_rad: Tensor) -> dict[str, tuple[float, float]]:
    """Mean information about the inverse range, −log σ², over the matched receptive fields [nats].

    The realised σ is the predicted one times its ring's `scale`.

    Returns:
        For `realised`, `predicted` and `printed`: the plain mean, and the mean weighted by solid angle; 0 if nothing is
        matched.
    """
    scale = torch.zeros_like(sight.sigma)
    for ring, low, high in zip(rings_of_error(sight, edges_rad), edges_rad[:-1], edges_rad[1:], strict=True):
        here = (sight.eccentricity_rad >= low) & (sight.eccentricity_rad < high)
        scale = torch.where(here, torch.full_like(scale, ring.scale), scale)
    use = sight.matched & (scale > 0)
    means = {}
    for name, sigma in (
        ("realised", scale * sight.sigma),
        ("predicted", sight.sigma),
        ("printed", sight.sigma_printed),
    ):
        nats = -2 * torch.log(torch.where(use, sigma, torch.ones_like(sigma)).double())
        weight = torch.where(use, sight.solid_angle_sr, torch.zeros_like(sigma)).double()
        count = use.double()
        means[name] = (
            float((nats * count).sum() / count.sum().clamp(min=1)),
            float((nats * weight).sum() / weight.sum().clamp(min=1e-300)),
        )
    return means
