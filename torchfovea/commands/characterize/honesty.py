"""How far uncertainty can be believed: the sections of `torchfovea characterize` on propagation and actual errors."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from torchfovea.commands.shared.build import build_matcher
from torchfovea.commands.shared.settings import numbers, whole, wholes
from torchfovea.files import write_csv
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require
from torchfovea.studies.characterization import PlaneSensor, matched_vergence
from torchfovea.studies.propagation import (
    StereoCases,
    compare_gaussians,
    first_order,
    sample_moments,
    stereo_cases,
    unscented,
)
from torchfovea.studies.realised import (
    look_at_plane,
    off_lattice_distances,
    pool_sights,
    realised_information,
    rings_of_error,
)

__all__ = [
    "PROPAGATION_COLUMNS",
    "REALISED_COLUMNS",
    "plan_cases",
    "plan_planes",
    "propagate",
    "realise",
]

SENSORS = ("log_polar", "uniform")
PROPAGATION_COLUMNS = (
    "chart", "way", "e", "vergence_deg", "eccentricity_deg", "distance_m", "range_variance_error", "covariance_error",
    "mean_error_sigma", "monte_carlo_kept", "monte_carlo_standard_error",
)  # fmt: skip
REALISED_COLUMNS = (
    "sensor", "source_px", "distance_m", "eccentricity_from_deg", "eccentricity_to_deg", "receptive_fields",
    "matched_fraction", "error_median_m", "predicted_median_m", "printed_median_m", "sigma_ratio", "coverage_95",
)  # fmt: skip
# Figures are the worst up to this e, by chart: beyond, Cartesian moments hardly exist
GOALS = {"cartesian": 0.1, "inverse_range": 0.2}
# Samples at a time, which the processor's cache holds
CHUNK = 1 << 14
RING_SHARES = (0.0, 0.1, 0.2, 0.4, 0.7, 1.001)


def plan_planes(cfg: DictConfig) -> list[tuple[str, int, float]]:
    """Which planes to match: sensor, source_px, distance."""
    sizes, distances = wholes(cfg, "realised.source_px", 16), numbers(cfg, "realised.distances_m")
    require(min(distances) > 0, "realised.distances_m", distances, "positive distances in metres")
    whole(cfg, "realised.planes")
    return [(name, size, d) for size in sizes for d in distances for name in SENSORS] if cfg.realised.run else []


def plan_cases(cfg: DictConfig, sensor: PlaneSensor) -> tuple[StereoCases, int]:
    """The correspondences to propagate, of a sensor with its error budget, and how many samples to draw of each."""
    ratios, shares = numbers(cfg, "propagation.ratios"), numbers(cfg, "propagation.eccentricities")
    angles = numbers(cfg, "propagation.vergences_deg")
    require(min(ratios) > 0, "propagation.ratios", ratios, "positive numbers")
    inside = min(shares) >= 0 and max(shares) <= 1
    require(inside, "propagation.eccentricities", shares, "shares of the retina's radius, 0 to 1")
    require(min(angles) >= 0 and max(angles) < 180, "propagation.vergences_deg", angles, "0 to less than 180 degrees")
    e, vergence, share = (torch.tensor(v, dtype=torch.float64) for v in (ratios, angles, shares))
    return stereo_cases(sensor, e, torch.deg2rad(vergence), share), whole(cfg, "propagation.samples", 1000)


def propagate(
    folder: Path, cases: StereoCases, samples: int, generator: torch.Generator, done: Callable[[], None]
) -> dict[str, Any]:
    """Every way of propagation beside Monte Carlo, on the same correspondences; `done` after each CHUNK of samples."""
    from torchfovea.commands.characterize.pictures import draw_propagation

    truth = sample_moments(cases, tuple(GOALS), samples, generator, CHUNK, done)
    rows: list[tuple[Any, ...]] = []
    worst: dict[tuple[str, str], list[list[float]]] = {}
    figures: dict[str, Any] = {}
    groups = cases.ratio.unique().tolist()
    for chart, reference in truth.items():
        ways = {
            "first_order": first_order(cases, chart),
            "ut_paper": unscented(cases, chart, SigmaPoints.paper(), False),
            "ut_default": unscented(
                cases, chart, SigmaPoints.midpoint() if chart == "cartesian" else SigmaPoints(), True
            ),
        }
        for way, belief in ways.items():
            error = torch.stack(compare_gaussians(cases, chart, belief, reference.moments), -1)
            truths = torch.stack([reference.kept, reference.range_error], -1)
            places = torch.stack([cases.ratio, cases.vergence_rad.rad2deg(), cases.eccentricity_rad.rad2deg()], -1)
            table = torch.cat([places, cases.distance_m[:, None], error, truths], -1)
            rows += [(chart, way, *row) for row in table.tolist()]
            worst[chart, way] = [error[cases.ratio == e].abs().amax(0).tolist() for e in groups]
            within = [w for e, w in zip(groups, worst[chart, way], strict=True) if e <= GOALS[chart]]
            for column, name in enumerate(("range_variance_error_max", "covariance_error_max", "mean_error_max_sigma")):
                figures[f"propagation.{chart}.{way}.{name}"] = max((w[column] for w in within), default=None)
    write_csv(folder / "propagation.csv", PROPAGATION_COLUMNS, rows)
    draw_propagation(folder / "propagation.png", groups, worst)
    kept = float(truth["cartesian"].kept.min())
    return figures | {"propagation.samples": samples, "propagation.kept_min": kept}


def realise(
    cfg: DictConfig,
    folder: Path,
    sensors: dict[str, PlaneSensor],
    tasks: list[tuple[str, int, float]],
    done: Callable[[], None],
) -> dict[str, Any]:
    """Textured planes drawn, matched and measured, at the vergence that meets them."""
    from torchfovea.commands.characterize.pictures import draw_realised

    matcher, planes, seed = (
        build_matcher(cfg),
        whole(cfg, "realised.planes"),
        whole(cfg, "seed", 0),
    )
    edges = torch.tensor(RING_SHARES) * math.radians(cfg.sensor.fov_deg) / 2
    degrees = torch.rad2deg(edges).tolist()
    rows: list[tuple[Any, ...]] = []
    nats: dict[tuple[str, int, float], dict[str, tuple[float, float]]] = {}
    rings: dict[tuple[str, int, float], Any] = {}
    for name, size, wanted in tasks:
        sensor = sensors[name]
        sights = []
        for k, d in enumerate(off_lattice_distances(sensor, size, wanted, planes)):
            angle = float(matched_vergence(sensor.baseline_m, torch.tensor(d)))
            sights.append(look_at_plane(sensor, size, d, angle, seed + k, matcher))
        sight = pool_sights(sights)
        rings[name, size, wanted] = rings_of_error(sight, edges)
        nats[name, size, wanted] = realised_information(sight, edges)
        for (low, high), ring in zip(pairwise(degrees), rings[name, size, wanted], strict=True):
            known = (*ring[2:],) if ring.matched_fraction > 0 else (None,) * 5
            rows.append((name, size, wanted, low, high, ring.receptive_fields, ring.matched_fraction, *known))
        done()
    write_csv(folder / "realised.csv", REALISED_COLUMNS, rows)
    farthest = max(wanted for *_, wanted in tasks)
    shown = {(name, size): r for (name, size, wanted), r in rings.items() if wanted == farthest}
    draw_realised(folder / "realised.png", degrees, shown, f"textured planes at about {farthest:g} m, matched vergence")
    figures: dict[str, Any] = {}
    for size in sorted({size for _, size, _ in tasks}):
        at = sorted({wanted for _, s, wanted in tasks if s == size})
        for kind in ("realised", "predicted", "printed"):
            for column, suffix in ((0, "nats"), (1, "solid_angle_nats")):
                gaps = [nats["log_polar", size, d][kind][column] - nats["uniform", size, d][kind][column] for d in at]
                figures[f"range_advantage.source_{size}.{kind}.{suffix}"] = statistics.fmean(gaps)
    return figures
