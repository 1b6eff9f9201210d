"""Fit what stripes tell of a mark: `python scripts/fit_stripes.py [SCENES [OVERRIDE...]]` (of `torchfovea search`).

Looks at every can of SCENES scenes (8) of `family=marked_images`, from seed 90000 on, with a log-polar and a uniform
retina, and fits `reward.evidence`'s numbers to the classes of what the fields show, first its colour, then the stripes;
told are the numbers, and what they tell of the marks in half as many other scenes, for fields of each width. Every
class counts alike.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from scipy.optimize import minimize
from torch import Tensor

from torchfovea.commands.shared.build import build_arena, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.sensing.head import fixate
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.stripes import Stripes, StripesShown
from torchfovea.stereo.views import verged_views

SEED = 90000
COLOUR = {"redness": (0.0, 100.0), "red": (0.0, 1.0)}
WIDTHS = (0.0, 0.3, 0.5, 0.7, 0.9, 1.2, 1.5, 2.0, 3.0)  # of the fields, in stripes


def looks(cfg: DictConfig, stripes: Stripes, seed: int) -> list[tuple[StripesShown, Tensor]]:
    """What matched fields show at each can of a scene, somewhere on it, and its class."""
    observer = build_observer(cfg)
    arena = build_arena(cfg, observer, seed)
    scene, retina, generator = arena.world.scene, observer.retina, torch.Generator().manual_seed(seed)
    assert scene.marks is not None and arena.matcher is not None
    found = []
    for geom in scene.marks.of_geom.nonzero()[:, 0].tolist():
        middle = torch.tensor(scene.solids[geom].position_m, dtype=torch.float64)
        middle[2] -= observer.head.ego_height_m
        gaze = fixate(observer.head, middle + 0.05 * torch.randn(3, generator=generator, dtype=torch.float64))[0]
        frames = arena.world.images(gaze)
        rig = rig_at(observer.head, gaze)
        views = verged_views(frames[0].image, frames[1].image, rig, observer.camera, retina.radius_px)
        matches, _ = arena.matcher(views, retina, observer.budget)
        column, row = (matches.left_px * views.scale(retina) + torch.tensor(views.gaze_px)).round().long().unbind(-1)
        side = cfg.sensor.source_px - 1
        shown = frames[0].geom[row.clamp(0, side), column.clamp(0, side)]
        good = matches.valid & (shown >= 0)
        seen = stripes.see(views, retina, matches)
        found.append((StripesShown(*(part[good].double() for part in seen)), scene.marks.of_geom[shown[good]]))
    return found


def gather(cfgs: list[DictConfig], stripes: Stripes, seeds: range) -> tuple[StripesShown, Tensor]:
    """All looks with all retinas."""
    seen, shown = zip(*(look for seed in seeds for cfg in cfgs for look in looks(cfg, stripes, seed)), strict=True)
    return StripesShown(*(torch.cat(parts) for parts in zip(*seen, strict=True))), torch.cat(shown)


def nats(log_likelihood: Tensor, shown: Tensor) -> Tensor:
    """The mean logarithm of the true class's posterior over that of a guess, every class counting alike."""
    told = log_likelihood.log_softmax(-1).gather(-1, shown[:, None])[:, 0]
    count = log_likelihood.shape[-1]
    return torch.stack([told[shown == k].mean() for k in range(count) if (shown == k).any()]).mean() + math.log(count)


def fit(stripes: Stripes, seen: StripesShown, shown: Tensor, bounds: dict[str, tuple[float, float]]) -> Stripes:
    """The same with the numbers, of these ranges, that make the classes most likely."""

    def cost(numbers: np.ndarray) -> float:
        tried = replace(stripes, **dict(zip(bounds, map(float, numbers), strict=True)))
        return -float(nats(tried.likelihood(seen).log(), shown))

    start = [getattr(stripes, name) for name in bounds]
    best = minimize(cost, start, method="Nelder-Mead", bounds=list(bounds.values()), options={"xatol": 1e-3}).x
    return replace(stripes, **{name: round(float(number), 2) for name, number in zip(bounds, best, strict=True)})


def main(scenes: int, overrides: list[str]) -> None:
    """Print the figures."""
    torch.set_num_threads(1)
    with initialize_config_dir(config_dir=str(conf_dir()), version_base=None):
        cfgs = [
            compose("search", overrides=["family=marked_images", f"sensor={name}", *overrides])
            for name in ("log_polar", "uniform")
        ]
    classes = build_observer(cfgs[0]).classes
    assert classes is not None and isinstance(classes.evidence, Stripes)
    stripes, known = classes.evidence, range(SEED, SEED + scenes)
    colour = fit(replace(stripes, concentration=0.0), *gather(cfgs, stripes, known), COLOUR)
    stripes = replace(stripes, redness=colour.redness, red=colour.red)
    stripes = fit(stripes, *gather(cfgs, stripes, known), {"concentration": (0.0, 200.0)})
    print(stripes)
    for cfg in cfgs:
        seen, shown = gather([cfg], stripes, range(SEED + scenes, SEED + scenes + math.ceil(scenes / 2)))
        told, which = (
            stripes.likelihood(seen).log(),
            torch.bucketize(seen.width_m / stripes.detail_m, torch.tensor(WIDTHS)),
        )
        for k, (low, high) in enumerate(zip(WIDTHS, (*WIDTHS[1:], math.inf), strict=True), 1):
            on = (which == k) & (shown > 0)
            if on.any():
                value = float(nats(told[on][:, 1:], shown[on] - 1))
                print(f"{cfg.sensor.layout}: {low} to {high} stripes wide, {int(on.sum())} fields: {value:.3f} nats")


if __name__ == "__main__":
    more = sys.argv[1:]
    main(int(more.pop(0)) if more and more[0].isdigit() else 8, more)
