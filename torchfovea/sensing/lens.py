"""Real lenses: what calibrations tell of a camera, distortion included.

A raw image is looked at as it is. A pixel's ray is found through the lens, and a direction's pixel likewise, so that a
retina on the raw image samples it once, and triangulation's sigma points pass through the lens themselves.

Distortion by Brown and Conrady is kornia's model, with OpenCV's coefficients; its inverse here is Newton's method,
for kornia's own iterates a fixed number of times without knowing where the model folds over (kornia#4285). Kannala
and Brandt's model in kornia and OpenCV lives on the plane z = 1; here it is the equidistant `Fisheye` with a
polynomial, which goes on beyond 90 degrees from the axis.

References:
    Brown (1966), Decentering distortion of lenses. Kannala, Brandt (2006), A generic camera model and calibration
    method for conventional, wide-angle, and fish-eye lenses, PAMI 28(8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Fisheye, Optics
from torchfovea.setting import require

__all__ = ["BrownConrady", "KannalaBrandt"]

STEPS = 8  # of Newton's method, quadratic: four do but near the fold


@dataclass(frozen=True)
class _Lens(Optics):
    """A camera with two focal lengths and coefficients of distortion, so many as one of `_counts`."""

    _lengths: ClassVar[tuple[str, ...]] = ("fx_px", "fy_px")
    _counts: ClassVar[tuple[int, ...]] = ()
    _names: ClassVar[str] = ""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Raise SettingError for focal lengths that are not positive, and what is no set of coefficients."""
        super().__post_init__()
        require(all(map(math.isfinite, self.distortion)), "distortion", self.distortion, "finite numbers")
        require(len(self.distortion) in self._counts, "distortion", self.distortion, self._names)

    @property
    def focal_px(self) -> float:
        """The mean (geometric) of both focal lengths [px, of a fisheye px/rad]."""
        return math.sqrt(self.fx_px * self.fy_px)


@dataclass(frozen=True)
class BrownConrady(_Lens):
    """A pinhole behind a lens, as OpenCV's `calibrateCamera` and ROS (plumb_bob, rational_polynomial) describe it.

    With (x, y) = (X, Y)/Z, r² = x² + y² and q = (1 + k₁r² + k₂r⁴ + k₃r⁶)/(1 + k₄r² + k₅r⁴ + k₆r⁶),

        u = fx (x q + 2 p₁ x y + p₂ (r² + 2 x²)) + cx,   v = fy (y q + p₁ (r² + 2 y²) + 2 p₂ x y) + cy.

    Attributes:
        fx_px: focal length along rows [px], > 0.
        fy_px: focal length along columns [px], > 0.
        cx_px: column of the optical axis [px].
        cy_px: row of the optical axis [px].
        distortion: (k1, k2, p1, p2[, k3[, k4, k5, k6]]), or none.
    """

    _counts = (0, 4, 5, 8)
    _names = "k1, k2, p1, p2[, k3[, k4, k5, k6]], or none"

    @property
    def straight(self) -> bool:
        """Whether there is no distortion at all."""
        return not any(self.distortion)

    @cached_property
    def fold(self) -> float:
        """The r at which distorted radii stop growing and the model folds over: nothing beyond it is seen."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *[0.0] * 8)[:8]
        over, under = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
        s = np.polynomial.Polynomial([0, 1])
        slope = over * under + 2 * s * (over.deriv() * under - over * under.deriv())
        return min(math.sqrt(_first_root(slope)), math.sqrt(_first_root(under)))

    def rays(self, px: Tensor) -> Tensor:
        """Directions of pixels, (..., 2) to (..., 3) with z = 1; (0, 0, −1) where the lens shows nothing.

        Differentiable.
        """
        return columns(*self.ray_components(*px.unbind(-1)))

    def ray_components(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`rays` by components: x, y, z (...)."""
        x, y = (u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px
        if self.straight:
            return x, y, torch.ones_like(x)
        aim = columns(x, y)
        at = aim.detach()
        for _ in range(STEPS):
            at = self._within(at + self._step(at, aim.detach())[0])
        # the last step carries the gradient: that of the inverse map
        step, away = self._step(at, aim)
        found = (away < 1e-3) & (at.square().sum(-1) < self.fold**2)
        x, y = torch.where(found[..., None], at + step, torch.zeros_like(at)).unbind(-1)
        return x, y, 2 * found.to(x) - 1

    def project(self, direction: Tensor) -> Tensor:
        """Pixels of directions, (..., 3) to (..., 2); finite, and meaningless where `in_view` is false.

        Differentiable.
        """
        x, y, z = direction.unbind(-1)
        seen = self.in_view(direction)
        over = 1 / torch.where(seen, z, torch.ones_like(z))
        # what is not in view is projected along the axis, or so: nothing overflows
        x, y = (torch.where(seen, c, c * 0) * over for c in (x, y))
        x, y = self._distorted(columns(x, y)).unbind(-1)
        return columns(self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px)

    def in_view(self, direction: Tensor) -> Tensor:
        """Whether directions (..., 3) lie in front of the camera and within the lens's fold; bool (...)."""
        x, y, z = direction.unbind(-1)
        ahead = z > 1e-6 * (x.abs() + y.abs() + z.abs())
        return ahead if math.isinf(self.fold) else ahead & (x * x + y * y < (self.fold * z).square())

    def _distorted(self, place: Tensor) -> Tensor:
        """Places (..., 2) on the plane z = 1 as the lens shows them there."""
        if self.straight:
            return place
        # kornia takes as long to import as this whole package; only who looks through a lens needs it
        from kornia.geometry.calibration import distort_points

        flat = place.reshape(-1, 2)
        eye = torch.eye(3, device=place.device, dtype=place.dtype)
        bent: Tensor = distort_points(flat, eye, place.new_tensor(self.distortion))
        return bent.reshape(place.shape)

    def _step(self, at: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's step from places (..., 2) toward those that the lens shows at `aim`, and how far off they are."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *[0.0] * 8)[:8]
        with torch.no_grad():
            bent = self._distorted(at)
            x, y = at.unbind(-1)
            s = x * x + y * y
            over, under = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
            q = over / under
            rate = 2 * (k1 + s * (2 * k2 + s * 3 * k3) - q * (k4 + s * (2 * k5 + s * 3 * k6))) / under
            # the Jacobian is symmetric
            a = q + x * x * rate + 2 * p1 * y + 6 * p2 * x
            b = x * y * rate + 2 * p1 * x + 2 * p2 * y
            d = q + y * y * rate + 6 * p1 * y + 2 * p2 * x
            # beyond the fold the map turns around; a step back toward the axis leads out of there
            whole = (a * d - b * b).clamp(min=1e-3)
        miss_x, miss_y = (aim - bent).unbind(-1)
        step = columns((d * miss_x - b * miss_y) / whole, (a * miss_y - b * miss_x) / whole)
        return step, (aim - bent).detach().abs().amax(-1)

    def _within(self, place: Tensor) -> Tensor:
        """Places no farther from the axis than the fold."""
        if math.isinf(self.fold):
            return place
        radius = place.square().sum(-1, keepdim=True).clamp(min=1e-30).sqrt()
        return place * (self.fold / radius).clamp(max=1)


@dataclass(frozen=True)
class KannalaBrandt(_Lens):
    """A fisheye, as OpenCV's `fisheye` module, ROS (equidistant, fisheye) and Kalibr (equidistant) describe it.

    A direction at angle θ from the axis lands at d(θ) = θ (1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸) from it, times fx or fy.

    Attributes:
        fx_px: pixels per radian along rows, > 0.
        fy_px: pixels per radian along columns, > 0.
        cx_px: column of the optical axis [px].
        cy_px: row of the optical axis [px].
        distortion: (k1, k2, k3, k4).
    """

    _counts = (4,)
    _names = "k1, k2, k3, k4"

    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @cached_property
    def fold_rad(self) -> float:
        """The angle at which d(θ) stops growing: nothing beyond it is seen; π where it never does."""
        slope = np.polynomial.Polynomial([(2 * i + 1) * k for i, k in enumerate((1.0, *self.distortion))])
        return min(math.sqrt(_first_root(slope)), math.pi)

    @cached_property
    def rim(self) -> float:
        """d(θ) there."""
        return sum(k * self.fold_rad ** (2 * i + 1) for i, k in enumerate((1.0, *self.distortion)))

    def rays(self, px: Tensor) -> Tensor:
        """Unit directions of pixels, (..., 2) to (..., 3); (0, 0, −1) where the lens shows nothing. Differentiable."""
        return columns(*self.ray_components(*px.unbind(-1)))

    def ray_components(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`rays` by components: x, y, z (...)."""
        a, b = (u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px
        square = a * a + b * b
        shown = square.detach() < self.rim**2
        square = torch.where(shown, square, torch.zeros_like(square))
        # Newton's method on t = θ²: t q(t)² = d², smooth at the axis too
        t = square.detach().clamp(max=0.25 * self.fold_rad**2)
        for _ in range(2 * STEPS):
            t = self._nearer(t, square.detach()).clamp(0, self.fold_rad**2)
        t = self._nearer(t, square)  # carries the gradient
        ratio = torch.where(shown, 1 / self._ratio(t), torch.zeros_like(a))
        x, y, z = Fisheye(1.0).ray_components(a * ratio, b * ratio)
        return x, y, torch.where(shown, z, -torch.ones_like(z))

    def project(self, direction: Tensor) -> Tensor:
        """Pixels of directions, (..., 3) to (..., 2); finite, and meaningless where `in_view` is false.

        Differentiable.
        """
        even = Fisheye(1.0).project(direction)
        a, b = (even * self._ratio(even.square().sum(-1, keepdim=True))).unbind(-1)
        return columns(self.fx_px * a + self.cx_px, self.fy_px * b + self.cy_px)

    def in_view(self, direction: Tensor) -> Tensor:
        """Whether directions (..., 3) lie within the lens's fold, and not straight behind; bool (...)."""
        x, y, z = direction.unbind(-1)
        near = torch.atan2((x * x + y * y).sqrt(), z) < self.fold_rad
        return near & Fisheye(1.0).in_view(direction)

    def _ratio(self, t: Tensor) -> Tensor:
        """The ratio q = d(θ)/θ for t = θ²."""
        k1, k2, k3, k4 = self.distortion
        return 1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))

    def _nearer(self, t: Tensor, square: Tensor) -> Tensor:
        """One of Newton's steps for t q(t)² = d²."""
        k1, k2, k3, k4 = self.distortion
        held = t.detach()
        ratio = self._ratio(held)
        slope = ratio * (ratio + 2 * held * (k1 + held * (2 * k2 + held * (3 * k3 + held * 4 * k4))))
        return held - (held * ratio * ratio - square) / slope.clamp(min=1e-3)


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """The least positive real root; infinite if there is none."""
    roots = polynomial.trim().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-12)]
    return float(real.min()) if real.size else math.inf
