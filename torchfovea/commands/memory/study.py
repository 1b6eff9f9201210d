"""What each way to fuse makes of the same observations: estimated over true range, and honesty, cell by cell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.judge import Judge, estimate, fixation_course, judge_cells
from torchfovea.commands.shared.settings import whole
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.perception import Observer, new_memory, perceive
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.sensing.unscented import SigmaPoints

__all__ = ["Rows", "figures_of", "study_encoders", "study_fusion"]

COLUMNS = (
    "cells", "straddling", "range_ratio_median", "relative_error_median", "nees_mean", "z2_median", "outlier_share",
    "straddling_relative_error_median", "straddling_outlier_share",
)  # fmt: skip


@dataclass
class Rows:
    """A study's table: labels, then figures, of which the screen shows the first `shown`."""

    labels: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    shown: int | None = None
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    @property
    def columns(self) -> tuple[str, ...]:
        """The header."""
        return (*self.labels, *self.names)

    def figures(self) -> dict[str, Any]:
        """All figures under dotted keys."""
        count = len(self.labels)
        return {
            ".".join([*(str(v) for v in row[:count]), name]): value
            for row in self.rows
            for name, value in zip(self.names, row[count:], strict=True)
        }


def figures_of(estimates: Sequence[tuple[Tensor, Tensor, Tensor, Judge]]) -> tuple[Any, ...]:
    """COLUMNS from inverse ranges, their variances, what was seen, and the truth, of several memories."""
    parts = [(m[s].double(), v[s].double(), j.rho[s], j.straddles[s]) for m, v, s, j in estimates]
    rho, variance, true, straddles = (torch.cat(part) for part in zip(*parts, strict=True))
    z = (rho - true) / variance.sqrt()
    error = (rho / true - 1).abs()
    out = z.abs() > 5

    def median(x: Tensor) -> float | None:
        return float(x.median()) if len(x) else None

    plain = ~straddles
    inside = plain & ~out
    return (
        len(rho), float(straddles.double().mean()), median((true / rho.clamp(min=1e-3))[plain]), median(error[plain]),
        float(z[inside].square().mean()) if bool(inside.any()) else None, median(z[plain].square()),
        float(out[plain].double().mean()), median(error[straddles]), float(out[straddles].double().mean()),
    )  # fmt: skip


def ways_to_fuse(base: Observer) -> dict[str, Observer]:
    """The three settings, and the default without its parts."""
    cartesian = replace(base, prior=Prior(4.0, 4.0))
    printed = replace(base, prior=Prior(1000.0, 1000.0), points=SigmaPoints.paper(), rotated=False)
    point = replace(base.prior, slope_std=1e-3)
    return {
        "printed": replace(printed, fusion=Fusion("printed")),
        "aligned": replace(cartesian, fusion=Fusion("aligned")),
        "inverse_range, a cell a point": replace(base, fusion=Fusion(conflict=math.inf), prior=point),
        "inverse_range, a cell a patch": replace(base, fusion=Fusion(conflict=math.inf)),
        "inverse_range": replace(base, fusion=Fusion()),
    }


def study_fusion(cfg: DictConfig, rows: Rows) -> None:
    """The ways to fuse, both retinas, after five saccades and after all."""
    rows.labels, rows.names = ("sensor", "fusion", "saccades"), COLUMNS
    base = build_observer(cfg)
    saccades, seed = whole(cfg, "saccades"), whole(cfg, "seed", 0)
    fields = whole(cfg, "sensor.receptive_fields", 16)
    retinas: dict[str, Retina] = {
        "log_polar": LogPolar(fields), "uniform": Uniform(fields)
    }  # fmt: skip
    marks = sorted({min(5, saccades), saccades})
    for sensor, retina in retinas.items():
        found: dict[tuple[str, int], list[Any]] = {}
        for k in range(seed, seed + whole(cfg, "episodes")):
            observers = ways_to_fuse(replace(base, retina=retina))
            arena = build_arena(cfg, observers["inverse_range"], k)
            generator = torch.Generator().manual_seed(k)
            cells = build_cells(cfg, base.head, generator)
            judge = judge_cells(arena.world, cells)
            memories = {name: new_memory(observer, cells) for name, observer in observers.items()}
            for t, gaze in enumerate(fixation_course(arena, cells, saccades, k), 1):
                executed = Gaze(*(a.to(cells) for a in arena.saccade(gaze).gaze))
                matches, pose = arena.look(executed, generator).matches, eyes(base.head, executed)
                for name, observer in observers.items():
                    memories[name] = perceive(observer, memories[name], matches, pose)
                    if t in marks:
                        found.setdefault((name, t), []).append((*estimate(memories[name]), judge))
        rows.rows += [(sensor, name, t, *figures_of(parts)) for (name, t), parts in sorted(found.items(), key=_by_mark)]


def _by_mark(item: tuple[tuple[str, int], Any]) -> int:
    return item[0][1]


def study_encoders(cfg: DictConfig, rows: Rows) -> None:
    """Encoders that err by 0 to 0.2 degrees, counted as common covariance or not."""
    rows.labels, rows.names = ("encoder_deg", "common"), COLUMNS
    base = build_observer(cfg)
    saccades, seed = whole(cfg, "saccades"), whole(cfg, "seed", 0)
    for encoder_deg in (0.0, 0.05, 0.1, 0.2):
        head = replace(base.head, encoder_deg=encoder_deg)
        observers = {"counted": replace(base, head=head), "left out": base}
        found: dict[str, list[Any]] = {name: [] for name in observers}
        for k in range(seed, seed + whole(cfg, "episodes")):
            arena = build_arena(cfg, base, k)
            arena.observer = observers["counted"]
            generator = torch.Generator().manual_seed(k)
            cells = build_cells(cfg, base.head, generator)
            judge = judge_cells(arena.world, cells)
            memories = {name: new_memory(observer, cells) for name, observer in observers.items()}
            for gaze in fixation_course(arena, cells, saccades, k):
                told = Gaze(*(a.to(cells) for a in arena.saccade(gaze).gaze))
                matches, pose = arena.look(told, generator).matches, eyes(head, told)
                memories = {name: perceive(observers[name], m, matches, pose) for name, m in memories.items()}
            for name, memory in memories.items():
                found[name].append((*estimate(memory), judge))
        rows.rows += [(encoder_deg, name, *figures_of(parts)) for name, parts in found.items()]
