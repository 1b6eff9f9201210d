"""`torchfovea sense`: a rectified stereo pair to 3-D points with covariances, judged where the truth is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchfovea.config import run_folder
from torchfovea.experiments.budgets import build_budget
from torchfovea.experiments.build import build_matcher, build_sensor, choice, name_of
from torchfovea.experiments.images import write_ply
from torchfovea.experiments.pairs import Pair, gaze_of, load_pair
from torchfovea.experiments.sense_report import beside, figures_of, read_map
from torchfovea.experiments.unread import refuse_unread
from torchfovea.files import replacing, write_result
from torchfovea.gaussian import Gaussian
from torchfovea.sensing.chart import cartesian_from_inverse_range
from torchfovea.sensing.correspondence import once_a_pixel
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import fovea
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError
from torchfovea.stereo.matchers import Matcher, match_pair
from torchfovea.stereo.rectified import RectifiedMatch
from torchfovea.stereo.sgbm import SGBM

__all__ = ["Sensed", "run", "sense"]


class Sensed(NamedTuple):
    """Points of a pair, in the left camera's optical frame (x right, y down, z forward).

    Attributes:
        match: correspondences and disparity.
        observed: in the inverse-range chart about the left camera.
        points: Cartesian moments, (N, 3) [m] and (N, 6) [m²].
        colour: what each receptive field sees, (N, 3).
        chosen: bool (N,), the valid fields of which none copies another's source pixel.
    """

    match: RectifiedMatch
    observed: Observations
    points: Gaussian
    colour: Tensor
    chosen: Tensor


def run(cfg: DictConfig) -> float | None:
    """Sense a pair; the median depth error is what a sweeper sees, if there is truth."""
    refuse_unread("sensor.fov_deg", "sensor.camera", "sensor.sample")
    every = name_of(cfg, "sensor", "layout") == "every_pixel"
    retina = None if every else build_sensor(cfg)[1]  # the field of view is the images' own
    matcher, pair, folder = build_matcher(cfg), load_pair(cfg), run_folder()
    gaze_px, budget = gaze_of(cfg, pair), build_budget(cfg, pair=True)
    printed = choice(cfg, "budget.sigma_points", ("ours", "paper")) == "paper"

    match = match_pair(matcher, *pair[:5], retina, gaze_px, budget)
    sensed = sense(pair, match, retina, gaze_px, SigmaPoints.paper() if printed else None, not printed)
    _write(folder, sensed)
    figures: dict[str, Any] = figures_of(pair, sensed.observed, sensed.points, match, sensed.chosen, retina, gaze_px)
    # from here on nothing can lose the points
    refused: SettingError | None = None
    if pair.disparity is not None and retina is not None:
        try:
            peer = matcher.params if isinstance(matcher.params, SGBM) else SGBM()
            plain = match_pair(Matcher(peer, matcher.nearest_m), *pair[:5], None, gaze_px, budget).disparity
            again = read_map(pair, plain.disparity, plain.valid, retina, gaze_px)
            figures |= beside(pair, sensed.observed, sensed.points, again, retina, gaze_px)
        except SettingError as error:
            refused = error
    from torchfovea.pictures.episode import draw_sense

    draw_sense(folder / "sense.png", pair.left, match.disparity, sensed.observed, match.correspondences.left_px)
    write_result(folder, figures)
    grid = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in figures.items():
        grid.add_row(name, f"{value:.4g}")
    Console().print(grid)
    if refused is not None:
        Console(stderr=True).print(f"sense: not judged beside plain matching: {refused}", highlight=False, markup=False)
    return figures.get("median_error_m")


def sense(
    pair: Pair,
    match: RectifiedMatch,
    retina: Retina | None,
    gaze_px: tuple[float, float] | None,
    points: SigmaPoints | None,
    rotated: bool,
) -> Sensed:
    """Correspondences of a rectified pair as points with covariances, in the left camera's frame."""
    eye = torch.eye(3)
    rig = Eyes(eye, torch.zeros(3), eye, torch.tensor([pair.baseline_m, 0.0, 0.0]))
    px = match.correspondences.left_px
    support = torch.full_like(px[..., 0], 0.5) if retina is None else retina.width_px(px) / 2
    observed = observe(
        match.correspondences, rig, match.camera_left, support, points, "inverse_range", rotated, match.camera_right
    )
    moments = cartesian_from_inverse_range(Gaussian(observed.mean, observed.cov), observed.direction)
    if retina is None:
        colour = pair.left.flatten(1).T
    else:
        gaze = None if gaze_px is None else torch.tensor([gaze_px])
        colour = fovea(pair.left[None], gaze, retina)[0].T
    chosen = observed.valid
    if retina is not None:
        pixel_px = 2 * retina.radius_px / min(pair.left.shape[-2:])
        chosen = once_a_pixel(px, pixel_px, observed.valid)
    return Sensed(match, observed, moments, colour, chosen)


def _write(folder: Path, sensed: Sensed) -> None:
    """points.ply and points.npz: the valid points alone, one a source pixel."""
    keep = sensed.chosen
    mean, cov, colour = (t[keep].numpy() for t in (sensed.points.mean, sensed.points.cov, sensed.colour))
    inlier = sensed.observed.inlier
    assert inlier is not None
    write_ply(folder / "points.ply", mean, cov, colour, inlier[keep].numpy())
    with replacing(folder / "points.npz") as path:
        np.savez_compressed(
            path,
            mean_m=mean,
            cov_m2=cov,
            colour=colour,
            inlier=inlier[keep].numpy(),
            left_px=sensed.match.correspondences.left_px[keep].numpy(),
            direction=sensed.observed.direction[keep].numpy(),
            inverse_range=sensed.observed.mean[keep, 2].numpy(),
            inverse_range_std=sensed.observed.cov[keep, 5].sqrt().numpy(),
        )
