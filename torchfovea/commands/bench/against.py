"""``bench against=COMMIT``: this tree's paths and another commit's, in turns on one machine, and a history of that."""

from __future__ import annotations

import datetime
import io
import json
import platform
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

import torchfovea
from torchfovea.commands.shared.config import run_folder
from torchfovea.files import write_csv, write_result
from torchfovea.setting import SettingError, require

__all__ = ["Compared", "add_line", "checkout", "compare", "in_turns"]

_FEWEST, _MOST = 5, 200  # calls of each tree
_OWN = ("against", "history", "compile", "hydra.")  # settings that are not the workers'
COLUMNS = (
    "path", "work", "runs", "least_cpu_ms", "then_least_cpu_ms", "least_ratio", "cpu_ms", "then_cpu_ms", "ratio",
    "wall_ms", "then_wall_ms",
)  # fmt: skip


class Compared(NamedTuple):
    """A path in both trees: CPU milliseconds of a piece of work, least and median, and the medians of wall time.

    Ratios are the other commit's over this tree's: more than 1 is faster now.
    """

    path: str
    work: str
    runs: int
    least_cpu_ms: float
    then_least_cpu_ms: float
    least_ratio: float
    cpu_ms: float
    then_cpu_ms: float
    ratio: float
    wall_ms: float
    then_wall_ms: float


class _Side:
    """A tree's worker."""

    def __init__(self, tree: Path, settings: Sequence[str], name: str) -> None:
        text, self.name = Path(__file__).with_name("worker.py").read_text(), name
        command = [sys.executable, "-c", text, *settings]
        self.process = subprocess.Popen(
            command, cwd=tree, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            self.paths: list[tuple[str, str]] = [(name, work) for name, work in self.answer()]
        except BaseException:
            self.close()
            raise

    def answer(self) -> list[Any]:
        """The next line of JSON.

        Raises:
            SettingError: where the worker has ended instead.
        """
        assert self.process.stdout is not None
        said = "it ended"
        for line in self.process.stdout:
            if line.startswith("["):
                found: list[Any] = json.loads(line)
                return found
            said = line.strip() or said
        raise SettingError(f"against = {self.name}: expected a commit whose bench knows these settings ({said})")

    def call(self, number: int) -> tuple[float, float]:
        """Wall and CPU milliseconds of one call of a path."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{number}\n")
        self.process.stdin.flush()
        wall, cpu = self.answer()
        return wall, cpu

    def close(self) -> None:
        """End the worker."""
        self.process.kill()
        self.process.communicate()


def compare(cfg: DictConfig, wanted: Sequence[str], seconds: float) -> float | None:
    """Time this tree's paths and those of the commit `against`; the step's ratio of CPU times, for a sweeper.

    Raises:
        SettingError: outside a checkout of git, for a commit that there is not, or one whose bench is another.
    """
    name, history = str(cfg.against), cfg.history
    root = Path(torchfovea.__file__).resolve().parents[1]
    told = HydraConfig.get().overrides.task
    settings = [one for one in told if not one.lstrip("+~").startswith(_OWN)]
    with ExitStack() as stack:
        then = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torchfovea-against-")))
        commit = checkout(root, name, then)
        sides = []
        for tree, side in ((root, "this tree"), (then, name)):
            sides.append(_Side(tree, settings, side))
            stack.callback(sides[-1].close)
        rows = in_turns(sides[0], sides[1], seconds)
    require(bool(rows), "paths", list(wanted), f"paths that {name} has, too")
    folder, console = run_folder(), Console()
    write_csv(folder / "against.csv", COLUMNS, rows)
    now = _git(root, "describe", "--always", "--dirty").strip()
    line = {
        "when": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "now": now,
        "then": commit,
        "machine": platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "settings": settings,
        "paths": [row._asdict() for row in rows],
    }
    if history is not None:
        add_line(Path(history), line)
    table = Table(
        "path", "work", "CPU ms, least", "then", "ratio", "median", "then", "ratio", box=None, padding=(0, 2, 0, 0)
    )
    for row in rows:
        table.add_row(row.path, row.work, *(f"{value:.3g}" for value in row[3:9]))
    console.print(f"{now} and {name} ({commit[:10]}), call by call in turns; ratio: then over now.")
    console.print(table)
    write_result(folder, line)
    return next((row.least_ratio for row in rows if row.path == "step"), None)


def checkout(root: Path, commit: str, folder: Path) -> str:
    """Put a commit's files into a folder; the commit's own name.

    Raises:
        SettingError: outside a checkout of git, and for a commit that there is not.
    """
    try:
        named = _git(root, "rev-parse", "--verify", "--end-of-options", commit + "^{commit}").strip()
        archive = subprocess.run(
            ["git", "-C", str(root), "archive", "--format=tar", named], check=True, capture_output=True
        ).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or str(error)
        why = (said.decode() if isinstance(said, bytes) else said).strip().splitlines()[-1]
        raise SettingError(f"against = {commit}: expected a commit of the checkout {root} ({why})") from error
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return named


def in_turns(now: _Side, then: _Side, seconds: float) -> list[Compared]:
    """Call the paths that both trees have, for so many seconds each, in turns; either tree begins every second turn."""
    rows = []
    for name, work, ours, theirs in _pairs(now.paths, then.paths):
        mine: list[tuple[float, float]] = []
        other: list[tuple[float, float]] = []
        begin = time.perf_counter()
        for turn in range(_MOST):
            if turn >= _FEWEST and time.perf_counter() - begin > seconds:
                break
            calls = [(mine, now, ours), (other, then, theirs)]
            for found, side, number in calls if turn % 2 else calls[::-1]:
                found.append(side.call(number))
        (wall, cpu), (then_wall, then_cpu) = (zip(*found, strict=True) for found in (mine, other))
        least, middle = (min(cpu), min(then_cpu)), (median(cpu), median(then_cpu))
        rows.append(
            Compared(
                name, work, len(cpu), *least, least[1] / max(least[0], 1e-9), *middle, middle[1] / max(middle[0], 1e-9),
                median(wall), median(then_wall),
            )
        )  # fmt: skip
    return rows


def _pairs(ours: Sequence[tuple[str, str]], theirs: Sequence[tuple[str, str]]) -> list[tuple[str, str, int, int]]:
    """Paths of one name in their order, which both have: name, work and the numbers."""
    seen: dict[str, count[int]] = {}
    places: dict[tuple[str, int], int] = {}
    for number, (name, _) in enumerate(theirs):
        places[name, next(seen.setdefault(name, count()))] = number
    seen = {}
    keys = [(name, next(seen.setdefault(name, count()))) for name, _ in ours]
    return [(*ours[k], k, places[key]) for k, key in enumerate(keys) if key in places]


def add_line(path: Path, line: dict[str, Any]) -> None:
    """Add an object to a file of JSON lines.

    Raises:
        SettingError: where it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise SettingError(f"history = {path}: expected a file that can be written ({error.strerror})") from error


def _git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", "-C", str(root), *arguments], check=True, capture_output=True, text=True).stdout
