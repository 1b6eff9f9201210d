"""The tables of docs/results, from the files that runs leave: no figure of theirs is typed.

    python scripts/results.py keep search RUN_FOLDER ...   # right after the runs: what a table needs, and its origin
    python scripts/results.py                              # writes every table anew
    python scripts/results.py --check                      # says which is not what its data say

A page says where its table stands, `<!-- results: NAME -->` to `<!-- end -->`; data are docs/results/data/NAME.json.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import re
import shlex
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from torchfovea.files import write_json
from torchfovea.studies.significance import bootstrap_interval

PAGES = Path(__file__).resolve().parents[1] / "docs" / "results"
MARKED = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
LARGEST = 20_000  # bytes of a table that is kept
# what is kept of tables that have much more
COLUMNS = {
    "episodes": ("seed", "found", "saccades_to_target", "target_error_m"),
    "honesty": (
        "sensor", "cells", "looks", "nees_mean", "coverage_50", "coverage_95", "coverage_95_low", "coverage_95_high",
        "outlier_share", "median_error", "mean_error",
    ),
}  # fmt: skip


class Run(NamedTuple):
    """What is kept of a run.

    Attributes:
        command: that made it.
        commit: of the tree that ran it; a + behind it: with changes.
        machine: in words.
        result: its result.json, or the list in its claims.json.
        tables: its small CSV files by their stems, a mapping a row (COLUMNS of it).
    """

    command: str
    commit: str
    machine: str
    result: Any
    tables: dict[str, list[dict[str, str]]]


def keep(name: str, folders: Sequence[Path], commit: str | None = None, pages: Path = PAGES) -> None:
    """Keep what runs left, in place of what was kept under this name.

    Args:
        name: of the data.
        folders: of the runs.
        commit: of the tree that made them; None: the one here.
        pages: where docs/results is.
    """
    runs = [_kept(folder, commit or _commit()) for folder in folders]
    # a study's result repeats its table
    runs = [run._replace(result={}) if name in run.tables else run for run in runs]
    write_json(pages / "data" / f"{name}.json", {"runs": [run._asdict() for run in runs]})


def load(name: str, pages: Path = PAGES) -> list[Run]:
    """What is kept under a name."""
    text = (pages / "data" / f"{name}.json").read_text(encoding="utf-8")
    return [Run(**run) for run in json.loads(text)["runs"]]


def renewed(text: str, pages: Path = PAGES) -> str:
    """A page whose tables are those of the data."""

    def table(found: re.Match[str]) -> str:
        runs = load(found[2], pages)
        return f"{found[1]}\n{TABLES[found[2]](runs)}\n\n{origin(runs)}\n\n{found[3]}"

    return MARKED.sub(table, text)


def _kept(folder: Path, commit: str) -> Run:
    hydra = folder / ".hydra"
    command = yaml.safe_load((hydra / "hydra.yaml").read_text())["hydra"]["job"]["config_name"]
    words = yaml.safe_load((hydra / "overrides.yaml").read_text())
    claims = folder / "claims.json"
    result = json.loads((claims if claims.is_file() else folder / "result.json").read_text())
    tables = {}
    for path in sorted(folder.glob("*.csv")):
        if path.stat().st_size <= LARGEST:
            with path.open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
            names = COLUMNS.get(path.stem)
            tables[path.stem] = [{name: row[name] for name in names or row if name in row} for row in rows]
    words = [word for word in words if not word.startswith(("picture=", "workers="))]
    return Run(shlex.join(["torchfovea", command, *words]), commit, _machine(), result, tables)


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=True, cwd=PAGES).stdout.strip()

    changed = git("status", "--porcelain", "--", "../../torchfovea", "../../conf")
    return git("rev-parse", "--short=7", "HEAD") + "+" * bool(changed)


def _machine() -> str:
    python = ".".join(platform.python_version_tuple()[:2])
    return f"{os.cpu_count()} cores, {platform.machine()}, Python {python}, PyTorch {torch.__version__.split('+')[0]}"


def origin(runs: Sequence[Run]) -> str:
    """Where a table comes from, in a paragraph."""
    commits, machines = (
        dict.fromkeys(parts) for parts in ([run.commit for run in runs], [run.machine for run in runs])
    )
    said = "; ".join(f"`{run.command}`" for run in runs)
    return f"*{said}: at {', '.join(commits)} on {' and '.join(machines)}.*"


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def settings(run: Run) -> dict[str, str]:
    """The settings of a run's command."""
    return dict(word.split("=", 1) for word in shlex.split(run.command) if "=" in word)


def percent(value: Any, digits: int = 1) -> str:
    """A share."""
    return f"{100 * float(value):.{digits}f}%"


def mean_with_interval(values: Sequence[float], digits: int = 1) -> str:
    """A mean with its 95% interval by bootstrap; without one if all agree."""
    mean = f"{statistics.fmean(values):.{digits + 1}f}"
    if min(values) == max(values):
        return mean
    drawn = torch.tensor(values, dtype=torch.float64)
    found = bootstrap_interval(drawn, torch.Generator().manual_seed(0))
    return f"{mean} ({float(found.low):.{digits}f}–{float(found.high):.{digits}f})"


def pair(runs: Sequence[Run]) -> str:
    """A real pair, by matcher and by what the retinas span; in brackets by area."""
    rows = []
    for run in runs:
        given, found = settings(run), run.result

        def both(name: str, found: Mapping[str, Any] = found) -> str:
            return f"{percent(found[name])} ({percent(found[f'{name}_by_area'])})"

        errors = [f"{1e3 * found[name]:.1f} mm" for name in ("median_error_m", "common_median_error_m")]
        rows.append(
            [
                given.get("span", "whole"),
                {"sgbm": "SGBM"}.get(given.get("matcher", "sweep"), "sweep"),
                f"{found['points']:,}",
                both("valid_fraction"),
                errors[0],
                f"{errors[1]}, {1e3 * found['plain_common_median_error_m']:.1f} mm",
                both("coverage_50"),
                both("coverage_95"),
            ]
        )
    columns = ("`span`", "matcher", "points", "fields with a point (by area)", "median depth error")
    beside = "where plain SGBM has one too: ours, plain SGBM"
    return markdown([*columns, beside, "inside 50% (by area)", "inside 95% (by area)"], rows)


def search(runs: Sequence[Run]) -> str:
    """Searches, each of several episodes."""
    rows = []
    for run in runs:
        given, episodes = settings(run), run.tables["episodes"]
        found = sum(int(row["found"]) for row in episodes)
        geometric = given.get("fidelity") == "geometric"
        matcher = "geometric" if geometric else {"sgbm": "SGBM"}.get(given.get("matcher", "sgbm"), "sweep")
        layout = given.get("sensor", "log_polar").replace("_", "-")
        policy = f", {given['acquisition']}" if "acquisition" in given else ""
        errors = [float(row["target_error_m"]) for row in episodes if row["target_error_m"]]
        rows.append(
            [
                f"{float(given.get('sensor.fov_deg', 135)):.0f}°, {layout}, {matcher}{policy}",
                f"{found} of {len(episodes)}",
                mean_with_interval([float(row["saccades_to_target"]) for row in episodes]),
                percent(run.result["phantom_share"]),
                f"{100 * statistics.median(errors):.1f} cm",
            ]
        )
    named = ("view, retina, matcher", "found", "saccades, mean (95%)", "phantoms", "target error, median")
    return markdown(named, rows)


def rows_of(stem: str, names: Mapping[str, str], form: Callable[[str, str], str]) -> Callable[[Sequence[Run]], str]:
    """A table that shows columns of the runs' own one.

    Args:
        stem: of the CSV file.
        names: from its columns to ours.
        form: of a column and its cell.
    """

    def table(runs: Sequence[Run]) -> str:
        rows = [[form(name, row[name]) for name in names] for run in runs for row in run.tables[stem]]
        return markdown(list(names.values()), rows)

    return table


def honesty(runs: Sequence[Run]) -> str:
    """How far a memory's uncertainty can be believed, look after look; intervals over scenes."""
    rows = []
    # by sensor as they were looked through, then by size; looks stay in order
    given = sorted((row for run in runs for row in run.tables["honesty"]), key=lambda row: int(row["cells"]))
    sensors = list(dict.fromkeys(row["sensor"] for row in given))
    for row in sorted(given, key=lambda row: sensors.index(row["sensor"])):
        number = {name: float(cell) for name, cell in row.items() if name != "sensor" and cell}
        inside = "{coverage_95:.3f} ({coverage_95_low:.3f}–{coverage_95_high:.3f})".format(**number)
        shares = [percent(number[name]) for name in ("outlier_share", "median_error", "mean_error")]
        nees, half = (f"{number[name]:.2f}" for name in ("nees_mean", "coverage_50"))
        rows.append([row["sensor"], f"{number['cells']:,.0f}", row["looks"], nees, half, inside, *shares])
    columns = ("sensor", "cells", "looks", "NEES", "in 50%", "in 95%", "beyond 5σ", "median error", "mean error")
    return markdown(columns, rows)


def claims(runs: Sequence[Run]) -> str:
    """The paper's claims with their verdicts."""
    rows = []
    for claim in (claim for run in runs for claim in run.result):
        known = claim["estimate"] is not None
        measured = "{estimate:.3g} ({ci_low:.3g} to {ci_high:.3g})".format(**claim) if known else "–"
        rows.append([claim["section"], claim["text"], claim["verdict"], measured, str(claim["n"])])
    return markdown(("Sec.", "the paper's claim", "verdict", "estimate (95%)", "scenes"), rows)


def ablation(runs: Sequence[Run]) -> str:
    """What each change of a search does to its gap, the greatest loss first."""
    rows = []
    given = (row for run in runs for row in run.tables["ablation"])
    for row in sorted(given, key=lambda row: float(row["gap_per_saccade"])):
        change = "–"
        if row["gap_change"]:
            ends = (float(row[f"gap_change{end}"]) for end in ("", "_low", "_high"))
            change = "{:+.3f} ({:+.3f} to {:+.3f})".format(*ends)
        gap, saccades = f"{float(row['gap_per_saccade']):.3f}", f"{float(row['saccades_to_target']):.1f}"
        rows.append([row["variant"], gap, change, percent(row["found"], 0), saccades])
    return markdown(("change", "gap per saccade", "its change (95%)", "found", "saccades"), rows)


def short(name: str, cell: str) -> str:
    """A cell as it is shown: a share in per cent, another number to three digits, words without underlines."""
    try:
        value = float(cell)
    except ValueError:
        return cell.replace("log_polar", "log-polar").replace("_", " ") or "–"
    if name.endswith("share"):
        return percent(value)
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:#.3g}"


FUSION = {
    "sensor": "sensor", "saccades": "looks", "fusion": "fusion", "range_ratio_median": "estimated/true range",
    "nees_mean": "range NEES", "z2_median": "median z²", "outlier_share": "outliers",
}  # fmt: skip
TABLES: dict[str, Callable[[Sequence[Run]], str]] = {
    "pair": pair,
    "search": search,
    "others": search,
    "widest": search,
    "honesty": honesty,
    "fusion": rows_of("fusion", FUSION, short),
    "claims": claims,
    "ablation": ablation,
}


def main(words: Sequence[str]) -> int:
    """Keep runs, or renew or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    does = parser.add_subparsers(dest="does")
    keeps = does.add_parser("keep", help="keep what runs left")
    keeps.add_argument("name", choices=sorted(TABLES))
    keeps.add_argument("folders", nargs="+", type=Path)
    keeps.add_argument("--commit", help="of the tree that made them; by default the one here")
    given = parser.parse_args(words)
    if given.does == "keep":
        keep(given.name, given.folders, given.commit)
    stale = 0
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := renewed(text)) != text:
            stale += 1
            print(f"{page.name}: {'not what its data say' if given.check else 'renewed'}")
            if not given.check:
                page.write_text(new, encoding="utf-8")
    return stale if given.check else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
