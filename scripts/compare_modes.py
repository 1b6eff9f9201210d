"""How true and how fast SGBM is by its modes, each with the budget that comes along: `python scripts/compare_modes.py`.

Two looks at each of six fresh `cans` rooms with image noise, at 60, 90 and 135 degrees, and real pairs with true
disparity: `python scripts/compare_modes.py motorcycle FOLDER ...`. Milliseconds are of a pair, matched and judged.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.calibrate.simulated import SceneTask, looks_at
from torchfovea.commands.calibrate.truths import Truths, look_at_pair
from torchfovea.commands.shared.budgets import load_budget
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.pairs import named_pair
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import MODES, SGBM
from torchfovea.studies.calibration import concatenate, sigma_of

RETINAS: dict[str, Retina] = {"log_polar": LogPolar(), "uniform": Uniform()}
COLUMNS = ("valid", "hidden", "median_px", "above_1_px", "c95", "c95_area")


def row(looks: list[Truths], budget: Budget) -> list[float]:
    """COLUMNS of some looks together."""
    data = concatenate([look.data for look in looks])
    error_px, area = data.error.abs() / data.right_gain / data.pixel_px, data.area()
    inside = (data.error.abs() < 1.96 * sigma_of(data, budget)).to(area)
    valid, hidden = (
        torch.tensor([share[0] for share in shares]).nanmean()
        for shares in ([look.valid_share for look in looks], [look.hidden_valid_share for look in looks])
    )
    by_area = (inside * area).sum() / area.sum()
    values = valid, hidden, error_px.median(), (error_px > 1).to(area).mean(), inside.mean(), by_area
    return [float(value) for value in values]


def config(layout: str) -> DictConfig:
    """What `torchfovea calibrate` would look at rooms with."""
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("calibrate", [f"sensor={layout}"])


def main(pairs: list[str]) -> None:
    """Print a row for every retina, mode, and field of view or pair."""
    print("retina mode place", *COLUMNS, "ms")
    for layout, retina in RETINAS.items():
        cfg = config(layout)
        rendered, real = (load_budget(f"{layout}_sgbm{suffix}") for suffix in ("_rendered", ""))
        for mode in MODES:
            cfg = OmegaConf.merge(cfg, {"matcher": {"mode": mode}})
            assert isinstance(cfg, DictConfig)
            for fov in (60.0, 90.0, 135.0):
                scenes = [3000 + k for k in range(6) if k % 3 == (60.0, 90.0, 135.0).index(fov)]
                looks = [look for seed in scenes for look in looks_at(SceneTask(cfg, rendered, seed, fov, 2))]
                print(layout, mode, f"{fov:g}", *(f"{value:.4f}" for value in row(looks, rendered)), flush=True)
            for name in pairs:
                pair, matcher = named_pair(name, "pairs"), Matcher(SGBM(mode=mode))
                start = time.process_time()
                look = look_at_pair(pair, retina, None, real, matcher)
                spent = f"{1e3 * (time.process_time() - start):.0f}"
                values = row([look], real)
                print(layout, mode, Path(name).name, *(f"{value:.4f}" for value in values), spent, flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(sys.argv[1:])
