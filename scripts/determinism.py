"""Runs every command several times over, with what must not matter changed, and compares all that it wrote.

    python scripts/determinism.py [command ...]

Each run is a process of its own. A table says for each command and change whether every file has the same bytes (times,
and what names the run or the machine, left out), and if not how far apart its numbers are.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

SENSOR = ["sensor.receptive_fields=2000", "sensor.source_px=200"]
SEARCH = [*SENSOR, "memory.cells=300", "saccades=4", "episodes=3", "seed=5"]
TUNE = [
    "profile=quick",
    "episodes=96",
    "warm_episodes=32",
    "validations=2",
    "validation_scenes=16",
    "heldout_scenes=32",
]
# Not of the figures: how long it took, and on what
TIMES = (
    "seconds",
    "manifest.json",
    "config_hash",
    "settings_hash",
    "versions",
    "times",
    "per_second",
    "per_cpu_second",
    ".log",
    ".hydra",
    "cpu",
)
PICTURES = (".png", ".gif", ".html", ".svg")


class Change(NamedTuple):
    """What is done otherwise in one of two runs.

    Attributes:
        name: in the table.
        settings: added to the command's.
        environment: of the process.
    """

    name: str
    settings: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()


AGAIN = Change("another process and hash seed", (), (("PYTHONHASHSEED", "7"),))
THREADS = Change("2 threads in place of 1", (), (("OMP_NUM_THREADS", "2"),))
WORKERS = Change("2 workers in place of 1", ("workers=2",))
BATCH = Change("batch 1 in place of 4", ("batch=1",))
COMMANDS: dict[str, tuple[list[str], tuple[Change, ...]]] = {
    "search, images": (["search", *SEARCH, "workers=1"], (AGAIN, THREADS, WORKERS)),
    "search, sweep": (["search", *SEARCH, "matcher=sweep", "workers=1"], (AGAIN, THREADS, WORKERS)),
    "search, geometric": (["search", *SEARCH, "fidelity=geometric", "batch=4"], (AGAIN, THREADS, BATCH)),
    "sense, SGBM": (["sense", "pair=motorcycle", "matcher=sgbm", *SENSOR[:1]], (AGAIN, THREADS)),
    "sense, sweep": (["sense", "pair=motorcycle", *SENSOR[:1]], (AGAIN, THREADS)),
    "replay": (["replay", "recording=RECORDING", *SENSOR[:1], "memory.cells=300"], (AGAIN, THREADS)),
    "characterize": (
        ["characterize", "profile=quick", "sensor.receptive_fields=2000", "propagation.samples=4000"],
        (AGAIN, THREADS),
    ),
    "tune": (["tune", *TUNE, "prior_field=false"], (AGAIN, THREADS)),
    "reproduce": (
        ["reproduce", "profile=quick", "episodes=2", "saccades=3", "sensor.receptive_fields=400", "workers=1"],
        (AGAIN, THREADS, WORKERS),
    ),
    "calibrate": (["calibrate", "profile=quick", *SENSOR, "workers=1"], (AGAIN, THREADS, WORKERS)),
    "memory": (["memory", "memory.cells=300"], (AGAIN, THREADS)),
    "memory study=moving": (["memory", "study=moving", *SEARCH], (AGAIN, THREADS)),
    "benchmark": (
        ["benchmark", "profile=quick", "tracks=[policy,memory]", "families=[narrow]", "workers=1"],
        (AGAIN, THREADS, WORKERS),
    ),
}


def main(chosen: list[str]) -> None:
    """Run, compare and print the table."""
    print(
        "| command | " + " | ".join(("change", "tables and results", "pictures")) + " |\n|---|---|---|---|", flush=True
    )
    with tempfile.TemporaryDirectory() as place:
        recording = Path(place) / "record"
        if not chosen or "replay" in chosen:
            run(["search", *SEARCH[:-2], "episodes=1", "record=true"], Change("record"), recording)
        for name, (words, changes) in COMMANDS.items():
            if chosen and words[0] not in chosen:
                continue
            words = [word.replace("RECORDING", str(recording / "recording")) for word in words]
            first = Path(place) / "first" / name.replace(", ", "_").replace(" ", "_")
            run(words, Change("first"), first)
            for change in changes:
                other = Path(place) / change.name.replace(" ", "_") / first.name
                run(words, change, other)
                print(f"| {name} | {change.name} | {' | '.join(compared(first, other))} |", flush=True)


def run(words: list[str], change: Change, folder: Path) -> None:
    """A command in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0", **dict(change.environment)}
    command = [sys.executable, "-m", "torchfovea", *words, *change.settings, f"hydra.run.dir={folder}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")


def compared(first: Path, other: Path) -> tuple[str, str]:
    """In words: of tables and results, and of pictures."""
    names = [{str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} for folder in (first, other)]
    if names[0] ^ names[1]:
        return f"other files: {', '.join(sorted(names[0] ^ names[1]))}", "-"
    told, drawn = [], []
    for name in sorted(n for n in names[0] if not any(part in n for part in TIMES)):
        if name.endswith(PICTURES):
            drawn.append((first / name).read_bytes() == (other / name).read_bytes())
        else:
            told.append((name, *apart(first / name, other / name)))
    unequal = [(name, far, count) for name, far, count in told if far > 0]
    worst = max(unequal, key=lambda one: one[1], default=None)
    text = "same" if worst is None else f"{worst[1]:.1e} apart in {worst[0]} ({len(unequal)} of {len(told)} files)"
    return text, "-" if not drawn else "same" if all(drawn) else f"{drawn.count(False)} of {len(drawn)} differ"


def apart(one: Path, other: Path) -> tuple[float, int]:
    """The largest difference of two files' numbers over the column's largest one; inf where words differ."""
    parts = [list(columns_of(path)) for path in (one, other)]
    if [name for name, _ in parts[0]] != [name for name, _ in parts[1]]:
        return math.inf, 0
    worst, count = 0.0, 0
    for (name, left), (_, right) in zip(*parts, strict=True):
        if any(part in name for part in TIMES):
            continue
        count += 1
        worst = max(worst, differing(left, right))
    return worst, count


def differing(left: Any, right: Any) -> float:
    """How far two columns are apart."""
    if np.array_equal(left, right) if isinstance(left, np.ndarray) else left == right:
        return 0.0
    try:
        a, b = (np.asarray(value, dtype=np.float64) for value in (left, right))
    except (TypeError, ValueError):
        return math.inf
    if a.shape != b.shape or not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return math.inf
    known = np.isfinite(a)
    scale = max(float(np.abs(a[known]).max(initial=0.0)), 1e-12)
    return float(np.abs(a - b)[known].max(initial=0.0)) / scale


def columns_of(path: Path) -> Iterator[tuple[str, Any]]:
    """What a file holds, by name; the bytes themselves of a kind that is not read."""
    if path.suffix == ".csv":
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
        for k, name in enumerate(rows[0]):
            column = [row[k] for row in rows[1:]]
            yield name, [float("nan") if v == "" else float(v) for v in column] if numeric(column) else column
    elif path.suffix == ".json":
        yield from flat(json.loads(path.read_text(encoding="utf-8")), path.stem)
    elif path.suffix == ".yaml":
        yield from flat(yaml.safe_load(path.read_text(encoding="utf-8")), path.stem)
    elif path.suffix == ".npz":
        with np.load(path) as arrays:
            yield from ((name, arrays[name]) for name in sorted(arrays.files))
    else:
        yield path.name, path.read_bytes()


def numeric(column: list[str]) -> bool:
    """Whether all of a column's cells are numbers or empty."""
    try:
        return bool([float(cell) for cell in column if cell])
    except ValueError:
        return False


def flat(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The leaves of a JSON or YAML file."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from flat(value, f"{name}.{key}")
    else:
        yield name, node


if __name__ == "__main__":
    main(sys.argv[1:])
