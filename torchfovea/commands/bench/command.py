"""``torchfovea bench``: how long the hot paths take, beside the peers that a user would pick."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from torchfovea.commands.bench.episodes import episode, photometric_saccade, picture, tuning_episode
from torchfovea.commands.bench.look import Saccade, saccade
from torchfovea.commands.bench.paths import paths_of_look
from torchfovea.commands.bench.retina_paths import path_of_retina
from torchfovea.commands.bench.steps import batched_steps, paths_of_steps
from torchfovea.commands.bench.timing import Path, Timing, copy_bandwidth, interleaved, slope
from torchfovea.commands.shared.build import (
    build_cells,
    build_observer,
    choice,
    number,
    whole,
)
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.settings import construct
from torchfovea.files import write_csv, write_result
from torchfovea.perception import Observer
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import require

__all__ = ["run"]

PATHS = ("retina", "triangulate_ut", "align", "fuse", "decide", "step", "render", "saccade", "episode", "tune")
SECONDS = {"quick": 0.3, "reduced": 1.0, "paper": 3.0}
_COLUMNS = (
    "path", "work", "device", "peer", "median_ms", "low_ms", "high_ms", "runs",
    "peer_median_ms", "peer_low_ms", "peer_high_ms", "ratio", "bytes", "over_copy",
    "slope_rfs", "slope_cells", "slope_batch",
)  # fmt: skip
_WIDTH = 170  # of the table in a file
_GROWTH_SHARE = 0.4  # of a path's seconds


def run(cfg: DictConfig) -> float | None:
    """Check, time, print and write; the ratio of the whole step is what a sweeper sees.

    Raises:
        SettingError: for a setting out of range, or cuda where there is none.
        RuntimeError: where a path and a peer do not compute the same thing.
    """
    threads = torch.get_num_threads()
    if cfg.threads is not None:
        torch.set_num_threads(whole(cfg, "threads"))
    try:
        with torch.no_grad():
            return _run(cfg)
    finally:
        torch.set_num_threads(threads)


def _run(cfg: DictConfig) -> float | None:
    device = choice(cfg, "device", ("cpu", "cuda"))
    require(device == "cpu" or torch.cuda.is_available(), "device", device, "cpu, or cuda on a machine that has it")
    profile = SECONDS[str(HydraConfig.get().runtime.choices["profile"])]
    seconds = profile if cfg.seconds is None else number(cfg, "seconds")
    wanted = PATHS if cfg.paths is None else cfg.paths if OmegaConf.is_list(cfg.paths) else (cfg.paths,)
    for name in wanted:
        require(name in PATHS, "paths", name, "some of " + ", ".join(PATHS))
    folder, console = run_folder(), Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    bandwidth = copy_bandwidth(seconds / 2, device)
    figures: dict[str, Any] = {
        "machine": torch.cuda.get_device_name() if device == "cuda" else platform.processor() or platform.machine(),
        "device": device,
        "threads": torch.get_num_threads(),
        "copy_bandwidth_bytes_per_second": bandwidth,
    }
    figures |= {f"{name}.{key}": None for name in PATHS for key in ("median_ms", "peer_median_ms", "ratio")}
    table = Table("path", "work", "ms", "peer", "its ms", "ratio", "x copy", "slopes", box=None, padding=(0, 2, 0, 0))
    rows: list[list[Any]] = []
    done: set[str] = set()
    for builder in _builders(cfg, device, wanted):
        for path in builder():
            if path.name not in wanted:
                continue
            path.check()
            timings = interleaved([path.run, *(peer.run for peer in path.peers)], seconds, device, True)
            scales = (1.0, *(peer.scale for peer in path.peers))
            timings = [_scaled(t, scale / path.units) for t, scale in zip(timings, scales, strict=True)]
            slopes = {g.axis: _slope(g.sizes, g.runs, seconds, device) for g in path.growths}
            floor_ms = 1e3 * path.moved / path.units / bandwidth
            over = timings[0].median_ms / floor_ms if path.moved else None
            rows += _rows(path, timings, over, slopes)
            _tabulate(table, path, timings, over, slopes)
            if path.name not in done:
                done.add(path.name)
                figures[f"{path.name}.median_ms"] = timings[0].median_ms
                if path.peers:
                    figures[f"{path.name}.peer_median_ms"] = timings[1].median_ms
                    figures[f"{path.name}.ratio"] = timings[1].median_ms / timings[0].median_ms
                figures |= {f"{path.name}.slope_{axis.lower()}": value for axis, value in slopes.items()}
                figures[f"{path.name}.over_copy"] = over
    console.print(
        f"{device}, {figures['machine']}, {torch.get_num_threads()} threads; copies {bandwidth / 1e9:.1f} GB/s. "
        "ms: median (quartiles). ratio: the peer's median over ours. x copy: ms over the time to copy the bytes."
    )
    console.print(table)
    write_csv(folder / "bench.csv", _COLUMNS, rows)
    write_result(folder, figures)
    ratio: float | None = figures["step.ratio"]
    return ratio


def _scaled(timing: Timing, factor: float) -> Timing:
    return Timing(factor * timing.median_ms, factor * timing.low_ms, factor * timing.high_ms, timing.runs)


def _slope(sizes: tuple[int, ...], runs: tuple[Callable[[], Any], ...], seconds: float, device: str) -> float:
    """How the time of the whole call grows with its size."""
    timings = interleaved(runs, _GROWTH_SHARE * seconds, device)
    return slope(sizes, [t.median_ms for t in timings])


def _rows(path: Path, timings: list[Timing], over: float | None, slopes: dict[str, float]) -> list[list[Any]]:
    ours = timings[0]
    grown = [slopes.get(axis) for axis in ("RFs", "cells", "batch")]
    peers: list[tuple[str | None, Timing | None]] = [
        (peer.name, t) for peer, t in zip(path.peers, timings[1:], strict=True)
    ]
    peers = peers or [(None, None)]
    moved = path.moved // path.units or None
    return [
        [
            path.name, path.work, path.device, name, *ours,
            *(theirs[:3] if theirs else (None,) * 3), theirs.median_ms / ours.median_ms if theirs else None,
            moved, over, *grown,
        ]
        for name, theirs in peers
    ]  # fmt: skip


def _tabulate(table: Table, path: Path, timings: list[Timing], over: float | None, slopes: dict[str, float]) -> None:
    def show(t: Timing) -> str:
        return f"{t.median_ms:.3g} ({t.low_ms:.3g}-{t.high_ms:.3g})"

    grown = ", ".join(f"{axis} {value:.2f}" for axis, value in slopes.items())
    first = [path.name, path.work, show(timings[0])]
    last = ["" if over is None else f"{over:.3g}", grown]
    if not path.peers:
        table.add_row(*first, "", "", "", *last)
    for peer, theirs in zip(path.peers, timings[1:], strict=True):
        table.add_row(*first, peer.name, show(theirs), f"{theirs.median_ms / timings[0].median_ms:.3g}", *last)
        first, last = ["", "", ""], ["", ""]


def _builders(cfg: DictConfig, device: str, wanted: Sequence[str]) -> list[Callable[[], list[Path]]]:
    """What makes the paths, each when its turn comes."""
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
    few = OmegaConf.merge(cfg, {"memory": {"cells": whole(cfg, "small.cells")}})
    assert isinstance(few, DictConfig)

    def cells_of(settings: DictConfig) -> torch.Tensor:
        return build_cells(settings, head, torch.Generator().manual_seed(int(cfg.seed)))

    @cache
    def look() -> Saccade:
        return saccade(plain, cells_of(cfg), device)._replace(compile=mode)

    builders: list[tuple[tuple[str, ...], Callable[[], list[Path]]]] = [
        (("retina",), lambda: path_of_retina(_log_polar(full), source, batch, device)),
        (PATHS[1:4], lambda: paths_of_look(look())),
        (PATHS[4:6], lambda: paths_of_steps(look(), full)),
        (("step",), lambda: [batched_steps(small, cells_of(few), batch, device)]),
        (("episode",), lambda: [episode(few, dataclasses.replace(full, retina=small.retina), batch, device)]),
    ]
    if device == "cpu":
        builders += [
            (("render",), lambda: [picture(cfg, full, source)]),
            (("saccade",), lambda: [photometric_saccade(cfg, full)]),
            (("tune",), lambda: [tuning_episode(cfg, full)]),
        ]
    return [build for names, build in builders if set(names) & set(wanted)]


def _log_polar(observer: Observer) -> LogPolar:
    assert isinstance(observer.retina, LogPolar)
    return observer.retina
