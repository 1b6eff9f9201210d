"""Rectified views: parallel cameras, in which a point lies on one row of both, and how they belong to the retinas.

A rectified pair is its own; two eyes' are cut from what their retinas keep. Not differentiable.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.rounding import unrounded
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.head import to_ego
from torchfovea.sensing.retina import Retina, interpolate
from torchfovea.setting import require
from torchfovea.stereo.views import Views

__all__ = ["Part", "RectifiedPair", "frame_to_match", "frame_to_show", "image_frame"]


class Part(NamedTuple):
    """A rectangle of rectified views, as pixels that are each so many of theirs wide.

    Attributes:
        left: its first column [view px].
        top: its first row [view px].
        size: height and width, in its own pixels.
        step: side of one of its pixels [view px].
    """

    left: int
    top: int
    size: tuple[int, int]
    step: int = 1


class RectifiedPair(NamedTuple):
    """The rectified views of two images.

    Attributes:
        views: the images.
        retina: of both; None: the receptive fields (RFs) are the pixels of a rectified pair.
        camera: the left view's, a pinhole; the right one's differs by `Views.doffs_px`.
        size: height and width [px].
        limit: |x/z| and |y/z| beyond which the view shows nothing.
        looks: bool (H, W), where the left eye looks; None: everywhere.
    """

    views: Views
    retina: Retina | None
    camera: Pinhole
    size: tuple[int, int]
    limit: float = math.inf
    looks: Tensor | None = None

    def room(self, part: Part, rows: int, before: int, after: int) -> tuple[int, int, int, int]:
        """How many of a part's pixels there are above, below, before and after it in the views, at most so many."""
        height, width = (-(-side // part.step) for side in self.size)
        top, left = part.top // part.step, part.left // part.step
        below, right = height - top - part.size[0], width - left - part.size[1]
        return min(top, rows), min(below, rows), min(left, before), min(right, after)

    def place(self, px: Tensor) -> tuple[Tensor, Tensor]:
        """Where the left view shows places (..., 2) of the left eye [retinal px], and whether it does: bool (...)."""
        views = self.views
        if views.rectified:
            place = px * views.scale(self.retina) + px.new_tensor(views.origin_px(self.retina))
            return place, torch.ones_like(px[..., 0], dtype=torch.bool)
        directions = to_ego(views.rig.R_left.to(px), views.cameras(self.retina)[0].rays(px))
        x, y, z = directions.unbind(-1)
        ahead = self.camera.in_view(directions)
        return self.camera.project(directions), ahead & (x.abs() <= self.limit * z) & (y.abs() <= self.limit * z)

    def there(self, px: Tensor, place: Tensor, shift_px: Tensor) -> tuple[Tensor, Tensor]:
        """Where the right eye sees what the left one sees at places (N, 2), and whether it does: bool (N,).

        Args:
            px: [retinal px].
            place: of these in the left view (N, 2), see `place`.
            shift_px: disparities (N,) [view px], without doffs.
        """
        views, retina = self.views, self.retina
        if views.rectified:
            there = columns(px[..., 0] - shift_px / views.scale(retina), px[..., 1])
            seen = views.holds(there, retina)
        else:
            camera = views.cameras(retina)[1]
            rays = self.camera.rays(columns(place[..., 0] - shift_px, place[..., 1]))
            rays = to_ego(views.rig.R_right.to(px).mT, rays)
            there = camera.project(rays)
            seen = camera.in_view(rays) & views.holds(there, retina, right=True)
        return there, seen if retina is None else seen & retina.inside(there)

    def seen(self, like: Tensor, part: Part | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Where both eyes see pixels, (H, W, 2) [retinal px], and where they are before the left: bool.

        Args:
            like: of the result's device and type.
            part: whose pixels; None: the views'.
        """
        views, retina = self.views, self.retina
        part = part or Part(0, 0, self.size)
        row, column = (
            torch.arange(n, device=like.device, dtype=like.dtype) * part.step + (first + (part.step - 1) / 2)
            for n, first in zip(part.size, (part.top, part.left), strict=True)
        )
        if views.rectified:
            px = columns(column, row[:, None])
            place = (px - px.new_tensor(views.origin_px(retina))) / views.scale(retina)
            return place, place, torch.ones_like(px[..., 0], dtype=torch.bool)
        x, y, z = self.camera.ray_components(column, row[:, None])
        # a row and a column of them are added up: no more is done for every pixel
        turned = [columns(*(x * a + z * c + y * b for a, b, c in R.to(like).mT)) for R in views.rig[:2]]
        left, right = (c.project(r) for c, r in zip(views.cameras(retina), turned, strict=True))
        return left, right, views.cameras(retina)[0].in_view(turned[0])

    def kept(self, images: Tensor, left_px: Tensor, right_px: Tensor) -> Tensor:
        """The views of images (2, C, ...) as the retinas keep them, (2, C, H, W); places as `seen` tells them."""
        if self.retina is None:
            return images
        values = self.views.fovea(images, self.retina)
        if right_px is left_px:
            return interpolate(values, self.retina, left_px)
        return torch.cat([interpolate(values[i : i + 1], self.retina, px) for i, px in enumerate((left_px, right_px))])

    def looked_at(self, left_px: Tensor, ahead: Tensor, slack_px: float = 0.0) -> Tensor | None:
        """Where the left eye looks, bool (H, W), or so many source pixels beyond its rim; None: everywhere."""
        if self.retina is None:
            return None
        near = self.retina.inside(left_px * (1 - 2 * slack_px / self.views.source_px)) & ahead
        return near if self.views.framed else near & self.views.holds(left_px, self.retina, slack_px + 0.5)


def image_frame(views: Views, retina: Retina | None) -> RectifiedPair:
    """The images of a rectified pair themselves.

    Raises:
        SettingError: for views that are not rectified.
    """
    require(views.rectified, "views", "views that are not rectified", "a rectified pair (rectified_views)")
    _check_single(views)
    assert isinstance(views.camera_left, Pinhole)
    height, width = views.left.shape[-2:]
    return RectifiedPair(views, retina, views.camera_left, (height, width))


@unrounded
def frame_to_match(
    views: Views, retina: Retina | None, nearest_m: float, fov_deg: float, search: tuple[int, int]
) -> RectifiedPair:
    """What both eyes can see of anything between the nearest range and infinity, and the search range to its left.

    Args:
        views: whose rig is that of two eyes.
        retina: of both.
        nearest_m: nearest depth.
        fov_deg: widest view, in degrees.
        search: the first disparity searched and one past the last, in image pixels.
    """
    retina = _checked(views, retina)
    focal, baseline, limit = views.camera_left.focal_px, views.rig.baseline_m, _limit(fov_deg)
    like = views.left.detach()
    (l_low, l_high), (r_low, r_high) = (
        _extent(camera, retina, R.to(like), limit)
        for camera, R in zip(views.cameras(retina), views.rig[:2], strict=True)
    )
    low = torch.maximum(l_low, r_low)
    high = torch.minimum(l_high, r_high + r_high.new_tensor([baseline / nearest_m, 0.0]))
    width, height = (((high - low) * focal).ceil().int() + 1).clamp(min=1).tolist()
    before, after = max(search[1], 0), max(-search[0], 0)
    camera = Pinhole(focal, before - low[0].item() * focal, -low[1].item() * focal)
    return RectifiedPair(views, retina, camera, (height, before + width + after), limit)


@unrounded
def frame_to_show(views: Views, retina: Retina | None, fov_deg: float) -> RectifiedPair:
    """What the left eye sees, to be shown to somebody else's matcher; arguments as of `frame_to_match`.

    Raises:
        SettingError: where the left eye sees nothing of it.
    """
    retina = _checked(views, retina)
    focal, limit, R = views.camera_left.focal_px, _limit(fov_deg), views.rig.R_left.to(views.left)
    directions = views.cameras(retina)[0].rays(retina.centers_px(views.left.device, views.left.dtype)) @ R.mT
    x, y, z = directions.unbind(-1)
    inside = (z > 0) & (x.abs() <= limit * z) & (y.abs() <= limit * z)
    require(bool(inside.any()), "matcher.rectified_fov_deg", fov_deg, "a view that the left eye sees")
    slope = (directions[..., :2] / z.clamp(min=1e-6)[..., None])[inside]
    low, high = slope.amin(0), slope.amax(0)
    width, height = ((high - low) * focal).ceil().int().add(1).tolist()
    camera = Pinhole(focal, -low[0].item() * focal, -low[1].item() * focal)
    return RectifiedPair(views, retina, camera, (height, width), limit)


def _extent(camera: Camera, retina: Retina, rotation: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The box of x/z and y/z that an eye's retina spans in the rectified frame: lowest (2,), highest (2,)."""
    angle = torch.linspace(0, 2 * math.pi, 257, device=rotation.device, dtype=rotation.dtype)
    # a lens may show nothing at the rim: the widest ring that it does show decides
    radius = retina.radius_px * torch.arange(9, device=rotation.device, dtype=rotation.dtype)[:, None] / 8
    rays = camera.rays(torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], -1).flatten(0, 1))
    directions = rays[camera.in_view(rays)] @ rotation.mT
    # what lies behind is beyond the limit on its side
    slope = directions[:, :2] / directions[:, 2:].clamp(min=1e-6)
    slope = slope.clamp(-limit, limit)
    return slope.amin(0), slope.amax(0)


def _limit(fov_deg: float) -> float:
    return math.tan(math.radians(fov_deg) / 2)


def _checked(views: Views, retina: Retina | None) -> Retina:
    require(retina is not None, "retina", None, "a retina, for views that are not rectified")
    assert retina is not None
    _check_single(views)
    return retina


def _check_single(views: Views) -> None:
    require(views.left.dim() == 3, "left.shape", tuple(views.left.shape), "(3, H, W) or (1, H, W), for this matcher")
