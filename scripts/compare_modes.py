"""How true and how fast SGBM is by its modes, each with the budget that comes along: `python scripts/compare_modes.py`.

Two looks at each of six fresh `cans` rooms with image noise, at 60, 90 and 135 degrees, and real pairs with true
disparity: `python scripts/compare_modes.py motorcycle FOLDER ...`. `hh/3` is `hh` at half the size for fields
from three pixels on (`matcher.half_from_px=3`). Milliseconds are OpenCV's CPU time for a look or pair.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from torchfovea.allocation import keep_memory
from torchfovea.commands.calibrate.simulated import SceneTask, looks_at
from torchfovea.commands.calibrate.truths import Truths, look_at_pair
from torchfovea.commands.shared.budgets import load_budget
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.pairs import named_pair
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.stereo import matching
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import MODES, SGBM, disparity_sgbm
from torchfovea.studies.calibration import concatenate, sigma_of

RETINAS: dict[str, Retina] = {"log_polar": LogPolar(), "uniform": Uniform()}
WAYS: dict[str, tuple[str, float | None]] = {**{mode: (mode, None) for mode in MODES}, "hh/3": ("hh", 3.0)}
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


class Clock:
    """OpenCV's matcher, and the CPU seconds that it took."""

    spent = 0.0

    def __call__(self, *given: Any) -> Any:
        """As `disparity_sgbm`."""
        start = time.process_time()
        found = disparity_sgbm(*given)
        self.spent += time.process_time() - start
        return found


def main(pairs: list[str]) -> None:
    """Print a row for every retina, mode, and field of view or pair."""
    print("retina mode place", *COLUMNS, "ms")
    clock = matching.disparity_sgbm = Clock()

    def tell(*where: str, looks: list[Truths], budget: Budget) -> None:
        print(
            *where,
            *(f"{value:.4f}" for value in row(looks, budget)),
            f"{1e3 * clock.spent / len(looks):.0f}",
            flush=True,
        )
        clock.spent = 0.0

    for layout, retina in RETINAS.items():
        rendered, real = (load_budget(f"{layout}_sgbm{suffix}") for suffix in ("_rendered", ""))
        for way, (mode, half_from_px) in WAYS.items():
            cfg = OmegaConf.merge(config(layout), {"matcher": {"mode": mode, "half_from_px": half_from_px}})
            assert isinstance(cfg, DictConfig)
            for fov in (60.0, 90.0, 135.0):
                scenes = [3000 + k for k in range(6) if k % 3 == (60.0, 90.0, 135.0).index(fov)]
                looks = [look for seed in scenes for look in looks_at(SceneTask(cfg, rendered, seed, fov, 2))]
                tell(layout, way, f"{fov:g}", looks=looks, budget=rendered)
            for name in pairs:
                matcher = Matcher(SGBM(mode=mode, half_from_px=half_from_px))
                look = look_at_pair(named_pair(name, "pairs"), retina, None, real, matcher)
                tell(layout, way, Path(name).name, looks=[look], budget=real)


if __name__ == "__main__":
    torch.set_num_threads(1)
    keep_memory()
    main(sys.argv[1:])
