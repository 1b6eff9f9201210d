"""Observations whose truth is known, for `torchfovea calibrate`: simulated looks, and pairs with disparity."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.commands.shared.pairs import Pair
from torchfovea.commands.shared.regions import REGIONS, at_places, regions, truth_step_px
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Eyes, Gaze, eyes
from torchfovea.sensing.kinship import once_a_pixel
from torchfovea.sensing.layout import Retina
from torchfovea.setting import SettingError
from torchfovea.sim.world import World
from torchfovea.stereo.maps import match_disparity
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import verged
from torchfovea.stereo.views import verged_views
from torchfovea.studies.calibration import Judged, judged, select

__all__ = ["Truths", "look_at_pair", "look_at_world"]


class Truths(NamedTuple):
    """What one look tells.

    Attributes:
        data: the observations, M of them: one a source pixel.
        point_m: (M, 3), the true points, in a frame that all looks at one scene share.
        valid_share: share of the receptive fields that the matcher calls valid, by field and by area.
        hidden_valid_share: likewise, of those that the right eye cannot see; NaN where there are none.
        step_px: the step in which the truth comes [source px].
        axis: (3,), where the left eye looks, in the frame of `point_m`.
    """

    data: Judged
    point_m: Tensor
    valid_share: tuple[float, float]
    hidden_valid_share: tuple[float, float]
    step_px: float
    axis: Tensor


def look_at_world(world: World, gaze: Gaze, retina: Retina, budget: Budget, matcher: Matcher) -> Truths:
    """Match both eyes' pictures; the truth is cast along the left receptive fields' rays."""
    left, right = world.images(gaze)
    rig, pose = verged(gaze.vergence, world.head.baseline_m), eyes(world.head, gaze)
    views = verged_views(left.image, right.image, rig, world.camera, retina.radius_px)
    matches, found = matcher(views, retina, budget)
    seen = world.correspond(gaze, world.camera.rays(matches.left_px))
    away = torch.linalg.vector_norm(seen.points_e.double() - pose.t_left, dim=-1)
    truth = torch.where(seen.hit, 1 / away, torch.zeros_like(away))
    # pixels of disparity, but for the rays' slant
    shift = world.image_camera.focal_px * world.head.baseline_m / left.range_m
    around = regions(shift, left.image, torch.zeros_like(left.geom, dtype=torch.bool))
    scale = world.source_px / (2 * retina.radius_px)
    region = at_places(around, matches.left_px * scale + (world.source_px - 1) / 2)
    region = torch.where(seen.hit & ~seen.visible_right, REGIONS.index("hidden"), region)
    data, which = judged(matches, pose, world.camera, retina, budget, truth, found.clues, region=region)
    return _told(
        data, which, seen.points_e.double(), matches, region, seen.hit, retina, 1 / scale, 0.0, pose.R_left[:, 2]
    )


def look_at_pair(
    pair: Pair, retina: Retina, gaze_px: tuple[float, float] | None, budget: Budget, matcher: Matcher
) -> Truths:
    """Match a rectified pair; the truth is its disparity.

    Raises:
        SettingError: for a pair without true disparity.
    """
    if pair.disparity is None:
        raise SettingError("disparity = null: expected the true disparity of the pair, to judge by")
    views = pair.views(gaze_px)
    true, _ = match_disparity(pair.disparity, views, retina, nearest_range_m=1e-3)
    scale, (left, right) = views.scale(retina), views.cameras(retina)
    same = torch.eye(3)
    pose = Eyes(same, torch.zeros(3), same, torch.tensor([pair.baseline_m, 0.0, 0.0]))
    budget = replace(budget, source_px=views.source_px)
    matches, found = matcher(views, retina, budget)
    truth = _inverse_range(true, left, right, pair.baseline_m)
    known = true.valid
    truth = torch.where(known, truth, torch.zeros_like(truth))
    places = matches.left_px * scale + true.left_px.new_tensor(views.gaze_px)
    region = at_places(regions(pair.disparity, pair.left), places)
    data, which = judged(matches, pose, (left, right), retina, budget, truth, found.clues, region=region)
    ray = torch.nn.functional.normalize(left.rays(matches.left_px), dim=-1)
    points = ray / torch.where(known, truth, torch.ones_like(truth))[:, None]
    step = truth_step_px(pair.disparity)
    return _told(data, which, points.double(), matches, region, known, retina, 1 / scale, step, same[2])


def _told(
    data: Judged,
    which: Tensor,
    points: Tensor,
    matches: Correspondences,
    region: Tensor,
    known: Tensor,
    retina: Retina,
    pixel_px: float,
    step_px: float,
    axis: Tensor,
) -> Truths:
    area = retina.width_px(matches.left_px).square()
    hidden = known & (region == REGIONS.index("hidden"))
    once = once_a_pixel(matches.left_px, pixel_px, which)[which]
    return Truths(
        select(data, once), points[which][once], _shares(matches.valid, torch.ones_like(hidden), area),
        _shares(matches.valid, hidden, area), step_px, axis.double(),
    )  # fmt: skip


def _shares(valid: Tensor, among: Tensor, area: Tensor) -> tuple[float, float]:
    by_field, by_area = (float((w * (valid & among)).sum() / (w * among).sum()) for w in (torch.ones_like(area), area))
    return by_field, by_area


def _inverse_range(matches: Correspondences, left: Camera, right: Camera, baseline_m: float) -> Tensor:
    """Of places (N, 2) in both rectified cameras, along the left ray."""
    one, other = left.rays(matches.left_px), right.rays(matches.right_px)
    length: Tensor = torch.linalg.vector_norm(one, dim=-1)
    return (one - other)[:, 0] / baseline_m / length
