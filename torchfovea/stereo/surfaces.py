"""Surfaces on one sheet of an eye: the best hypotheses of inverse depth, and their refinement with its variance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.machine import Loops, columns_of, loops
from torchfovea.sensing.camera import Pinhole
from torchfovea.setting import check_types, require
from torchfovea.stereo.acuity import level_of
from torchfovea.stereo.costs import Eye, Hypotheses, Looks, correlate, inverse_depths, own_values, project, sheet_rays
from torchfovea.stereo.semiglobal import RUN_IN, SEGMENT, aggregate
from torchfovea.stereo.sheets import Sheet, nearest_rf, read_sheet
from torchfovea.stereo.subpixel import Neighbourhood, smoothed, steps_per_width, subpixel

__all__ = ["Estimate", "Sweep", "Winner", "match_sheet", "refine", "win"]

CHUNK = 100_000  # cells times hypotheses handled at once, so that they stay in the cache


@dataclass(frozen=True)
class Sweep:
    """Parameters of the sweep.

    Attributes:
        window: half the side of the neighbourhoods that choose the winner, in RFs.
        refine_window: half the side of those that refine it.
        per_width: hypotheses per RF width of motion on the right retina.
        hypotheses: at most so many; beyond, they lie further apart.
        smooth_small: penalty of a step to the next hypothesis between neighbours, as a correlation.
        smooth_large: penalty of a larger step.
        contrast: difference between neighbours' values at which the large penalty is halved.
        noise: standard deviation of the images' noise, of a range of 1.
        uniqueness: by how much the second-best surface's cost must exceed the best's, as a share of it.
        correlation: least correlation of a match.
        left_right: whether RFs that claim one place of the right eye from different depths are settled
            (`torchfovea.stereo.visibility`).
        winner_widths: standard deviation of a surface's refinements about their surroundings', in RF widths; what is
            known of a match without texture is what is known of its surroundings.
        temperature: scales the variance that the images give.
        volume: where to look: `all`, or `memory`: nothing behind the surfaces that the memory is sure of
            (`torchfovea.memory.expected`).
        volume_sigmas: how far behind these it still looks, in standard deviations of their inverse range.
    """

    window: int = 1
    refine_window: int = 2
    per_width: float = 1.5
    hypotheses: int = 256
    smooth_small: float = 0.2
    smooth_large: float = 2.5
    contrast: float = 0.2
    noise: float = 0.004
    uniqueness: float = 0.05
    correlation: float = 0.5
    left_right: bool = True
    winner_widths: float = 0.2
    temperature: float = 1.0
    volume: str = "all"
    volume_sigmas: float = 3.0

    def __post_init__(self) -> None:
        """Raise SettingError for what the sweep cannot run with."""
        check_types(self, "matcher.")
        for name in ("window", "refine_window"):
            # a sheet keeps four cells of context
            value = getattr(self, name)
            require(value in (1, 2, 3), f"matcher.{name}", value, "1, 2 or 3 receptive fields")
        require(0.1 <= self.per_width <= 10, "matcher.per_width", self.per_width, "0.1 to 10")
        require(self.hypotheses >= 8, "matcher.hypotheses", self.hypotheses, "a whole number, at least 8")
        large = self.smooth_small <= self.smooth_large < math.inf
        require(0 <= self.smooth_small < math.inf, "matcher.smooth_small", self.smooth_small, "0 or more")
        require(large, "matcher.smooth_large", self.smooth_large, f"at least smooth_small = {self.smooth_small}")
        require(self.volume in ("all", "memory"), "matcher.volume", self.volume, "all or memory")
        require(-1 <= self.correlation < 1, "matcher.correlation", self.correlation, "-1 to less than 1")
        require(0 <= self.uniqueness < math.inf, "matcher.uniqueness", self.uniqueness, "0 or more")
        for name in ("contrast", "noise", "winner_widths", "temperature", "volume_sigmas"):
            require(getattr(self, name) > 0, f"matcher.{name}", getattr(self, name), "more than 0")


class Winner(NamedTuple):
    """The best hypotheses on a sheet, piecewise constant in the images; (B, R, S) each.

    Attributes:
        rho: inverse depth, to a quarter of a hypothesis [1/m].
        step: distance of hypotheses there.
        clear: whether no other surface fits nearly as well.
    """

    rho: Tensor
    step: Tensor
    clear: Tensor


class Estimate(NamedTuple):
    """Refined on a sheet; (B, R, S) each.

    Attributes:
        rho: inverse depth [1/m].
        variance: of it.
        correlation: of the neighbourhoods.
        unit: inverse depth that moves the match by the wider RF's width.
        misfit: mean square difference of the images there.
        sharp: whether the refinement stays with its winner.
    """

    rho: Tensor
    variance: Tensor
    correlation: Tensor
    unit: Tensor
    misfit: Tensor
    sharp: Tensor


def match_sheet(eye: Eye, sheet: Sheet, params: Sweep, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Match a sheet's RFs with the other eye.

    Args:
        eye: whose sheet it is.
        sheet: with n RFs.
        params: of the sweep.
        low: (B, N), least inverse depth of every RF of the retina [1/m], or (1, 1) for all.
        high: greatest, likewise.

    Returns:
        The RFs (n,); their inverse depth, its variance, correlation, unit and misfit, (B, 5, n); and bool (B, n),
        whether these can be believed. Differentiable in the images.
    """
    winner = win(eye, sheet, params, low, high)
    estimate = refine(eye, sheet, winner, params)
    good = winner.clear & estimate.sharp & (estimate.correlation.detach() >= params.correlation)
    values = torch.stack(estimate[:5], 1)
    return (sheet.rf, *read_sheet(sheet, values, winner.rho, good, 1.5 * winner.step))


class _Trial(NamedTuple):
    """What is tried on a sheet.

    Attributes:
        own: what its cells see.
        ray: (B, R, S, 3), see `sheet_rays`.
        hypotheses: of inverse depth.
        bounds: of it, (B or 1, R, S) each, and how far beyond these each hypothesis (B, D) may lie; None: everywhere.
    """

    own: Looks
    ray: Tensor
    hypotheses: Hypotheses
    bounds: tuple[Tensor, Tensor, Tensor] | None


@torch.no_grad()
def win(eye: Eye, sheet: Sheet, params: Sweep, low: Tensor, high: Tensor) -> Winner:
    """The best hypotheses between bounds, see `match_sheet`."""
    low, high = (_at_cells(eye, sheet, bound) for bound in (low, high))
    least, most = low.amin((1, 2)).expand(len(eye.R)), high.amax((1, 2)).expand(len(eye.R))
    most = torch.maximum(most, least + 1e-6)
    tried = inverse_depths(eye, sheet, least, most, params.per_width, params.hypotheses)
    bounds = None
    if low.shape[-1] > 1:
        # the widest bound is none; those that lie between two hypotheses leave the nearer one
        low = torch.where(low > least[:, None, None], low, -math.inf)
        high = torch.where(high < most[:, None, None], high, math.inf)
        gap = tried.rho.diff(dim=1) / 2
        bounds = low, high, torch.maximum(torch.cat([gap[:, :1], gap], 1), torch.cat([gap, gap[:, -1:]], 1))
    own = own_values(eye, sheet, params.window, params.noise)
    trial = _Trial(own, sheet_rays(eye, sheet.px), tried, bounds)
    library = loops(eye.others, trial.ray, tried.rho)
    if library is not None:
        return _by_loops(library, eye, sheet, params, trial)
    return _best(_costs(eye, sheet, params, trial), sheet, params, trial)


def _costs(eye: Eye, sheet: Sheet, params: Sweep, trial: _Trial) -> Tensor:
    """What each hypothesis costs at each cell, (B, D, R, S), up to 1; infinite past a pair's own."""
    rho, number = trial.hypotheses
    cost = trial.ray.new_empty(*rho.shape, *sheet.width_px.shape)
    chunk = max(1, CHUNK // trial.ray[..., 0].numel())
    for k in range(0, rho.shape[1], chunk):
        some = rho[:, k : k + chunk, None, None]
        z, seen = correlate(eye, sheet, trial.own, trial.ray, some, params.window, params.noise)
        if trial.bounds is not None:
            low, high, slack = trial.bounds
            reach = slack[:, k : k + chunk, None, None]
            seen = seen & (some >= low[:, None] - reach) & (some <= high[:, None] + reach)
        cost[:, k : k + chunk] = torch.where(seen, 1 - z, torch.ones_like(z)).clamp_(max=1)
    if len(rho) > 1:
        past = torch.arange(rho.shape[1], device=rho.device) >= number[:, None]
        cost.masked_fill_(past[..., None, None], math.inf)
    return cost


def _best(cost: Tensor, sheet: Sheet, params: Sweep, trial: _Trial) -> Winner:
    """The hypotheses that cost least with their neighbours'."""
    (rho, number), values = trial.hypotheses, trial.own.values[:, 0]
    total = aggregate(cost, values, sheet.closed, params.smooth_small, params.smooth_large, params.contrast)
    best = total.amin(0)
    index = torch.arange(len(total), device=rho.device, dtype=torch.int16)[:, None, None, None]
    win = torch.where(total == best, index, len(total)).amin(0).long()
    inner = torch.minimum(win.clamp(min=1), number[:, None, None] - 2)
    before, here, after = (total.gather(0, (inner + k)[None])[0] for k in (-1, 0, 1))
    for k in range(-2, 3):  # what is left are other surfaces
        total.scatter_(0, (win + k).clamp(0, len(total) - 1)[None], math.inf)
    clear = total.amin(0) - best >= params.uniqueness * best
    bend = before - 2 * here + after
    part = torch.where(bend > 0, (before - after) / (2 * bend.clamp(min=1e-9)), torch.zeros_like(bend))
    part = (4 * part.clamp(-0.5, 0.5)).round() / 4
    first, middle, third = (rho.gather(1, (inner + k).flatten(1)).view_as(best) for k in (-1, 0, 1))
    step = torch.where(part < 0, middle - first, third - middle)
    return Winner(middle + part * step, step, clear)


def _by_loops(library: Loops, eye: Eye, sheet: Sheet, params: Sweep, trial: _Trial) -> Winner:
    """`_costs` and `_best` by the loops of sweep.c; of cameras that are no pinholes the latter."""
    (rho, number), own = trial.hypotheses, trial.own
    shape = (len(rho), *sheet.width_px.shape)
    camera, (across, down) = eye.other, eye.other_middle or eye.middle
    seen: tuple[Any, ...] = (0, 0, 0, None, None, None)
    given, lens = None, (0.0, 0.0, 0.0)
    low, high, slack = trial.bounds or (None, None, None)
    if isinstance(camera, Pinhole):
        level = level_of(sheet.width_px, eye.scale).clamp(max=eye.others.shape[1] - 1)
        seen = (*eye.others.shape[1:], eye.others.contiguous(), level.contiguous(), eye.t.contiguous())
        lens = (camera.focal_px, camera.cx_px, camera.cy_px)
        if trial.bounds is not None:
            low, high = (bound.expand(shape).contiguous() for bound in trial.bounds[:2])
    else:
        given, low, high, slack = _costs(eye, sheet, params, trial), None, None, None
    looks = (part.expand(len(rho), 1, *shape[1:]).contiguous() for part in own)
    cells = (*shape, sheet.closed, rho.shape[1], rho.contiguous(), number, columns_of(trial.ray), *looks)
    numbers = (params.noise, params.smooth_small, params.smooth_large, params.contrast, params.uniqueness)
    found = Winner(rho.new_empty(shape), rho.new_empty(shape), torch.empty(shape, dtype=torch.bool))
    library(
        "sweep",
        (*cells, low, high, slack, given),
        (*seen, *map(float, (*lens, eye.retina.radius_px, eye.scale, across, down))),
        (params.window, SEGMENT, RUN_IN, *map(float, numbers)),
        tuple(found),
    )
    return found


def _at_cells(eye: Eye, sheet: Sheet, bound: Tensor) -> Tensor:
    """A bound of every RF (B, N) at a sheet's cells, (B, R, S); one that is the same everywhere (1, 1) as (1, 1, 1)."""
    if bound.shape[-1] == 1:
        return bound[..., None]
    cell = nearest_rf(eye.retina, 1 / eye.scale, sheet.px)
    return bound.index_select(1, cell.flatten()).view(-1, *cell.shape)


def refine(eye: Eye, sheet: Sheet, winner: Winner, params: Sweep) -> Estimate:
    """Winners moved to where the images agree best, on neighbourhoods that follow their surface."""
    with torch.no_grad():
        ray, surface = sheet_rays(eye, sheet.px), smoothed(winner.rho, 1.5 * winner.step)
        unit = winner.step * steps_per_width(eye, sheet, ray, surface, winner.step)
        seen = project(eye, ray, surface[:, None])[2]
        trusted = winner.clear & seen[:, 0] & eye.retina.inside(sheet.px)
    about = Neighbourhood(params.refine_window, params.noise, params.winner_widths)
    offset = subpixel(eye, sheet, surface, unit, trusted, about)
    sharp = offset.value.detach().abs() < 1
    variance = params.temperature * offset.variance
    rho = surface + offset.value.clamp(-1, 1) * unit
    return Estimate(rho, variance * unit * unit, offset.correlation, unit, offset.misfit, sharp)
