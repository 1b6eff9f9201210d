"""`torchfovea characterize`: what two eyes know of planes, foveal and uniform, over distance and vergence (Fig. 5)."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.characterize.honesty import CHUNK, plan_cases, plan_planes, propagate, realise
from torchfovea.commands.shared.build import build_camera, build_matcher
from torchfovea.commands.shared.config import run_folder, sized
from torchfovea.commands.shared.manifest import complete, finished
from torchfovea.commands.shared.screen import print_figures, progress_bar
from torchfovea.commands.shared.settings import construct, number, whole, wholes
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.files import write_csv
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import require
from torchfovea.studies.characterization import (
    Characterization,
    Places,
    PlaneSensor,
    characterize_planes,
    half_retina,
    matched_vergence,
    peak_vergence,
    plane_information,
    spread_over_vergence,
)

__all__ = ["ADVANTAGE_COLUMNS", "FIG5_COLUMNS", "run"]

SENSORS = ("log_polar", "uniform")
FIG5_COLUMNS = ("sensor", "distance_m", "vergence_rad", "information", "information_solid_angle", "matched_fraction")
ADVANTAGE_COLUMNS = (
    "reading", "distance_m", "vergence_rad", "advantage_nats", "advantage_solid_angle_nats", "log_polar_information",
    "uniform_information",
)  # fmt: skip
# Sizes that a profile chooses where a setting is null
QUICK = {
    "distances": 5, "vergences": 13, "every": 1, "propagation.samples": 50_000, "realised.source_px": [200]
}  # fmt: skip
FULL = {
    "distances": 20, "vergences": 31, "every": 3, "propagation.samples": 1 << 20, "realised.source_px": [200, 400, 800]
}  # fmt: skip


def run(cfg: DictConfig) -> float:
    """Characterize both sensors; the smallest advantage of the foveal one is what a sweeper sees."""
    refuse_unread("budget.source", "budget.sigma_points", "budget.made_for")
    cfg = sized(cfg, QUICK, FULL)
    printed = _sensors(cfg)
    full = {name: _with(sensor, _budget(cfg, whole(cfg, "sensor.source_px", 16))) for name, sensor in printed.items()}
    distance, vergence = _axis(cfg, "distance", "_m"), torch.deg2rad(_axis(cfg, "vergence", "_deg"))
    sources, matched = wholes(cfg, "advantage_source_px", 16), matched_vergence(printed["uniform"].baseline_m, distance)
    tasks, every = plan_planes(cfg), whole(cfg, "every", 1)
    planned = plan_cases(cfg, full["log_polar"]) if cfg.propagation.run else None
    generator = torch.Generator().manual_seed(whole(cfg, "seed", 0))
    layouts = _small_layouts(cfg)
    build_matcher(cfg), whole(cfg, "realised.planes")  # mistakes come first, also in what is not used
    folder = run_folder()
    done_before = finished(cfg, folder, "foveal_advantage_min_nats")
    if done_before is not None:
        return done_before
    figures: dict[str, Any] = {f"{name}_receptive_fields": printed[name].retina.count for name in SENSORS}
    with progress_bar() as progress:
        task = progress.add_task("planes", total=4 * len(distance) * len(vergence))

        def done() -> None:
            progress.update(task, advance=1)

        halves = {name: half_retina(sensor.camera, sensor.retina) for name, sensor in printed.items()}
        grids, budgeted = (
            {
                name: characterize_planes(
                    sensor, distance, vergence, done, half_retina(sensor.camera, sensor.retina, every=every)
                )
                for name, sensor in sensors.items()
            }
            for sensors in (printed, full)
        )
        _write_fig5(folder / "fig5.csv", grids)
        _write_fig5(folder / "fig5_budget.csv", budgeted)
        progress.update(task, description="advantage")
        readings: dict[str, Budget] = {"printed": printed["uniform"].budget}
        readings |= {f"source_{size}": _budget(cfg, size) for size in sources}
        advantage = {name: _advantage(printed, halves, budget, distance, matched) for name, budget in readings.items()}
        figures |= _fig5_figures(printed, halves, grids, matched, advantage)
        if planned is not None:
            task = progress.add_task("propagation", total=math.ceil(planned[1] / CHUNK))
            figures |= propagate(folder, *planned, generator, done)
        if cfg.realised.run:
            task = progress.add_task("matched planes", total=len(tasks))
            figures |= realise(cfg, folder, full, tasks, done)
    _write_advantage(folder, distance, matched, advantage)
    _draw(folder, cfg, grids, layouts, printed["uniform"])
    complete(folder, figures)
    print_figures(figures)
    return float(figures["foveal_advantage_min_nats"] or 0.0)


def _sensors(cfg: DictConfig) -> dict[str, PlaneSensor]:
    """Both sensors in the paper's reading: retinal noise alone."""
    baseline = number(cfg, "baseline_m")
    alone = Budget(number(cfg, "budget.sigma_over_width"), None, 0.0)
    kinds: tuple[type[LogPolar] | type[Uniform], ...] = (LogPolar, Uniform)
    retinas = [construct(kind, cfg.sensor, "sensor") for kind in kinds]
    return {
        name: PlaneSensor(build_camera(cfg, retina.radius_px), retina, baseline, alone)
        for name, retina in zip(SENSORS, retinas, strict=True)
    }


def _with(sensor: PlaneSensor, budget: Budget) -> PlaneSensor:
    return PlaneSensor(sensor.camera, sensor.retina, sensor.baseline_m, budget, sensor.points, sensor.rotated)


def _budget(cfg: DictConfig, source_px: int) -> Budget:
    return construct(Budget, {**cfg.budget, "source_px": source_px}, "budget")


def _axis(cfg: DictConfig, name: str, unit: str) -> Tensor:
    """A grid's distances or vergences, evenly spaced."""
    low, high, count = cfg[f"{name}_min{unit}"], cfg[f"{name}_max{unit}"], whole(cfg, f"{name}s", 2)
    for end, value in (("min", low), ("max", high)):
        require(math.isfinite(value), f"{name}_{end}{unit}", value, "a number")
    if name == "distance":
        require(low > 0, f"distance_min{unit}", low, "more than 0: a plane in front of the eyes")
    else:
        require(low >= 0, f"vergence_min{unit}", low, "at least 0: below, the axes cross behind the head")
        require(high < 180, f"vergence_max{unit}", high, "less than 180: beyond, the eyes look behind the head")
    require(high > low, f"{name}_max{unit}", high, f"more than {name}_min{unit} = {low}")
    return torch.linspace(low, high, count, dtype=torch.float64)


def _small_layouts(cfg: DictConfig) -> dict[str, LogPolar | Uniform]:
    count, rho = whole(cfg, "layout_receptive_fields", 16), 0.05 * cfg.sensor.radius_px
    fields = {**cfg.sensor, "receptive_fields": count}
    polar = construct(LogPolar, {**fields, "rho_min_px": rho, "uniform_fovea": False}, "sensor")
    fovea = construct(LogPolar, {**fields, "rho_min_px": 2 * rho, "uniform_fovea": True}, "sensor")
    return {"uniform": construct(Uniform, fields, "sensor"), "log-polar": polar, "log-polar, uniform fovea": fovea}


def _write_fig5(path: Path, grids: dict[str, Characterization]) -> None:
    rows = []
    for name, grid in grids.items():
        for i, d in enumerate(grid.distance_m.tolist()):
            for j, v in enumerate(grid.vergence_rad.tolist()):
                share = float(grid.matched_fraction[i, j])
                nats = (
                    (float(grid.information[i, j]), float(grid.information_solid_angle[i, j]))
                    if share
                    else (None, None)
                )
                rows.append((name, d, v, *nats, share))
    write_csv(path, FIG5_COLUMNS, rows)


Advantage = list[tuple[float | None, float | None, float | None, float | None]]


def _advantage(
    sensors: dict[str, PlaneSensor], places: dict[str, Places], budget: Budget, distance: Tensor, vergence: Tensor
) -> Advantage:
    """For each distance at its matched vergence: plain, by solid angle, and both sensors' plain information."""
    rows: Advantage = []
    for d, v in zip(distance.tolist(), vergence.tolist(), strict=True):
        foveal, uniform = (plane_information(_with(sensors[name], budget), d, v, places[name]) for name in SENSORS)
        if foveal.matched_fraction > 0 and uniform.matched_fraction > 0:
            plain, wide = (float(a - b) for a, b in zip(foveal[:2], uniform[:2], strict=True))
            rows.append((plain, wide, float(foveal.information), float(uniform.information)))
        else:
            rows.append((None, None, None, None))
    return rows


def _known(rows: Advantage, column: int) -> list[float]:
    return [value for row in rows if (value := row[column]) is not None]


def _fig5_figures(
    sensors: dict[str, PlaneSensor],
    places: dict[str, Places],
    grids: dict[str, Characterization],
    matched: Tensor,
    advantage: dict[str, Advantage],
) -> dict[str, Any]:
    foveal, uniform = grids["log_polar"], grids["uniform"]
    both = (foveal.matched_fraction > 0) & (uniform.matched_fraction > 0)
    wins = ((foveal.information > uniform.information) & both).sum(1) / both.sum(1).clamp(min=1)
    # only planes whose matched vergence the grid holds can have their peak there
    inside = (
        (matched >= foveal.vergence_rad[0])
        & (matched <= foveal.vergence_rad[-1])
        & (foveal.matched_fraction > 0).any(1)
    )
    rows = inside.nonzero().flatten().tolist()
    peaks = [peak_vergence(sensors["log_polar"], foveal, i, places=places["log_polar"]) for i in rows]
    errors = [abs(peak - float(matched[i])) for peak, i in zip(peaks, rows, strict=True)]
    spread = spread_over_vergence(uniform) / spread_over_vergence(foveal).clamp(min=1e-9)
    down = uniform.information[1:] < uniform.information[:-1]
    seen = (uniform.matched_fraction[1:] > 0) & (uniform.matched_fraction[:-1] > 0)
    plain = _known(advantage["printed"], 0)
    figures: dict[str, Any] = {
        "foveal_advantage_min_nats": min(plain, default=None),
        "foveal_advantage_median_nats": statistics.median(plain) if plain else None,
        "peak_vergence_error_max_rad": max(errors, default=None),
        "uniform_range_over_foveal_range": float(spread[rows].max()) if rows else None,
        "uniform_monotone": bool((down | ~seen).all()),
        "foveal_wins_share_of_vergences_nearest": float(wins[0]),
        "foveal_wins_share_of_vergences_farthest": float(wins[-1]),
    }
    for name, values in advantage.items():
        for column, suffix in ((0, "median_nats"), (1, "solid_angle_median_nats")):
            known = _known(values, column)
            figures[f"advantage.{name}.{suffix}"] = statistics.median(known) if known else None
    return figures


def _write_advantage(folder: Path, distance: Tensor, vergence: Tensor, advantage: dict[str, Advantage]) -> None:
    from torchfovea.commands.characterize.pictures import draw_advantage

    rows = []
    for name, values in advantage.items():
        rows += [(name, float(d), float(v), *row) for d, v, row in zip(distance, vergence, values, strict=True)]
    write_csv(folder / "advantage.csv", ADVANTAGE_COLUMNS, rows)
    curves = {
        "as printed" if name == "printed" else f"image of {name.removeprefix('source_')} px": tuple(
            [math.nan if row[k] is None else row[k] for row in values] for k in (0, 1)
        )
        for name, values in advantage.items()
    }
    draw_advantage(folder / "advantage.png", distance, curves)  # type: ignore[arg-type]


def _draw(
    folder: Path,
    cfg: DictConfig,
    grids: dict[str, Characterization],
    layouts: dict[str, LogPolar | Uniform],
    sensor: PlaneSensor,
) -> None:
    from torchfovea.commands.characterize.pictures import draw_fig5, draw_layouts

    fields = cfg.sensor.receptive_fields
    title = (
        f"Fig. 5: {fields} receptive fields, field of view {cfg.sensor.fov_deg:g}°, baseline {sensor.baseline_m:g} m"
    )
    draw_fig5(folder / "fig5.png", grids, sensor.baseline_m, title)
    draw_layouts(folder / "layouts.png", layouts, sensor.budget.sigma_over_width)
