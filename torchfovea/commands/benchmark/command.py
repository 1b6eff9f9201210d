"""`torchfovea benchmark`: entries against the frozen protocol, a record for each, and the leaderboard."""

from __future__ import annotations

import hashlib
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from torchfovea import __version__
from torchfovea.commands.benchmark.entries import Entry, entries_of
from torchfovea.commands.benchmark.protocol import SIZES, TRACKS, VERSION, Size, fingerprint, seeds_of
from torchfovea.commands.benchmark.report import leaderboard, read_records
from torchfovea.commands.benchmark.tracks import TIMES, Unit, run_unit
from torchfovea.commands.shared.composed import config_folders
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.manifest import read_kept, write_kept
from torchfovea.commands.shared.mistakes import describe
from torchfovea.commands.shared.parallel import spread, workers_of
from torchfovea.commands.shared.screen import progress_bar
from torchfovea.commands.shared.settings import choice, number, words
from torchfovea.files import write_json, write_result
from torchfovea.setting import SettingError, require

__all__ = ["run"]

Outcome = dict[str, Any]


def run(cfg: DictConfig) -> float:
    """Run what is missing in the folder, and draw the leaderboard; the number of whole records is the score."""
    if cfg.report is not None:
        sources = [str(path) for path in ([cfg.report] if isinstance(cfg.report, str) else cfg.report)]
        records, folder = read_records([Path(source).expanduser() for source in sources]), run_folder()
    else:
        records, folder = _records(cfg)
    leaderboard(folder, records)
    whole = sum(not record["errors"] for record in records)
    write_result(folder, {"entries": len(records), "complete": whole, "failed": len(records) - whole})
    print((folder / "leaderboard.md").read_text(encoding="utf-8"))
    return float(whole)


def _records(cfg: DictConfig) -> tuple[list[dict[str, Any]], Path]:
    """The record of every entry, and the run's folder, to which they are written."""
    profile = choice(cfg, "size", tuple(SIZES))
    size, split = SIZES[profile], choice(cfg, "split", ("training", "validation", "test"))
    tracks = words(cfg, "tracks", TRACKS)
    limit_s, entries, workers = number(cfg, "limit_s"), entries_of(cfg, tracks), workers_of(cfg)
    if cfg.families is not None:
        size = size._replace(families=tuple(words(cfg, "families", SIZES["paper"].families)))
    units = [unit for entry in entries for unit in _units(entry, size, split, limit_s)]
    marks = fingerprint(size.families)
    told = [_told(unit, marks) for unit in units]
    folder = run_folder()
    outcomes = _outcomes(units, told, folder / "units", *workers)
    records = []
    for entry in entries:
        own = [(unit, outcome) for unit, outcome in zip(units, outcomes, strict=True) if unit.entry == entry]
        record = _record(entry, own, profile, split, marks)
        write_json(folder / "records" / f"{entry.track}.{_file_name(entry.name)}.json", record)
        records.append(record)
    return records, folder


def _units(entry: Entry, size: Size, split: str, limit_s: float) -> list[Unit]:
    images = entry.track in ("matcher", "whole")
    families = [name for name in size.families if not (images and name == "twins")]
    seeds = tuple(seeds_of(split, size.scenes[entry.track]))
    return [Unit(entry, family, seeds, size, limit_s, config_folders()) for family in families]


def _told(unit: Unit, marks: dict[str, str]) -> dict[str, Any]:
    """What decides a unit's figures."""
    size = {key: list(value) if isinstance(value, tuple) else value for key, value in unit.size._asdict().items()}
    del size["families"]
    made = {"protocol": VERSION, "torchfovea": __version__, "family": [unit.family, marks[unit.family]]}
    return {**made, "entry": unit.entry.describe(), "seeds": list(unit.seeds), "size": size, "limit_s": unit.limit_s}


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _file_name(name: str) -> str:
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
    return plain if plain == name else f"{plain}-{_hash(name)[:6]}"


def _outcomes(
    units: list[Unit], told: list[dict[str, Any]], units_at: Path, workers: int, backend: str
) -> list[Outcome]:
    """What became of every unit: its rows or its error; those that the folder holds already are read."""
    paths = [
        units_at / f"{unit.entry.track}-{unit.family}-{_hash(what)}.json"
        for unit, what in zip(units, told, strict=True)
    ]
    missing = [k for k, path in enumerate(paths) if not path.exists()]
    with progress_bar() as progress:
        bar = progress.add_task("benchmark", total=len(missing))
        for n, outcome in spread(_attempt, [units[k] for k in missing], workers, backend):
            k = missing[n]
            if isinstance(outcome, Exception):
                raise outcome
            write_kept(paths[k], {**told[k], **outcome})
            if outcome["error"] is not None:
                line = f"benchmark: {units[k].entry.name} in {units[k].family}: {outcome['error']}"
                progress.console.print(line, highlight=False, markup=False, soft_wrap=True)
            progress.advance(bar)
    return [_read(path) for path in paths]


def _read(path: Path) -> Outcome:
    outcome: Outcome = read_kept(path)
    require({"rows", "error"} <= set(outcome), str(path), "corrupt", "a unit's rows; remove it to run it again")
    return outcome


def _attempt(unit: Unit) -> Outcome:
    """An entry's own mistakes are its outcome, and nobody else's."""
    start = time.monotonic()
    try:
        with _within(unit.limit_s):
            rows = run_unit(unit)
        took = time.monotonic() - start
        require(took <= unit.limit_s, "limit_s", f"{took:.0f} s", f"at most {unit.limit_s:g} s")
    except Exception as error:
        said = describe(error, ()) or f"{type(error).__name__}: {error}"
        return {"rows": [], "error": " ".join(said.split())[:300], "seconds": time.monotonic() - start}
    return {"rows": rows, "error": None, "seconds": time.monotonic() - start}


@contextmanager
def _within(limit_s: float) -> Iterator[None]:
    """Raise in what takes longer; where signals do not reach (a thread, Windows) it is judged when it ends."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def late(number: int, frame: FrameType | None) -> None:
        raise SettingError(f"limit_s = {limit_s:g}: expected to be done in time")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _record(
    entry: Entry, own: list[tuple[Unit, Outcome]], profile: str, split: str, marks: dict[str, str]
) -> dict[str, Any]:
    """The record of an entry: what it was, on what, its figures by scene, and apart from them the times."""
    versions = {"torchfovea": __version__, "torch": torch.__version__, "numpy": np.__version__}
    versions["python"] = ".".join(map(str, sys.version_info[:3]))
    families, times = {}, {}
    for unit, outcome in own:
        rows = [{key: value for key, value in row.items() if key not in TIMES} for row in outcome["rows"]]
        families[unit.family] = {"hash": marks[unit.family], "scenes": len(unit.seeds), "rows": rows}
        spent = [row[key] for row in outcome["rows"] for key in TIMES if row.get(key) is not None]
        times[unit.family] = {
            "seconds": outcome["seconds"],
            "compute_seconds": sum(spent) / len(spent) if spent else None,
        }
    errors = {unit.family: outcome["error"] for unit, outcome in own if outcome["error"] is not None}
    return {
        "protocol": VERSION, "profile": profile, "split": split, "track": entry.track, "entry": entry.describe(),
        "settings_hash": _hash([_told(unit, marks) for unit, _ in own]), "versions": versions, "families": families,
        "errors": errors, "times": times,
    }  # fmt: skip
