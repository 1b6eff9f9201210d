"""Foveated drawing, in docs/results/speed.md: what it would save, and what the sweep would make of such pictures.

    python scripts/foveated_drawing.py SCENES OVERRIDE...

OVERRIDEs are those of `torchfovea search`. Where receptive fields are four pixels wide and more, tiles get one ray for
four pixels, whose footprint is as wide; `edges` draws those of them in which two things meet as they are. Corners that
retinas do not see are left out of the rays counted. Each scene is matched in all pictures, so that scenes are paired.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch
import torch.nn.functional as F
from hydra import compose, initialize_config_dir
from scipy.stats import t as student
from torch import Tensor

from torchfovea.commands.shared.build import build_arena, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.compiling import compiling
from torchfovea.sensing.camera import image_camera
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sensing.triangulation import observe
from torchfovea.sim.drawing import colour
from torchfovea.sim.noise import expose
from torchfovea.sim.pixels import Pixels, pixels_of, surfaces_seen
from torchfovea.sim.rays import paint_scenes, render_together
from torchfovea.stereo.rig import rig_at
from torchfovea.stereo.sweep import match_sweep
from torchfovea.stereo.views import verged_views

TILE = 16  # eight rays a side where fields are wide
WIDE_PX = 4.0
COLUMNS = ("valid", "c95", "beyond 5 sigma", "median error of range", "errors above 20%")


def of_tiles(values: Tensor, how: str) -> Tensor:
    """`amin` or `amax` over the tiles of (H, W), by rows of tiles."""
    across = values.shape[-1] // TILE
    tiles = values.view(-1, TILE, across, TILE).transpose(1, 2).flatten(2)
    return getattr(tiles, how)(-1)


def doubled(values: Tensor, times: int = 2) -> Tensor:
    """Every pixel so many times along both axes."""
    return values.repeat_interleave(times, -1).repeat_interleave(times, -2)


def joined(parts: tuple[Tensor, Tensor], kept: tuple[Tensor, Tensor]) -> Tensor:
    """Some tiles of two sets as one; of rays (3, T, 64) tiles are the second axis, of all else the first."""
    axis = 1 if parts[0].dim() == 3 else 0
    chosen = [part.index_select(axis, own.nonzero()[:, 0]) for part, own in zip(parts, kept, strict=True)]
    return torch.cat(chosen, axis)


def time_of(scene: object, pose: object, chosen: dict[str, Pixels]) -> None:
    """Print the CPU milliseconds of both eyes' pixels, before they are put together."""
    turn, shift = (torch.from_numpy(part) for part in scene.world_from_ego)
    rotation = turn @ torch.stack([pose.R_left, pose.R_right])
    eye, painted = torch.stack([pose.t_left, pose.t_right]) @ turn.mT + shift, paint_scenes([scene] * 2)
    for mode in ("off", "on"):
        took: dict[str, list[float]] = {name: [] for name in chosen}
        for _ in range(12):
            for name, pixels in chosen.items():
                start = time.process_time()
                with compiling(mode):
                    _, surface, place, normal, footprint_m = surfaces_seen(painted.solids, eye, rotation, pixels)
                    colour(painted.paint, surface, place, normal, footprint_m)
                took[name].append(1e3 * (time.process_time() - start))
        print(f"compile={mode}: two pictures, least ms:", {name: round(min(ms), 1) for name, ms in took.items()})


def main(scenes: int, overrides: list[str]) -> None:
    """Print means over scenes, and the differences to the whole pictures with their 95% intervals."""
    torch.set_num_threads(1)
    with initialize_config_dir(config_dir=str(conf_dir()), version_base=None):
        cfg = compose("search", overrides=["fidelity=photometric", "matcher=sweep", *overrides])
    observer = build_observer(cfg)
    retina, camera, size = observer.retina, observer.camera, int(cfg.sensor.source_px)
    scale = size / (2 * retina.radius_px)
    cameras = {step: image_camera(camera, retina.radius_px, size // step) for step in (1, 2)}
    axis = (torch.arange(size) - (size - 1) / 2) / scale
    px = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)
    coarse, beyond = of_tiles(retina.width_px(px) * scale, "amin") >= WIDE_PX, of_tiles(px.norm(dim=-1), "amin")
    live, wide = beyond <= retina.radius_px + 8 / scale, retina.width_px(retina.centers_px()) * scale >= WIDE_PX
    fine, half = (pixels_of(cameras[step], size // step, torch.device("cpu")) for step in (1, 2))
    kept = doubled(~coarse & live).flatten(), (coarse & live).flatten()
    mixed = Pixels(*(joined(pair, kept) for pair in zip(fine, half, strict=True)))
    rows: dict[tuple[str, str], list[list[float]]] = {}
    counted, generator = [], np.random.default_rng(1)
    for seed in range(scenes):
        arena = build_arena(cfg, observer, seed)
        world = arena.world
        angles = (generator.uniform(*ends) for ends in ((-0.5, 0.5), (0.0, 0.5), (0.06, 0.2)))
        gaze = Gaze(*(torch.tensor(angle, dtype=torch.float64) for angle in angles))
        pose = eyes(observer.head, gaze)
        if seed == 0:
            time_of(world.scene, pose, {"whole": fine, "coarse": mixed})
        turns, places = torch.stack([pose.R_left, pose.R_right]), torch.stack([pose.t_left, pose.t_right])
        whole, small = (
            render_together([world.scene] * 2, turns, places, cameras[step], size // step) for step in (1, 2)
        )
        pictures: dict[str, list[Tensor]] = {"whole": [frame.image for frame in whole], "coarse": [], "edges": []}
        for frame, rough in zip(whole, small, strict=True):
            geom = rough.geom.float()[None, None]
            meets = doubled((F.max_pool2d(geom, 3, 1, 1) != -F.max_pool2d(-geom, 3, 1, 1))[0, 0])
            where = {"coarse": coarse, "edges": coarse & ~of_tiles(meets.float(), "amax").bool()}
            for name, tiles in where.items():
                pictures[name].append(torch.where(doubled(tiles, TILE), doubled(rough.image), frame.image))
            rays = [(coarse & live).float() / 4 + (live & ~tiles).float() for tiles in where.values()]
            counted.append([float(part.mean()) for part in rays])
        seen = world.correspond(gaze, camera.rays(retina.centers_px(dtype=torch.float64)))
        true = 1 / seen.points_e.norm(dim=-1)
        for name, pair in pictures.items():
            chance = torch.Generator().manual_seed(seed)
            pair = pair if world.noise is None else [expose(image, world.noise, 1.0, chance) for image in pair]
            views = verged_views(*pair, rig_at(observer.head, gaze), camera, retina.radius_px)
            with compiling("auto"):
                matches, _ = match_sweep(views, retina, arena.matcher.params, observer.budget)
            found = observe(matches, pose, camera, retina.width_px(matches.left_px) / 2)
            error, sigma = found.mean[:, 2] - true, found.cov[:, 5].sqrt()
            for fields, own in (("all", torch.ones_like(wide)), ("wide", wide)):
                good = found.valid & seen.hit & own
                off, part = (error / sigma)[good].abs(), (error.abs() / true)[good]
                shares = (off < 1.96, off > 5, part > 0.2)
                inside, outside, gross = (float(share.double().mean()) for share in shares)
                rows.setdefault((fields, name), []).append(
                    [float(matches.valid[own].double().mean()), inside, outside, float(part.median()), gross]
                )
    rays = dict(zip(("coarse", "edges"), np.mean(counted, 0).round(2).tolist(), strict=True))
    print(f"rays: {rays} of a whole picture's; wide: {float(wide.double().mean()):.3f} of the fields")
    for (fields, name), values in rows.items():
        difference = np.array(values) - np.array(rows[fields, "whole"])
        half_width = student.ppf(0.975, scenes - 1) * difference.std(0, ddof=1) / np.sqrt(scenes)
        for k, column in enumerate(COLUMNS):
            mean = np.mean(values, 0)[k]
            change = f"minus whole {difference[:, k].mean():+.4f} ± {half_width[k]:.4f}"
            print(f"{fields:5s} {name:7s} {column:22s} {mean:8.4f}   {change}")


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
