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
from torchfovea.experiments.build import build_matcher, build_sensor, choice, construct, number, whole
from torchfovea.experiments.images import read_image, write_ply
from torchfovea.files import replacing, write_result
from torchfovea.gaussian import Gaussian
from torchfovea.metrics import coverage, nees_mean, outlier_share
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.chart import cartesian_from_inverse_range
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.retina import fovea
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError, require
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.stereo.matchers import Matcher, match_pair
from torchfovea.stereo.rectified import RectifiedMatch, match_disparity
from torchfovea.stereo.sgbm import SGBM

__all__ = ["Pair", "Sensed", "load_pair", "motorcycle", "run", "sense"]


class Pair(NamedTuple):
    """A rectified stereo pair.

    Attributes:
        left: (3, H, W) in [0, 1].
        right: the same size.
        camera_left: in image pixels.
        camera_right: in image pixels.
        baseline_m: between the cameras.
        disparity: the truth, (H, W), not finite where unknown; or None.
    """

    left: Tensor
    right: Tensor
    camera_left: Pinhole
    camera_right: Pinhole
    baseline_m: float
    disparity: Tensor | None


class Sensed(NamedTuple):
    """Points of a pair, in the left camera's optical frame (x right, y down, z forward).

    Attributes:
        match: correspondences and disparity.
        observed: in the inverse-range chart about the left camera.
        points: Cartesian moments, (N, 3) [m] and (N, 6) [m²].
        colour: what each receptive field sees, (N, 3).
    """

    match: RectifiedMatch
    observed: Observations
    points: Gaussian
    colour: Tensor


def run(cfg: DictConfig) -> float | None:
    """Sense a pair; the median depth error is what a sweeper sees, if there is truth."""
    every = choice(cfg, "sensor.layout", ("log_polar", "uniform", "every_pixel")) == "every_pixel"
    retina = None if every else build_sensor_of_pair(cfg)
    matcher = build_matcher(cfg)
    source = whole(cfg, "sensor.source_px", 16) if cfg.budget.source else None
    budget = construct(Budget, {**cfg.budget, "source_px": source}, "budget")
    printed = choice(cfg, "budget.sigma_points", ("ours", "paper")) == "paper"
    pair, gaze_px, folder = load_pair(cfg), _gaze(cfg), run_folder()

    match = match_pair(matcher, *pair[:5], retina, gaze_px, budget)
    sensed = sense(pair, match, retina, gaze_px, SigmaPoints.paper() if printed else None, not printed)
    valid = sensed.observed.valid
    figures: dict[str, Any] = {"points": int(valid.sum()), "valid_fraction": float(valid.double().mean())}
    if pair.disparity is not None:
        figures.update(judge(pair, sensed, retina, gaze_px))
        if retina is not None:
            peer = matcher.params if isinstance(matcher.params, SGBM) else SGBM()
            plain = match_pair(Matcher(peer, matcher.nearest_m), *pair[:5], None, gaze_px, budget).disparity
            again = _at(pair, plain.disparity, plain.valid, retina, gaze_px, budget)
            figures.update(_beside(pair, sensed, again, retina, gaze_px))
    _write(folder, sensed)
    from torchfovea.pictures.episode import draw_sense

    draw_sense(
        folder / "sense.png", pair.left, sensed.match.disparity, sensed.observed, sensed.match.correspondences.left_px
    )
    write_result(folder, figures)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)
    return figures.get("median_error_m")


def build_sensor_of_pair(cfg: DictConfig) -> Retina:
    """The retina; the field of view is the image's own."""
    return build_sensor(cfg)[1]


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
    return Sensed(match, observed, moments, colour)


def _at(
    pair: Pair,
    disparity: Tensor,
    valid: Tensor | None,
    retina: Retina | None,
    gaze_px: tuple[float, float] | None,
    budget: Budget | None = None,
) -> Tensor:
    """A disparity map read at the receptive fields, (N,); NaN where there is none [px of the image]."""
    match = match_disparity(
        disparity, pair.camera_left, pair.camera_right, pair.baseline_m, retina, gaze_px, valid, budget, 1e-3
    )
    scale = pair.camera_left.focal_px / match.camera_left.focal_px
    found = match.correspondences
    shift = (found.left_px - found.right_px)[:, 0] * scale
    return torch.where(found.valid, shift, torch.full_like(shift, torch.nan))


def _depth(pair: Pair, disparity: Tensor) -> Tensor:
    doffs = pair.camera_right.cx_px - pair.camera_left.cx_px
    return pair.camera_left.focal_px * pair.baseline_m / (disparity + doffs)


def judge(pair: Pair, sensed: Sensed, retina: Retina | None, gaze_px: tuple[float, float] | None) -> dict[str, float]:
    """Errors and honesty against the true disparity.

    The truth lies on the left ray, so that one degree of freedom is left to err in: the inverse range.
    """
    assert pair.disparity is not None
    depth = _depth(pair, _at(pair, pair.disparity, None, retina, gaze_px))
    length = sensed.match.camera_left.rays(sensed.match.correspondences.left_px).norm(dim=-1)
    known = sensed.observed.valid & torch.isfinite(depth)
    error = sensed.observed.mean[:, 2] - 1 / (depth * length)
    z = (error / sensed.observed.cov[:, 5].sqrt())[known]
    levels = (0.5, 0.9, 0.95, 0.99)
    shares = coverage(z, levels)
    return {
        "median_error_m": float((sensed.points.mean[:, 2] - depth)[known].abs().median()),
        "nees_mean": float(nees_mean(z)),
        **{f"coverage_{round(100 * level)}": float(share) for level, share in zip(levels, shares, strict=True)},
        "outlier_share": float(outlier_share(z)),
    }


def _beside(
    pair: Pair, sensed: Sensed, plain: Tensor, retina: Retina, gaze_px: tuple[float, float] | None
) -> dict[str, float]:
    """Both matchers at the receptive fields where both found something and the truth is known."""
    assert pair.disparity is not None
    depth = _depth(pair, _at(pair, pair.disparity, None, retina, gaze_px))
    peer = _depth(pair, plain)
    common = sensed.observed.valid & torch.isfinite(depth) & torch.isfinite(peer)
    return {
        "common_median_error_m": float((sensed.points.mean[:, 2] - depth)[common].abs().median()),
        "plain_common_median_error_m": float((peer - depth)[common].abs().median()),
        "plain_valid_fraction": float(torch.isfinite(peer).double().mean()),
    }


def _gaze(cfg: DictConfig) -> tuple[float, float] | None:
    if cfg.gaze_px is None:
        return None
    require(len(cfg.gaze_px) == 2, "gaze_px", cfg.gaze_px, "[column, row]")
    return float(cfg.gaze_px[0]), float(cfg.gaze_px[1])


def load_pair(cfg: DictConfig) -> Pair:
    """The pair that a configuration names.

    Raises:
        SettingError: for a missing file or calibration, or images of different sizes.
    """
    if cfg.pair is not None:
        choice(cfg, "pair", ("motorcycle",))
        return motorcycle()
    for name in ("left", "right"):
        if cfg[name] is None:
            raise SettingError(f"{name} = null: expected an image file (or pair=motorcycle)")
    left, right = (read_image(Path(cfg[name]), name) for name in ("left", "right"))
    require(
        left.shape == right.shape,
        "right",
        f"{right.shape[-1]}x{right.shape[-2]} px",
        f"the left image's {left.shape[-1]}x{left.shape[-2]} px",
    )
    for name in ("focal_px", "cx_px", "cy_px", "baseline_m"):
        if cfg[name] is None:
            raise SettingError(
                f"{name} = null: expected the calibration of the left camera, in image pixels and metres"
            )
    focal, baseline = number(cfg, "focal_px"), number(cfg, "baseline_m")
    cx, cy, doffs = float(cfg.cx_px), float(cfg.cy_px), float(cfg.doffs_px)
    truth = None if cfg.disparity is None else load_disparity(Path(cfg.disparity), "disparity")[0]
    if truth is not None:
        require(
            truth.shape == left.shape[-2:], "disparity", tuple(truth.shape), f"the images' {tuple(left.shape[-2:])}"
        )
    return Pair(left, right, Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), baseline, truth)


def motorcycle() -> Pair:
    """Middlebury 2014's motorcycle at a quarter of its size, as scikit-image ships it."""
    try:
        from skimage.data import stereo_motorcycle
    except ModuleNotFoundError as error:
        raise SettingError("pair = motorcycle: expected scikit-image (pip install torchfovea[samples])") from error
    left, right, disparity = stereo_motorcycle()
    left, right = (torch.from_numpy(np.ascontiguousarray(i)).movedim(-1, 0).float() / 255 for i in (left, right))
    focal, cx, cy, doffs = 994.978, 311.193, 254.877, 31.086
    truth = torch.from_numpy(np.array(disparity, dtype=np.float32))
    return Pair(left, right, Pinhole(focal, cx, cy), Pinhole(focal, cx + doffs, cy), 0.193001, truth)


def _write(folder: Path, sensed: Sensed) -> None:
    """points.ply and points.npz: the valid points alone."""
    keep = sensed.observed.valid
    mean, cov, colour = (t[keep].numpy() for t in (sensed.points.mean, sensed.points.cov, sensed.colour))
    write_ply(folder / "points.ply", mean, cov, colour)
    with replacing(folder / "points.npz") as path:
        np.savez_compressed(
            path,
            mean_m=mean,
            cov_m2=cov,
            colour=colour,
            left_px=sensed.match.correspondences.left_px[keep].numpy(),
            direction=sensed.observed.direction[keep].numpy(),
            inverse_range=sensed.observed.mean[keep, 2].numpy(),
            inverse_range_std=sensed.observed.cov[keep, 5].sqrt().numpy(),
        )
