"""Which cells may be fixated."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchfovea.setting import check_types, require

__all__ = ["Eligibility"]


@dataclass(frozen=True)
class Eligibility:
    """Which cells may be fixated.

    Attributes:
        nearest_m: points nearer than this are not looked at.
        ground_z_m: a seen cell whose point lies lower than this above the floor is ground, and not an object.
        ground_sigmas: by so many standard deviations of its height must a point lie above that. Of the hundreds of
            cells on a floor that is seen out of the corner of an eye, noise lifts some well above it, and the nearest
            of them would win every comparison: the floor is nearer than most objects.
    """

    nearest_m: float = 0.5
    ground_z_m: float = 0.05
    ground_sigmas: float = 3.0

    def __post_init__(self) -> None:
        """Raise SettingError for a negative distance, and numbers that are not finite."""
        check_types(self, "eligibility.")
        require(0 <= self.nearest_m < math.inf, "eligibility.nearest_m", self.nearest_m, "at least 0 metres")
        require(math.isfinite(self.ground_z_m), "eligibility.ground_z_m", self.ground_z_m, "a finite height in metres")
        sigmas = self.ground_sigmas
        require(0 <= sigmas < math.inf, "eligibility.ground_sigmas", sigmas, "0 or more standard deviations")
