"""Do biases that `torchfovea tune` found carry over to the full simulator? `python scripts/transfer.py RUN OUT`.

Plays tuned, fitted, remembered, hand and the best of Table 1 on the same scenes, each with the α that the run has
chosen for it, by `torchfovea search`; whatever follows OUT is passed on (memory.cells=20000, head=human, ...). What is
done already in the folder OUT is not played again; with --only NAME a call plays that one alone.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from pathlib import Path

import torch

from torchfovea.cli import main
from torchfovea.setting import require
from torchfovea.studies.significance import bootstrap_interval
from torchfovea.tuning.baselines import TABLE_1

OURS = ("tuned", "fitted", "remembered", "hand")


def chosen(run: Path, name: str) -> list[str]:
    """α and field of view, as the note in a bias's file has them."""
    note = (run / "memory" / f"{name}.yaml").read_text(encoding="utf-8").splitlines()[0]
    found = re.findall(r"(?:acquisition(?:\.\w+)?|sensor\.fov_deg)=\S+", note)
    require(len(found) >= 2, f"{name}.yaml", note, "a first line that names acquisition.alpha and sensor.fov_deg")
    return found


def play(run: Path, out: Path, name: str, scene: str, settings: list[str]) -> tuple[torch.Tensor, torch.Tensor]:
    """Found and gap of each scene."""
    alike = ["fidelity=geometric", "profile=reduced", "episodes=40", "saccades=10", "batch=8", "picture=false"]
    own = chosen(run, name) if name in OURS else [chosen(run, "hand")[-1], "acquisition.alpha=1"]
    where = [f"--config-dir={run}", f"memory={name}", f"scene={scene}", f"hydra.run.dir={out / name}"]
    if main(["search", *where, *alike, *own, *settings]) != 0:
        raise SystemExit(1)
    with (out / name / "episodes.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(torch.tensor([float(row[key]) for row in rows]) for key in ("found", "gap_per_saccade"))


def told(values: torch.Tensor) -> str:
    """Mean and 95% interval."""
    mean, low, high = (float(v) for v in bootstrap_interval(values, torch.Generator().manual_seed(0)))
    return f"{mean:.3f} ({low:.3f} to {high:.3f})"


def compare(run: Path, out: Path, settings: list[str], only: str | None) -> None:
    """Print a line for each policy; differences are paired over scenes."""
    scores = json.loads((run / "result.json").read_text(encoding="utf-8"))
    best = max(TABLE_1, key=lambda name: scores[f"heldout.{name}.gap_per_saccade"])
    scene = sorted(path.stem for path in (run / "scene").glob("*.yaml"))[0]
    names = [only] if only else [*OURS, best]
    found = {name: play(run, out, name, scene, settings) for name in names}
    print("policy, found, gap per saccade (95%), tuned minus it (95%)")
    for name, (hit, gap) in found.items():
        behind = "-" if only or name == "tuned" else told(found["tuned"][1] - gap)
        print(f"{name}, {float(hit.mean()):.2f}, {told(gap)}, {behind}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run of torchfovea tune")
    parser.add_argument("out", type=Path, help="folder for the episodes")
    parser.add_argument("--only", help="one of " + ", ".join((*OURS, *TABLE_1)))
    parser.add_argument("settings", nargs="*", help="of torchfovea search")
    given = parser.parse_args()
    compare(given.run.resolve(), given.out.resolve(), given.settings, given.only)
