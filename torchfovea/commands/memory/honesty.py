"""How far the memory's uncertainty can be believed, look after look: from images by each matcher, and without."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.memory.study import Rows
from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.judge import Judge, fixation_course, judge_cells
from torchfovea.commands.shared.screen import progress_bar
from torchfovea.commands.shared.settings import changed, whole, wholes, words
from torchfovea.memory.egosphere import Memory, belief, trust
from torchfovea.metrics import coverage, nees_mean, outlier_share
from torchfovea.perception import Observer, new_memory, perceive
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sim.arena import SimulatedArena
from torchfovea.studies.significance import bootstrap_interval

__all__ = ["plan_honesty", "study_honesty"]

SENSORS = ("sgbm", "sweep", "geometric")
FIGURES = ("nees_mean", "coverage_50", "coverage_95", "outlier_share", "median_error", "mean_error")
INTERVALS = tuple(f"{name}_{end}" for name in FIGURES for end in ("low", "high"))
BESIDE = ("nll", "median_sigma", "believed", "cells_judged", "straddling")
STRADDLING = tuple(f"straddling_{name}" for name in FIGURES)


class Sensor(NamedTuple):
    """One way to see, with all memories that it fills.

    Attributes:
        observer: with the budget of this sensor.
        arena: of the scene at hand.
        memories: by number of cells.
    """

    observer: Observer
    arena: SimulatedArena
    memories: dict[int, Memory]


def study_honesty(cfg: DictConfig, rows: Rows) -> None:
    """Random fixations in fresh scenes; what the memory claims against the truth, cells on an edge apart.

    A cell is judged if it believes its surface (`torchfovea.memory.egosphere.trust` of a half or more); `believed` is
    the share of the seen ones that do. The figures are over all cells of all scenes, their intervals by scene.
    """
    rows.labels, rows.shown = ("sensor", "cells", "looks"), len(FIGURES)
    rows.names = (*FIGURES, *INTERVALS, *BESIDE, *STRADDLING)
    sensors, counts, marks = plan_honesty(cfg)
    scenes, seed = whole(cfg, "episodes"), whole(cfg, "seed", 0)
    settings = {name: _settings(cfg, name) for name in sensors}
    observers = {name: build_observer(settings[name]) for name in sensors}
    found: dict[tuple[str, int, int], list[tuple[Tensor, ...]]] = {}
    with progress_bar() as progress:
        task = progress.add_task("looks", total=scenes * marks[-1])
        for k in range(seed, seed + scenes):
            first = build_arena(settings[sensors[0]], observers[sensors[0]], k)
            generator = torch.Generator().manual_seed(k)
            cells = {
                n: build_cells(changed(cfg, {"memory": {"cells": n}}), first.observer.head, generator) for n in counts
            }
            judges = {n: judge_cells(first.world, cells[n]) for n in counts}
            seeing = {
                name: Sensor(
                    observers[name], build_arena(settings[name], observers[name], k),
                    {n: new_memory(observers[name], cells[n]) for n in counts},
                )
                for name in sensors
            }  # fmt: skip
            for t, gaze in enumerate(fixation_course(first, cells[counts[0]], marks[-1], k), 1):
                executed = Gaze(*(a.to(cells[counts[0]]) for a in first.saccade(gaze).gaze))
                _look(seeing, executed, generator)
                progress.update(task, advance=1)
                for name, n in [(s, n) for s in sensors for n in counts if t in marks]:
                    found.setdefault((name, n, t), []).append(_known(seeing[name].memories[n], judges[n]))
    rows.rows += [(*labels, *_figures(parts)) for labels, parts in found.items()]


def plan_honesty(cfg: DictConfig) -> tuple[list[str], list[int], list[int]]:
    """The sensors, numbers of cells and looks of the study's settings."""
    cells, looks = (sorted(set(wholes(cfg, setting, 1))) for setting in ("honesty.cells", "honesty.looks"))
    return words(cfg, "honesty.sensors", SENSORS), cells, looks


def _settings(cfg: DictConfig, sensor: str) -> DictConfig:
    """The configuration with another sensor in it."""
    other = cfg.copy()
    OmegaConf.set_struct(other, False)
    other.fidelity = "geometric" if sensor == "geometric" else "photometric"
    if sensor not in ("geometric", cfg.matcher.name):
        other.matcher = OmegaConf.load(Path(conf_dir()) / "matcher" / f"{sensor}.yaml")
    return other


def _look(seeing: dict[str, Sensor], gaze: Gaze, generator: torch.Generator) -> None:
    """One look by every sensor into all its memories; the pictures are taken once."""
    pictures = None
    for name, (observer, arena, memories) in seeing.items():
        if arena.matcher is None:
            matches = arena.look(gaze, generator).matches
        else:
            if pictures is None:
                pictures = [frame.image for frame in arena.world.images(gaze)]
            left, right = pictures
            matches = arena.match(left, right, gaze, generator).matches
        pose = eyes(observer.head, gaze)
        for n, memory in memories.items():
            seeing[name].memories[n] = perceive(observer, memory, matches, pose)


def _known(memory: Memory, judge: Judge) -> tuple[Tensor, ...]:
    """Of the believed cells: inverse range, its variance, the truth, whether they straddle an edge; and all seen."""
    moments, seen = belief(memory), memory.looks > 0
    sure = seen & (trust(memory) >= 0.5)
    rho, variance = moments.mean[sure, 2].double(), moments.cov[sure, 5].double()
    return rho, variance, judge.rho[sure], judge.straddles[sure], seen.sum()


def _judged(rho: Tensor, variance: Tensor, true: Tensor) -> list[float]:
    """FIGURES of some cells."""
    z = (rho - true) / variance.sqrt()
    error = (rho / true - 1).abs()
    figures = (nees_mean(z), *coverage(z, (0.5, 0.95)), outlier_share(z), error.median(), error.mean())
    return [float(figure) for figure in figures]


def _figures(scenes: Sequence[tuple[Tensor, ...]]) -> tuple[Any, ...]:
    """A row of the table."""
    plain = [tuple(part[~scene[3]] for part in scene[:3]) for scene in scenes]
    edges = [tuple(part[scene[3]] for part in scene[:3]) for scene in scenes]
    rho, variance, true = (torch.cat(parts) for parts in zip(*plain, strict=True))
    figures = _judged(rho, variance, true)
    ends: list[float | None] = [None] * len(INTERVALS)
    if len(scenes) > 1:
        by_scene = torch.tensor([_judged(*scene) for scene in plain], dtype=torch.float64)
        interval = bootstrap_interval(by_scene, torch.Generator().manual_seed(0))
        ends = [float(end) for pair in zip(interval.low, interval.high, strict=True) for end in pair]
    nll = float((((rho - true) ** 2 / variance + variance.log()) / 2).mean())
    believed = sum(len(scene[0]) for scene in scenes) / max(1, sum(int(scene[4]) for scene in scenes))
    straddling = sum(len(edge[0]) for edge in edges) / max(1, sum(len(scene[0]) for scene in scenes))
    beside = (nll, float((variance.sqrt() / true).median()), believed, len(rho), straddling)
    on_edge = [torch.cat(parts) for parts in zip(*edges, strict=True)]
    rest = _judged(*on_edge) if len(on_edge[0]) else [None] * len(STRADDLING)
    return (*figures, *ends, *beside, *rest)
