"""Noise of a camera's images: photons, read-out, and eyes that are not exposed alike.

Rendered images have none, so that a repeated gaze is the same picture and a matcher's errors repeat to the last digit.
A pixel of brightness I (0 to 1) that a full well of N photons makes white has the variance I/N + r² with read noise r
(the EMVA 1288 standard's model without its fixed pattern); a Gaussian stands for the Poisson distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfovea.setting import check_types, require

__all__ = ["ImageNoise", "expose"]


@dataclass(frozen=True)
class ImageNoise:
    """What the eyes' images suffer from.

    Attributes:
        photons: that make a pixel white; inf: no photon noise.
        read: standard deviation of the read-out, a share of white.
        exposure: standard deviation of the logarithm of the eyes' ratio of exposures, drawn once for a pair of eyes.
    """

    photons: float = 10000.0
    read: float = 0.002
    exposure: float = 0.02

    def __post_init__(self) -> None:
        """Raise SettingError for numbers out of range."""
        check_types(self, "noise.")
        require(self.photons >= 1, "noise.photons", self.photons, "at least 1; .inf: no photon noise")
        require(0 <= self.read <= 1, "noise.read", self.read, "a share of white, 0 to 1")
        require(0 <= self.exposure <= 2, "noise.exposure", self.exposure, "0 to 2")

    def gains(self, generator: torch.Generator) -> tuple[float, float]:
        """Exposures of a left and a right eye, whose product is 1."""
        half = self.exposure * float(torch.randn((), generator=generator, dtype=torch.float64)) / 2
        return math.exp(half), math.exp(-half)


def expose(image: Tensor, noise: ImageNoise, gain: float, generator: torch.Generator) -> Tensor:
    """An image (3, H, W) in [0, 1] as a camera of some gain would take it, in [0, 1] again.

    The same state of the generator, on the CPU, gives the same picture.
    """
    light = (image * gain).clamp_(0, 1)
    std = (light / noise.photons).add_(noise.read**2).sqrt_()
    chance = torch.randn(image.shape, generator=generator, dtype=torch.float32).to(image)
    return chance.mul_(std).add_(light).clamp_(0, 1)
