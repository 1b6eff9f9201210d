"""What an entry does in a family of scenes, track by track: a row of figures for every scene."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.benchmark.entries import FAMILY, Entry
from torchfovea.commands.benchmark.processes import LinePolicy, ask_matcher, ask_memory
from torchfovea.commands.benchmark.protocol import FAMILIES, Size
from torchfovea.commands.shared.build import build_arena, build_cells, build_match, build_observer
from torchfovea.commands.shared.composed import compose_search
from torchfovea.commands.shared.figures import EPISODE_COLUMNS, episode_row
from torchfovea.commands.shared.judge import estimate, fixation_course, judge_cells
from torchfovea.commands.shared.regions import REGIONS, at_places, regions
from torchfovea.commands.shared.rollout import one_episode, roll_out
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.deciding.strategies import Strategy, View
from torchfovea.episode import Episode
from torchfovea.imported import load_function
from torchfovea.metrics import coverage, nees_mean, outlier_share
from torchfovea.perception import new_memory, perceive
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Eyes, Gaze, eyes
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import require
from torchfovea.sim.arena import SimulatedArena
from torchfovea.stereo.matchers import checked_matches
from torchfovea.stereo.rig import verged
from torchfovea.stereo.views import verged_views

__all__ = ["Unit", "run_unit"]

TIMES = ("seconds_per_saccade", "compute_seconds")
FOVEA_RAD = 0.17
LOOKS = 2  # of the matcher track: straight ahead, and a place of the scene
OUTLIER_DENSITY = 0.3  # of a false match's inverse range: even from 0 to 1/(0.3 m)


class Unit(NamedTuple):
    """An entry in a family; it is plain data, for processes.

    Attributes:
        entry: who.
        family: of FAMILIES.
        seeds: of the scenes.
        size: of the profile.
        limit_s: that it may take.
        folders: of configurations beside ours.
    """

    entry: Entry
    family: str
    seeds: tuple[int, ...]
    size: Size
    limit_s: float
    folders: tuple[str, ...] = ()


Row = dict[str, Any]


def run_unit(unit: Unit) -> list[Row]:
    """A row for every scene: its seed, figures, and times under `TIMES`.

    Raises:
        SettingError: for an entry that answers something else than its track asks, or NaN.
    """
    run = {"policy": _policy, "matcher": _matcher, "memory": _memory, "whole": _whole}
    return run[unit.entry.track](unit)


def _settings(unit: Unit, images: bool) -> DictConfig:
    """The search of a family with what the entry chooses; the protocol's sizes have the last word."""
    size, track = unit.size, unit.entry.track
    fields = size.image_fields if images else size.fields
    own = [
        "profile=paper", f"fidelity={'photometric' if images else 'geometric'}", f"memory.cells={size.cells}",
        f"saccades={size.saccades.get(track, 2)}", f"sensor.receptive_fields={fields}",
        f"sensor.source_px={size.source_px}", "sensor.sample=null", "stop.probability=null",
        "motor=instant", "renderer=rays",
    ]  # fmt: skip
    chosen = [line.replace(FAMILY, unit.family) for line in unit.entry.config]
    return compose_search((*FAMILIES[unit.family], *chosen, *own), unit.folders)


@contextmanager
def _strategy(unit: Unit, cfg: DictConfig) -> Iterator[Strategy | None]:
    """The strategy of a function or a command; None: the configuration's own."""
    entry = unit.entry
    if entry.command is not None:
        policy = LinePolicy(entry.command, unit.limit_s)
        try:
            yield _finite(policy)
        finally:
            policy.close()
    elif entry.function is not None:
        named = compose_search(
            (*FAMILIES[unit.family], "acquisition=external", f"acquisition.source={entry.function}"), unit.folders
        )
        yield _finite(build_strategy(named, build_observer(cfg)))
    else:
        yield None


def _finite(strategy: Strategy) -> Strategy:
    """Refuse NaN among the scores of eligible cells, which would silently never be chosen."""

    @wraps(strategy, updated=())
    def scored(view: View) -> Any:
        answer = strategy(view)
        score = answer[0] if isinstance(answer, tuple) else answer
        none = not bool((score.isnan() & view.eligible).any())
        require(none, "scores", "NaN", "a number for every eligible cell")
        return answer

    return scored


def _episode(seed: int, episode: Episode) -> Row:
    return {"seed": seed, **dict(zip(EPISODE_COLUMNS[2:], episode_row(episode), strict=True))}


def _policy(unit: Unit) -> list[Row]:
    cfg = _settings(unit, images=False)
    observer = build_observer(cfg)
    with _strategy(unit, cfg) as strategy:
        chosen = None if strategy is None else lambda truths: strategy
        episodes = []
        for start in range(0, len(unit.seeds), 4):  # few at once, for a batch's rows must fit the cache
            episodes += roll_out(cfg, observer, unit.seeds[start : start + 4], chosen)
    return [_episode(seed, episode) for seed, episode in zip(unit.seeds, episodes, strict=True)]


def _whole(unit: Unit) -> list[Row]:
    cfg = _settings(unit, images=True)
    observer = build_observer(cfg)
    rows = []
    with _strategy(unit, cfg) as strategy:
        for seed in unit.seeds:
            rows.append(_episode(seed, one_episode(cfg, observer, seed, strategy=strategy)))
    return rows


def _scene(cfg: DictConfig, seed: int, looks: int) -> tuple[SimulatedArena, Tensor, list[Gaze]]:
    """The arena of a seed, its memory's cells, and the gazes of a course that nobody chooses."""
    observer = build_observer(cfg)
    arena = build_arena(cfg, observer, seed)
    cells = build_cells(cfg, observer.head, torch.Generator().manual_seed(seed))
    course = [Gaze(*(angle.to(cells) for angle in gaze)) for gaze in fixation_course(arena, cells, looks, seed)]
    return arena, cells, course


def _matcher(unit: Unit) -> list[Row]:
    cfg, rows = _settings(unit, images=True), []
    entry = unit.entry
    match = load_function(entry.function, "function") if entry.function is not None else build_match(cfg)
    for seed in unit.seeds:
        arena, _, course = _scene(cfg, seed, LOOKS)
        observer, world = arena.observer, arena.world
        retina, parts, took = observer.retina, [], 0.0
        for gaze in course:
            left, right = world.images(gaze)
            rig = verged(gaze.vergence, observer.head.baseline_m)
            views = verged_views(left.image, right.image, rig, observer.camera, retina.radius_px)
            start = time.perf_counter()
            if entry.command is not None:
                matches = ask_matcher(entry.command, views, retina, unit.limit_s)
            else:
                matches, _ = checked_matches(match(views, retina, observer.budget), retina)
            took += time.perf_counter() - start
            _check_matches(matches)
            seen = world.correspond(gaze, observer.camera.rays(matches.left_px))
            shift = world.image_camera.focal_px * observer.head.baseline_m / left.range_m
            around = regions(shift, left.image, torch.zeros_like(left.geom, dtype=torch.bool))
            places = matches.left_px * world.source_px / (2 * retina.radius_px) + (world.source_px - 1) / 2
            here = at_places(around, places)
            parts.append(_judge_matches(arena, matches, gaze, seen.points_e, seen.hit, here))
        told = [torch.cat(part) for part in zip(*parts, strict=True)]
        rows.append({"seed": seed, **_match_figures(told), "compute_seconds": took / LOOKS})
    return rows


def _check_matches(matches: Correspondences) -> None:
    valid = matches.valid
    for name in ("right_px", "left_sigma_px", "right_sigma_px"):
        require(bool(torch.isfinite(getattr(matches, name)[valid]).all()), f"matcher's {name}", "NaN", "finite numbers")


def _judge_matches(
    arena: SimulatedArena, matches: Correspondences, gaze: Gaze, points: Tensor, hit: Tensor, region: Tensor
) -> tuple[Tensor, ...]:
    """Error and deviation of the inverse range from the left eye, truth, inlier probability, validity, area, place."""
    observer = arena.observer
    pose = eyes(observer.head, gaze)
    support = observer.retina.width_px(matches.left_px) / 2
    from_left = Eyes(pose.R_left, torch.zeros_like(pose.t_left), pose.R_right, pose.t_right - pose.t_left)
    seen = observe(matches, from_left, observer.camera, support, observer.points, "inverse_range", observer.rotated)
    true = 1 / (points - pose.t_left).norm(dim=-1)
    inlier = torch.ones_like(true) if seen.inlier is None else seen.inlier
    ray = torch.nn.functional.normalize(observer.camera.rays(matches.left_px), dim=-1)
    columns = (seen.mean[..., 2] - true, seen.cov[..., 5].sqrt(), true, inlier, support.square(), ray[..., 2].acos())
    return *(column.double() for column in columns), seen.valid & hit, hit, region


def _match_figures(told: Sequence[Tensor]) -> Row:
    error, sigma, true, inlier, area, eccentricity, valid, hit, region = told
    figures: Row = {"valid_share": float(valid[hit].double().mean())}
    figures["valid_area"] = float((area * valid).sum() / (area * hit).sum())
    figures |= _honesty(error[valid], sigma[valid], true[valid], inlier[valid])
    places = {"fovea": eccentricity < FOVEA_RAD, "periphery": eccentricity >= FOVEA_RAD}
    places |= {name: region == k for k, name in enumerate(REGIONS)}
    for name, among in places.items():
        some = valid & among
        figures[f"median_error.{name}"] = float((error[some] / true[some]).abs().median()) if bool(some.any()) else None
        there = hit & among
        figures[f"valid_share.{name}"] = float(valid[there].double().mean()) if bool(there.any()) else None
    return figures


def _honesty(error: Tensor, sigma: Tensor, true: Tensor, inlier: Tensor | None = None) -> Row:
    """Error, calibration and sharpness of inverse ranges; the likelihood allows for outliers, and is finite."""
    names = ("median_error", "nees_mean", "coverage_50", "coverage_95", "outlier_share", "nll", "sharpness")
    if len(error) == 0:
        return dict.fromkeys(names)
    z = error / sigma
    sure = torch.full_like(z, 1 - 1e-6) if inlier is None else inlier.clamp(1e-6, 1 - 1e-6)
    normal = sure.log() - 0.5 * z.square() - (sigma * (2 * torch.pi) ** 0.5).log()
    density = torch.logaddexp(normal, ((1 - sure) * OUTLIER_DENSITY).log())
    close = bool((z.abs() <= 5).any())
    figures = (
        (error / true).abs().median(), nees_mean(z) if close else torch.nan, *coverage(z, (0.5, 0.95)),
        outlier_share(z), -density.mean(), (sigma / true).median(),
    )  # fmt: skip
    return {name: float(figure) for name, figure in zip(names, figures, strict=True)}


def _memory(unit: Unit) -> list[Row]:
    cfg, given, rows = _settings(unit, images=False), _settings(_bare(unit), images=False), []
    observer, entry = build_observer(cfg), unit.entry
    remember = None if entry.function is None else load_function(entry.function, "function")
    for seed in unit.seeds:
        arena, cells, course = _scene(given, seed, unit.size.marks[-1])
        judge, memory, looks, took = judge_cells(arena.world, cells), new_memory(observer, cells), [], 0.0
        generator, row = torch.Generator().manual_seed(seed), {"seed": seed}
        for count, gaze in enumerate(course, 1):
            matches, pose = arena.look(gaze, generator).matches, eyes(observer.head, gaze)
            start = time.perf_counter()
            if remember is None and entry.command is None:
                memory = perceive(observer, memory, matches, pose)
            else:
                support = arena.observer.retina.width_px(matches.left_px) / 2
                looks.append(observe(matches, pose, arena.observer.camera, support))
            if count in unit.size.marks:
                if entry.command is not None:
                    mean, std = ask_memory(entry.command, cells, looks, unit.limit_s)
                elif remember is not None:
                    mean, std = _answered(remember(cells, list(looks)), len(cells))
                else:
                    rho, variance, seen = estimate(memory)
                    mean, std = rho.double(), torch.where(seen, variance.double().sqrt(), torch.inf)
                row |= _memory_figures(mean, std, judge.rho, judge.straddles, count)
            took += time.perf_counter() - start
        rows.append({**row, "compute_seconds": took / len(course)})
    return rows


def _bare(unit: Unit) -> Unit:
    """The unit without its entry's choices: who gives the observations."""
    return unit._replace(entry=Entry("given", unit.entry.track, ("fusion=inverse_range",)))


def _answered(answer: object, count: int) -> tuple[Tensor, Tensor]:
    pair = isinstance(answer, tuple) and len(answer) == 2 and all(isinstance(part, Tensor) for part in answer)
    require(pair, "memory's answer", type(answer).__name__, "tensors (mean, std) of the inverse range of each cell")
    assert isinstance(answer, tuple)
    mean, std = answer
    for name, part in (("mean", mean), ("std", std)):
        require(tuple(part.shape) == (count,), f"memory's {name}", tuple(part.shape), f"({count},)")
    return mean.double(), std.double()


def _memory_figures(mean: Tensor, std: Tensor, true: Tensor, straddles: Tensor, looks: int) -> Row:
    """After so many looks, over the known cells that no depth edge runs through."""
    known = torch.isfinite(std)
    good = bool(torch.isfinite(mean[known]).all()) and bool((std[known] > 0).all()) and not bool(std.isnan().any())
    require(good, "memory's answer", "NaN, or a std that is not positive", "finite means where the std is finite")
    plain = known & ~straddles
    figures = _honesty(mean[plain] - true[plain], std[plain], true[plain])
    found = {**figures, "known_share": float(known.double().mean())}
    return {f"{name}.{looks}": value for name, value in found.items()}
