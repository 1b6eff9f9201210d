"""Where a retina reads an image and the pyramid above it, and the reading, by kornia or by loops in C."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfovea.machine import Loops, columns_of, loops
from torchfovea.sensing.layout import LogPolar, Retina

__all__ = [
    "Rings",
    "Sampling",
    "constant",
    "halve",
    "place",
    "read",
    "read_fields",
    "read_rings",
    "ring_numbers",
    "sampling",
    "wide",
]

_F = TypeVar("_F", bound=Callable[..., Any])


class Sampling(NamedTuple):
    """Where a retina reads an image and its pyramid.

    The P places are, in this order: RFs 0…N−1 at the finer of their two levels, then RFs `first`…N−1, those wide enough
    to need a coarser one, at that. Layouts list narrow RFs first, so that every group is one slice. Coordinates, x and
    y apart, run from −1 to 1 between the border pixels: of the image for the places before `above`, of the stacked
    pyramid for the others.
    """

    fields: int  # N
    levels: int  # above the image
    first: int  # the first RF that needs two levels
    above: int  # the first RF that does not read the image itself
    blend: Tensor  # (N − first,), weight of the coarser level
    maps: Tensor  # (2, 1, 1, P), for a gaze at the image's pixel (0, 0)
    gain: Tensor  # (2, 1, 1, P), motion of the place per pixel of gaze
    low: Tensor  # (2, 1, 1, P), centres of the level's border pixels
    high: Tensor  # (2, 1, 1, P)
    middle: Tensor  # (2, 1, 1, P), the places for a gaze at the image's middle


def wide(dtype: torch.dtype) -> torch.dtype:
    """The type in which images of a type are read: at least float32."""
    return torch.promote_types(dtype, torch.float32)


def constant(function: _F) -> _F:
    """Mark a function whose result depends on constants alone, so that torch.compile keeps it instead of tracing it.

    As `torch.compiler.assume_constant_result` does, whose import takes seconds.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


def place(plan: Sampling, gaze_px: Tensor) -> Tensor:
    """Places (2, B, G, P) for gazes (B, G, 2), kept within their level's border."""
    maps = torch.addcmul(plan.maps, gaze_px.movedim(-1, 0)[..., None], plan.gain)
    return torch.maximum(torch.minimum(maps, plan.high), plan.low)


def read(image: Tensor, maps: Tensor) -> Tensor:
    """(B, C, G, P) of images (B, C, H, W) at places (2, B or 1, G, P), the border's value beyond it."""
    library = loops(image, maps)
    if library is not None:
        count = maps.shape[-1]
        return _by_loops(library, image, maps, (count, 0, count, count, None))
    # kornia takes as long to import as this whole package; only who looks needs it
    from kornia.geometry.transform import remap

    x, y = maps
    seen: Tensor = remap(image, x, y, padding_mode="border", align_corners=True, normalized_coordinates=True)
    return seen


def read_fields(image: Tensor, maps: Tensor, plan: Sampling) -> Tensor:
    """What RFs see, (B, C, G, N), of images (B, C, H, W) at a plan's places. Differentiable."""
    library = loops(image, maps)
    if library is not None:
        return _by_loops(library, image, maps, (plan.fields, plan.levels, plan.first, plan.above, plan.blend))
    values = read(image, maps[..., : plan.above])
    if not plan.levels:
        return values
    higher = read(_pyramid(image, plan.levels), maps[..., plan.above :])
    fine, coarse = higher[..., : plan.fields - plan.above], higher[..., plan.fields - plan.above :]
    blended = torch.lerp(torch.cat([values[..., plan.first :], fine], -1), coarse, plan.blend)
    return torch.cat([values[..., : plan.first], blended], -1)


def halve(image: Tensor) -> Tensor:
    """The next level of the pyramid, ⌈H/2⌉ × ⌈W/2⌉; replicated beyond the border."""
    return _halve_along(_halve_along(image, -2), -1) / 64


def _halve_along(image: Tensor, dim: int) -> Tensor:
    """Weights (1, 3, 3, 1) at every second pixel; slices are faster here than a convolution."""
    if image.shape[dim] % 2:
        image = torch.cat([image, image.narrow(dim, -1, 1)], dim)
    pairs: Tensor = image.unflatten(dim, (-1, 2))
    even, odd = pairs.unbind(dim)
    count = even.shape[dim]
    out = (even + odd).mul_(3)
    out.narrow(dim, 1, count - 1).add_(odd.narrow(dim, 0, count - 1))
    out.narrow(dim, 0, count - 1).add_(even.narrow(dim, 1, count - 1))
    out.narrow(dim, 0, 1).add_(even.narrow(dim, 0, 1))
    out.narrow(dim, -1, 1).add_(odd.narrow(dim, -1, 1))
    return out


def _pyramid(image: Tensor, levels: int) -> Tensor:
    """Levels 1…`levels` of the pyramid, one below the other."""
    parts, width = [], (image.shape[-1] + 1) // 2
    for _ in range(levels):
        image = halve(image)
        parts.append(pad(image, (0, width - image.shape[-1])))
    return torch.cat(parts, -2)


def _by_loops(library: Loops, image: Tensor, maps: Tensor, plan: tuple[int, int, int, int, Tensor | None]) -> Tensor:
    """`read_fields` by a plan as sampling.c wants it."""
    image = image if image.stride(-1) == 1 else image.contiguous()
    x, y = maps.expand(-1, len(image), -1, -1)
    values = image.new_empty(*image.shape[:2], x.shape[1], plan[0])
    library("look", (*image.shape, *image.stride()[:3], image), (x, y, *x.shape, *x.stride()), plan, values)
    return values


def read_rings(values: Tensor, rings: Rings, px: Tensor) -> Tensor | None:
    """(B, C, P) of a log-polar retina's values (B, C, N) at places (P, 2) [retinal px], by the loop of sampling.c.

    None where there is no such loop, see `torchfovea.machine.loops`.
    """
    library = loops(values, px)
    if library is None:
        return None
    seen = values.new_empty(*values.shape[:2], len(px))
    sizes = (values.shape[:2].numel(), values.shape[-1], rings.fovea_count, *rings.shape, len(px))
    library("read_rings", (*sizes, values.contiguous(), columns_of(px), rings.innermost_px, rings.growth), seen)
    return seen


class Rings(NamedTuple):
    """A log-polar retina's numbers.

    Attributes:
        shape: rings and sectors.
        fovea_count: fields before those of the first ring.
        innermost_px: radius of the first ring.
        growth: by which the logarithm of the next one's is larger.
    """

    shape: tuple[int, int]
    fovea_count: int
    innermost_px: float
    growth: float


@constant
def ring_numbers(retina: LogPolar) -> Rings:
    """What places on a log-polar retina are counted by."""
    innermost = retina.rho_min_px * math.sqrt(retina.base)
    return Rings(retina.shape, retina.fovea_count, innermost, math.log(retina.base))


@constant
def sampling(
    retina: Retina, height: int, width: int, scale: float, device: torch.device, dtype: torch.dtype
) -> Sampling:
    """The plan of a retina on images of one size; built once."""
    return _sampling(retina, height, width, scale, device, dtype)


@lru_cache(maxsize=32)
def _sampling(
    retina: Retina, height: int, width: int, scale: float, device: torch.device, dtype: torch.dtype
) -> Sampling:
    with torch.inference_mode(False), torch.no_grad():
        centers = retina.centers_px("cpu", torch.float64)
        level = (torch.log2(retina.width_px(centers) * scale) - 1).numpy()
        levels = max(0, min(math.ceil(level.max()), int(math.log2(min(height, width)))))
        # layouts list narrow RFs first (but for a few percent where a uniform fovea ends): the wide ones are one slice
        level = np.maximum.accumulate(level.clip(0, levels))
        first = int(np.argmax(level > 0)) if (level > 0).any() else retina.count
        fine = np.minimum(np.floor(level), max(levels - 1, 0)).astype(int)
        above = int(np.argmax(fine > 0)) if (fine > 0).any() else retina.count
        sizes = [np.array([width, height])]
        for _ in range(levels):
            sizes.append((sizes[-1] + 1) // 2)
        offsets = [np.zeros(2)] + [np.array([0, sum(s[1] for s in sizes[1:i])]) for i in range(1, levels + 1)]
        extents = [sizes[0]] + [np.array([sizes[1][0], sum(s[1] for s in sizes[1:])]) for _ in range(levels)]
        which = np.concatenate([fine, fine[first:] + 1])
        px = scale * np.concatenate([centers.numpy(), centers.numpy()[first:]])
        shrink = 0.5 ** which[:, None]
        low = np.array(offsets)[which]
        high = low + np.array(sizes)[which] - 1
        # a pixel's side spans 2/(extent − 1) of these coordinates; along one pixel any coordinate will do
        unit = 2 / np.maximum(np.array(extents)[which] - 1, 1)
        maps, gain, low, high = (
            torch.as_tensor(np.ascontiguousarray(part.T[:, None, None])).to(device, dtype)
            for part in (
                (px * shrink + 0.5 * shrink - 0.5 + low) * unit - 1,
                shrink * unit,
                low * unit - 1,
                high * unit - 1,
            )
        )
        blend = torch.as_tensor((level - fine)[first:]).to(device, dtype)
        plan = Sampling(retina.count, levels, first, above, blend, maps, gain, low, high, middle=maps)
        gaze_px = torch.tensor([[[(width - 1) / 2, (height - 1) / 2]]], device=device, dtype=dtype)
        # pairs side by side in memory: remap puts its x and y so, and is faster where they are
        return plan._replace(middle=place(plan, gaze_px).movedim(0, -1).contiguous().movedim(-1, 0))
