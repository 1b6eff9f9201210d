"""Compare the foveated sweep with SGBM at the same receptive fields: `python scripts/compare_matchers.py --help`.

On scenes of cans (the target fixated by verged eyes) and on the motorcycle pair, for both retinas. Errors are of the
right eye's pixel, in pixels of the source image; `bad` counts more than one of these, `wide` more than one RF width.
Medians and rates are over RFs that both matchers call valid and the right eye truly sees; `valid` is each matcher's own
share of those seen.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path
from typing import Any

import torch

from torchfovea.commands.shared.pairs import motorcycle
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import eyes, fixate
from torchfovea.sensing.layout import LogPolar, Retina, Uniform
from torchfovea.sim.cans import Cans
from torchfovea.sim.scene import build_scene
from torchfovea.sim.world import World
from torchfovea.stereo.maps import match_disparity
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.rig import verged
from torchfovea.stereo.sweep import match_sweep
from torchfovea.stereo.views import Views, verged_views

FOVEA_PX = 20.0
RETINAS = {"log_polar": LogPolar(), "uniform": Uniform()}
COLUMNS = ("pair", "retina", "region", "matcher", "seen", "valid", "common", "median_px", "bad", "wide", "seconds")


def judge(
    found: dict[str, tuple[Correspondences, float]],
    right_px: torch.Tensor,
    seen: torch.Tensor,
    retina: Retina,
    size: int,
) -> list[list[Any]]:
    """Rows of COLUMNS from `region` on."""
    left_px = retina.centers_px()
    eccentricity = left_px.norm(dim=-1)
    width = retina.width_px(left_px).clamp(min=2 * retina.radius_px / size)
    rows = []
    for region, mask in (("fovea", eccentricity <= FOVEA_PX), ("periphery", eccentricity > FOVEA_PX)):
        mask = mask & seen
        common = mask.clone()
        for matches, _ in found.values():
            common &= matches.valid
        for name, (matches, seconds) in found.items():
            error = (matches.right_px.double() - right_px).norm(dim=-1)[common]
            source = error * size / (2 * retina.radius_px)
            valid = float(matches.valid[mask].double().mean())
            rates = [float(x.double().mean()) for x in (source > 1, error > width[common])]
            rows.append(
                [region, name, int(mask.sum()), valid, int(common.sum()), float(source.median()), *rates, seconds]
            )
    return rows


def timed(match: Any) -> tuple[Any, float]:
    """What a call returns and how long its second run takes."""
    match()
    start = time.perf_counter()
    return match(), time.perf_counter() - start


def matched(views: Views, retina: Retina, nearest_m: float) -> dict[str, tuple[Correspondences, float]]:
    """What both matchers find, and the seconds they take."""
    found = {}
    for name, match in (("sgbm", match_sgbm), ("sweep", match_sweep)):
        answer, seconds = timed(lambda match=match: match(views, retina, nearest_range_m=nearest_m))
        found[name] = (answer[0], seconds)
    return found


def compare_cans(seed: int, retina: Retina, fov_deg: float, source_px: int) -> list[list[Any]]:
    """One scene of cans."""
    scene = build_scene(Cans(), seed)
    camera = Pinhole.from_fov(fov_deg, retina.radius_px)
    world = World(scene, camera=camera, source_px=source_px, radius_px=retina.radius_px)
    gaze = world.saccade(fixate(scene.head, scene.nearest_point_e)[0]).gaze
    left, right = (frame.image for frame in world.images())
    rig, pose = verged(gaze.vergence, scene.head.baseline_m), eyes(scene.head, gaze)
    truth = world.correspond(gaze, camera.rays(retina.centers_px(dtype=torch.float64)))
    line = (truth.points_e - pose.t_right) @ pose.R_right
    right_px = camera.project(line)
    seen = truth.visible_right & camera.in_view(line) & retina.inside(right_px)
    found = matched(verged_views(left, right, rig, camera, retina.radius_px), retina, 0.3)
    return judge(found, right_px, seen, retina, source_px)


def compare_motorcycle(retina: Retina) -> list[list[Any]]:
    """The motorcycle pair, looked at in its middle."""
    pair = motorcycle()
    views = pair.views(None)
    truth, _ = match_disparity(pair.disparity, views, retina, nearest_range_m=1.0)
    found = matched(views, retina, 1.0)
    return judge(found, truth.right_px.double(), truth.valid, retina, min(pair.left.shape[-2:]))


def main() -> None:
    """Compare, print the means over the scenes and write every row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--fov-deg", type=float, default=135.0)
    parser.add_argument("--source-px", type=int, default=400)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, help="a CSV of every row")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    rows: list[list[Any]] = []
    with torch.no_grad():
        for name, retina in RETINAS.items():
            for seed in range(options.scenes):
                compared = compare_cans(seed, retina, options.fov_deg, options.source_px)
                rows += [["cans", name, *row] for row in compared]
            rows += [["motorcycle", name, *row] for row in compare_motorcycle(retina)]
    if options.out:
        with options.out.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
    print(("{:>11} " * 9).format(*COLUMNS[:4], *COLUMNS[5:6], *COLUMNS[7:]))
    for key in dict.fromkeys(tuple(row[:4]) for row in rows):
        group = [row for row in rows if tuple(row[:4]) == key]
        # every scene weighs as much as its RFs
        seen, common = sum(r[4] for r in group), sum(r[6] for r in group)
        valid = sum(r[4] * r[5] for r in group) / seen
        others = [sum(r[6] * r[k] for r in group) / common for k in (7, 8, 9)]
        seconds = sum(r[10] for r in group) / len(group)
        print(("{:>11} " * 4 + "{:>11.3f} " * 5).format(*key, valid, *others, seconds))


if __name__ == "__main__":
    sys.exit(main())
