"""The table of docs/sense.md: pairs whose right image is moved up or down, and whether the covariances stay honest.

    python scripts/rows_apart.py FOLDER...

Each FOLDER has left.png, right.png, calib.txt and the true disparity, as Middlebury's benchmark.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.stats import t as student

from torchfovea.commands.sense.checks import examine
from torchfovea.commands.sense.points import sense
from torchfovea.commands.sense.report import match_figures
from torchfovea.commands.shared.budgets import load_budget
from torchfovea.commands.shared.pairs import Pair, load_folder
from torchfovea.sensing.layout import LogPolar
from torchfovea.stereo.health import misaligned
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep

RETINA = LogPolar(20000)


def coverage(pair: Pair, shift_px: float, params: Sweep | SGBM, widened: bool) -> float:
    """Share of the truths inside the 95% interval, the right image moved down by so much."""
    image = np.ascontiguousarray(pair.right.movedim(0, -1).numpy())
    size, move = image.shape[1::-1], np.array([[1, 0, 0], [0, 1, shift_px]], np.float32)
    moved = cv2.warpAffine(image, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).clip(0, 1)
    pair = pair._replace(right=torch.from_numpy(moved).movedim(-1, 0).contiguous())
    views = pair.views(None).whole()
    budget = load_budget(f"log_polar_{type(params).__name__.lower()}", views.source_px)
    budget = misaligned(budget, examine(pair, views, "warn").rows_px * widened)
    matches, _ = Matcher(params)(views, RETINA, budget)
    sensed = sense(views, RETINA, matches, None, True)
    told = match_figures(pair, views, RETINA, matches.left_px, sensed.observed, sensed.points, sensed.chosen)
    return told["coverage_95"]


def main(folders: list[str]) -> None:
    """Print the table's rows: mean over the pairs with its 95% interval, and a pair's each."""
    pairs = {name: load_folder(Path(name), "pair") for name in folders}
    for params in (Sweep(), SGBM()):
        for shifts, widened in (((0.0,), False), *(((s, -s), w) for s in (0.5, 1.0, 1.5) for w in (False, True))):
            each = [np.mean([coverage(pair, s, params, widened) for s in shifts]) for pair in pairs.values()]
            half = student.ppf(0.975, len(each) - 1) * np.std(each, ddof=1) / len(each) ** 0.5
            name = f"{type(params).__name__}, {shifts[0]:g} px, widened {widened}"
            print(f"{name}: {np.mean(each):.3f} ± {half:.3f}; " + ", ".join(f"{c:.3f}" for c in each), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
