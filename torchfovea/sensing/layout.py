"""Where the receptive fields (RFs) of a retina lie and how wide they are: the log-polar and the uniform layout.

Retinal coordinates are pixels relative to the optical axis, x right, y down; every layout fills the disc of radius
`radius_px` with the same budget of RFs, so that layouts can be compared at equal cost (paper Sec. 7).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.lattice import BUDGET_TOLERANCE, disc_lattice, fovea_lattice
from torchfovea.setting import check_types, require

__all__ = ["LogPolar", "Retina", "Uniform", "cortical"]

MOST = 10_000_000  # RFs of a retina
Grid = tuple[int, int]  # rings and sectors
ASPECT_TOLERANCE = 5.0  # an RF may be at most so many times longer than wide, or wider than long


@runtime_checkable
class Retina(Protocol):
    """Where N receptive fields lie on a retina, and how wide they are: what every layout offers, also a user's own.

    A layout is compared and hashed by its settings (a frozen dataclass is), because what follows from it is kept. RFs
    come narrow ones first: none is narrower than 0.6 times one before it.
    """

    @property
    def count(self) -> int:
        """N."""
        ...

    @property
    def radius_px(self) -> float:
        """Radius of the disc that holds the retina [px]; the images that it sees span it."""
        ...

    def centers_px(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
        """Centres of the RFs, (N, 2) [px]."""
        ...

    def width_px(self, px: Tensor) -> Tensor:
        """RF width at any place of the retina, (..., 2) to (...) [px], positive."""
        ...

    def inside(self, px: Tensor) -> Tensor:
        """Whether places (..., 2) [px] lie on the retina; bool (...)."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class LogPolar:
    """Rings of RFs whose width grows in proportion to the eccentricity (paper Fig. 3b).

    Ring i = 0…R−1 spans ρ_min aⁱ to ρ_min aⁱ⁺¹ with a = (ρ_max/ρ_min)^(1/R); its RFs lie at ρ_min a^(i+½), are
    W_i = ρ_min aⁱ(a−1) wide and, in S sectors with 2π/S ≈ a−1, about as long. R and S are chosen so that R·S meets the
    budget within 0.5% and RFs are as square as the budget allows. Inside ρ_min there is none.

    With `uniform_fovea` the numbers are those of the authors' programs, S = 2√(πN)/√(1 + 2 ln C), R = (S/2π) ln C with
    C = ρ_max/ρ_min, and the N − R·S RFs left over are a fovea. The programs store it as a square image of side
    √(N − R·S); our reading is that as many RFs of a square lattice fill the disc inside ρ_min: those nearest to the
    axis, at a pitch of about ρ_min √(π/n), which is the first ring's width but for rounding.

    RFs are ordered by ring, then sector (ring-major, θ from +x towards +y); a uniform fovea comes first.

    Attributes:
        receptive_fields: the budget N.
        radius_px: ρ_max, radius of the retina [px].
        rho_min_px: ρ_min, inner border of the first ring [px].
        uniform_fovea: fill the disc inside ρ_min as the authors do.
        grid: R and S themselves, in place of what meets the budget, which then does not count.
    """

    receptive_fields: int = 31416
    radius_px: float = 100.0
    rho_min_px: float = 1.0
    uniform_fovea: bool = False
    grid: Grid | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for a layout that cannot be built."""
        check_types(self, "sensor.")
        if self.grid is not None:
            most = f"at least 1 ring and 3 sectors, at most {MOST} receptive fields together"
            rings, sectors = self.grid
            require(rings >= 1 and sectors >= 3 and rings * sectors <= MOST, "sensor.grid", list(self.grid), most)
            require(not self.uniform_fovea, "sensor.uniform_fovea", True, "false with sensor.grid, which has no fovea")
        _require_disc(self.receptive_fields, self.radius_px)
        require(
            0 < self.rho_min_px < self.radius_px,
            "sensor.rho_min_px",
            self.rho_min_px,
            f"more than 0 and less than radius_px = {self.radius_px}",
        )
        rings, sectors, count = _log_polar_numbers(self)
        # 2 sectors have no neighbours on either side; an RF as long as a whole ring is wide is no log-polar layout
        budget = self.receptive_fields if self.grid is None else count
        possible = rings >= 1 and sectors >= 3 and abs(count - budget) <= BUDGET_TOLERANCE * budget
        squareness = self.aspect if possible else math.inf
        require(
            possible and 1 / ASPECT_TOLERANCE <= squareness <= ASPECT_TOLERANCE,
            "sensor.receptive_fields" if self.grid is None else "sensor.grid",
            self.receptive_fields if self.grid is None else list(self.grid),
            f"a budget that whole rings and sectors meet within {BUDGET_TOLERANCE:.1%} with RFs at most "
            f"{ASPECT_TOLERANCE:g} times as wide as long or as long as wide "
            f"(radius_px = {self.radius_px}, rho_min_px = {self.rho_min_px})",
        )

    @property
    def rings(self) -> int:
        """R, the number of rings."""
        return _log_polar_numbers(self)[0]

    @property
    def sectors(self) -> int:
        """S, the number of sectors."""
        return _log_polar_numbers(self)[1]

    @property
    def count(self) -> int:
        """The actual number of RFs, within 0.5% of the budget: R·S, which few numbers are exactly; see `grid`."""
        return _log_polar_numbers(self)[2]

    @property
    def fovea_count(self) -> int:
        """RFs of the uniform fovea; 0 without one."""
        return self.count - self.rings * self.sectors

    @property
    def shape(self) -> tuple[int, int]:
        """The cortical image's shape (R, S)."""
        return self.rings, self.sectors

    @property
    def base(self) -> float:
        """The growth a of the eccentricity from ring to ring."""
        return math.pow(self.radius_px / self.rho_min_px, 1 / self.rings)

    @property
    def aspect(self) -> float:
        """Width over length of an RF, (a−1)/(2π/S); 1 is square."""
        return (self.base - 1) * self.sectors / (2 * math.pi)

    @property
    def fovea_pitch_px(self) -> float:
        """Spacing of the uniform fovea's lattice [px]; 0 without one."""
        return self.rho_min_px / fovea_lattice(self.fovea_count)[0] if self.fovea_count else 0.0

    @property
    def width_law(self) -> tuple[float, float]:
        """How much wider RFs are for every px of eccentricity, and how wide they are at least [px]."""
        return (self.base - 1) / math.sqrt(self.base), self.fovea_pitch_px or self.rho_min_px * (self.base - 1)

    def centers_px(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
        """Centres of the RFs, (N, 2) [px]. Built once; do not write into it."""
        return _centers(self, torch.device(device or "cpu"), dtype or torch.get_default_dtype())

    def width_px(self, px: Tensor) -> Tensor:
        """RF width at any place of the retina, (..., 2) to (...) [px].

        The continuous law W(ρ) = ρ (a−1)/√a, which is W_i at ring i's centre. Towards the axis it stops at the first
        ring's width, or at the pitch of the uniform fovea. Differentiable.
        """
        slope, smallest = self.width_law
        # the floor is under the root: its gradient at the axis is 0, not NaN
        return slope * _square(px).clamp(min=(smallest / slope) ** 2).sqrt()

    def inside(self, px: Tensor) -> Tensor:
        """Whether places (..., 2) [px] lie on the retina; bool (...)."""
        return _square(px) <= self.radius_px**2


@dataclass(frozen=True)
class Uniform:
    """RFs of one size on a square lattice, as in an ordinary camera whose corners are dropped (paper Fig. 3a).

    RFs are ordered by row, then column. The pitch is ρ_max √(π/N) where that meets the budget within 0.5%, otherwise
    the nearest that does.

    Attributes:
        receptive_fields: the budget N.
        radius_px: ρ_max, radius of the retina [px].
    """

    receptive_fields: int = 31416
    radius_px: float = 100.0

    def __post_init__(self) -> None:
        """Raise SettingError for a layout that cannot be built."""
        check_types(self, "sensor.")
        _require_disc(self.receptive_fields, self.radius_px)

    @property
    def pitch_px(self) -> float:
        """Spacing and width of the RFs [px]."""
        return self.radius_px / disc_lattice(self.receptive_fields)[0]

    @property
    def width_law(self) -> tuple[float, float]:
        """As of `LogPolar`: RFs do not grow."""
        return 0.0, self.pitch_px

    @property
    def count(self) -> int:
        """The actual number of RFs, within 0.5% of the budget."""
        return len(disc_lattice(self.receptive_fields)[2])

    @property
    def lattice(self) -> tuple[np.ndarray, tuple[float, float]]:
        """Columns and rows (N, 2) of the RFs on the whole-number lattice, and the axis' place on it."""
        return disc_lattice(self.receptive_fields)[2], disc_lattice(self.receptive_fields)[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the smallest image that holds the lattice; the disc does not fill its corners."""
        columns, rows = np.ptp(disc_lattice(self.receptive_fields)[2], axis=0) + 1
        return int(rows), int(columns)

    def centers_px(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
        """Centres of the RFs, (N, 2) [px]. Built once; do not write into it."""
        return _centers(self, torch.device(device or "cpu"), dtype or torch.get_default_dtype())

    def width_px(self, px: Tensor) -> Tensor:
        """RF width at any place of the retina, (..., 2) to (...) [px]: the pitch everywhere."""
        return torch.full_like(px[..., 0], self.pitch_px)

    def inside(self, px: Tensor) -> Tensor:
        """Whether places (..., 2) [px] lie on the retina; bool (...)."""
        return _square(px) <= self.radius_px**2


def cortical(values: Tensor, retina: LogPolar) -> Tensor:
    """The cortical image: values of the RFs by ring and sector.

    Args:
        values: (..., N) of a log-polar retina.
        retina: the layout.

    Returns:
        (..., R, S), a view; a uniform fovea is left out.

    Raises:
        SettingError: for another layout or another number of values.
    """
    require(isinstance(retina, LogPolar), "retina", type(retina).__name__, "a LogPolar retina")
    require(values.shape[-1] == retina.count, "values.shape", tuple(values.shape), f"(..., {retina.count})")
    rings: Tensor = values[..., retina.fovea_count :].unflatten(-1, retina.shape)
    return rings


def _square(px: Tensor) -> Tensor:
    """Squared length (...) of (..., 2); written out, for sums over so short an axis are slow."""
    x, y = px.unbind(-1)
    return x * x + y * y


def _require_disc(receptive_fields: int, radius_px: float) -> None:
    require(receptive_fields >= 16, "sensor.receptive_fields", receptive_fields, "a whole number, at least 16")
    require(receptive_fields <= MOST, "sensor.receptive_fields", receptive_fields, f"16 to {MOST}")
    require(1e-6 <= radius_px <= 1e6, "sensor.radius_px", radius_px, "a positive number of pixels, 1e-6 to 1e6")


@lru_cache(maxsize=256)
def _log_polar_numbers(retina: LogPolar) -> tuple[int, int, int]:
    """Rings, sectors and count; (0, 0, 0) where the budget cannot be met."""
    if retina.grid is not None:
        return *retina.grid, math.prod(retina.grid)
    budget, growth = retina.receptive_fields, math.log(retina.radius_px / retina.rho_min_px)
    if retina.uniform_fovea:
        sectors = int(2 * math.sqrt(math.pi * budget) / math.sqrt(1 + 2 * growth))
        rings = int(sectors / (2 * math.pi) * growth)
        rest = budget - rings * sectors
        square = math.isqrt(max(rest, 0)) ** 2
        # a whole square where the budget allows (58 × 58 for the authors' 200 × 200 image), else what is left
        fovea = square if rest - square <= BUDGET_TOLERANCE * budget else rest
        return rings, sectors, rings * sectors + fovea
    # square RFs have S = 2π/(a−1) ≈ 2πR/ln C, hence R ≈ √(N ln C/2π); squareness allows a factor around it
    ideal = math.sqrt(budget * growth / (2 * math.pi))
    best = (math.inf, 0, 0)
    for rings in range(max(1, int(ideal / 6)), min(budget, math.ceil(6 * ideal) + 1) + 1):
        for sectors in {budget // rings, math.ceil(budget / rings)}:
            if abs(rings * sectors - budget) <= BUDGET_TOLERANCE * budget and growth / rings < 300:
                mismatch = abs(math.log(math.expm1(growth / rings) * sectors / (2 * math.pi)))
                best = min(best, (mismatch, rings, sectors))
    return best[1], best[2], best[1] * best[2]


@lru_cache(maxsize=64)
def _centers(retina: LogPolar | Uniform, device: torch.device, dtype: torch.dtype) -> Tensor:
    # kept for later calls, which may want gradients: never an inference tensor
    with torch.inference_mode(False), torch.no_grad():
        if isinstance(retina, Uniform):
            places, axis = retina.lattice
            px = (places - np.array(axis)) * retina.pitch_px
        else:
            rho = retina.rho_min_px * retina.base ** (np.arange(retina.rings)[:, None] + 0.5)
            theta = 2 * math.pi * (np.arange(retina.sectors) + 0.5) / retina.sectors
            px = np.stack([rho * np.cos(theta), rho * np.sin(theta)], -1).reshape(-1, 2)
            if retina.fovea_count:
                px = np.concatenate([fovea_lattice(retina.fovea_count)[1] * retina.fovea_pitch_px, px])
        # coordinates outermost in memory: both components of (N, 2) are contiguous
        return torch.as_tensor(np.ascontiguousarray(px.T)).to(device, dtype).mT
