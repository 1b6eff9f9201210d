"""Foveated plane sweep: stereo matching in the cortical domain, from images to correspondences with their variance.

For every receptive field (RF) of the left eye hypotheses of inverse depth are tried, each as far from the next as the
two retinas can tell apart there: an RF on the periphery is wide and needs few. A hypothesis takes the RF's
neighbourhood into the right image, which is read as wide as the wider of the two RFs that would see it, and is judged
by the correlation (ZNCC) of the neighbourhoods on the cortical grid. Penalties for steps between neighbours, passed
along rings and sectors (`torchfovea.stereo.semiglobal`), settle what single neighbourhoods cannot. The winner is then
refined on neighbourhoods that follow its surface, which also tells its variance (`torchfovea.stereo.subpixel`).

Nothing is rectified: the eyes may be verged, and pinholes or fisheyes. The choice of the winner is piecewise constant
in the images; everything after it is differentiable.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.rounding import unrounded
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences, eye_sigma_px, inlier_share
from torchfovea.sensing.kinship import lasting_share
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require
from torchfovea.stereo.confidence import field_clues
from torchfovea.stereo.costs import left_eye, project, sheet_rays
from torchfovea.stereo.maps import checked_range
from torchfovea.stereo.sheets import sheets
from torchfovea.stereo.surfaces import Sweep, match_sheet
from torchfovea.stereo.views import Views
from torchfovea.stereo.visibility import unrivalled

__all__ = ["Sweep", "SweepRange", "Volume", "match_sweep"]


class SweepRange(NamedTuple):
    """What was found along the left eye's rays.

    Attributes:
        inverse_range: (..., N) [1/m] from the left eye; 0 where invalid.
        sigma: (..., N), its standard deviation by the images alone, without the RFs' own width; 0 where
            invalid.
        correlation: (..., N) of the neighbourhoods, up to 1; 0 where invalid.
        valid: bool (..., N).
        clues: of how far each can be trusted (..., N).
    """

    inverse_range: Tensor
    sigma: Tensor
    correlation: Tensor
    valid: Tensor
    clues: Clues

    def take(self, index: int | Tensor) -> SweepRange:
        """Every part at an index of the first axis: one pair of a batch (B, N), or some receptive fields (N,)."""
        inverse_range, sigma, correlation, valid = (part[index] for part in self[:4])
        return SweepRange(inverse_range, sigma, correlation, valid, self.clues.take(index))


class Volume(NamedTuple):
    """Where to look: a volume of interest, such as a memory gives (paper Sec. 8).

    It limits the search and is no prior: fused with the memory it came from, the result does not count twice.

    Attributes:
        least: (N,) or (B, N), least inverse range along each left RF's ray, from the left eye [1/m]; 0: however far.
        most: the same shape, greatest; infinite: however near.
    """

    least: Tensor
    most: Tensor


@unrounded
def match_sweep(
    views: Views,
    retina: Retina | None,
    params: Sweep | None = None,
    budget: Budget | None = None,
    nearest_range_m: float = 0.3,
    farthest_range_m: float = math.inf,
    volume: Volume | None = None,
) -> tuple[Correspondences, SweepRange]:
    """Match two images on the retinas themselves.

    Args:
        views: the images with their cameras, or a batch of them.
        retina: of both.
        params: the sweep's parameters.
        budget: the error budget; its `source_px` is replaced by the images' own size unless it is None.
        nearest_range_m: nearest depth that is tried (beyond 60 degrees from the axis: half the range).
        farthest_range_m: farthest depth; infinite by default.
        volume: where to look, for every left RF; None: everywhere between these.

    Returns:
        Correspondences (..., N) in the pixels of `Views.cameras`, one per RF of the left eye, batched as the images;
        right_sigma_px has the variance of the match beside the budget's. And the inverse ranges they come from.
        Invalid: RFs whose counterpart is off the right retina or image, textureless or ambiguous neighbourhoods, RFs
        that others contradict, and depths out of range.

    Raises:
        SettingError: without a retina, for images of fewer than 8 pixels, impossible ranges, and a volume that does not
            fit the retina.

    Differentiable in the images where valid; zero gradient elsewhere.
    """
    require(retina is not None, "sensor.layout", "every_pixel", "a retina, log_polar or uniform, for matcher=sweep")
    assert retina is not None
    size = tuple(views.left.shape)
    require(views.source_px >= 8, "left.shape", size, "at least 8 pixels on either side")
    params, budget = params or Sweep(), views.told(budget)
    widest = tuple(1 / depth for depth in reversed(checked_range(nearest_range_m, farthest_range_m)))
    pair = views.grey()
    batch, eye = len(pair) // 2, left_eye(pair, views, retina)
    left_px = retina.centers_px(pair.device, pair.dtype)
    ray = sheet_rays(eye, left_px)
    length = ray.detach().square().sum(-1).sqrt()
    low, high = (length.new_full((1, 1), bound) for bound in widest)
    if volume is not None:
        low, high = (bound.clamp(*widest) for bound in _depths(volume, retina, length.expand(batch, -1)))
    parts = [
        match_sheet(eye, sheet, params, low, high) for sheet in sheets(retina, 1 / eye.scale, pair.device, pair.dtype)
    ]
    rf = torch.cat([own for own, _, _ in parts])
    order = torch.empty_like(rf).scatter_(0, rf, torch.arange(len(rf), device=rf.device))
    values = torch.cat([values for _, values, _ in parts], -1)
    rho, variance, correlation, unit, misfit = values.gather(-1, order.expand_as(values)).unbind(1)
    valid = torch.cat([found for _, _, found in parts], -1)[:, order]

    sigma = torch.where(valid, variance, torch.ones_like(variance)).sqrt()
    u, v, seen = project(eye, ray, torch.stack([rho - sigma, rho, rho + sigma], 1))
    right_px = columns(u[:, 1], v[:, 1])
    valid = valid & seen[:, 1] & views.holds(right_px.detach(), retina, right=True)
    slack = unit.detach()  # noise may carry a match past the last hypothesis
    valid = valid & (rho.detach() >= low - slack) & (rho.detach() <= high + slack)
    square = ((u[:, 2] - u[:, 0]).square() + (v[:, 2] - v[:, 0]).square()) / 4
    motion = square.detach().sqrt()
    hidden_px = None
    if params.left_right:
        apart = rho.detach() * motion / sigma.detach()
        valid, hidden_px = unrivalled(retina, eye.scale, right_px.detach(), apart, misfit, valid)
    right_px = torch.where(valid[..., None], right_px, left_px)
    zero = torch.zeros_like(rho)
    match_px = torch.where(valid, square, zero)
    noise_px = torch.where(valid, motion, zero) * eye.scale
    slope = torch.where(valid, noise_px / sigma.detach(), zero)
    clues = field_clues(torch.where(valid, rho.detach(), zero), valid, slope, retina, 1 / eye.scale)
    clues = clues._replace(
        noise_px=noise_px, mismatch=torch.where(valid, 1 - correlation.detach(), zero), hidden_px=hidden_px
    )
    left_sigma = eye_sigma_px(budget, retina, left_px, clues).expand(batch, -1)
    right_sigma = (eye_sigma_px(budget, retina, right_px, clues).square() + budget.claim**2 * match_px).sqrt()
    both = (left_sigma.square() + right_sigma.square()) * eye.scale**2
    matches = Correspondences(
        left_px.expand(batch, -1, -1),
        right_px,
        left_sigma,
        right_sigma,
        valid,
        valid * inlier_share(budget, clues),
        (retina.width_px(left_px) / 2).expand(batch, -1),
        None if budget.source_px is None else lasting_share(budget, clues, both),
    )
    inverse_range, sigma, correlation = (
        torch.where(valid, x, zero) for x in (rho / length, sigma / length, correlation)
    )
    found = SweepRange(inverse_range, sigma, correlation, valid, clues)
    if views.left.dim() == 3:
        return matches.take(0), found.take(0)
    return matches, found


def _depths(volume: Volume, retina: Retina, length: Tensor) -> tuple[Tensor, Tensor]:
    """A volume's least and greatest inverse depth, (B, N)."""
    for name, value in zip(Volume._fields, volume, strict=True):
        fits = value.shape in ((retina.count,), tuple(length.shape))
        require(fits, f"volume.{name}.shape", tuple(value.shape), f"({retina.count},) or {tuple(length.shape)}")
        require(not bool(value.isnan().any()), f"volume.{name}", "NaN", "numbers")
    require(bool((volume.least <= volume.most).all()), "volume.most", "less than volume.least", "at least as much")
    least, most = (bound.detach().to(length) for bound in volume)
    return least * length, most * length
