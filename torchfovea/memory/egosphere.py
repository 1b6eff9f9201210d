"""The memory, a sensory ego-sphere: what the observer knows, one Gaussian for each direction cell (Sec. 5).

In the Cartesian charts a cell holds the point (x, y, z), as printed. In inverse range it holds a *patch*, the plane
q·X = 1 around its direction p. Seen from E, inverse range is linear in the direction, ρ(u) = q·u, so that observations
on different rays of one cell enter exactly, wherever in the cell they fall; a slanted floor neither biases the range
nor passes for noise. In the cell's own frame (e₁, e₂, p) the state is (g₁, g₂, ρ), the slope of the inverse range and
the inverse range itself; an observation of ρ in direction u is the row (u·e₁, u·e₂, u·p) of a linear filter.

How a look enters is `torchfovea.memory.update`'s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.finite import require_tensor
from torchfovea.gaussian import Gaussian, Information, columns, gaussian_from_information
from torchfovea.memory.nearest import CellIndex, build_index, neighbour_spacing_rad
from torchfovea.memory.pooling import nearness
from torchfovea.setting import check_types, require

__all__ = [
    "Fusion",
    "Memory",
    "Prior",
    "belief",
    "blend",
    "cartesian_belief",
    "cartesian_from_patches",
    "check_chart",
    "empty_memory",
    "forget",
    "inverse_range_belief",
    "prior_information",
    "reducible",
    "trust",
]

FAR_M = 1000.0  # points of patches lie no farther out


class Memory(NamedTuple):
    """What is known, and all that it takes to know more; its size never changes. Build it with `empty_memory`.

    Attributes:
        cells: unit directions in E, (..., Nx, 3) (Eq. 20).
        information: vector (..., Nx, 3) and packed matrix (..., Nx, 6), of (x, y, z) or of a patch (g₁, g₂, ρ). These
            sums are kept in float64 whatever the cells are: looks that are all alike tell ever more of one direction,
            and in float32 their rounding would come to outweigh what is known of the others.
        bearing: how well the patches' places across the line of sight are known [1/rad²], (..., Nx); zero in x, y, z.
        looks: how many saccades brought each cell something, (..., Nx); 0 is unseen.
        lasting: (..., Nx, 2), what says how much of a patch's error no further look takes away. With u the variance of
            a look's inverse range and l what of it lasts: the sums over looks of √l/u and of l/u², see `belief`.
        votes: (..., Nx, 2), looks for and against what the cell believes, see `torchfovea.memory.voting`.
        lookup: finds the cell of a direction.
        spacing_rad: distance of each cell to its neighbours, (..., Nx).
        prior: what a cell believes before it is seen.
        chart: of the information, `inverse_range` or `cartesian`.
        axis: where the left eye looked last, unit (..., 3) in E; None: there was no look.
        classes: what the cells show, (..., Nx, K), see `torchfovea.memory.classes`; None: nobody asks.
    """

    cells: Tensor
    information: Information
    bearing: Tensor
    looks: Tensor
    lasting: Tensor
    votes: Tensor
    lookup: CellIndex
    spacing_rad: Tensor
    prior: Prior
    chart: str
    axis: Tensor | None = None
    classes: Tensor | None = None


@dataclass(frozen=True)
class Prior:
    """What a cell believes before it is seen.

    Attributes:
        mean: range along the cell [m] in the Cartesian charts, inverse range [1/m] in the other.
        std: the same unit; the Cartesian prior is isotropic.
        bearing_std: across the line of sight [rad], inverse range only.
        slope_std: of the inverse range over the angle [1/m/rad], inverse range only. A plane at distance d from E has a
            slope of at most 1/d.
    """

    mean: float = 0.4
    std: float = 0.4
    bearing_std: float = 0.1
    slope_std: float = 1.5

    def __post_init__(self) -> None:
        """Raise SettingError unless all are positive, of a size whose square, and its inverse, float32 can hold."""
        check_types(self, "prior.")
        for name in ("mean", "std", "bearing_std", "slope_std"):
            value = getattr(self, name)
            require(1e-9 <= value <= 1e9, f"prior.{name}", value, "a positive number, 1e-9 to 1e9")


@dataclass(frozen=True)
class Fusion:
    """How observations enter the memory.

    Attributes:
        name: `inverse_range` (patches), `aligned` (each observation first turned onto its cell's direction, Cartesian)
            or `printed` (the paper's, Cartesian, without the turn: it pulls toward the eye).
        gate_deg: observations farther than this from their cell are dropped, unless their receptive field covers it.
        gate_spacing: the gate is at least this many times the cell's distance to its neighbour.
        fill: whether a cell within a receptive field's cover that got no observation takes the nearest one.
        conflict: patches only. Two inverse ranges this many standard deviations apart are two surfaces, and a cell
            believes the one that most looks speak for; inf: they are averaged.
        window: patches only. How many looks the votes for and against a surface remember: as long, about, as the
            memory holds against the looks to one that has gone.
        nearest_m: patches only. Nearest range that a false match shows: they are even in inverse range up to here.
        half_life: saccades after which half of the information is forgotten; inf: never.
    """

    name: str = "inverse_range"
    gate_deg: float = 0.8
    gate_spacing: float = 2.0
    fill: bool = True
    conflict: float = 4.0
    window: float = 5.0
    nearest_m: float = 0.3
    half_life: float = math.inf

    def __post_init__(self) -> None:
        """Raise SettingError for an unknown name or a size out of range."""
        check_types(self, "fusion.")
        names = ("inverse_range", "aligned", "printed")
        require(self.name in names, "fusion.name", self.name, "one of " + ", ".join(names))
        for name in ("gate_deg", "gate_spacing"):
            require(0 <= getattr(self, name) <= 1e6, f"fusion.{name}", getattr(self, name), "0 to 1e6")
        require(self.conflict > 0, "fusion.conflict", self.conflict, "a positive number of standard deviations")
        require(1 <= self.window < math.inf, "fusion.window", self.window, "a number of looks, at least 1")
        require(0 < self.nearest_m < math.inf, "fusion.nearest_m", self.nearest_m, "a positive distance in metres")
        require(self.half_life > 0, "fusion.half_life", self.half_life, "a positive number of saccades")

    @property
    def votes(self) -> bool:
        """Whether looks vote for and against surfaces (`torchfovea.memory.voting`)."""
        return self.chart == "inverse_range" and self.conflict < math.inf

    @property
    def chart(self) -> str:
        """The chart that the memory is kept in."""
        return "inverse_range" if self.name == "inverse_range" else "cartesian"


def _prior_scalars(cells: Tensor, prior: Prior, chart: str) -> tuple[list[tuple[Tensor | float, float]], float]:
    """The prior's information vector and diagonal matrix, axis by axis, and its bearing precision."""
    weight, slope = prior.std**-2, prior.slope_std**-2
    if chart == "cartesian":
        return [(prior.mean * weight * c, weight) for c in cells.unbind(-1)], 0.0
    return [(0.0, slope), (0.0, slope), (prior.mean * weight, weight)], prior.bearing_std**-2


def prior_information(cells: Tensor, prior: Prior, chart: str = "inverse_range") -> tuple[Information, Tensor]:
    """What every cell believes at first, and its bearing precision, in the shapes and dtypes of `Memory`."""
    zero = torch.zeros_like(cells[..., 0], dtype=torch.float64)
    ((x, xx), (y, yy), (z, zz)), bearing = _prior_scalars(cells, prior, chart)
    matrix = columns(zero + xx, zero, zero, zero + yy, zero, zero + zz)
    return Information(columns(zero + x, zero + y, zero + z), matrix), (zero + bearing).to(cells.dtype)


def empty_memory(cells: Tensor, prior: Prior, chart: str = "inverse_range") -> Memory:
    """A memory that has seen nothing, its cells indexed.

    Args:
        cells: unit directions (Nx, 3), or of B memories (B, Nx, 3).
        prior: what every cell believes at first.
        chart: of the information, see `Fusion.chart`.

    Raises:
        SettingError: for no cells, directions that are not unit vectors, or an unknown chart.

    Differentiable in the cells.
    """
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    require_tensor(cells, "cells", "a tensor (..., cells, 3)")
    require(cells.dim() >= 2 and cells.shape[-1] == 3, "cells", tuple(cells.shape), "a shape (..., cells, 3)")
    require(cells.numel() > 0, "memory.cells", cells.shape[-2], "at least 1")
    require(cells.dtype in (torch.float32, torch.float64), "cells.dtype", cells.dtype, "torch.float32 or torch.float64")
    unit = bool(((cells * cells).sum(-1) - 1).abs().max() < 1e-3)
    require(unit, "cells", "directions", "finite unit vectors")
    zero = torch.zeros_like(cells[..., 0])
    found = build_index(cells), neighbour_spacing_rad(cells)
    first, bearing = prior_information(cells, prior, chart)
    # copies: kernels are compiled anew for what is a view of other tensors, as these are, but not after the first look
    known = Information(*(part.clone() for part in first)), bearing
    cells = columns(*cells.unbind(-1)).clone()
    return Memory(cells, *known, zero, columns(zero, zero).clone(), columns(zero, zero), *found, prior, chart)


def check_chart(memory: Memory, chart: str, whose: str) -> None:
    """Refuse what is of another chart than a memory.

    Args:
        memory: that would take it.
        chart: of it.
        whose: the name that the user knows it by.

    Raises:
        SettingError: where the two differ; it names both.
    """
    require(chart == memory.chart, whose, chart, f"{memory.chart}, the chart of the memory")


def blend(memory: Memory, keep: Tensor) -> Memory:
    """Keep a share (..., Nx) of what was learned; the rest is the prior's. Differentiable."""
    first, sure = _prior_scalars(memory.cells, memory.prior, memory.chart)
    less = 1 - keep
    vector, matrix = ([keep * part for part in parts.unbind(-1)] for parts in memory.information)
    for k, (mean, weight) in enumerate(first):
        vector[k] = vector[k] + less * mean
        matrix[(0, 3, 5)[k]] = matrix[(0, 3, 5)[k]] + less * weight
    information = Information(columns(*vector), columns(*matrix))
    bearing = keep * memory.bearing + less * sure
    once, twice = memory.lasting.unbind(-1)
    return memory._replace(information=information, bearing=bearing, lasting=columns(keep * once, keep * keep * twice))


def forget(memory: Memory, keep: float | Tensor) -> Memory:
    """Let information decay toward the prior.

    Args:
        memory: before.
        keep: the share that remains, 0 to 1, broadcastable to (..., Nx); for a half-life of h saccades 0.5^(1/h).

    Differentiable. Seen cells stay seen.
    """
    share = torch.as_tensor(keep, dtype=memory.cells.dtype, device=memory.cells.device)
    require(bool(((share >= 0) & (share <= 1)).all()), "keep", keep, "a share from 0 to 1")
    return blend(memory, share.expand(memory.looks.shape))


def belief(memory: Memory) -> Gaussian:
    """Moments in the memory's own coordinates, (..., Nx, 3) and (..., Nx, 6): a point, or a patch (g₁, g₂, ρ).

    Looks are averaged with their informations 1/u as weights. Of their variances u the parts l last, so that these err
    together: with Λ = Σ 1/u, the variance of the mean is (Λ − Σ l/u² + (Σ √l/u)²)/Λ². Differentiable.
    """
    mean, cov = (part.to(memory.cells.dtype) for part in gaussian_from_information(memory.information))
    *rest, variance = cov.unbind(-1)
    return Gaussian(mean, columns(*rest, variance + variance.square() * _together(memory)))


def inverse_range_belief(memory: Memory) -> tuple[Tensor, Tensor]:
    """Mean and variance (..., Nx) of patches' inverse range at their cells: those of `belief`, without the slopes.

    Differentiable.
    """
    rho, variance = (part.to(memory.cells.dtype) for part in nearness(memory.information))
    return rho, variance + variance.square() * _together(memory)


def _together(memory: Memory) -> Tensor:
    """What lasts of the looks' errors, beyond what each has by itself: (Σ √l/u)² − Σ l/u², (..., Nx)."""
    once, twice = memory.lasting.unbind(-1)
    return (once.square() - twice).clamp(min=0)


def reducible(memory: Memory, variance: Tensor) -> Tensor:
    """The share of a variance of inverse range that further looks may take away, (..., Nx).

    What lasts between looks is not worth another one.

    Args:
        memory: of patches, or of points, of which nothing lasts.
        variance: of `belief` (..., Nx).

    Differentiable.
    """
    together, twice = _together(memory), memory.lasting[..., 1]
    # of V + V² (a² − q), which is known, the V that looks average
    own = 2 * variance / (1 + (1 + 4 * together * variance).sqrt())
    return ((1 - own * twice).clamp(min=0) / (1 + own * together)).clamp(max=1)


def trust(memory: Memory) -> Tensor:
    """Probability that each cell's surface is there, (..., Nx): the share of votes for it, 0 where unseen."""
    yes, no = memory.votes.unbind(-1)
    return yes / (yes + no).clamp(min=torch.finfo(yes.dtype).tiny)


def cartesian_belief(memory: Memory) -> Gaussian:
    """Moments in 3-D, in E: what information, exports and pictures use. Differentiable."""
    if memory.chart == "cartesian":
        return belief(memory)
    return cartesian_from_patches(*inverse_range_belief(memory), memory)


def cartesian_from_patches(rho: Tensor, variance: Tensor, memory: Memory, far_m: float = FAR_M) -> Gaussian:
    """Cartesian moments of the patches' points in their cells' directions, to first order.

    Args:
        rho: inverse ranges of the patches at their cells (..., Nx), from `inverse_range_belief`.
        variance: theirs.
        memory: whose.
        far_m: an inverse range below 1/far_m is taken as 1/far_m.

    Differentiable.
    """
    r = 1 / rho.clamp(min=1 / far_m)
    square = r * r
    across = square / memory.bearing
    along = square * square * variance - across
    x, y, z = memory.cells.unbind(-1)
    mean = columns(r * x, r * y, r * z)
    ax, ay, az = along * x, along * y, along * z
    xx, yy, zz = (torch.addcmul(across, a, c) for a, c in ((ax, x), (ay, y), (az, z)))
    return Gaussian(mean, columns(xx, ax * y, ax * z, yy, ay * z, zz))
