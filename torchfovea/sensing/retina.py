"""What a retina sees: images to receptive fields (RFs) and back.

An RF averages what it covers. Averages come from an image pyramid, as in mip-mapping: each level halves the one below
with the binomial filter (1, 3, 3, 1)/8 along both axes, so that pixel k of level l has its centre at 2ˡk + (2ˡ − 1)/2
in the image's pixels. An RF that is W image pixels wide is read, bilinearly, at level log₂W − 1, between the two
nearest levels. What it then weighs spreads over 0.32 W (standard deviation along an axis); a square, over 0.29 W.

Pixel centres are integers; an image's middle is at (size − 1)/2.
"""

from __future__ import annotations

import math
from functools import lru_cache
from operator import index
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.finite import require_finite, require_tensor
from torchfovea.gaussian import columns
from torchfovea.sensing.layout import LogPolar, Retina, Uniform, cortical
from torchfovea.sensing.sampling import (
    Rings,
    constant,
    place,
    read,
    read_fields,
    read_rings,
    ring_numbers,
    sampling,
    wide,
)
from torchfovea.sensing.triangles import from_triangles
from torchfovea.setting import require

__all__ = ["LogPolar", "Retina", "Uniform", "cortical", "covered", "fovea", "interpolate", "kept", "reconstruct"]


def fovea(image: Tensor, gaze_px: Tensor | None, retina: Retina, scale: float | None = None) -> Tensor:
    """Look at an image with a retina: every RF's average over its own footprint.

    Args:
        image: (B, C, H, W), floating point, finite.
        gaze_px: the image pixel (column, row) where the optical axis lands: (B, 2), one for each image, or with B = 1
            any number of them for the one image; (B, G, 2), G for each; None for the image's middle.
        retina: the layout.
        scale: image pixels per retinal pixel; None lets the retina span the image's shorter side.

    Returns:
        (B, C, N), for gazes (B, G, 2) (B, G, C, N), in the image's type; half precision is read in float32, where a
        place is not rounded to whole pixels. An RF that looks outside the image gets the nearest border's value;
        `covered` tells which do not.

    Raises:
        SettingError: for shapes or types that do not fit; for NaN or infinite values on the CPU (`require_finite`).

    Differentiable in the image and the gaze (bilinear: piecewise smooth in the gaze). For torch.compile one graph, and
    clean for vmap.
    """
    require_tensor(image, "image", "a tensor (B, C, H, W)")
    # a compiler's sizes may be symbols; a plan is made for numbers
    height, width = index(image.shape[-2]), index(image.shape[-1])
    scale = _checked_scale((height, width), retina, scale)
    require(image.dim() == 4 and image.numel() > 0, "image.shape", tuple(image.shape), "(B, C, H, W)")
    require(image.is_floating_point(), "image.dtype", image.dtype, "a floating-point type")
    given, image = image.dtype, image.to(wide(image.dtype))
    require_finite(image, "image", "finite values")
    plan = sampling(retina, height, width, scale, image.device, image.dtype)
    if gaze_px is None:
        maps = plan.middle
    else:
        _check_gaze(gaze_px)
        fits = len(image) == len(gaze_px) or (len(image) == 1 and gaze_px.dim() == 2)
        form = f"({len(image)}, 2) or ({len(image)}, G, 2), one or several per image"
        require(fits, "gaze_px.shape", tuple(gaze_px.shape), form)
        rows = gaze_px if gaze_px.dim() == 3 else gaze_px[None] if len(image) == 1 else gaze_px[:, None]
        maps = place(plan, rows.to(image))
    values = read_fields(image, maps, plan).to(given)  # (B, C, G, N)
    if gaze_px is not None and gaze_px.dim() == 3:
        return values.transpose(1, 2)
    return values[0].transpose(0, 1) if len(image) == 1 else values[:, :, 0]


def covered(retina: Retina, size: tuple[int, int], gaze_px: Tensor | None, scale: float | None = None) -> Tensor:
    """Which RFs look at the image rather than beyond its border.

    Args:
        retina: the layout.
        size: the image's height and width [px].
        gaze_px: (B, 2) or (B, G, 2) as in `fovea`; None for the image's middle (B = 1).
        scale: image pixels per retinal pixel, as in `fovea`.

    Returns:
        bool (B, N) or (B, G, N): whether the RF's centre lies on a pixel of the image.
    """
    scale = _checked_scale(size, retina, scale)
    height, width = size
    if gaze_px is None:
        gaze_px = torch.tensor([[(width - 1) / 2, (height - 1) / 2]])
    _check_gaze(gaze_px)
    dtype = gaze_px.dtype if gaze_px.is_floating_point() else torch.get_default_dtype()
    seen_px = gaze_px.to(dtype)[..., None, :] + scale * retina.centers_px(gaze_px.device, dtype)
    return ((seen_px >= -0.5) & (seen_px <= seen_px.new_tensor([width - 0.5, height - 0.5]))).all(-1)


def interpolate(values: Tensor, retina: Retina, px: Tensor) -> Tensor:
    """Values between the RFs, at any place of the retina.

    Bilinear in (log ρ, θ), with wrap-around in θ, on a log-polar retina, and on the lattice of a uniform one. From the
    centre of ring 0 inward a log-polar retina without a uniform fovea goes over, linearly in ρ, to the ring's mean. On
    any other layout linear over the triangles between neighbouring RFs (Delaunay's).

    Args:
        values: (B, C, N).
        retina: the layout.
        px: (..., 2), places [retinal px].

    Returns:
        (B, C, ...). Places beyond the outermost RFs get the nearest one's value.

    Raises:
        SettingError: for another number of values.

    Differentiable in the values and the places (bilinear: piecewise smooth in the places). For torch.compile one graph
    and clean for vmap, but for layouts of a user's own.
    """
    count = count_of(retina)
    fits = values.dim() == 3 and values.shape[-1] == count and values.is_floating_point()
    require(fits, "values.shape", (*values.shape, values.dtype), f"(B, C, {count}), floating point")
    given, values = values.dtype, values.to(wide(values.dtype))
    flat = px.to(values).reshape(-1, 2)
    if isinstance(retina, Uniform):
        out = _from_lattice(values, retina, flat)
    elif not isinstance(retina, LogPolar):
        out = from_triangles(values, retina.centers_px("cpu", torch.float64), flat)
    else:
        rings = ring_numbers(retina)
        out = _from_rings(values, rings, flat)
        if rings.fovea_count:
            inside = flat[:, 0] ** 2 + flat[:, 1] ** 2 < retina.rho_min_px**2
            out = torch.where(inside, _from_lattice(values[..., : rings.fovea_count], retina, flat), out)
    return out.reshape(*values.shape[:2], *px.shape[:-1]).to(given)


def reconstruct(
    values: Tensor, retina: Retina, size_px: int | tuple[int, int], scale: float | None = None
) -> tuple[Tensor, Tensor]:
    """Turn the RFs' values back into an image, looked at in its middle.

    Args:
        values: (B, C, N).
        retina: the layout.
        size_px: side, or height and width, of the image.
        scale: image pixels per retinal pixel; None lets the retina span the image's shorter side.

    Returns:
        The image (B, C, H, W), 0 outside the retina, and the mask (H, W) of pixels on the retina. See `interpolate`.

    Raises:
        SettingError: for another number of values or an impossible size.

    Differentiable in the values. Half precision is worked out in float32.
    """
    height, width = (size_px, size_px) if isinstance(size_px, int) else size_px
    scale = _checked_scale((height, width), retina, scale)
    x, y = (
        (torch.arange(side, device=values.device, dtype=wide(values.dtype)) - (side - 1) / 2) / scale
        for side in (width, height)
    )
    px = columns(*torch.broadcast_tensors(x, y[:, None]))
    mask = retina.inside(px)
    image = interpolate(values, retina, px)
    return torch.where(mask, image, torch.zeros_like(image)), mask


def kept(image: Tensor, retina: Retina) -> Tensor:
    """What a retina that looks at the middle of an image (C, H, W) keeps of it, as an image (C, H, W).

    It is 0 off the retina. Differentiable.
    """
    return reconstruct(fovea(image[None], None, retina), retina, (image.shape[-2], image.shape[-1]))[0][0]


def _checked_scale(size: tuple[int, ...] | torch.Size, retina: Retina, scale: float | None) -> float:
    require(len(size) == 2 and min(size) >= 1, "size", tuple(size), "a height and a width of at least 1 pixel")
    if scale is None:
        return min(size) / (2 * retina.radius_px)
    require(0 < scale < math.inf, "scale", scale, "a positive number of image pixels per retinal pixel")
    return float(scale)


def _check_gaze(gaze_px: Tensor) -> None:
    require_tensor(gaze_px, "gaze_px", "a tensor (B, 2) or (B, G, 2)")
    fits = gaze_px.dim() in (2, 3) and gaze_px.shape[-1] == 2
    require(fits, "gaze_px.shape", tuple(gaze_px.shape), "(B, 2) or (B, G, 2)")
    require_finite(gaze_px, "gaze_px", "finite pixels")


@constant
def count_of(retina: Retina) -> int:
    return retina.count


def _from_rings(values: Tensor, rings: Rings, px: Tensor) -> Tensor:
    """(B, C, N) at px (P, 2)."""
    fast = read_rings(values, rings, px)
    if fast is not None:
        return fast
    sectors, innermost = rings.shape[1], rings.innermost_px
    image = values[..., rings.fovea_count :].unflatten(-1, rings.shape)
    image = torch.cat([image[..., :1, :].mean(-1, keepdim=True).expand(*image.shape[:2], 1, sectors), image], -2)
    image = torch.cat([image[..., -1:], image, image[..., :1]], -1)
    x, y = px.unbind(-1)
    # on the axis there is no direction: the root under the floor and the angle have no gradient there
    rho = (x * x + y * y).clamp(min=1e-30).sqrt()
    ring = torch.log(rho.clamp(min=innermost) / innermost) / rings.growth
    # row 0 is ring 0's mean, at the centre; a uniform fovea stands in its place
    inward = torch.zeros_like(rho) if rings.fovea_count else (rho / innermost).clamp(max=1) - 1
    row = ring + inward + 1
    angle = torch.atan2(y, x)
    column = torch.remainder(angle * (sectors / (2 * math.pi)), sectors) + 0.5
    return _bilinear(image, column, row)


def _from_lattice(values: Tensor, retina: LogPolar | Uniform, px: Tensor) -> Tensor:
    """(B, C, N) of a uniform retina, or of a uniform fovea, at px (P, 2)."""
    lattice = lattice_image(retina, values.device)
    column, row = px.unbind(-1)
    return _bilinear(
        values[..., lattice.shown], column / lattice.pitch_px + lattice.column, row / lattice.pitch_px + lattice.row
    )


def _bilinear(image: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """(B, C, H, W) at (P,) columns and rows; the border's value beyond it."""
    height, width = image.shape[-2:]
    maps = torch.stack([column * (2 / (width - 1)) - 1, row * (2 / (height - 1)) - 1])
    return read(image, maps[:, None, None])[:, :, 0]


class _Lattice(NamedTuple):
    """The square image that holds a disc's lattice.

    Attributes:
        shown: which RF each pixel shows; corners show the nearest RF of their row.
        column: of the axis.
        row: of the axis.
        pitch_px: of the lattice.
    """

    shown: Tensor
    column: float
    row: float
    pitch_px: float


@constant
def lattice_image(retina: LogPolar | Uniform, device: torch.device) -> _Lattice:
    return _lattice_image(retina, device)


@lru_cache(maxsize=64)
def _lattice_image(retina: LogPolar | Uniform, device: torch.device) -> _Lattice:
    if isinstance(retina, Uniform):
        pitch, (places, axis) = retina.pitch_px, retina.lattice
    else:
        pitch, axis = retina.fovea_pitch_px, (-0.5, -0.5)
        fine = retina.centers_px("cpu", torch.float64)[: retina.fovea_count].numpy()
        places = np.rint(fine / pitch + np.array(axis)).astype(int)
    corner = places.min(0)
    shown = np.full((np.ptp(places, axis=0) + 1)[::-1], -1)
    shown[tuple((places - corner).T[::-1])] = np.arange(len(places))
    for row in shown:
        (filled,) = np.nonzero(row >= 0)
        row[: filled[0]], row[filled[-1] + 1 :] = row[filled[0]], row[filled[-1]]
    with torch.inference_mode(False):
        column, line = (float(one - other) for one, other in zip(axis, corner, strict=True))
        return _Lattice(torch.as_tensor(shown).to(device), column, line, float(pitch))
