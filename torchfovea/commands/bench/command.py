"""``torchfovea bench``: how long the hot paths take, beside the peers that a user would pick."""

from __future__ import annotations

import platform
from collections.abc import Callable
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from torchfovea.commands.bench.against import compare
from torchfovea.commands.bench.builders import PATHS, builders_of
from torchfovea.commands.bench.memory import peak_bytes
from torchfovea.commands.bench.timing import Path, Timing, copy_bandwidth, interleaved, slope
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.screen import wide_screen
from torchfovea.commands.shared.settings import device_of, number, whole
from torchfovea.files import write_csv, write_result
from torchfovea.setting import require

__all__ = ["run"]

SECONDS = {"quick": 0.3, "reduced": 1.0, "paper": 3.0}
_COLUMNS = (
    "path", "work", "device", "peer", "median_ms", "low_ms", "high_ms", "cpu_ms", "runs",
    "peer_median_ms", "peer_low_ms", "peer_high_ms", "peer_cpu_ms", "ratio", "bytes", "over_copy", "peak_bytes",
    "slope_rfs", "slope_cells", "slope_batch",
)  # fmt: skip
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
    device = device_of(cfg)
    profile = SECONDS[str(HydraConfig.get().runtime.choices["profile"])]
    seconds = profile if cfg.seconds is None else number(cfg, "seconds")
    wanted = PATHS if cfg.paths is None else cfg.paths if OmegaConf.is_list(cfg.paths) else (cfg.paths,)
    for name in wanted:
        require(name in PATHS, "paths", name, "some of " + ", ".join(PATHS))
    builders = builders_of(cfg, device, wanted)
    if cfg.against is not None:
        return compare(cfg, wanted, seconds)
    require(cfg.history is None, "history", cfg.history, "null, or against=COMMIT besides")
    folder, console = run_folder(), wide_screen(170)
    bandwidth = copy_bandwidth(seconds / 2, device)
    figures: dict[str, Any] = {
        "machine": torch.cuda.get_device_name() if device == "cuda" else platform.processor() or platform.machine(),
        "device": device,
        "threads": torch.get_num_threads(),
        "copy_bandwidth_bytes_per_second": bandwidth,
    }
    figures |= {f"{name}.{key}": None for name in PATHS for key in ("median_ms", "cpu_ms", "peer_median_ms", "ratio")}
    columns = ("path", "work", "ms", "CPU", "peer", "its ms", "ratio", "x copy", "peak MB", "slopes")
    table = Table(*columns, box=None, padding=(0, 2, 0, 0))
    rows: list[list[Any]] = []
    done: set[str] = set()
    for builder in builders:
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
            peak = peak_bytes(path.run, device)
            rows += _rows(path, timings, over, peak, slopes)
            _tabulate(table, path, timings, over, peak, slopes)
            if path.name not in done:
                done.add(path.name)
                figures[f"{path.name}.median_ms"] = timings[0].median_ms
                figures[f"{path.name}.cpu_ms"] = timings[0].cpu_ms
                figures[f"{path.name}.peak_bytes"] = peak
                if path.peers:
                    figures[f"{path.name}.peer_median_ms"] = timings[1].median_ms
                    figures[f"{path.name}.ratio"] = timings[1].median_ms / timings[0].median_ms
                figures |= {f"{path.name}.slope_{axis.lower()}": value for axis, value in slopes.items()}
                figures[f"{path.name}.over_copy"] = over
    console.print(
        f"{device}, {figures['machine']}, {torch.get_num_threads()} threads; copies {bandwidth / 1e9:.1f} GB/s. "
        "ms: median (quartiles); CPU: milliseconds of all threads. ratio: the peer's median over ours. x copy: ms over "
        "the time to copy the bytes. peak MB: memory while it runs, beyond what there was."
    )
    console.print(table)
    write_csv(folder / "bench.csv", _COLUMNS, rows)
    write_result(folder, figures)
    ratio: float | None = figures["step.ratio"]
    return ratio


def _scaled(timing: Timing, factor: float) -> Timing:
    middle, low, high, cpu = (factor * ms for ms in timing[:4])
    return Timing(middle, low, high, cpu, timing.runs)


def _slope(sizes: tuple[int, ...], runs: tuple[Callable[[], Any], ...], seconds: float, device: str) -> float:
    """How the time of the whole call grows with its size."""
    timings = interleaved(runs, _GROWTH_SHARE * seconds, device)
    return slope(sizes, [t.median_ms for t in timings])


def _rows(
    path: Path, timings: list[Timing], over: float | None, peak: int | None, slopes: dict[str, float]
) -> list[list[Any]]:
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
            *(theirs[:4] if theirs else (None,) * 4), theirs.median_ms / ours.median_ms if theirs else None,
            moved, over, peak, *grown,
        ]
        for name, theirs in peers
    ]  # fmt: skip


def _tabulate(
    table: Table, path: Path, timings: list[Timing], over: float | None, peak: int | None, slopes: dict[str, float]
) -> None:
    def show(t: Timing) -> str:
        return f"{t.median_ms:.3g} ({t.low_ms:.3g}-{t.high_ms:.3g})"

    grown = ", ".join(f"{axis} {value:.2f}" for axis, value in slopes.items())
    first = [path.name, path.work, show(timings[0]), f"{timings[0].cpu_ms:.3g}"]
    last = ["" if over is None else f"{over:.3g}", "" if peak is None else f"{peak / 1e6:.3g}", grown]
    if not path.peers:
        table.add_row(*first, "", "", "", *last)
    for peer, theirs in zip(path.peers, timings[1:], strict=True):
        table.add_row(*first, peer.name, show(theirs), f"{theirs.median_ms / timings[0].median_ms:.3g}", *last)
        first, last = [""] * 4, [""] * 3
