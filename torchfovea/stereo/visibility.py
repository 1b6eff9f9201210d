"""Whether both eyes can see what a match says, by the other matches of the same look. Not differentiable."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.stereo.costs import Eye

__all__ = ["unrivalled"]


@torch.no_grad()
def unrivalled(eye: Eye, rho: Tensor, limit: Tensor, correlation: Tensor, right_px: Tensor, valid: Tensor) -> Tensor:
    """Which RFs agree, to a limit, with the best correlated of those that claim their place of the right eye; (B, N).

    This is the left-right check as semi-global matchers do it, from one sweep. Places are cells of a lattice for every
    octave of RF widths; an RF asks that of its own octave, in which all RFs as narrow or narrower have their say.
    """
    retina, scale = eye.retina, eye.scale
    width = torch.maximum(retina.width_px(right_px), retina.width_px(retina.centers_px(rho.device, rho.dtype)))
    octave = torch.where(valid, torch.log2(width * scale).clamp(min=0).ceil(), torch.zeros_like(width)).long()
    out = valid
    for k in range(int(octave.max()) + 1):
        pitch = 2.0**k / scale
        reach = math.ceil(retina.radius_px / pitch)
        side = 2 * reach + 1
        column, row = ((right_px / pitch).round().clamp(-reach, reach).long() + reach).unbind(-1)
        voter = valid & (octave <= k)
        cell = torch.where(voter, row * side + column, side * side)
        lowest = rho.new_full((len(rho), side * side + 1), -math.inf)
        best = lowest.scatter_reduce(1, cell, correlation, "amax").gather(1, cell)
        told = torch.where(voter & (correlation == best), rho, torch.full_like(rho, -math.inf))
        theirs = lowest.scatter_reduce(1, cell, told, "amax").gather(1, cell)
        out = out & ~(voter & (octave == k) & ((theirs - rho).abs() > limit))
    return out
