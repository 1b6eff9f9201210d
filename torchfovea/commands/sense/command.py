"""`torchfovea sense`: a calibrated stereo pair to 3-D points with covariances, judged where the truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from torchfovea.cloud import COVARIANCE, write_ply
from torchfovea.commands.sense.checks import examine, examine_map
from torchfovea.commands.sense.figure1 import draw_pair, retinas_of
from torchfovea.commands.sense.points import Sensed, match_and_sense
from torchfovea.commands.sense.report import beside, image_seen, match_figures, read_at_fields
from torchfovea.commands.shared.budgets import build_budget
from torchfovea.commands.shared.build import build_match, build_sensor
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.pairs import Pair, gaze_of, load_pair
from torchfovea.commands.shared.screen import print_figures, say
from torchfovea.commands.shared.settings import choice
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.files import replacing, write_result
from torchfovea.sensing.correspondence import Budget, Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.setting import SettingError, require
from torchfovea.stereo.external import External
from torchfovea.stereo.health import misaligned
from torchfovea.stereo.matchers import Match, Matcher
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.meeting import met
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.views import Views

__all__ = ["run"]

FRAME = "the left camera's frame: x right, y down, z forward"
PLAIN_BYTES = 1_000_000_000
_MET = "the right retina looks at [{:.0f}, {:.0f}], at the left one's thing (gaze_right_px=same: at the same pixel)"
UNITS = "mean_m m, cov_m2 m^2, left_px retinal px, left_image_px px, inverse_range 1/m; direction has length 1"


def run(cfg: DictConfig) -> float | None:
    """Sense a pair; the median depth error is what a sweeper sees, if there is truth."""
    refuse_unread("sensor.fov_deg", "sensor.camera", "sensor.sample")
    every = name_of(cfg, "sensor", "layout") == "every_pixel"
    retina = None if every else build_sensor(cfg)[1]  # the field of view is the images' own
    match, pair, health = build_match(cfg), load_pair(cfg), choice(cfg, "health", ("error", "warn", "off"))
    raw = retina is None and pair.rig is not None
    require(not raw, "sensor.layout", "every_pixel", "a retina (sensor=log_polar or uniform) for raw images")
    views, free = _looking(cfg, pair)
    budget, whole = build_budget(cfg, pair=True), choice(cfg, "span", ("whole", "shorter")) == "whole"
    printed = choice(cfg, "budget.sigma_points", ("ours", "paper")) == "paper"
    both, folder = retinas_of(cfg, retina, budget), run_folder()
    found_out = examine(pair, views, health)
    pair, told = pair._replace(disparity=found_out.disparity), found_out.warnings
    if free:
        views = met(views, match.nearest_m if isinstance(match, Matcher) else 0.3)
        say("sense: " + _MET.format(*views.gazes_px[1]))
    views = views.whole() if whole else views
    budget = misaligned(budget, found_out.rows_px)

    sensed, found = match_and_sense(match, views, printed, retina, budget)
    foreign = isinstance(match, Matcher) and isinstance(match.params, External) and views.rectified
    if foreign and isinstance(found, Disparity) and found_out.matches is not None:
        told += examine_map(found.disparity, found.valid, found_out.matches, views, health)
    _write(folder, sensed, views, retina)
    right_px, looked = views.gazes_px[1], views
    # the truth is the left image's, wherever the right eye looked
    views = views._replace(rectified=pair.rig is None, gaze_right_px=None)
    # from here on nothing can lose the points
    observed, points = sensed.observed, sensed.points
    figures: dict[str, float] = {"image_seen": image_seen(views, retina), "rows_px": found_out.rows_px}
    figures |= match_figures(pair, views, retina, sensed.matches.left_px, observed, points, sensed.chosen)
    if pair.disparity is not None and retina is not None:
        try:
            figures |= _beside_plain(match, pair, views, retina, budget, sensed)
        except SettingError as error:
            told.append(f"not judged beside plain matching: {error}")
    from torchfovea.commands.sense.pictures import draw_sense

    draw_sense(folder / "sense.png", pair.left, found, retina, observed, sensed.matches.left_px)
    if both:
        alike = partial(match_and_sense, match, looked, printed)
        draw_pair(folder / "figure1.png", pair, both, lambda r, b: alike(r, misaligned(b, found_out.rows_px))[0])
    write_result(folder, {**figures, "gaze_right_px": right_px, "warnings": told})
    print_figures(figures)
    for line in told:
        say(f"sense: {line}")
    return figures.get("median_error_m")


def _looking(cfg: DictConfig, pair: Pair) -> tuple[Views, bool]:
    """The pair with what its retinas look at, and whether the right one is free to look where the left one's thing is.

    The eyes of a rectified pair look at the same pixel by themselves.
    """
    gaze = gaze_of(cfg, pair, "gaze_px")
    if cfg.gaze_right_px == "same":
        return pair.views(gaze), False
    other = gaze_of(cfg, pair, "gaze_right_px")
    return pair.views(gaze, other), other is None and pair.rig is not None


def _beside_plain(
    match: Match, pair: Pair, views: Views, retina: Retina, budget: Budget, sensed: Sensed
) -> dict[str, float]:
    """Block matching of the images themselves, along all directions, at the same receptive fields.

    Raises:
        SettingError: where it cannot match them, or only in more than a gigabyte.
    """
    ours = match if isinstance(match, Matcher) else Matcher(SGBM())
    params = ours.params if isinstance(ours.params, SGBM) else SGBM()
    _, plain = match_sgbm(views, None, replace(params, mode="hh"), budget, ours.nearest_m, most_bytes=PLAIN_BYTES)
    again = read_at_fields(plain.disparity, views, retina, plain.valid)
    return beside(pair, views, retina, sensed.observed, sensed.points, again)


def _write(folder: Path, sensed: Sensed, views: Views, retina: Retina | None) -> None:
    """points.ply and points.npz: the valid points alone, one a source pixel; with their frame, units and order."""
    keep = sensed.chosen
    left_px = sensed.matches.left_px[keep]
    image_px = left_px * views.scale(retina) + left_px.new_tensor(views.origin_px(retina))
    mean, cov, colour = (t[keep].numpy() for t in (sensed.points.mean, sensed.points.cov, sensed.colour))
    inlier = sensed.observed.inlier
    inlier = torch.ones_like(sensed.observed.mean[:, 2]) if inlier is None else inlier
    write_ply(folder / "points.ply", mean, cov, colour, inlier[keep].numpy(), FRAME)
    with replacing(folder / "points.npz") as path:
        np.savez_compressed(
            path,
            mean_m=mean,
            cov_m2=cov,
            colour=colour,
            inlier=inlier[keep].numpy(),
            left_px=left_px.numpy(),
            left_image_px=image_px.numpy(),
            direction=sensed.observed.direction[keep].numpy(),
            inverse_range=sensed.observed.mean[keep, 2].numpy(),
            inverse_range_std=sensed.observed.cov[keep, 5].sqrt().numpy(),
            frame=np.array(FRAME),
            units=np.array(UNITS),
            cov_order=np.array(COVARIANCE),
        )
