"""`torchfovea collect`: the results of a sweep, or of any runs below a folder, in one table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.manifest import MANIFEST, read_result, unchanged
from torchfovea.commands.shared.screen import in_words, say, wide_screen
from torchfovea.files import write_csv, write_result
from torchfovea.setting import SettingError, require

__all__ = ["run"]

FIGURES = 6  # shown on the screen


def run(cfg: DictConfig) -> float:
    """Write collect.csv: a row for each run, its overrides and figures; the number of rows is what a sweeper sees."""
    source = Path(str(cfg.dir)).expanduser()
    require(bool(str(cfg.dir)) and source.is_dir(), "dir", source, "a folder of runs")
    rows, unfinished, corrupt = [], [], []
    for folder in sorted(path.parent for path in source.rglob(".hydra")):
        name = str(folder.relative_to(source))
        if not (folder / "result.json").exists():
            unfinished.append(name)
            continue
        try:
            rows.append({"run": name, **_overrides(folder), **_figures(folder)})
        except (SettingError, OSError) as error:
            corrupt.append(name)
            say(f"collect: {name}: {error}")
    for name in unfinished:
        say(f"collect: {name}: no result.json (unfinished or failed); start the sweep again to run it")
    require(bool(rows), "dir", source, "a folder with at least one complete run")
    columns = list(dict.fromkeys(key for row in rows for key in row))
    folder = run_folder()
    _show(columns, rows)
    write_csv(folder / "collect.csv", columns, [[row.get(key) for key in columns] for row in rows])
    write_result(folder, {"rows": len(rows), "unfinished": len(unfinished), "corrupt": len(corrupt)})
    return float(len(rows))


def _show(columns: list[str], rows: list[dict[str, Any]]) -> None:
    """The table's settings and first figures; the file has them all."""
    words = [c for c in columns if any(isinstance(row.get(c), str) for row in rows)]
    figures = [c for c in columns if c not in words][:FIGURES]
    table = Table(*words, *figures, box=None, padding=(0, 2, 0, 0))
    for row in rows:
        cells = (row.get(c) for c in (*words, *figures))
        table.add_row(*map(in_words, cells))
    wide_screen().print(table, markup=False)
    print(f"collect.csv: {len(rows)} runs, {len(columns)} columns")


def _overrides(folder: Path) -> dict[str, str]:
    """The settings that the run was made with; Hydra's own record would tell those of the last attempt."""
    manifest = folder / MANIFEST
    if not manifest.exists():
        given: Any = OmegaConf.load(folder / ".hydra" / "overrides.yaml")
    else:
        given = read_result(manifest).get("overrides", [])
    pairs = (str(override).lstrip("+~").partition("=") for override in given)
    return {key: value for key, _, value in pairs}


def _figures(folder: Path) -> dict[str, Any]:
    """The run's figures that are single numbers or words."""
    result = read_result(folder / "result.json")
    if (folder / MANIFEST).exists():
        unchanged(folder)
    return {key: value for key, value in result.items() if not isinstance(value, dict | list)}
