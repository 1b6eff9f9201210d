"""The leaderboard: one HTML page and one of Markdown, drawn from records alone."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchfovea.commands.benchmark.protocol import LEADING, TRACKS
from torchfovea.files import replacing
from torchfovea.setting import SettingError, require
from torchfovea.studies.significance import bootstrap_interval

__all__ = ["leaderboard", "read_records"]

STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:80em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;width:100%;font-size:14px}th,td{text-align:left;padding:.3em .6em;border-bottom:1px solid
#ddd}td.n,th.n{text-align:right;white-space:nowrap}td.first{font-weight:600}small{color:#555}.bad{color:#a31515}"""

HEAD = f"<!doctype html><meta charset=utf-8><title>torchfovea benchmark</title><style>{STYLE}</style>"

Record = dict[str, Any]


def read_records(paths: Sequence[Path]) -> list[Record]:
    """Records from files, or from the folders `records` of runs.

    Raises:
        SettingError: for no records, files that are none, and two that say different things of one entry.
    """
    files: list[Path] = []
    for path in paths:
        inside = path / "records" if (path / "records").is_dir() else path
        files += sorted(inside.glob("*.json")) if inside.is_dir() else [inside]
    found: dict[tuple[str, ...], Record] = {}
    for file in files:
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            key = record["track"], record["profile"], record["split"], record["protocol"], record["entry"]["name"]
            record["families"], record["errors"], record["times"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SettingError(f"report = {file}: expected a record of torchfovea benchmark ({error})") from None
        same = key not in found or found[key]["families"] == record["families"]
        require(same, "report", file, f"one record of {key[-1]}, or records that agree")
        found[key] = record
    require(len(found) > 0, "report", ", ".join(map(str, paths)), "records, or folders of runs with some")
    return list(found.values())


def leaderboard(folder: Path, records: list[Record]) -> None:
    """Write leaderboard.md and leaderboard.html: for each track and family a table, best first.

    Only records of one protocol, profile, split and family stand in one table; intervals are over scenes (BCa).
    """
    text, page = ["# torchfovea benchmark", ""], [HEAD]
    groups = sorted({(r["protocol"], r["profile"], r["split"]) for r in records})
    for protocol, profile, split in groups:
        group = [r for r in records if (r["protocol"], r["profile"], r["split"]) == (protocol, profile, split)]
        for track in TRACKS:
            own = [record for record in group if record["track"] == track]
            for family, mark in dict.fromkeys((f, v["hash"]) for r in own for f, v in r["families"].items()):
                title = f"{track}, {family}"
                scenes = max(r["families"].get(family, {"scenes": 0})["scenes"] for r in own)
                note = f"protocol {protocol}, profile {profile}, {split}, {scenes} scenes, family {mark}"
                header, lines = _table(own, track, family, mark)
                text += [f"## {title}", "", note, "", _row(header), _row(["---"] * len(header))]
                text += [*(_row(line) for line in lines), ""]
                page += [f"<h2>{html.escape(title)}</h2><p><small>{html.escape(note)}</small></p>"]
                page += [_html(header, lines)]
    failed = [f"{r['track']}, {r['entry']['name']}, in {f}: {e}" for r in records for f, e in r["errors"].items()]
    if failed:
        text += ["## What failed", "", *(f"- {line}" for line in failed)]
        items = "".join(f"<li>{html.escape(line)}</li>" for line in failed)
        page.append(f"<h2>What failed</h2><ul class=bad>{items}</ul>")
    for name, parts in (("leaderboard.md", text), ("leaderboard.html", page)):
        with replacing(folder / name) as temporary:
            temporary.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")


def _table(records: list[Record], track: str, family: str, mark: str) -> tuple[list[str], list[list[str]]]:
    """Header and lines, best first by the first figure; those that failed last."""
    names = [name.removeprefix("-") for name in LEADING[track]]
    lines = []
    for record in records:
        part = record["families"].get(family)
        if part is None or part["hash"] != mark:
            continue
        rows = part["rows"]
        keys = [_last_mark(name, rows) for name in names]
        cells = [_cell([row.get(key) for row in rows]) for key in keys]
        first = cells[0][0]
        worst = first is None
        order = 0.0 if first is None else first if LEADING[track][0].startswith("-") else -first
        spent = record["times"].get(family, {}).get("compute_seconds")
        told = [text for _, text in cells] if rows else ["failed"] + ["–"] * (len(cells) - 1)
        shown = "–" if spent is None else f"{spent:.3g}"
        lines.append(((worst, order, record["entry"]["name"]), [record["entry"]["name"], *told, shown]))
    return ["entry", *names, "s a look"], [line for _, line in sorted(lines, key=lambda item: item[0])]


def _last_mark(name: str, rows: list[Record]) -> str:
    """A figure by its name; of one that is told after several looks, that after most."""
    told = [key.rpartition(".") for key in (rows[0] if rows else {})]
    marks = [int(mark) for own, _, mark in told if own == name and mark.isdigit()]
    return f"{name}.{max(marks)}" if marks else name


def _cell(values: list[Any]) -> tuple[float | None, str]:
    known = [float(value) for value in values if value is not None]
    if not known:
        return None, "–"
    x = torch.tensor(known, dtype=torch.float64)
    mean = float(x.mean())
    if len(known) < 2:
        return mean, f"{mean:.3g}"
    interval = bootstrap_interval(x, torch.Generator().manual_seed(0), resamples=2000)
    return mean, f"{mean:.3g} ({float(interval.low):.3g} to {float(interval.high):.3g})"


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _html(header: list[str], lines: list[list[str]]) -> str:
    head = "".join(f"<th{' class=n' if k else ''}>{html.escape(name)}" for k, name in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td class={'n' if k else 'first'}>{html.escape(cell)}" for k, cell in enumerate(line))
        for line in lines
    )
    return f"<table><tr>{head}{body}</table>"
