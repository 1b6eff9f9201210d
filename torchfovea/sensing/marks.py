"""Marks that tell things of one shape apart, as far as a receptive field resolves them; no images.

A field that averages over more than the detail of a mark shows grey. Its contrast falls with the field's width on the
object, as that of a Gaussian aperture does, and with it the share of the fields that can read the mark at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.layout import Retina

__all__ = ["field_width_rad", "read_marks", "readable"]


def field_width_rad(camera: Camera, retina: Retina, budget: Budget, px: Tensor) -> Tensor:
    """Angle that a receptive field averages over, its own width and a source pixel's together.

    Args:
        camera: of the eye.
        retina: its layout.
        budget: of the source image that the fields are read from.
        px: the fields' centres (..., 2).

    Returns:
        (...) [rad].
    """
    source = 0.0 if budget.source_px is None else 2 * retina.radius_px / budget.source_px
    step = torch.tensor([1e-2, 0.0], dtype=px.dtype, device=px.device)
    here, beside = (torch.nn.functional.normalize(camera.rays(p), dim=-1) for p in (px, px + step))
    per_px: Tensor = (beside - here).norm(dim=-1) / 1e-2
    return (retina.width_px(px).square() + source**2).sqrt() * per_px


def readable(width_m: Tensor, detail_m: float) -> Tensor:
    """Share of the fields of a width on the object that can read a mark of a detail, exp(−(width/detail)²), (...)."""
    return torch.exp(-(width_m / detail_m).square())


def read_marks(
    mark: Tensor, share: Tensor, count: int, generator: torch.Generator | Sequence[torch.Generator]
) -> Tensor:
    """What fields tell of the class that they look at: a share of them reads it, the others guess.

    Args:
        mark: the true class of what each field sees, int64 (..., N).
        share: of the fields like it that can read it, (..., N), see `readable`.
        count: K.
        generator: one, or one for each row of a batch (B, N).

    Returns:
        The likelihood of each reading under every class, (..., N, K): share + (1 − share)/K for the class read, the
        rest for each other.
    """
    chance = _uniform(mark.shape, generator, share)
    guess = (_uniform(mark.shape, generator, share) * count).long().clamp(max=count - 1)
    read = torch.where(chance < share, mark, guess)
    told = torch.nn.functional.one_hot(read, count).to(share)
    return share[..., None] * told + (1 - share[..., None]) / count


def _uniform(shape: torch.Size, generator: torch.Generator | Sequence[torch.Generator], like: Tensor) -> Tensor:
    """Numbers in [0, 1) drawn where the generators live; a row's do not depend on the batch."""
    if isinstance(generator, torch.Generator):
        return torch.rand(shape, generator=generator, dtype=like.dtype, device=generator.device).to(like)
    rows = [torch.rand(shape[1:], generator=g, dtype=like.dtype, device=g.device) for g in generator]
    return torch.stack(rows).to(like)
