"""The report of a reproduction: one HTML file, claims first, pictures inside."""

from __future__ import annotations

import base64
import html
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchfovea import __version__
from torchfovea.commands.reproduce import pictures
from torchfovea.commands.reproduce.claims import rows_where
from torchfovea.commands.shared.manifest import MANIFEST
from torchfovea.files import replacing, write_csv
from torchfovea.studies.significance import bootstrap_interval

__all__ = ["decidable", "shown", "write_report"]

Row = dict[str, Any]

STYLE = """body{font:15px/1.45 system-ui,sans-serif;max-width:75em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;width:100%;font-size:14px}th,td{text-align:left;vertical-align:top;padding:.35em .6em;
border-bottom:1px solid #ddd}td.n{text-align:right;white-space:nowrap}.holds{color:#176b2c;font-weight:600}
.fails{color:#a31515;font-weight:600}.undecided{color:#7a6200;font-weight:600}small{color:#555}img{max-width:100%}
code{background:#f2f2f2;padding:0 .25em}dt{font-weight:600}
@media(max-width:50em){body{font-size:14px}table{display:block;overflow-x:auto}}"""

LEVEL = 0.05  # of the verdicts
UNITS = {
    "global_information_per_saccade": "nats", "local_information_per_saccade": "nats", "regret_per_saccade": "m",
    "target_error_m": "m", "saccades_to_target": "saccades", "regret_convergence": "saccades", "degrees_travelled": "°",
}  # fmt: skip
GLOSSARY = """<h2>Words</h2><dl>
<dt>gap<dd>of the way from the first fixation's reward to the best possible one, the share that a search has come, 0 to
1; per saccade: its mean over the saccades (Eq. 46-49)
<dt>regret<dd>by how much the mean reward so far falls short of the best possible one [m] (Eq. 50-51)
<dt>information<dd>&minus;log |&Sigma;| of what the memory believes [nats]; global: mean over all cells, local: over
those within 0.1 m of the target (Eq. 52-55). 1 nat is 1.44 bits
<dt>&alpha;, UCB, PI, EI<dd>strategies: mean plus &alpha; standard deviations, probability of improvement, expected
improvement
<dt>log-polar, uniform<dd>a foveal retina, and one whose receptive fields are all alike, with equally many of them
<dt>bias<dd>where the memory's cells lie densely
<dt>effect size<dd>mean difference over the scenes' standard deviation of it
<dt>p (Holm)<dd>probability of so large a difference by chance, corrected for the number of claims
<dt>n<dd>scenes; a claim is <i>undecided</i> where its interval and p leave both ways open
</dl>"""


def write_report(folder: Path, plain: Row, rows: list[Row], stated: list[Row], figures: Row, fig5: Row) -> None:
    """Draw the figures, tabulate the ablation, and write report.html.

    Args:
        folder: the run's.
        plain: its settings.
        rows: its episodes.
        stated: its claims with their verdicts, as in claims.json.
        figures: as in result.json.
        fig5: the curves of `torchfovea.commands.reproduce.fig5`.
    """
    sections: list[tuple[str, list[Path], str]] = []
    pictures.draw_vergences(folder / "fig5.png", fig5)
    sections.append(("Fig. 5: what a sensor knows of a plane", [folder / "fig5.png"], ""))
    sections += _fig8(folder, plain, rows) + _fig9(folder, plain, rows)
    sections += _ablation(folder, rows, plain["level"])
    sections += _photometric(rows, plain["level"])
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<title>torchfovea reproduce</title><style>{STYLE}</style>",
        "<h1>Foveal mechanisms in active stereo: the claims, measured again</h1>",
        _summary(stated, figures),
        f"<p>torchfovea {__version__}; {figures['scenes']} scenes, "
        f"{figures['episodes']} episodes of {plain['saccades']} saccades, {plain['memory']['cells']} cells, "
        f"{plain['sensor']['sample'] or plain['sensor']['receptive_fields']} receptive fields a look. "
        f"What counts was fixed before the run: scene "
        f"{plain['counts']['scene']}, reading {plain['counts']['reading']}. "
        "The scene is the unit of statistics; differences are paired over scenes; intervals are bootstrapped (BCa); "
        f"verdicts are two-sided at {1 - plain['level']:.0%} after Holm's correction over the claims of Sec. 7.2, by "
        "the larger p of a sign flip and a studentized bootstrap; a claim about the best or worst of several is one "
        f"about every one of them (intersection-union). {_what_can(stated)} reading=printed has the paper's chart, "
        "fusion, reward, prior and error budget; the gate's least width (fusion.gate_spacing), what a cell without an "
        "observation takes (fusion.fill) and which cells may be fixated (eligibility) are ours there too. "
        "In attention_world all scenes are one place, and only the noise and the memory's cells differ.</p>",
        _claims_table(stated),
    ]
    for title, drawn, text in sections:
        parts.append(f"<h2>{html.escape(title)}</h2>{text}")
        parts += [_inline(picture) for picture in drawn]
    parts += [_provenance(folder, rows, figures), GLOSSARY, "</html>"]
    with replacing(folder / "report.html") as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")


def decidable(scenes: int, claims: int) -> str:
    """What so many scenes can decide at all: of signs that all agree, p is 2^(1 − scenes), times the claims."""
    least = min(1.0, claims * 2.0 ** (1 - scenes))
    if least > 0.05:
        return f"With {scenes} scenes no claim can be decided: p is at least {least:.2g} after Holm's correction."
    return f"With {scenes} scenes the smallest p after Holm's correction is {least:.1g}."


def shown(entry: Row) -> str:
    """A claim's estimate in words: a share as a share."""
    if entry["estimate"] is None:
        return "-"
    return f"{entry['estimate']:.0%}" if entry["id"] == "fig5_uniform" else f"{entry['estimate']:.3g}"


def _inline(picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode()
    return f'<p><img alt="{html.escape(picture.stem)}" src="data:image/png;base64,{data}"></p>'


def _what_can(stated: list[Row]) -> str:
    known = [entry["n"] for entry in stated if entry["p_value"] is not None]
    return decidable(max(known), len(known)) if known else ""


def _too_small(entry: Row, stated: list[Row]) -> bool:
    """Whether so few scenes could not have decided a claim, had all of them agreed."""
    tested = sum(other["p_value"] is not None for other in stated)
    known = entry["verdict"] == "undecided" and entry["p_value"] is not None
    return known and tested * 2.0 ** (1 - entry["n"]) > LEVEL


def _summary(stated: list[Row], figures: Row) -> str:
    """The outcome in a sentence, before any table."""
    small = sum(_too_small(entry, stated) for entry in stated)
    held, failed = (
        [entry["text"].removeprefix("... ") for entry in stated if entry["verdict"] == verdict]
        for verdict in ("holds", "fails")
    )
    lines = [
        f"<p><b>Of {figures['claims']} claims {figures['claims_hold']} hold, {figures['claims_fail']} fail and "
        f"{figures['claims_undecided']} are undecided</b>"
        + (f", {small} of these because n is too small to decide them: run more scenes (episodes=)." if small else ".")
    ]
    for word, texts in (("Hold", held), ("Fail", failed)):
        if texts:
            lines.append(f"<br>{word}: {html.escape('; '.join(texts))}.")
    return "".join([*lines, "</p>"])


def _provenance(folder: Path, rows: list[Row], figures: Row) -> str:
    """What it was made with, so that it can be made again; and the arms that took part."""
    path = folder / MANIFEST
    told = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    arms = ", ".join(sorted({str(row["arm"]) for row in rows if row.get("arm")}))
    facts = {
        "command": " ".join(["torchfovea reproduce", *told.get("overrides", [])]),
        "settings": told.get("config_hash", "–"),
        "software": f"torchfovea {__version__}, PyTorch {torch.__version__}, Python {platform.python_version()}",
        "machine": f"{platform.system()} {platform.machine()}",
        "time": f"{figures['seconds']:.0f} s for the episodes of this run",
        "strategies that were run": f"{arms}; another that a definition names took no part",
    }
    cells = "".join(f"<tr><th>{name}<td><code>{html.escape(str(fact))}</code>" for name, fact in facts.items())
    return f"<h2>Provenance</h2><table>{cells}</table>"


def _number(value: Any) -> str:
    return "–" if value is None else f"{value:.3g}"


def _claims_table(stated: list[Row]) -> str:
    lines = ["<h2>Claims</h2><table><tr><th>claim<th>verdict<th>estimate, 95% CI<th>effect size<th>p (Holm)<th>n"]
    for entry in stated:
        interval = "" if entry["ci_low"] is None else f"<br>{_number(entry['ci_low'])} to {_number(entry['ci_high'])}"
        places = [f"{place}: {verdict}" for place, verdict in entry.get("elsewhere", {}).items() if verdict]
        other = f"<br><small>elsewhere: {html.escape('; '.join(places))}</small>" if places else ""
        small = "<br><small>n too small to decide</small>" if _too_small(entry, stated) else ""
        unit = "" if entry["estimate"] is None else UNITS.get(entry["metric"], "")
        note = f". {entry['note']}" if entry.get("note") else ""
        lines.append(
            f"<tr><td>{html.escape(entry['text'])} <small>(Sec. {entry['section']}, {entry['id']})</small>"
            f"<br><small>{html.escape(entry['definition'])}{html.escape(note)}</small>{other}"
            f"<td class={entry['verdict']}>{entry['verdict']}{small}<td class=n>{shown(entry)} {unit}{interval}"
            f"<td class=n>{_number(entry['effect_size'])}<td class=n>{_number(entry['p_holm'])}<td class=n>{entry['n']}"
        )
    return "\n".join([*lines, "</table>"])


def _fig8(folder: Path, plain: Row, rows: list[Row]) -> list[tuple[str, list[Path], str]]:
    sections = []
    for condition in plain["fig8"]["conditions"]:
        own = rows_where(rows, {"fig": 8, **condition})
        if not own:
            continue
        name, words = f"{condition['scene']}_{condition['reading']}", f"{condition['scene']}, {condition['reading']}"
        arms, course = folder / f"fig8a_{name}.png", folder / f"fig8b_{name}.png"
        pictures.draw_arms(arms, own, f"Fig. 8a, {words}: mean over scenes with 95% CI")
        groups = {
            f"{sensor.replace('_', '-')}, {fov}°": (
                colour, rows_where(own, {"sensor": sensor, "fov_deg": fov, "arm": "ucb_100"})
            )
            for (sensor, fov), colour in pictures.COLOURS.items()
        }  # fmt: skip
        pictures.draw_course(course, groups, f"Fig. 8b, {words}: α = 100")
        sections.append((f"Fig. 8: {words}", [arms, course], ""))
    return sections


def _fig9(folder: Path, plain: Row, rows: list[Row]) -> list[tuple[str, list[Path], str]]:
    sections = []
    for condition in plain["fig9"]["conditions"]:
        own = rows_where(rows, {"fig": 9, **condition})
        for arm in dict.fromkeys(row["arm"] for row in own):
            part = rows_where(own, {"arm": arm})
            words = f"{condition['scene']}, {condition['reading']}, α = {arm.removeprefix('ucb_')}"
            name = f"{condition['scene']}_{condition['reading']}_{arm}"
            bars, course = folder / f"fig9a_{name}.png", folder / f"fig9b_{name}.png"
            pictures.draw_biases(bars, part, f"Fig. 9a, {words}: mean over scenes with 95% CI")
            groups = {
                bias: (colour, rows_where(part, {"bias": bias}))
                for bias, colour in pictures.BIASES.items()
                if bias != "aimed"
            }
            pictures.draw_course(course, groups, f"Fig. 9b, {words}")
            sections.append((f"Fig. 9: {words}", [bars, course], ""))
    return sections


def _difference(
    rows: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], metric: str, level: float
) -> tuple[float, float, float]:
    then = {row["seed"]: row[metric] for row in base if row[metric] is not None}
    pairs = [row[metric] - then[row["seed"]] for row in rows if row[metric] is not None and row["seed"] in then]
    values = torch.tensor(pairs, dtype=torch.float64)
    found = bootstrap_interval(values, torch.Generator().manual_seed(0), level)
    return float(found.estimate), float(found.low), float(found.high)


def _ablation(folder: Path, rows: list[Row], level: float) -> list[tuple[str, list[Path], str]]:
    own = rows_where(rows, {"fig": "ablation"})
    if not own:
        return []
    base = rows_where(own, {"variant": "as it is"})
    columns = ("gap_per_saccade", "saccades_to_target", "found", "target_error_m", "local_information_per_saccade")
    lines, drawn, table = [], [], []
    for variant in dict.fromkeys(row["variant"] for row in own):
        part = rows_where(own, {"variant": variant})
        cells: list[Any] = [variant]
        for metric in columns:
            known = [row[metric] for row in part if row[metric] is not None]
            cells.append(sum(known) / len(known) if known else None)
        gain = None
        if variant != "as it is":
            gain = _difference(part, base, "gap_per_saccade", level)
            drawn.append((variant, *gain))
        table.append((*cells, *(gain or (None, None, None))))
        change = "" if gain is None else f"{gain[0]:+.3f} ({gain[1]:+.3f} to {gain[2]:+.3f})"
        lines.append(
            f"<tr><td>{html.escape(variant)}"
            + "".join(f"<td class=n>{_number(value)}" for value in cells[1:])
            + f"<td class=n>{change}"
        )
    head = "".join(f"<th>{name.replace('_', ' ')}" for name in columns)
    text = f"<table><tr><th>change{head}<th>gap, change with 95% CI{''.join(lines)}</table>"
    names = ("variant", *columns, "gap_change", "gap_change_low", "gap_change_high")
    write_csv(folder / "ablation.csv", names, table)
    picture = folder / "ablation.png"
    pictures.draw_ablation(picture, drawn)
    return [("What decides the outcome", [picture], text)]


def _photometric(rows: list[Row], level: float) -> list[tuple[str, list[Path], str]]:
    own = rows_where(rows, {"fig": "photometric"})
    if not own:
        return []
    columns = ("gap_per_saccade", "saccades_to_target", "found", "target_error_m", "regret_per_saccade")
    lines = []
    for sensor in dict.fromkeys(row["sensor"] for row in own):
        part = rows_where(own, {"sensor": sensor})
        cells = []
        for metric in columns:
            known = torch.tensor([float(row[metric]) for row in part if row[metric] is not None], dtype=torch.float64)
            if len(known) < 2:
                cells.append("–")
                continue
            found = bootstrap_interval(known, torch.Generator().manual_seed(0), level)
            cells.append(f"{float(found.estimate):.3g} ({float(found.low):.3g} to {float(found.high):.3g})")
        lines.append(f"<tr><td>{sensor}" + "".join(f"<td class=n>{cell}" for cell in cells))
    head = "".join(f"<th>{name.replace('_', ' ')}" for name in columns)
    return [("Photometric: images, matched", [], f"<table><tr><th>sensor{head}{''.join(lines)}</table>")]
