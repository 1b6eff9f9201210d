"""A layout of a user's own: whether it is what `torchfovea.sensing.layout.Retina` asks for."""

from __future__ import annotations

import math
from collections.abc import Hashable

import torch
from torch import Tensor

from torchfovea.sensing.layout import Retina
from torchfovea.setting import require

__all__ = ["check_retina"]


def check_retina(retina: object, setting: str = "sensor") -> Retina:
    """A layout that is what `Retina` says, or an error under the setting that it comes from.

    Raises:
        SettingError: for a missing part, RFs that are not (N, 2) places on the retina, are not positive in width, or
            do not come narrow ones first.
    """
    name = type(retina).__name__
    parts = "a layout with count, radius_px, centers_px, width_px and inside"
    require(isinstance(retina, Hashable), setting, name, f"{parts} that can be hashed, such as a frozen dataclass")
    require(isinstance(retina, Retina), setting, name, parts)
    assert isinstance(retina, Retina)
    require(0 < retina.radius_px < math.inf, f"{setting}.radius_px", retina.radius_px, "a positive number of pixels")
    px = retina.centers_px("cpu", torch.float64)
    fits = isinstance(px, Tensor) and px.dtype == torch.float64 and px.shape == (retina.count, 2)
    require(
        fits, f"{name}.centers_px()", getattr(px, "shape", px), f"places ({retina.count}, 2) of the dtype asked for"
    )
    require(
        bool((px.square().sum(-1) <= 1.0001 * retina.radius_px**2).all()),
        f"{name}.centers_px()",
        "beyond radius_px",
        "within",
    )
    width, inside = retina.width_px(px), retina.inside(px)
    fits = (
        isinstance(width, Tensor) and width.shape == px.shape[:1] and bool((width > 0).all() and width.isfinite().all())
    )
    require(fits, f"{name}.width_px(centers)", getattr(width, "shape", width), f"positive widths ({retina.count},)")
    fits = isinstance(inside, Tensor) and inside.dtype == torch.bool and inside.shape == px.shape[:1]
    require(fits, f"{name}.inside(centers)", getattr(inside, "shape", inside), f"bool ({retina.count},)")
    ordered = bool((width >= 0.6 * width.cummax(0).values).all())
    require(ordered, f"{name}.centers_px()", "wide receptive fields before narrow ones", "narrow ones first")
    return retina
