"""Which paths a configuration asks for, each made when its turn comes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cache

import torch
from omegaconf import DictConfig

from torchfovea.commands.bench.episodes import (
    episode,
    photometric_saccade,
    picture,
    sweeps,
    tuning_episode,
    tuning_gradient,
)
from torchfovea.commands.bench.look import Saccade, saccade
from torchfovea.commands.bench.paths import paths_of_look
from torchfovea.commands.bench.retina_paths import path_of_retina
from torchfovea.commands.bench.steps import batched_steps, paths_of_steps
from torchfovea.commands.bench.timing import Path
from torchfovea.commands.shared.build import build_cells, build_observer
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.settings import changed, choice, construct, whole
from torchfovea.perception import Observer
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import require

__all__ = ["PATHS", "builders_of"]

PATHS = ("retina", "triangulate_ut", "align", "fuse", "decide", "step", "render", "saccade", "episode", "tune")


def builders_of(cfg: DictConfig, device: str, wanted: Sequence[str]) -> list[Callable[[], list[Path]]]:
    """What makes the paths.

    Args:
        cfg: of the command.
        device: cpu or cuda; what cannot run there is left out.
        wanted: some of `PATHS`; builders of several may make others too.

    Raises:
        SettingError: for an observer that the peers are not written for, and whatever a path would refuse.
    """
    full = build_observer(cfg)
    full, mode = dataclasses.replace(full, compile="off"), full.compile
    require(isinstance(full.retina, LogPolar), "sensor.layout", cfg.sensor.layout, "log_polar, in bench")
    require(cfg.sensor.camera == "pinhole", "sensor.camera", cfg.sensor.camera, "pinhole, in bench")
    require(full.fusion.chart == "inverse_range", "fusion", full.fusion.name, "inverse_range, in bench")
    require(full.points is None and full.rotated, "budget.sigma_points", "paper", "ours, in bench")
    batch, source = whole(cfg, "batch"), whole(cfg, "sensor.source_px", 16)
    # what the peers do not do: fill empty cells, keep two surfaces apart
    fusion = dataclasses.replace(full.fusion, fill=False, conflict=math.inf, half_life=math.inf)
    head = dataclasses.replace(full.head, encoder_deg=0.0)
    plain = dataclasses.replace(full, fusion=fusion, head=head, reward="inverse_range")
    fewer = {**cfg.sensor, "receptive_fields": whole(cfg, "small.receptive_fields")}
    small = dataclasses.replace(plain, retina=construct(LogPolar, fewer, "sensor"))
    few = changed(cfg, {"memory": {"cells": whole(cfg, "small.cells")}})
    whole(cfg, "saccades", 2), whole(cfg, "tuning.episodes", 8), whole(cfg, "tuning.cells", 2)
    choice(cfg, "fidelity", ("geometric", "photometric"))
    rehearse(changed(cfg, {"fidelity": "photometric"}), full.head, full)
    require(full.classes is None, "reward", "of_class", "a reward of nearness, in bench")

    def cells_of(settings: DictConfig) -> torch.Tensor:
        return build_cells(settings, head, torch.Generator().manual_seed(int(cfg.seed)))

    @cache
    def look() -> Saccade:
        return saccade(plain, cells_of(cfg), device)._replace(compile=mode)

    builders: list[tuple[tuple[str, ...], Callable[[], list[Path]]]] = [
        (("retina",), lambda: path_of_retina(_log_polar(full), source, batch, device, mode)),
        (PATHS[1:4], lambda: paths_of_look(look())),
        (PATHS[4:6], lambda: paths_of_steps(look(), full)),
        (("step",), lambda: [batched_steps(small, cells_of(few), batch, device)]),
        (("episode",), lambda: [episode(few, dataclasses.replace(full, retina=small.retina), batch, device, mode)]),
    ]
    if device == "cpu":
        builders += [
            (("render",), lambda: [picture(cfg, full, source)]),
            (("saccade",), lambda: [photometric_saccade(cfg, full)]),
            (("tune",), lambda: [tuning_episode(cfg, full), tuning_gradient(cfg, full)]),
        ]
        if cfg.matcher.name == "sweep":  # others match pair by pair
            builders.append(
                (("saccade",), lambda: [sweeps(cfg, dataclasses.replace(full, retina=small.retina), batch)])
            )
    return [build for names, build in builders if set(names) & set(wanted)]


def _log_polar(observer: Observer) -> LogPolar:
    assert isinstance(observer.retina, LogPolar)
    return observer.retina
