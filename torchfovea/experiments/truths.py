"""Observations whose truth is known, for `torchfovea calibrate`: simulated looks, and pairs with disparity."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.experiments.build import build_sensor
from torchfovea.experiments.sense import load_pair
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, Disparity
from torchfovea.sensing.head import Eyes, Gaze, eyes
from torchfovea.sensing.layout import Retina
from torchfovea.setting import SettingError, require
from torchfovea.sim.world import World
from torchfovea.stereo.confidence import read_clues
from torchfovea.stereo.matchers import Matcher, match_eyes, match_pair
from torchfovea.stereo.rectified import match_disparity
from torchfovea.stereo.rig import verged
from torchfovea.stereo.sweep import Sweep
from torchfovea.studies.calibration import Judged, judged

__all__ = ["Truths", "look_at_pair", "look_at_world"]


class Truths(NamedTuple):
    """What one look tells.

    Attributes:
        data: the observations, M of them.
        right_of_middle_px: (M,), where the left image shows them, from its middle column [px].
        valid_fraction: share of the receptive fields that the matcher calls valid.
    """

    data: Judged
    right_of_middle_px: Tensor
    valid_fraction: float


def look_at_world(world: World, gaze: Gaze, retina: Retina, budget: Budget, matcher: Matcher) -> Truths:
    """Match both eyes' pictures; the truth is cast along the left receptive fields' rays."""
    left, right = (frame.image for frame in world.images(gaze))
    rig, pose = verged(gaze.vergence, world.head.baseline_m), eyes(world.head, gaze)
    matches, found = match_eyes(matcher, left, right, rig, world.camera, retina, budget)
    clues = None
    if isinstance(found, Disparity):
        place = found.camera.project(world.camera.rays(matches.left_px) @ rig.R_left.to(matches.left_px).mT)
        other = found.camera.project(world.camera.rays(matches.right_px) @ rig.R_right.to(matches.left_px).mT)
        clues = _clues(found, place, (place - other)[:, 0], retina, world.source_px)
    seen = world.correspond(gaze, world.camera.rays(matches.left_px))
    away = torch.linalg.vector_norm(seen.points_e.double() - pose.t_left, dim=-1)
    truth = torch.where(seen.hit, 1 / away, torch.zeros_like(away))
    data, which = judged(matches, pose, world.camera, retina, budget, truth, clues)
    return Truths(data, matches.left_px[which, 0], float(matches.valid.double().mean()))


def look_at_pair(cfg: DictConfig, budget: Budget, matcher: Matcher) -> Truths:
    """Match a rectified pair; the truth is its disparity.

    Raises:
        SettingError: for a pair without true disparity.
    """
    pair = load_pair(cfg)
    if pair.disparity is None:
        raise SettingError("disparity = null: expected the true disparity of the pair, to judge by")
    retina = build_sensor(cfg)[1]
    if cfg.gaze_px is not None:
        require(len(cfg.gaze_px) == 2, "gaze_px", cfg.gaze_px, "[column, row]")
    gaze = None if cfg.gaze_px is None else (float(cfg.gaze_px[0]), float(cfg.gaze_px[1]))
    height, width = pair.left.shape[-2:]
    cameras = pair.camera_left, pair.camera_right, pair.baseline_m
    true = match_disparity(pair.disparity, *cameras, retina, gaze, nearest_range_m=1e-3)
    scale = pair.camera_left.focal_px / true.camera_left.focal_px
    middle = true.correspondences.left_px.new_tensor(gaze or ((width - 1) / 2, (height - 1) / 2))
    place = true.correspondences.left_px * scale + middle
    same = torch.eye(3)
    pose = Eyes(same, torch.zeros(3), same, torch.tensor([pair.baseline_m, 0.0, 0.0]))
    source = min(height, width)
    budget = replace(budget, source_px=source)
    found = match_pair(matcher, pair.left, pair.right, *cameras, retina, gaze, budget)
    matches, clues = found.correspondences, None
    if not isinstance(matcher.params, Sweep):  # whose map is its receptive fields'
        shift = (matches.left_px - matches.right_px)[:, 0] * scale
        clues = _clues(found.disparity, place, shift, retina, source)
    truth = _inverse_range(true.correspondences, true.camera_left, true.camera_right, pair.baseline_m)
    truth = torch.where(true.correspondences.valid, truth, torch.zeros_like(truth))
    data, which = judged(matches, pose, true.camera_left, retina, budget, truth, clues, true.camera_right)
    return Truths(data, (place[:, 0] - (width - 1) / 2)[which], float(matches.valid.double().mean()))


def _inverse_range(matches: Correspondences, left: Camera, right: Camera, baseline_m: float) -> Tensor:
    """Of places (N, 2) in both rectified cameras, along the left ray."""
    one, other = left.rays(matches.left_px), right.rays(matches.right_px)
    return (one - other)[:, 0] / baseline_m / torch.linalg.vector_norm(one, dim=-1)


def _clues(disparity: Disparity, place: Tensor, shift: Tensor, retina: Retina, source_px: int) -> Clues:
    width_px = retina.width_px(retina.centers_px(place.device, place.dtype)) * (source_px / (2 * retina.radius_px))
    return read_clues(disparity, place, shift, width_px)
