"""What `torchfovea sense` says of its points: how many, how exact and how honest, by field and by area."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.experiments.pairs import Pair
from torchfovea.experiments.regions import hidden_places
from torchfovea.gaussian import Gaussian
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations
from torchfovea.stereo.rectified import RectifiedMatch, match_disparity

__all__ = ["beside", "figures_of", "read_map"]

LEVELS = (0.5, 0.9, 0.95, 0.99)
OUTLIER = 5.0  # standard deviations


def figures_of(
    pair: Pair,
    observed: Observations,
    points: Gaussian,
    match: RectifiedMatch,
    chosen: Tensor,
    retina: Retina | None,
    gaze_px: tuple[float, float] | None,
) -> dict[str, float]:
    """Counts, and errors and honesty against the true disparity where the pair has one.

    The truth lies on the left ray, so that one degree of freedom is left to err in: the inverse range. Coverage is that
    of the Gaussian over all valid points; ``inlier_*`` is over those whose inlier probability exceeds 1/2.

    Returns:
        Each figure by field; and as ``*_by_area``, every field weighted by the area that it stands for.
    """
    px, valid = match.correspondences.left_px, observed.valid
    area = torch.ones_like(px[:, 0]) if retina is None else retina.width_px(px).square()
    kinds = {"": torch.ones_like(area), "_by_area": area}
    inlier = valid.to(area) if observed.inlier is None else observed.inlier
    figures: dict[str, float] = {"points": int(chosen.sum())}
    figures |= {f"valid_fraction{k}": _mean(valid, w) for k, w in kinds.items()}
    figures |= {f"inlier_mean{k}": _mean(inlier, w * valid) for k, w in kinds.items() if bool(valid.any())}
    if pair.disparity is None:
        return figures
    depth = pair.depth_m(read_map(pair, pair.disparity, None, retina, gaze_px))
    length = match.camera_left.rays(px).norm(dim=-1)
    hidden = read_map(pair, hidden_places(pair.disparity).float(), None, retina, gaze_px) > 0.5
    known = torch.isfinite(depth)
    error = observed.mean[:, 2] - 1 / (depth * length)
    z = (error / observed.cov[:, 5].sqrt()).abs()
    miss = (points.mean[:, 2] - depth).abs()
    for suffix, weight in kinds.items():
        figures[f"hidden_valid{suffix}"] = _mean(valid, weight * (hidden & known))
        here = weight * (valid & known)
        if not bool(here.any()):
            continue
        figures[f"median_error_m{suffix}"] = _median(miss, here)
        figures[f"nees_mean{suffix}"] = _mean(z.square(), here * (z <= OUTLIER))
        for level in LEVELS:
            inside = z <= math.sqrt(2) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
            figures[f"coverage_{round(100 * level)}{suffix}"] = _mean(inside, here)
            if level in (0.5, 0.95):
                figures[f"inlier_coverage_{round(100 * level)}{suffix}"] = _mean(inside, here * (inlier > 0.5))
        figures[f"outlier_share{suffix}"] = _mean(z > OUTLIER, here)
        figures[f"inlier_share{suffix}"] = _mean(inlier > 0.5, here)
        figures[f"nll{suffix}"] = _mean(z.square() / 2 + (2 * math.pi * observed.cov[:, 5]).log() / 2, here)
    return figures


def beside(
    pair: Pair,
    observed: Observations,
    points: Gaussian,
    plain: Tensor,
    retina: Retina,
    gaze_px: tuple[float, float] | None,
) -> dict[str, float]:
    """Both matchers at the receptive fields where both found something and the truth is known."""
    assert pair.disparity is not None
    depth, peer = pair.depth_m(read_map(pair, pair.disparity, None, retina, gaze_px)), pair.depth_m(plain)
    common = observed.valid & torch.isfinite(depth) & torch.isfinite(peer)
    figures = {"plain_valid_fraction": float(torch.isfinite(peer).double().mean())}
    if bool(common.any()):
        figures["common_median_error_m"] = float((points.mean[:, 2] - depth)[common].abs().median())
        figures["plain_common_median_error_m"] = float((peer - depth)[common].abs().median())
    return figures


def read_map(
    pair: Pair, values: Tensor, valid: Tensor | None, retina: Retina | None, gaze_px: tuple[float, float] | None
) -> Tensor:
    """A disparity map read at the receptive fields, (N,); NaN where there is none [px of the image]."""
    match = match_disparity(
        values, pair.camera_left, pair.camera_right, pair.baseline_m, retina, gaze_px, valid, None, 1e-3
    )
    scale = pair.camera_left.focal_px / match.camera_left.focal_px
    found = match.correspondences
    shift = (found.left_px - found.right_px)[:, 0] * scale
    return torch.where(found.valid, shift, torch.full_like(shift, torch.nan))


def _mean(values: Tensor, weight: Tensor) -> float:
    """Weighted; NaN for no weight at all."""
    there = weight > 0
    return float((values[there].double() * weight[there]).sum() / weight.sum())


def _median(values: Tensor, weight: Tensor) -> float:
    """Weighted; the lower of two."""
    values, weight = values[weight > 0], weight[weight > 0]
    order = values.argsort()
    total = weight[order].cumsum(0)
    return float(values[order][int((total < total[-1] / 2).sum())])
