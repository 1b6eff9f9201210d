"""A portfolio of acquisitions, and the trivial policies that any claim must beat.

The policies return scores (..., N) for `acquisition.choose`; batches and generators are as there.

References:
    Hoffman, Brochu and de Freitas (2011), Portfolio allocation for Bayesian optimization.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import Generators, draw
from torchfovea.setting import require

__all__ = [
    "Hedge",
    "first_glance_scores",
    "hedge_choose",
    "hedge_start",
    "hedge_update",
    "oracle_scores",
    "random_scores",
    "raster_ranks",
    "raster_scores",
]


class Hedge(NamedTuple):
    """State of a GP-Hedge portfolio over K acquisitions.

    Attributes:
        gains: cumulated rewards of what each acquisition has nominated, (..., K).
    """

    gains: Tensor


def hedge_start(batch: Sequence[int], acquisitions: int, like: Tensor) -> Hedge:
    """A portfolio that trusts its acquisitions equally, for each row of `batch`, in the dtype and device of `like`."""
    return Hedge(torch.zeros(*batch, acquisitions, dtype=like.dtype, device=like.device))


def hedge_choose(state: Hedge, nominees: Tensor, eta: float, generator: Generators) -> tuple[Tensor, Tensor]:
    """Follow one acquisition's nominee, drawn with probability ∝ exp(η gain) (Hoffman et al. 2011, Algorithm 2).

    Args:
        state: the portfolio, gains (..., K).
        nominees: the cell that each acquisition would choose, (..., K) int64.
        eta: learning rate ≥ 0 in 1/reward; with rewards in [0, 1] over T choices, sqrt(8 ln K / T) is the theory's.
        generator: one, or one for each row.

    Returns:
        The cell, (...), and the acquisition followed, (...), both int64.

    Raises:
        SettingError: a negative eta; the number of generators is not the number of rows.
    """
    require(eta >= 0, "acquisition.eta", eta, "a number of at least 0")
    cumulated = torch.softmax(eta * state.gains, -1).cumsum(-1)
    lot = draw(torch.rand, (*state.gains.shape[:-1], 1), cumulated, generator)
    followed = (cumulated < lot).sum(-1, keepdim=True).clamp(max=state.gains.shape[-1] - 1)
    return nominees.gather(-1, followed)[..., 0], followed[..., 0]


def hedge_update(state: Hedge, nominees: Tensor, mean: Tensor) -> Hedge:
    """Reward every acquisition, followed or not, by the updated mean at its nominee.

    Args:
        state: the portfolio, gains (..., K).
        nominees: (..., K) int64; −1 (no eligible cell) gains nothing.
        mean: mean of the rewards *after* the look, (..., N).

    Returns:
        The new state.
    """
    gained = mean.expand(*nominees.shape[:-1], mean.shape[-1]).gather(-1, nominees.clamp_min(0))
    return Hedge(state.gains + torch.where(nominees >= 0, gained, 0.0))


def random_scores(mean: Tensor, generator: Generators) -> Tensor:
    """Uniform scores shaped as `mean` (..., N): every eligible cell is equally likely."""
    return draw(torch.rand, mean.shape, mean, generator)


def raster_ranks(directions: Tensor, spacing_deg: float) -> Tensor:
    """The place of each cell on a serpentine scan of the cells' extent, from the top row down, rows alternating.

    A grid of pan and tilt with equal spacing on the sphere; at each place the nearest cell, if within the spacing.

    Args:
        directions: the cells' unit vectors in the ego frame (x forward, y left, z up), (N, 3).
        spacing_deg: distance between neighbouring fixations, such as half the field of view.

    Returns:
        (N,) int64: 0, 1, 2, … along the scan, −1 for cells that are not on it. Not differentiable.

    Raises:
        SettingError: a spacing outside (0, 180).
    """
    require(0 < spacing_deg < 180, "spacing_deg", spacing_deg, "an angle between 0 and 180 degrees")
    cells = directions.detach()
    spacing = math.radians(spacing_deg)
    elevation = torch.atan2(cells[:, 2], torch.hypot(cells[:, 0], cells[:, 1]))
    azimuth = torch.atan2(cells[:, 1], cells[:, 0])
    ranks = torch.full((len(cells),), -1, dtype=torch.int64, device=cells.device)
    place = 0
    for row, up in enumerate(_centred(elevation.min().item(), elevation.max().item(), spacing)[::-1]):
        along = _centred(azimuth.min().item(), azimuth.max().item(), spacing / max(math.cos(up), 1e-6))
        for left in along if row % 2 else along[::-1]:
            point = (math.cos(up) * math.cos(left), math.cos(up) * math.sin(left), math.sin(up))
            cosine, cell = (cells @ cells.new_tensor(point)).max(0)
            if cosine >= math.cos(spacing) and ranks[cell] < 0:
                ranks[cell] = place
                place += 1
    return ranks


def raster_scores(ranks: Tensor, last: Tensor) -> Tensor:
    """Scores that follow a scan: highest for the next place after the last choice, cyclically.

    Args:
        ranks: from `raster_ranks`, (N,).
        last: the last cell chosen, (...) int64; −1 at the start.

    Returns:
        (..., N) float64; −inf for cells off the scan, which are chosen only when no cell on it is eligible.
    """
    count = int(ranks.max()) + 1
    position = torch.where(last >= 0, ranks[last.clamp_min(0)], -1)
    ahead = torch.remainder(ranks - position[..., None] - 1, max(count, 1))
    return torch.where(ranks >= 0, -ahead.to(torch.float64), -torch.inf)


def first_glance_scores(mean: Tensor, chosen: Tensor) -> Tensor:
    """Greedy on what the first glance showed, and never moving again while that cell stays eligible.

    Args:
        mean: mean of the reward, (..., N).
        chosen: the cell chosen after the first glance, (...) int64; −1 before there is one.

    Returns:
        (..., N): the mean, with +inf at the chosen cell.
    """
    return torch.where(torch.arange(mean.shape[-1], device=mean.device) == chosen[..., None], torch.inf, mean)


def oracle_scores(directions: Tensor, best: Tensor) -> Tensor:
    """Cosine between each cell (N, 3) or (..., N, 3) and the true best direction (..., 3), as (..., N): look there."""
    return (directions * best[..., None, :]).sum(-1)


def _centred(low: float, high: float, spacing: float) -> list[float]:
    """Evenly spaced places, `spacing` apart, that cover [low, high] symmetrically."""
    count = max(1, math.ceil((high - low) / spacing - 1e-9))
    return [(low + high) / 2 + (i - (count - 1) / 2) * spacing for i in range(count)]
