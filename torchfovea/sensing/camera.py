"""Camera models: where a pixel looks, and where a direction lands.

A retina is described in pixels relative to the optical axis; an image of the same field of view is the same camera with
another focal length and its centre at (size - 1)/2, for pixel centres are integers (`image_camera`).
Directions are in the optical frame: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.setting import check_types, require

__all__ = ["Camera", "Fisheye", "Optics", "Pinhole", "image_camera"]


@runtime_checkable
class Camera(Protocol):
    """What a camera tells; `Pinhole`, `Fisheye` and the lenses of `torchfovea.sensing.lens` do. Hashable.

    What it cannot see it projects somewhere finite and says so in `in_view`; the ray of a pixel that it cannot see
    anything through points straight behind, where nothing is in view.
    """

    @property
    def focal_px(self) -> float:
        """Pixels per unit of x/z on the optical axis, > 0; the mean where columns and rows differ."""
        ...

    @property
    def cx_px(self) -> float:
        """Column of the optical axis [px]."""
        ...

    @property
    def cy_px(self) -> float:
        """Row of the optical axis [px]."""
        ...

    def rays(self, px: Tensor) -> Tensor:
        """Directions of pixels, (..., 2) to (..., 3)."""
        ...

    def ray_components(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`rays` by components: x, y, z (...)."""
        ...

    def project(self, direction: Tensor) -> Tensor:
        """Pixels of directions of any length, (..., 3) to (..., 2); finite everywhere."""
        ...

    def in_view(self, direction: Tensor) -> Tensor:
        """Whether directions (..., 3) have a pixel; bool (...)."""
        ...

    def scaled(self, scale: float, shift_px: tuple[float, float]) -> Camera:
        """The same camera in other pixels: place p becomes scale · p + shift."""
        ...

    def __hash__(self) -> int:
        """By its numbers."""
        ...


@dataclass(frozen=True)
class Optics:
    """What the cameras here and the lenses have in common: sound numbers, and other pixels."""

    _lengths: ClassVar[tuple[str, ...]] = ("focal_px",)

    def __post_init__(self) -> None:
        """Raise SettingError unless the focal lengths are positive and all is finite."""
        check_types(self)
        for name in self._lengths:
            require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "a positive number of pixels")
        for name in ("cx_px", "cy_px"):
            require(math.isfinite(getattr(self, name)), name, getattr(self, name), "a finite number of pixels")

    def scaled(self, scale: float, shift_px: tuple[float, float]) -> Self:
        """The same camera in other pixels: place p becomes scale · p + shift."""
        shift = dict(zip(("cx_px", "cy_px"), shift_px, strict=True))
        moved = {name: scale * getattr(self, name) + by for name, by in shift.items()}
        return replace(self, **moved, **{name: scale * getattr(self, name) for name in self._lengths})


@dataclass(frozen=True)
class Pinhole(Optics):
    """The paper's camera: px = focal_px · (x, y)/z + centre.

    Attributes:
        focal_px: focal length [px], > 0.
        cx_px: column of the optical axis [px].
        cy_px: row of the optical axis [px].
    """

    focal_px: float
    cx_px: float = 0.0
    cy_px: float = 0.0

    @staticmethod
    def from_fov(fov_deg: float, radius_px: float) -> Pinhole:
        """The camera whose circle of radius `radius_px` spans `fov_deg` degrees (0 < fov_deg < 180)."""
        require(0 < fov_deg < 180, "fov_deg", fov_deg, "more than 0 and less than 180 degrees for a pinhole camera")
        return Pinhole(radius_px / math.tan(math.radians(fov_deg) / 2))

    def rays(self, px: Tensor) -> Tensor:
        """Directions of pixels, (..., 2) to (..., 3) with z = 1. Differentiable."""
        return columns(*self.ray_components(*px.unbind(-1)))

    def ray_components(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`rays` by components: x, y (...) and z, which is 1 and has no axes."""
        x, y = ((c - centre if centre else c) * (1 / self.focal_px) for c, centre in ((u, self.cx_px), (v, self.cy_px)))
        return x, y, u.new_ones(())

    def turned(self, rotation: Tensor) -> Tensor:
        """R K⁻¹ (..., 3, 3), which takes pixels (u, v, 1) to rays turned by R (..., 3, 3). Differentiable."""
        x, y, z = (rotation / rotation.new_tensor([self.focal_px, self.focal_px, 1.0])).unbind(-1)
        return torch.stack([x, y, z - self.cx_px * x - self.cy_px * y], -1)

    def project(self, direction: Tensor) -> Tensor:
        """Pixels of directions, (..., 3) to (..., 2); finite, and meaningless where `in_view` is false.

        Differentiable.
        """
        x, y, z = direction.unbind(-1)
        z = torch.where(self.in_view(direction), z, torch.ones_like(z))
        return columns(self.focal_px * x / z + self.cx_px, self.focal_px * y / z + self.cy_px)

    def in_view(self, direction: Tensor) -> Tensor:
        """Whether directions (..., 3) lie in front of the camera, so that they have a pixel; bool (...)."""
        x, y, z = direction.unbind(-1)  # a sum over strided axes takes several times as long
        return z > 1e-6 * (x.abs() + y.abs() + z.abs())


@dataclass(frozen=True)
class Fisheye(Optics):
    """Equidistant fisheye: the distance from the centre is focal_px times the angle from the axis.

    Attributes:
        focal_px: pixels per radian, > 0.
        cx_px: column of the optical axis [px].
        cy_px: row of the optical axis [px].
    """

    focal_px: float
    cx_px: float = 0.0
    cy_px: float = 0.0

    @staticmethod
    def from_fov(fov_deg: float, radius_px: float) -> Fisheye:
        """The camera whose circle of radius `radius_px` spans `fov_deg` degrees (0 < fov_deg < 360)."""
        require(0 < fov_deg < 360, "fov_deg", fov_deg, "more than 0 and less than 360 degrees for a fisheye camera")
        return Fisheye(radius_px / (math.radians(fov_deg) / 2))

    def rays(self, px: Tensor) -> Tensor:
        """Unit directions of pixels, (..., 2) to (..., 3). Differentiable, at the centre too."""
        return columns(*self.ray_components(*px.unbind(-1)))

    def ray_components(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`rays` by components: x, y, z (...)."""
        a, b = (u - self.cx_px) / self.focal_px, (v - self.cy_px) / self.focal_px
        # sin(θ)/θ as sinc keeps value and gradient finite at the centre
        square = a * a + b * b
        away = square > 1e-12
        theta = torch.where(away, square, torch.ones_like(square)).sqrt()
        ratio = torch.where(away, torch.sin(theta) / theta, 1 - square / 6)
        cosine = torch.where(away, torch.cos(theta), 1 - square / 2)
        return a * ratio, b * ratio, cosine

    def project(self, direction: Tensor) -> Tensor:
        """Pixels of directions, (..., 3) to (..., 2); finite, and meaningless straight behind. Differentiable."""
        x, y, z = direction.unbind(-1)
        square = x * x + y * y
        away = square > 1e-12 * z * z
        side = torch.where(away, square, torch.ones_like(square)).sqrt()
        ahead = torch.where(away, torch.ones_like(z), torch.where(z.abs() > 0, z.abs(), torch.ones_like(z)))
        ratio = torch.where(away, torch.atan2(side, z) / side, 1 / ahead)
        return columns(self.focal_px * x * ratio + self.cx_px, self.focal_px * y * ratio + self.cy_px)

    def in_view(self, direction: Tensor) -> Tensor:
        """Whether directions (..., 3) have a pixel (all but straight behind); bool (...)."""
        x, y, z = direction.unbind(-1)
        return (z > 0) | (x * x + y * y > 1e-12 * z * z)


def image_camera(camera: Camera, radius_px: float, size_px: int) -> Camera:
    """The camera of a square image that spans the same field of view as the retina.

    Args:
        camera: the retina's camera, in retinal pixels.
        radius_px: the retina's radius ρ_max [retinal px].
        size_px: side of the image [px]; its outermost pixel borders lie at the retina's radius.
    """
    centre, scale = (size_px - 1) / 2, size_px / (2 * radius_px)
    return camera.scaled(scale, (centre, centre))
