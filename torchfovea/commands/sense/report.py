"""What `torchfovea sense` says of its points: how many, how exact and how honest, by field and by area."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.commands.shared.pairs import Pair
from torchfovea.commands.shared.regions import at_places, hidden_places
from torchfovea.gaussian import Gaussian, columns
from torchfovea.metrics import gaussian_nll, weighted_mean, weighted_median
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.triangulation import Observations
from torchfovea.stereo.maps import match_disparity
from torchfovea.stereo.views import Views

__all__ = ["beside", "image_seen", "match_figures", "read_at_fields"]

LEVELS = (0.5, 0.9, 0.95, 0.99)
OUTLIER = 5.0  # standard deviations


def match_figures(
    pair: Pair,
    views: Views,
    retina: Retina | None,
    px: Tensor,
    observed: Observations,
    points: Gaussian,
    chosen: Tensor,
) -> dict[str, float]:
    """Counts, and errors and honesty against the true disparity where the pair has one.

    The truth lies on the left ray, so that one degree of freedom is left to err in: the inverse range. Coverage is that
    of the Gaussian over all valid points; ``inlier_*`` is over those whose inlier probability exceeds 1/2. The
    receptive fields are at `px` (N, 2).

    Returns:
        Each figure by field; and as ``*_by_area``, every field weighted by the area that it stands for.
    """
    valid = observed.valid
    area = torch.ones_like(px[:, 0]) if retina is None else retina.width_px(px).square()
    on = views.holds(px, retina).to(area)
    kinds = {"": on, "_by_area": area * on}
    inlier = valid.to(area) if observed.inlier is None else observed.inlier
    figures: dict[str, float] = {"points": int(chosen.sum())}
    figures |= {f"valid_fraction{k}": weighted_mean(valid, w) for k, w in kinds.items()}
    figures |= {f"inlier_mean{k}": weighted_mean(inlier, w * valid) for k, w in kinds.items() if bool(valid.any())}
    if pair.disparity is None:
        return figures
    depth = pair.depth_m(read_at_fields(pair.disparity, views, retina))
    length = views.cameras(retina)[0].rays(px).norm(dim=-1)
    seen = ~hidden_places(pair.disparity) if pair.seen is None else pair.seen
    places = px * views.scale(retina) + px.new_tensor(views.origin_px(retina))
    known, hidden = torch.isfinite(depth), ~at_places(seen, places)
    error = observed.mean[:, 2] - 1 / (depth * length)
    z = (error / observed.cov[:, 5].sqrt()).abs()
    miss = (points.mean[:, 2] - depth).abs()
    for suffix, weight in kinds.items():
        figures[f"hidden_valid{suffix}"] = weighted_mean(valid, weight * (hidden & known))
        here = weight * (valid & known & ~hidden) if pair.seen is not None else weight * (valid & known)
        if not bool(here.any()):
            continue
        figures[f"median_error_m{suffix}"] = weighted_median(miss, here)
        figures[f"nees_mean{suffix}"] = weighted_mean(z.square(), here * (z <= OUTLIER))
        for level in LEVELS:
            inside = z <= math.sqrt(2) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
            figures[f"coverage_{round(100 * level)}{suffix}"] = weighted_mean(inside, here)
            if level in (0.5, 0.95):
                figures[f"inlier_coverage_{round(100 * level)}{suffix}"] = weighted_mean(inside, here * (inlier > 0.5))
        figures[f"outlier_share{suffix}"] = weighted_mean(z > OUTLIER, here)
        figures[f"inlier_share{suffix}"] = weighted_mean(inlier > 0.5, here)
        figures[f"nll{suffix}"] = weighted_mean(gaussian_nll(error, observed.cov[:, 5]), here)
    return figures


def beside(
    pair: Pair, views: Views, retina: Retina, observed: Observations, points: Gaussian, plain: Tensor
) -> dict[str, float]:
    """Both matchers at the receptive fields where both found something and the truth is known."""
    assert pair.disparity is not None
    depth, peer = pair.depth_m(read_at_fields(pair.disparity, views, retina)), pair.depth_m(plain)
    common = observed.valid & torch.isfinite(depth) & torch.isfinite(peer)
    figures = {"plain_valid_fraction": float(torch.isfinite(peer).double().mean())}
    if bool(common.any()):
        figures["common_median_error_m"] = float((points.mean[:, 2] - depth)[common].abs().median())
        figures["plain_common_median_error_m"] = float((peer - depth)[common].abs().median())
    return figures


def read_at_fields(values: Tensor, views: Views, retina: Retina | None, valid: Tensor | None = None) -> Tensor:
    """A disparity map read at the receptive fields, (N,); NaN where there is none [px of the image]."""
    found, _ = match_disparity(values, views, retina, nearest_range_m=1e-3, valid=valid)
    shift = (found.left_px - found.right_px)[:, 0] * views.scale(retina)
    return torch.where(found.valid, shift, torch.full_like(shift, torch.nan))


def image_seen(views: Views, retina: Retina | None) -> float:
    """Share of the left image that lies on the retina."""
    if retina is None:
        return 1.0
    height, width = views.left.shape[-2:]
    row, column = (torch.arange(0, n, max(1, n // 500), dtype=torch.float64) for n in (height, width))
    place = columns(*torch.broadcast_tensors(column, row[:, None]))
    there = (place - place.new_tensor(views.origin_px(retina))) / views.scale(retina)
    return float(retina.inside(there).double().mean())
