"""The table of docs/matchers.md: what the sweep gains if the memory, or the truth itself, tells it where to look.

    python scripts/volume_of_interest.py EPISODES SACCADES OVERRIDE...

OVERRIDEs are those of `torchfovea search`, such as scene=cans. The episodes run with matcher.volume=all; every look's
images are matched again with each volume, so that looks are paired.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from scipy.stats import t as student
from torch import Tensor

from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.memory.expected import hidden_beyond
from torchfovea.perception import new_memory
from torchfovea.search import search
from torchfovea.sensing.head import eyes, to_ego
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.sweep import SweepRange, Volume, match_sweep
from torchfovea.stereo.views import verged_views

APART = 0.1  # 1/m; and four of its own standard deviations: a match that far off is an outlier
COLUMNS = ("sweep cpu ms", "telling cpu ms", "fields told", "truth ruled out", "valid", "outliers", "too near")


def judged(found: SweepRange, true: Tensor, seen: Tensor) -> tuple[float, float, float]:
    """Shares: valid of what both eyes see, outliers and those that are too near of the valid."""
    error, valid = found.inverse_range - true, found.valid & seen
    wrong = valid & (error.abs() > APART) & (error.abs() > 4 * found.sigma)
    return tuple(float(a.sum() / b.sum()) for a, b in ((valid, seen), (wrong, valid), (wrong & (error > 0), valid)))


def main(episodes: int, saccades: int, overrides: list[str]) -> None:
    """Print the means over episodes, and the differences to `all` with their 95% intervals."""
    torch.set_num_threads(1)
    with initialize_config_dir(config_dir=str(conf_dir()), version_base=None):
        cfg = compose("search", overrides=["matcher=sweep", *overrides])
    rows: dict[str, list[np.ndarray]] = {}
    for seed in range(episodes):
        observer = build_observer(cfg)
        arena, generator = build_arena(cfg, observer, seed), torch.Generator().manual_seed(seed)
        memory = new_memory(observer, build_cells(cfg, observer.head, generator))
        params, retina = arena.matcher.params, observer.retina
        px, looks = retina.centers_px(), {}
        for glance in search(arena, observer, memory, saccades, generator, build_strategy(cfg, observer)):
            gaze, pictures = glance.move.gaze, glance.look.pictures
            pose = eyes(observer.head, gaze)
            views = verged_views(
                pictures.left, pictures.right, rig_at(observer.head, gaze), observer.camera, retina.radius_px
            )
            rays = observer.camera.rays(px)
            met = arena.world.correspond(gaze, rays)
            true = (1 / (met.points_e.double() - pose.t_left.double()).norm(dim=-1)).float()
            seen = met.hit & met.visible_right
            start = time.process_time()
            least = hidden_beyond(memory, pose.t_left, to_ego(pose.R_left, rays), params.volume_sigmas)
            telling, none = time.process_time() - start, torch.full_like(least, torch.inf)
            volumes = {
                "all": (None, 0.0),
                "memory": (Volume(least, none), telling),
                "truth": (Volume((true - 0.15).clamp(min=0), true + 0.15), 0.0),
            }
            for name, (volume, took) in volumes.items():
                start = time.process_time()
                found = match_sweep(views, retina, params, observer.budget, arena.matcher.nearest_m, volume=volume)[1]
                cost = time.process_time() - start
                low = torch.zeros_like(true) if volume is None else volume.least
                told, lost = (low > 0).float().mean(), ((low > true) & seen).sum() / seen.sum()
                looks.setdefault(name, []).append(
                    (1e3 * cost, 1e3 * took, float(told), float(lost), *judged(found, true, seen))
                )
            memory = glance.step.memory
        for name, values in looks.items():
            rows.setdefault(name, []).append(np.mean(values, 0))
    for name, values in rows.items():
        mean, difference = np.mean(values, 0), np.array(values) - np.array(rows["all"])
        half = student.ppf(0.975, episodes - 1) * difference.std(0, ddof=1) / np.sqrt(episodes)
        for k, column in enumerate(COLUMNS):
            print(f"{name:7s} {column:15s} {mean[k]:9.4f}   minus all {difference[:, k].mean():+.4f} ± {half[k]:.4f}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
