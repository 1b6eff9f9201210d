"""The claims about Fig. 5, judged on a grid of planes and vergences: there is no chance in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.studies.characterization import (
    PlaneSensor,
    characterize_planes,
    matched_vergence,
    peak_vergence,
    spread_over_vergence,
)

__all__ = ["Fig5", "judge_fig5"]

Fig5 = dict[str, Any]


def judge_fig5(settings: Mapping[str, Any], receptive_fields: int) -> tuple[list[dict[str, Any]], Fig5]:
    """Judge the claims of Sec. 7.1.

    Args:
        settings: the section `fig5` of the configuration.
        receptive_fields: of each retina.

    Returns:
        The claims as `claims.json` states them, and the curves: vergences, distances, information of both sensors.
    """
    camera = Pinhole.from_fov(90.0, 100.0)
    layouts: dict[str, Retina] = {"log_polar": LogPolar(receptive_fields), "uniform": Uniform(receptive_fields)}
    sensors = {name: PlaneSensor(camera, layout) for name, layout in layouts.items()}
    distance = torch.tensor(settings["distances_m"], dtype=torch.float32)
    vergence = torch.linspace(0, torch.pi / 2, int(settings["vergences"]))
    grids = {name: characterize_planes(sensor, distance, vergence) for name, sensor in sensors.items()}
    matched = matched_vergence(sensors["log_polar"].baseline_m, distance)
    foveal, uniform = grids["log_polar"], grids["uniform"]
    errors = [abs(peak_vergence(sensors["log_polar"], foveal, i) - float(matched[i])) for i in range(len(distance))]
    share = (spread_over_vergence(uniform) / spread_over_vergence(foveal).clamp(min=1e-9)).max()
    best = matched[:, None]
    advantage = torch.cat(
        [
            characterize_planes(sensors["log_polar"], distance[i : i + 1], best[i]).information
            - characterize_planes(sensors["uniform"], distance[i : i + 1], best[i]).information
            for i in range(len(distance))
        ]
    )
    tolerance, most = float(settings["peak_tolerance_rad"]), float(settings["uniform_share"])
    planes = f"{len(distance)} planes from {distance[0]:g} to {distance[-1]:g} m"
    stated = [
        _state(
            "fig5_foveal", "The foveal outperforms the Cartesian sensor where the fixation coincides with the plane",
            f"information (Eq. 45) at the matched vergence, foveal minus uniform, the least over {planes}, exceeds 0",
            float(advantage.min()), float(advantage.min()) > 0, len(distance),
        ),
        _state(
            "fig5_peak", "Foveal information is maximal if the fixation point coincides with the surface",
            f"vergence of most information minus the matched one, the largest over {planes}, is within {tolerance} rad",
            max(errors), max(errors) <= tolerance, len(distance),
        ),
        _state(
            "fig5_uniform", "The Cartesian sensor's information does not depend on the vergence angle",
            f"its range over vergences is at most {most} of the foveal one's, on each of {planes}",
            float(share), float(share) <= most, len(distance),
        ),
    ]  # fmt: skip
    curves = {
        "distance_m": distance, "vergence_rad": vergence, "matched_rad": matched,
        **{name: torch.where(grid.matched_fraction > 0, grid.information, torch.nan) for name, grid in grids.items()},
    }  # fmt: skip
    return stated, curves


def _state(name: str, text: str, definition: str, estimate: float, holds: bool, n: int) -> dict[str, Any]:
    return {
        "id": name, "section": "7.1", "text": text, "definition": definition, "verdict": "holds" if holds else "fails",
        "estimate": estimate, "ci_low": estimate, "ci_high": estimate, "effect_size": None, "p_value": None,
        "p_holm": None, "n": n, "metric": "information",
    }  # fmt: skip
