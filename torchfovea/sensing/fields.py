"""Looks through some of a retina's receptive fields, drawn by chance, that stand for all of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.layout import Retina

__all__ = ["draw_fields", "for_all"]


def draw_fields(count: int, sample: int | None, generator: torch.Generator) -> Tensor | None:
    """Some of `count` receptive fields, each with the same chance, in ascending order; None: all of them."""
    if sample is None or sample >= count:
        return None
    chosen = torch.zeros(count, dtype=torch.bool, device=generator.device)
    chosen[torch.randperm(count, generator=generator, device=generator.device)[:sample]] = True
    return chosen.nonzero()[:, 0].cpu()


def for_all(matches: Correspondences, retina: Retina) -> Correspondences:
    """Correspondences (..., N) of some receptive fields, each standing for as many more as a look left out.

    Before any are dropped: what is missing then counts as not looked through.
    """
    share = retina.count / max(1, matches.valid.shape[-1])
    return matches._replace(support_px=matches.supported(retina) * math.sqrt(max(1.0, share)))
