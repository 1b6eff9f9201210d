"""`torchfovea calibrate`: fit the error budget on some observations with truth, judge it on others."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchfovea.config import run_folder
from torchfovea.experiments.build import build_matcher, build_scene_of, build_sensor, choice, construct, whole
from torchfovea.experiments.progress import progress_bar
from torchfovea.experiments.truths import Truths, look_at_pair, look_at_world
from torchfovea.files import replacing, write_csv, write_result
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Gaze, Head, fixate
from torchfovea.setting import SettingError, require
from torchfovea.sim.scene import Scene
from torchfovea.sim.world import World
from torchfovea.stereo.matchers import Matcher
from torchfovea.studies.calibration import Judged, Likelihood, concatenate, fit_budget, judge, select, sigma_of

__all__ = ["BIN_COLUMNS", "random_gazes", "run"]

FIGURES = (
    "nees_mean", "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nll", "outlier_share", "ause",
    "interval_over_error",
)  # fmt: skip
BIN_COLUMNS = (
    "data", "model", "range_from_m", "range_to_m", "eccentricity_from_deg", "eccentricity_to_deg", "observations",
    *FIGURES,
)  # fmt: skip
QUICK = {"scenes": 2, "judged_scenes": 2, "looks": 2}
FULL = {"scenes": 16, "judged_scenes": 16, "looks": 2}
JUDGED_SEEDS = 1000  # scenes to judge on have seeds from here, so that none is fitted on
LEAST_IN_BIN = 50


class Split(NamedTuple):
    """Observations of one kind: to fit on, to judge on, and the share of receptive fields that were matched."""

    fitted: Judged
    judged: Judged
    valid_fraction: float


def run(cfg: DictConfig) -> float:
    """Calibrate; the negative log-likelihood of what was judged on is what a sweeper sees."""
    cfg = _sized(cfg)
    scenes, judged_scenes = whole(cfg, "scenes", 0), whole(cfg, "judged_scenes")
    looks, seed = whole(cfg, "looks"), whole(cfg, "seed", 0)
    require(isinstance(cfg.real, bool), "real", cfg.real, "true or false")
    require(scenes > 0 or cfg.real, "scenes", scenes, "at least 1, or real=true")
    budget = construct(
        Budget, {**cfg.budget, "source_px": whole(cfg, "sensor.source_px", 16) if cfg.budget.source else None}, "budget"
    )
    start = replace(budget, source_px=whole(cfg, "sensor.source_px", 16))
    likelihood = construct(Likelihood, cfg.fit, "fit")
    edges = _edges(cfg, "range_edges_m"), _edges(cfg, "eccentricity_edges_deg")
    matcher, folder = build_matcher(cfg), run_folder()
    data: dict[str, Split] = {}
    if scenes:
        data["simulated"] = _simulate(cfg, start, matcher, scenes, judged_scenes, looks, seed)
    if cfg.real:
        data["real"] = _split(look_at_pair(cfg, start, matcher))
    fit = fit_budget([split.fitted for split in data.values()], start, likelihood)
    models = {"before": budget, "after": fit.budget}
    figures: dict[str, Any] = {}
    for kind, split in data.items():
        prefix = "" if kind == next(iter(data)) else f"{kind}."
        for model, law in models.items():
            for name, value in judge(split.judged, sigma_of(split.judged, law)).items():
                figures[f"{prefix}{model}.{name}"] = value
        figures[f"{prefix}observations"] = split.judged.error.numel()
        figures[f"{prefix}valid_fraction"] = split.valid_fraction
    numbers = {name: value for name, value in asdict(fit.budget).items() if name != "source_px"}
    figures |= {f"fit.{name}": value for name, value in numbers.items()}
    figures |= {"fit.outlier_share": fit.outlier_share, "fit.loss": fit.loss, "fit.first_loss": fit.first_loss}
    _write_budget(folder / "budget" / "fitted.yaml", numbers, cfg, fit.outlier_share)
    write_csv(folder / "bins.csv", BIN_COLUMNS, _bins(data, models, *edges))
    from torchfovea.pictures.calibration import draw_calibration

    draw_calibration(
        folder / "calibration.png",
        {kind: (s.judged, {m: sigma_of(s.judged, law) for m, law in models.items()}) for kind, s in data.items()},
    )
    write_result(folder, figures)
    _print(figures, list(data))
    return float(figures["after.nll"])


def random_gazes(scene: Scene, world: World, count: int, generator: torch.Generator) -> list[Gaze]:
    """Gazes that fixate surfaces in random directions within reach."""
    head, found = world.head, []
    for _ in range(1000 * count):
        pan = math.radians(head.pan_limit_deg) * (2 * torch.rand((), generator=generator, dtype=torch.float64) - 1)
        span = math.radians(head.tilt_up_deg + head.tilt_down_deg)
        tilt = span * torch.rand((), generator=generator, dtype=torch.float64) - math.radians(head.tilt_up_deg)
        forward = torch.cos(tilt)
        direction = torch.stack([forward * torch.cos(pan), forward * torch.sin(pan), -torch.sin(tilt)])
        hit = world.panorama(direction[None])
        gaze, reachable = fixate(head, direction * hit.range_m[0])
        if bool(reachable) and int(hit.geom[0]) >= 0:
            found.append(gaze)
        if len(found) == count:
            return found
    raise SettingError(f"scene = {type(scene.params).__name__}: expected a scene with surfaces within reach")


def _simulate(
    cfg: DictConfig, budget: Budget, matcher: Matcher, scenes: int, judged_scenes: int, looks: int, seed: int
) -> Split:
    """Random looks at simulated scenes; those to judge on have seeds of their own."""
    camera, retina = build_sensor(cfg)
    head = construct(Head, cfg.head, "head")
    renderer = cast(Literal["rays", "gl"], choice(cfg, "renderer.name", ("rays", "gl")))
    seeds = [seed + k for k in range(scenes)], [seed + JUDGED_SEEDS + k for k in range(judged_scenes)]
    parts: tuple[list[Truths], list[Truths]] = ([], [])
    with progress_bar() as p:
        task = p.add_task("looks", total=(scenes + judged_scenes) * looks)
        for part, those in zip(parts, seeds, strict=True):
            for k in those:
                scene = build_scene_of(cfg, head, k)
                world = World(
                    scene, renderer=renderer, camera=camera, source_px=budget.source_px or 400,
                    radius_px=retina.radius_px,
                )  # fmt: skip
                for gaze in random_gazes(scene, world, looks, torch.Generator().manual_seed(k)):
                    part.append(look_at_world(world, gaze, retina, budget, matcher))
                    p.update(task, advance=1)
    fitted, judged = (concatenate([look.data for look in part]) for part in parts)
    shares = [look.valid_fraction for part in parts for look in part]
    return Split(_known(fitted), _known(judged), sum(shares) / len(shares))


def _split(look: Truths) -> Split:
    """The left half of a picture to fit on, the right half to judge on."""
    left = look.right_of_middle_px < 0
    return Split(_known(select(look.data, left)), _known(select(look.data, ~left)), look.valid_fraction)


def _known(data: Judged) -> Judged:
    count = data.error.numel()
    require(count >= 100, "observations with truth", count, "at least 100 valid receptive fields whose truth is known")
    return data


def _bins(
    data: dict[str, Split], models: dict[str, Budget], ranges: list[float], eccentricities: list[float]
) -> list[tuple[Any, ...]]:
    """Rows of bins.csv: everything, each range, each eccentricity, each of both; edges that do not bound are empty."""
    rows: list[tuple[Any, ...]] = []
    anywhere: list[tuple[float, float] | None] = [None]
    for kind, split in data.items():
        degrees = torch.rad2deg(split.judged.eccentricity_rad)
        for low_high in anywhere + list(pairwise(ranges)):
            for inner_outer in anywhere + list(pairwise(eccentricities)):
                mask = _within(split.judged.range_m, low_high) & _within(degrees, inner_outer)
                part, count = select(split.judged, mask), int(mask.sum())
                for model, law in models.items():
                    found = judge(part, sigma_of(part, law)) if count >= LEAST_IN_BIN else {}
                    figures = (found.get(name) for name in FIGURES)
                    bounds = *(low_high or (None, None)), *(inner_outer or (None, None))
                    rows.append((kind, model, *bounds, count, *figures))
    return rows


def _within(values: Tensor, edges: tuple[float, float] | None) -> Tensor:
    if edges is None:
        return torch.ones_like(values, dtype=torch.bool)
    return (values >= edges[0]) & (values < edges[1])


def _edges(cfg: DictConfig, setting: str) -> list[float]:
    values = OmegaConf.select(cfg, setting)
    good = OmegaConf.is_list(values) and len(values) >= 2
    good = good and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    require(good and all(a < b for a, b in pairwise(values)), setting, values, "two or more ascending numbers")
    return [float(v) for v in values]


def _sized(cfg: DictConfig) -> DictConfig:
    """The configuration with the profile's sizes where a setting is null."""
    sizes = QUICK if HydraConfig.get().runtime.choices.get("profile") == "quick" else FULL
    cfg = cfg.copy()
    for setting, value in sizes.items():
        if OmegaConf.select(cfg, setting) is None:
            OmegaConf.update(cfg, setting, value)
    return cfg


def _write_budget(path: Path, numbers: dict[str, float], cfg: DictConfig, outliers: float) -> None:
    """The fitted budget as a file of the group `budget`."""
    real = ", the left half of a real pair" if cfg.real else ""
    simulated = f"{cfg.scenes} scenes {cfg.scene.name}, {cfg.looks} looks each" if cfg.scenes else "no simulation"
    lines = [
        "# Fitted by torchfovea calibrate; torchfovea.sensing.correspondence.Budget says what the numbers are.",
        f"# Fitted on: {simulated}{real}; {cfg.sensor.layout}, {cfg.sensor.fov_deg:g} degrees, "
        f"source {cfg.sensor.source_px} px, matcher {cfg.matcher.name}",
        f"# Taken for outliers: {outliers:.2%}",
        *(f"{name}: {value:.5g}" for name, value in numbers.items()),
        "source: true",
        f"sigma_points: {cfg.budget.sigma_points}",
    ]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _print(figures: dict[str, Any], kinds: list[str]) -> None:
    table = Table("", *(f"{kind}, {model}" for kind in kinds for model in ("before", "after")), box=None)
    for name in FIGURES:
        prefixes = ["" if kind == kinds[0] else f"{kind}." for kind in kinds]
        table.add_row(name, *(f"{figures[f'{p}{m}.{name}']:.4g}" for p in prefixes for m in ("before", "after")))
    console = Console()
    console.print(table)
    console.print("  ".join(f"{k.removeprefix('fit.')} {v:.4g}" for k, v in figures.items() if k.startswith("fit.")))
