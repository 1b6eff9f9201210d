"""`torchfovea reproduce`: Figs. 5, 8 and 9 and the claims of Sec. 7, measured again, with intervals and verdicts."""

from __future__ import annotations

import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from torchfovea.commands.reproduce.cells import METRICS, CellTask, run_task, task_name
from torchfovea.commands.reproduce.checks import checked
from torchfovea.commands.reproduce.claims import Claim, Verdict, judge_claims, rows_where
from torchfovea.commands.reproduce.fig5 import judge_fig5
from torchfovea.commands.reproduce.report import decidable, shown, write_report
from torchfovea.commands.shared.composed import config_folders
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.manifest import complete, finished, read_kept, write_kept
from torchfovea.commands.shared.mistakes import describe
from torchfovea.commands.shared.parallel import spread
from torchfovea.commands.shared.screen import progress_bar
from torchfovea.files import write_csv, write_json
from torchfovea.setting import SettingError, require

__all__ = ["run"]

LABELS = ("fig", "scene", "reading", "sensor", "fov_deg", "bias", "variant", "arm", "seed")
_COLUMNS = (*LABELS, *METRICS)

Row = dict[str, Any]


def run(cfg: DictConfig) -> float:
    """Run or resume a reproduction; the number of claims that hold is what a sweeper sees."""
    plain, claims, tasks, workers = checked(cfg)
    folder = run_folder()
    done = finished(cfg, folder, "claims_hold")
    if done is not None:
        return done
    start = time.perf_counter()
    rows = _episodes(tasks, folder / "cells", *workers)
    seconds = time.perf_counter() - start
    write_csv(folder / "episodes.csv", _COLUMNS, [[row[c] for c in _COLUMNS] for row in rows])
    counting = rows_where(rows, plain["counts"])
    verdicts = judge_claims(claims, counting, plain["level"], plain["seed"])
    stated = [_stated(c, v) for c, v in zip(claims, verdicts, strict=True)]
    planes, fig5 = judge_fig5(plain["fig5"], plain["sensor"]["receptive_fields"])
    stated += planes
    elsewhere = _elsewhere(claims, rows, plain)
    for entry in stated:
        entry["elsewhere"] = {place: found.get(entry["id"]) for place, found in elsewhere.items()}
    write_json(folder / "claims.json", stated)
    figures: Row = {"claims": len(stated)}
    for name, verdict in (("hold", "holds"), ("fail", "fails"), ("undecided", "undecided")):
        figures[f"claims_{name}"] = sum(entry["verdict"] == verdict for entry in stated)
    figures |= {"episodes": len(rows), "seconds": seconds, "scenes": plain["episodes"]}
    write_report(folder, plain, rows, stated, figures, fig5)
    complete(folder, figures)
    _print(stated)
    return float(figures["claims_hold"])


def _stated(claim: Claim, verdict: Verdict) -> Row:
    head = {key: getattr(claim, key) for key in ("id", "section", "text", "definition", "note")}
    return {**head, **asdict(verdict), "metric": claim.metric}


def _elsewhere(claims: list[Claim], rows: list[Row], plain: Row) -> dict[str, dict[str, str]]:
    """The verdicts under the other readings and scenes, each a family of its own; they do not count."""
    conditions = {(row["reading"], row["scene"]) for row in rows if row["fig"] in (8, 9)}
    conditions -= {(plain["counts"]["reading"], plain["counts"]["scene"])}
    found = {}
    for reading, scene in sorted(conditions):
        verdicts = judge_claims(
            claims, rows_where(rows, {"reading": reading, "scene": scene}), plain["level"], plain["seed"]
        )
        found[f"{reading}, {scene}"] = {
            claim.id: verdict.verdict for claim, verdict in zip(claims, verdicts, strict=True) if verdict.n >= 2
        }
    return found


def _episodes(tasks: list[CellTask], folder: Path, workers: int, backend: str) -> list[Row]:
    """All rows: of the tasks already complete in the folder, and of the others, run now.

    Raises:
        SettingError: tasks that failed, after the others are done; a file that does not hold a task's rows.
    """
    rows: list[Row] = []
    missing = []
    for task in tasks:
        path = folder / f"{task_name(task)}.json"
        if path.exists():
            rows += _read(path, task)
        else:
            missing.append(task)
    failed = []
    with progress_bar() as progress:
        bar = progress.add_task("reproduce", total=len(missing))
        for k, outcome in spread(partial(run_task, folders=config_folders()), missing, workers, backend):
            task = missing[k]
            name = task_name(task)
            if isinstance(outcome, Exception):
                line = describe(outcome, task.overrides) or f"{type(outcome).__name__}: {outcome}"
                failed.append(name)
                progress.console.print(f"reproduce: {name}: {line}", highlight=False, markup=False, soft_wrap=True)
            else:
                write_kept(folder / f"{name}.json", outcome)
                rows += outcome
            progress.advance(bar)
    if failed:
        raise SettingError(
            f"cells = {len(failed)} of {len(tasks)} failed ({', '.join(failed[:3])}{', ...' * (len(failed) > 3)}): "
            f"expected all; the others are kept in {folder}, to be resumed with hydra.run.dir={folder.parent}"
        )
    order = {name: k for k, name in enumerate(LABELS)}
    return sorted(rows, key=lambda row: [str(row[name]) for name in order])


def _read(path: Path, task: CellTask) -> list[Row]:
    rows: list[Row] = read_kept(path)
    whole = len(rows) == len(task.seeds) * max(1, len(task.alphas)) and all("gap_final" in row for row in rows)
    require(whole, str(path), f"{len(rows)} rows", "those of its episodes; remove it to run them again")
    return rows


def _print(stated: list[Row]) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("claim", "verdict", "estimate", "95% CI", "n"):
        table.add_column(column)
    for entry in stated:
        low, high = entry["ci_low"], entry["ci_high"]
        estimate, interval = shown(entry), "-" if low is None else f"{low:.3g} to {high:.3g}"
        table.add_row(entry["id"], entry["verdict"], estimate, interval, str(entry["n"]))
    Console().print(table)
    known = [entry["n"] for entry in stated if entry["p_value"] is not None]
    if known:
        Console().print(decidable(max(known), len(known)), soft_wrap=True)
