"""Costs of inverse-range hypotheses on a sheet of one eye, read from the other eye's image.

Everything here is differentiable in the images, but for `inverse_depths`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.retina import Retina
from torchfovea.stereo.acuity import acuity, level_of
from torchfovea.stereo.sheets import Sheet, average
from torchfovea.stereo.views import Views

__all__ = [
    "Eye",
    "Hypotheses",
    "Looks",
    "correlate",
    "inverse_depths",
    "own_values",
    "project",
    "read_other",
    "read_own",
    "sheet_rays",
]


class Eye(NamedTuple):
    """One eye that looks for its RFs' likes in the other; B pairs of images.

    Attributes:
        camera: its own, in retinal pixels.
        other: the other eye's.
        R: (B, 3, 3), from its frame to the other's.
        t: (B, 3), its centre in the other's frame [m].
        ahead: (B, 3), the rectified frame's z axis in its own frame.
        images: (B, L, H, W), its image at the L levels of its pyramid; see `acuity`.
        others: of the other eye's.
        retina: of both.
        scale: image pixels per retinal pixel.
        middle: image pixel that its retina looks at, column and row.
        other_middle: the other eye's, in its image; None: the same.
    """

    camera: Camera
    other: Camera
    R: Tensor
    t: Tensor
    ahead: Tensor
    images: Tensor
    others: Tensor
    retina: Retina
    scale: float
    middle: tuple[float, float]
    other_middle: tuple[float, float] | None = None


class Looks(NamedTuple):
    """What a sheet's cells see in their own eye.

    Attributes:
        values: (B, 1, R, S), about 0.
        mean: of their neighbourhoods.
        variance: of their neighbourhoods.
    """

    values: Tensor
    mean: Tensor
    variance: Tensor


# planes beyond this depth per range (60 degrees from the axis) are spheres: a wide view's rim sees walls face on
PLANE = 0.5


def left_eye(pair: Tensor, views: Views, retina: Retina) -> Eye:
    """The left eye that looks for its RFs' likes in the right one.

    Args:
        pair: (2B, 1, H, W), both eyes' images in grey, all left ones first.
        views: their cameras, and how these stand.
        retina: of both.
    """
    scale, (middle, there), rig = views.scale(retina), views.gazes_px, views.rig
    batch = len(pair) // 2
    if there == middle:
        levels = acuity(pair, retina, scale, middle)
    else:
        levels = torch.cat([acuity(pair[:batch], retina, scale, middle), acuity(pair[batch:], retina, scale, there)])
    R_left, R_right = (r.to(pair).expand(batch, 3, 3) for r in (rig.R_left, rig.R_right))
    shift = -(R_right.mT @ pair.new_tensor([rig.baseline_m, 0.0, 0.0]))
    camera, other = views.cameras(retina)
    mine, theirs = levels[:batch], levels[batch:]
    return Eye(camera, other, R_right.mT @ R_left, shift, R_left[:, 2], mine, theirs, retina, scale, middle, there)


def sheet_rays(eye: Eye, px: Tensor) -> Tensor:
    """Rays of places (*cells, 2) in the other eye's frame, (B, *cells, 3), as long as their depth is 1.

    Depth is along the rectified frame's z axis, so that one inverse depth is one plane; beyond 60 degrees from that
    axis it is half the range.
    """
    x, y, z = eye.camera.rays(px).unbind(-1)
    ahead, length = _ahead(eye, x, y, z)
    inverse = 1 / torch.maximum(ahead, PLANE * length)
    over = (...,) + (None,) * x.dim()
    x, y, z = x * inverse, y * inverse, z * inverse
    return columns(*(eye.R[:, i, 0][over] * x + eye.R[:, i, 1][over] * y + eye.R[:, i, 2][over] * z for i in range(3)))


def sheet_depth(eye: Eye, px: Tensor) -> Tensor:
    """Depth along the rectified frame's z axis where a sheet's depth is 1, (B, *cells), at places (*cells, 2)."""
    ahead, length = _ahead(eye, *eye.camera.rays(px).unbind(-1))
    return (ahead / (PLANE * length)).clamp(max=1)


def _ahead(eye: Eye, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Depths (B, *cells) and lengths (*cells) of rays in the eye's frame."""
    over = (...,) + (None,) * x.dim()
    ahead = [a[over] for a in eye.ahead.unbind(-1)]
    return ahead[0] * x + ahead[1] * y + ahead[2] * z, (x * x + y * y + z * z).sqrt()


def project(eye: Eye, ray: Tensor, rho: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the other eye sees points on rays.

    Args:
        eye: whose rays they are.
        ray: (B, *cells, 3) from `sheet_rays`.
        rho: inverse depths [1/m] that broadcast to (B, D, *cells).

    Returns:
        Columns and rows (B, D, *cells) [retinal px], and bool, whether the other eye's retina does see them.
    """
    shift = eye.t[(..., *(None,) * (ray.dim() - 1))]
    x, y, z = (r[:, None] + rho * shift[:, i] for i, r in enumerate(ray.unbind(-1)))
    if isinstance(eye.other, Pinhole):  # spares half of the work
        ahead = z > 1e-3
        inverse = eye.other.focal_px / z.clamp(min=1e-3)
        u, v = x * inverse + eye.other.cx_px, y * inverse + eye.other.cy_px
    else:
        direction = columns(x, y, z)
        u, v = eye.other.project(direction).unbind(-1)
        ahead = eye.other.in_view(direction)
    return u, v, ahead & (u.detach().square() + v.detach().square() <= eye.retina.radius_px**2)


def _read(eye: Eye, other: bool, u: Tensor, v: Tensor, width_px: Tensor) -> Tensor:
    """Averages as wide as RFs of `width_px` (R, S), or wider where the retina is coarser, at places (B, D, R, S)."""
    images, middle = (eye.others, eye.other_middle or eye.middle) if other else (eye.images, eye.middle)
    height, width = images.shape[-2:]
    level = level_of(width_px, eye.scale).clamp(max=images.shape[1] - 1)
    low, high = int(level.min()), math.ceil(float(level.max()))
    across, down = 2 / max(width - 1, 1), 2 / max(height - 1, 1)
    grid = torch.stack(
        [u * (eye.scale * across) + (middle[0] * across - 1), v * (eye.scale * down) + (middle[1] * down - 1)],
        -1,
    )
    value: Tensor = F.grid_sample(
        images[:, low : high + 1], grid.flatten(2, 3), padding_mode="border", align_corners=True
    ).unflatten(-1, u.shape[-2:])
    out = value[:, 0]
    if high > low:
        out = out * (1 - (level - low)).clamp(min=0)
        for k in range(low + 1, high + 1):
            out = out + value[:, k - low] * (1 - (level - k).abs()).clamp(min=0)
    return out


def own_values(eye: Eye, sheet: Sheet, radius: int, noise: float) -> Looks:
    """What a sheet's cells see in their own eye."""
    u, v = (c.expand(len(eye.images), 1, -1, -1) for c in sheet.px.unbind(-1))
    values = _read(eye, False, u, v, sheet.width_px)
    return Looks(values, *_moments(values, sheet, radius, noise))


def read_other(eye: Eye, sheet: Sheet, ray: Tensor, rho: Tensor) -> Tensor:
    """What the other eye sees of points on the rays of a sheet's cells, (B, D, R, S); see `project`."""
    u, v, _ = project(eye, ray, rho)
    return _read(eye, True, u, v, sheet.width_px)


def read_own(eye: Eye, sheet: Sheet, ray: Tensor, step: Tensor) -> Tensor:
    """What an eye sees behind, at and ahead of a sheet's cells, (B, 3, R, S).

    Ahead is where a point is that the other eye sees beside its own, by as much as a cell's moves there if its inverse
    depth grows by `step` (B, R, S) [1/m].
    """
    shift = step[..., None] * eye.t[:, None, None]
    beside = torch.stack([ray - shift, ray + shift], 1) @ eye.R[:, None, None]
    u, v = eye.camera.project(beside).unbind(-1)
    own_u, own_v = (c.expand(len(ray), 1, -1, -1) for c in sheet.px.unbind(-1))
    u, v = (torch.cat([b[:, :1], own, b[:, 1:]], 1) for b, own in ((u, own_u), (v, own_v)))
    return _read(eye, False, u, v, sheet.width_px)


def _moments(values: Tensor, sheet: Sheet, radius: int, noise: float) -> tuple[Tensor, Tensor]:
    mean, square = (average(v, radius, sheet.closed) for v in (values, values * values))
    return mean, (square - mean * mean).clamp(min=0) + noise * noise


def correlate(
    eye: Eye, sheet: Sheet, own: Looks, ray: Tensor, rho: Tensor, radius: int, noise: float
) -> tuple[Tensor, Tensor]:
    """Zero-mean normalized cross-correlation of neighbourhoods with their likes in the other eye.

    Args:
        eye: whose sheet it is.
        sheet: R × S cells.
        own: what they see.
        ray: from `sheet_rays`.
        rho: hypotheses that broadcast to (B, D, R, S) [1/m].
        radius: half the side of a neighbourhood, in cells.
        noise: standard deviation of the images' noise; flat neighbourhoods correlate with nothing.

    Returns:
        (B, D, R, S) and bool, whether the other eye sees the cell itself.
    """
    u, v, seen = project(eye, ray, rho)
    values = _read(eye, True, u, v, sheet.width_px)
    mean, variance = _moments(values, sheet, radius, noise)
    cov = average(own.values * values, radius, sheet.closed) - own.mean * mean
    return cov * (own.variance * variance).rsqrt(), seen


class Hypotheses(NamedTuple):
    """Inverse depths that are tried for B pairs of images, ascending; those past a pair's own number mean nothing.

    Attributes:
        rho: (B, D) [1/m].
        number: int64 (B,), how many each pair has, at least 5 and at most D.
    """

    rho: Tensor
    number: Tensor


@torch.no_grad()
def inverse_depths(eye: Eye, sheet: Sheet, low: Tensor, high: Tensor, per_width: float, most: int) -> Hypotheses:
    """Hypotheses of inverse depth as dense as the two retinas can tell apart.

    Args:
        eye: whose sheet it is.
        sheet: its finest cell decides.
        low: the second hypothesis of each pair, (B,) [1/m].
        high: the last but one, > low, (B,) [1/m].
        per_width: hypotheses per RF width of motion in the other eye.
        most: at most so many.

    RFs widen away from the fixation of verged eyes, and hypotheses thin out.
    """
    part = torch.linspace(0, 1, 65, device=low.device, dtype=low.dtype)
    knots = low[:, None] + (high - low)[:, None] * part
    stride = max(1, round(math.sqrt(sheet.width_px.numel() / 400)))
    place, own = sheet.px[::stride, ::stride], sheet.width_px[::stride, ::stride]
    u, v, seen = project(eye, sheet_rays(eye, place), knots[..., None, None])
    seen &= eye.retina.inside(place)
    width = torch.maximum(eye.retina.width_px(columns(u, v)), own)
    motion = torch.hypot(u.diff(dim=1), v.diff(dim=1)) / torch.minimum(width[:, 1:], width[:, :-1])
    rate = torch.where(seen[:, 1:] & seen[:, :-1], motion, torch.zeros_like(motion)).amax((2, 3))
    # where nothing is seen, hypotheses only fill the gap
    rate = torch.maximum(rate, 1e-3 * rate.amax(1, keepdim=True) + 1e-6)
    steps = torch.cat([torch.zeros_like(rate[:, :1]), rate.cumsum(1)], 1) * per_width
    last = steps[:, -1:]
    count = last.ceil().clamp(2, most - 3).long()
    at = (torch.arange(int(count.max()) + 1, device=steps.device) / count).to(steps).clamp(max=1) * last
    k = torch.searchsorted(steps, at, right=True).clamp(1, steps.shape[1] - 1)
    before, after = (steps.gather(1, k + j) for j in (-1, 0))
    start, end = (knots.gather(1, k + j) for j in (-1, 0))
    rho = start + (at - before) / (after - before) * (end - start)
    beyond = 2 * rho.gather(1, count) - rho.gather(1, count - 1)
    rho = torch.cat([2 * rho[:, :1] - rho[:, 1:2], rho, rho[:, -1:]], 1)
    return Hypotheses(rho.scatter(1, count + 2, beyond), count[:, 0] + 3)
