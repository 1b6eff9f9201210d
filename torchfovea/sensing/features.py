"""What a neural network asks of a retina: padding for convolutions in the cortex, and where each receptive field is."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.layout import Retina
from torchfovea.setting import require

__all__ = ["place_features", "wrap_around"]

_STEPS = 4096  # of the integral over eccentricity


def wrap_around(image: Tensor, rings: int = 1, sectors: int = 1) -> Tensor:
    """Pad a cortical image for a convolution, which then needs no padding of its own.

    Args:
        image: (..., R, S), see `cortical`.
        rings: to add on either side: the innermost and the outermost ring again.
        sectors: to add on either side: those from the other end, for the angle is a circle.

    Returns:
        (..., R + 2 rings, S + 2 sectors).

    Raises:
        SettingError: for a negative padding, or more sectors than there are.

    Differentiable.
    """
    require(image.dim() >= 2, "image.shape", tuple(image.shape), "(..., R, S)")
    count = image.shape[-1]
    require(rings >= 0, "rings", rings, "0 or more")
    require(0 <= sectors <= count, "sectors", sectors, f"0 to {count}, the sectors of the image")
    inner, outer = (side.expand(*side.shape[:-2], rings, count) for side in (image[..., :1, :], image[..., -1:, :]))
    padded = torch.cat([inner, image, outer], -2)
    return torch.cat([padded[..., count - sectors :], padded, padded[..., :sectors]], -1)


def place_features(
    retina: Retina, octaves: int = 3, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> Tensor:
    """Where each receptive field (RF) is, for a network that takes RFs as tokens.

    The eccentricity is counted in RFs from the axis, so that neighbours are as far apart in the periphery as in the
    fovea: u(ρ) = ∫₀^ρ dr/W(r), as a share of its value at the border. From p = u (cos θ, sin θ) in the unit disc follow
    sin and cos of π 2ᵏ p for k = 0…octaves − 1 (as in Vaswani et al. 2017 of a sentence's words).

    Args:
        retina: the layout.
        octaves: K.
        device: of the result; None: the CPU.
        dtype: of the result; None: torch's default.

    Returns:
        (N, 3 + 4 K): p, the logarithm of the width as a share from the narrowest RF to the widest (0 where all are
        alike), and the sines and cosines; all in [−1, 1].

    Raises:
        SettingError: for a negative number of octaves.
    """
    require(octaves >= 0, "octaves", octaves, "0 or more")
    rho = torch.linspace(0, retina.radius_px, _STEPS, dtype=torch.float64)
    density = 1 / retina.width_px(torch.stack([rho, torch.zeros_like(rho)], -1))
    passed = torch.cat([density.new_zeros(1), torch.cumulative_trapezoid(density, rho)])
    px = retina.centers_px("cpu", torch.float64)
    away = torch.linalg.vector_norm(px, dim=-1)
    share = torch.from_numpy(np.interp(away.numpy(), rho.numpy(), (passed / passed[-1]).numpy()))
    place = px * (share / away.clamp(min=1e-12))[:, None]
    width = retina.width_px(px).log()
    span = width.max() - width.min()
    grade = (width - width.min()) / torch.where(span > 1e-9, span, torch.inf)
    wave = math.pi * 2.0 ** torch.arange(octaves, dtype=torch.float64)[:, None] * place[:, None]
    told = torch.cat([place, grade[:, None], wave.sin().flatten(1), wave.cos().flatten(1)], -1)
    return told.to(device or "cpu", dtype or torch.get_default_dtype())
