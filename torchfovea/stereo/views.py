"""Two images with their cameras, how these stand, and where retinas look: what every matcher is given, checked once.

Cameras are in image pixels here, whose centres are integers, for a pair of images is one without any retina too. A
retina spans the images' shorter side about the gaze, so that `Views.cameras` knows them in its pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.retina import Retina, fovea
from torchfovea.setting import require
from torchfovea.stereo.rig import StereoRig

__all__ = ["Views", "batched_views", "grey_of", "posed_views", "rectified_views", "verged_views"]


class Views(NamedTuple):
    """Two images of one moment; made by `verged_views`, `rectified_views` or `posed_views`, which check them.

    Attributes:
        left: (1 or 3, H, W), floating point in [0, 1]; or a batch (B, 1 or 3, H, W), for matchers that take one.
        right: of the same height, width, type and device.
        camera_left: in image pixels.
        camera_right: in image pixels.
        rig: how the cameras stand; its rotations may be a batch (B, 3, 3), too.
        gaze_px: image pixel (column, row) that the retinas look at, in both images, or in the left one.
        rectified: whether the images are rectified views as they are: no rotation, and pinholes that differ in cx
            alone, so that matchers need not resample them.
        span_px: side of the square about the gaze that the retinas span; None: the images' shorter side.
        gaze_right_px: the right image's pixel that its retina looks at, where it is another one; else None.
    """

    left: Tensor
    right: Tensor
    camera_left: Camera
    camera_right: Camera
    rig: StereoRig
    gaze_px: tuple[float, float]
    rectified: bool = False
    span_px: int | None = None
    gaze_right_px: tuple[float, float] | None = None

    @property
    def gazes_px(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """What the left and the right retina look at, each in its image."""
        return self.gaze_px, self.gaze_px if self.gaze_right_px is None else self.gaze_right_px

    @property
    def source_px(self) -> int:
        """What a retina spans [px]: the images' shorter side, if nothing else is said."""
        return min(self.left.shape[-2:]) if self.span_px is None else self.span_px

    @property
    def framed(self) -> bool:
        """Whether all that the left retina spans is on the image."""
        sides = zip(self.gaze_px, self.left.shape[:-3:-1], strict=True)
        return all(abs(at - (side - 1) / 2) <= (side - self.source_px) / 2 for at, side in sides)

    def whole(self) -> Views:
        """The same, with retinas that span all of the images, whatever pixel they look at."""
        height, width = self.left.shape[-2:]
        reach = max(math.hypot(max(u, width - 1 - u) + 0.5, max(v, height - 1 - v) + 0.5) for u, v in self.gazes_px)
        return self._replace(span_px=math.ceil(2 * reach))

    @property
    def doffs_px(self) -> float:
        """Disparity of a point at infinity in rectified images, negated: cx_right − cx_left; else 0 [px]."""
        return self.camera_right.cx_px - self.camera_left.cx_px if self.rectified else 0.0

    def scale(self, retina: Retina | None) -> float:
        """Image pixels per retinal pixel; 1 without a retina, whose receptive fields (RFs) are the pixels then."""
        return 1.0 if retina is None else self.source_px / (2 * retina.radius_px)

    def origin_px(self, retina: Retina | None, right: bool = False) -> tuple[float, float]:
        """The image pixel where retinal coordinates are 0: the gaze; without a retina the first pixel."""
        return (0.0, 0.0) if retina is None else self.gazes_px[right]

    def cameras(self, retina: Retina | None) -> tuple[Camera, Camera]:
        """Both cameras in retinal pixels, those of the correspondences."""
        scale = self.scale(retina)
        (u, v), (s, t) = (self.origin_px(retina, right) for right in (False, True))
        return (
            self.camera_left.scaled(1 / scale, (-u / scale, -v / scale)),
            self.camera_right.scaled(1 / scale, (-s / scale, -t / scale)),
        )

    def holds(self, px: Tensor, retina: Retina | None, slack_px: float = 0.0, right: bool = False) -> Tensor:
        """Whether places (..., 2) [retinal px] lie on an image, or so many image pixels beyond; bool (...)."""
        place = px * self.scale(retina) + px.new_tensor(self.origin_px(retina, right))
        height, width = self.left.shape[-2:]
        low, high = -0.5 - slack_px, place.new_tensor([width - 0.5 + slack_px, height - 0.5 + slack_px])
        return ((place >= low) & (place <= high)).all(-1)

    def told(self, budget: Budget | None) -> Budget:
        """The error budget (the default for None) that knows the images' size, unless it leaves the source out."""
        budget = budget or Budget()
        return budget if budget.source_px is None else replace(budget, source_px=self.source_px)

    def grey(self) -> Tensor:
        """Both in grey, (2, 1, H, W), or (2B, 1, H, W) with all left ones first. Differentiable."""
        greys = [grey_of(image) for image in (self.left, self.right)]
        return torch.cat([grey if grey.dim() == 4 else grey[None] for grey in greys])

    def colour(self) -> Tensor:
        """Both in colour, (2, 3, H, W), of single images. Differentiable."""
        return torch.stack([image.expand(3, -1, -1) for image in (self.left, self.right)])

    def fovea(self, images: Tensor, retina: Retina) -> Tensor:
        """What retinas see of images (B, C, H, W) of this size, (B, C, N): both eyes', or B of the left eye.

        Differentiable.
        """
        if self.gaze_right_px is not None and len(images) == 2:
            return fovea(images, images.new_tensor(self.gazes_px), retina, self.scale(retina))
        gaze = None if self.gaze_px == _middle(images) else images.new_tensor([self.gaze_px] * len(images))
        return fovea(images, gaze, retina, self.scale(retina))


def grey_of(image: Tensor) -> Tensor:
    """Images (..., 1 or 3, H, W) in grey, (..., 1, H, W). Differentiable."""
    # kornia takes as long to import as this whole package; only who looks needs it
    from kornia.color import rgb_to_grayscale

    return rgb_to_grayscale(image) if image.shape[-3] == 3 else image


def verged_views(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    rig: StereoRig,
    camera: Camera,
    radius_px: float,
    camera_right: Camera | None = None,
) -> Views:
    """The images of two eyes, whose retinas look at their middles and span their shorter side.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8; or a batch (B, 1 or 3, H, W). Half precision becomes float32, of which
            correspondences are.
        right: the same size.
        rig: the eyes' poses (`torchfovea.stereo.rig`); a batch may have (B, 3, 3) rotations.
        camera: the left eye's, or both eyes', in retinal pixels.
        radius_px: of the retinas.
        camera_right: the right eye's, if it differs.

    Raises:
        SettingError: for images that are not finite, not of one size or out of [0, 1], and what is no camera or rig.
    """
    images = _images(left, right)
    require(0 < radius_px < math.inf, "radius_px", radius_px, "a positive number of retinal pixels")
    size, (u, v) = min(images[0].shape[-2:]), _middle(images[0])
    cameras = []
    for name, eye in (("camera", camera), ("camera_right", camera_right or camera)):
        _check_camera(name, eye)
        cameras.append(eye.scaled(size / (2 * radius_px), (u, v)))
    _check_rig(rig, images[0])
    return Views(*images, cameras[0], cameras[1], rig, (u, v))


def rectified_views(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    camera_left: Pinhole,
    camera_right: Pinhole,
    baseline_m: float,
    gaze_px: tuple[float, float] | None = None,
) -> Views:
    """A pair that is already rectified.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8.
        right: the same size.
        camera_left: in image pixels.
        camera_right: in image pixels; the same focal length and cy.
        baseline_m: distance between the cameras.
        gaze_px: (column, row) that the retinas look at; None for the images' middle.

    Raises:
        SettingError: as `verged_views`, and for cameras that are not rectified.
    """
    for name, camera in (("camera_left", camera_left), ("camera_right", camera_right)):
        require(isinstance(camera, Pinhole), name, camera, "a Pinhole in image pixels")
    same = (camera_left.focal_px, camera_left.cy_px) == (camera_right.focal_px, camera_right.cy_px)
    require(same, "camera_right", camera_right, f"focal_px and cy_px of the left camera, {camera_left}")
    eye = torch.eye(3, dtype=torch.float64)
    views = posed_views(left, right, camera_left, camera_right, StereoRig(eye, eye, baseline_m), gaze_px)
    return views._replace(rectified=True)


def posed_views(
    left: Tensor | np.ndarray,
    right: Tensor | np.ndarray,
    camera_left: Camera,
    camera_right: Camera,
    rig: StereoRig,
    gaze_px: tuple[float, float] | None = None,
    gaze_right_px: tuple[float, float] | None = None,
) -> Views:
    """The images of any calibrated pair.

    Args:
        left: (1 or 3, H, W) in [0, 1], or uint8; or a batch (B, 1 or 3, H, W).
        right: the same size.
        camera_left: in image pixels.
        camera_right: in image pixels.
        rig: how they stand (`torchfovea.stereo.rig.posed`).
        gaze_px: (column, row) that the retinas look at; None for the images' middle.
        gaze_right_px: the right one's, if it is another: eyes that meet at something near see both of it sharply.

    Raises:
        SettingError: as `verged_views`.
    """
    images = _images(left, right)
    _check_camera("camera_left", camera_left)
    _check_camera("camera_right", camera_right)
    _check_rig(rig, images[0])
    gazes = []
    for name, given in (("gaze_px", gaze_px), ("gaze_right_px", gaze_right_px)):
        u, v = _middle(images[0]) if given is None else given
        require(math.isfinite(u) and math.isfinite(v), name, given, "finite pixels")
        gazes.append((float(u), float(v)))
    other = None if gaze_right_px is None or gazes[0] == gazes[1] else gazes[1]
    return Views(*images, camera_left, camera_right, rig, gazes[0], gaze_right_px=other)


def batched_views(views: Sequence[Views]) -> Views | None:
    """Single pairs as one batch; None where they differ in more than their pictures and how the cameras are turned."""
    first = views[0]
    shapes = [(v.left.shape, v.right.shape, v.left.dtype, v.left.device, v.rig.baseline_m) for v in views]
    rest = [v._replace(left=first.left, right=first.right, rig=first.rig) for v in views]
    if any(shape != shapes[0] for shape in shapes) or any(other != first for other in rest):
        return None
    R_left, R_right = torch.stack([v.rig.R_left for v in views]), torch.stack([v.rig.R_right for v in views])
    left, right = torch.stack([v.left for v in views]), torch.stack([v.right for v in views])
    return first._replace(left=left, right=right, rig=StereoRig(R_left, R_right, first.rig.baseline_m))


def _images(left: Tensor | np.ndarray, right: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """Both as floating-point tensors of one type; checked."""
    one, other = (_image(name, image) for name, image in (("left", left), ("right", right)))
    shapes = [(*image.shape[:-3], *image.shape[-2:]) for image in (one, other)]
    expected = f"height and width {tuple(one.shape[-2:])}, as the left image"
    require(shapes[0] == shapes[1], "right.shape", tuple(other.shape), expected)
    return one, other.to(one)


def _image(name: str, image: Tensor | np.ndarray) -> Tensor:
    pixels = torch.as_tensor(image)
    shape = tuple(pixels.shape)
    fits = len(shape) in (3, 4) and shape[-3] in (1, 3)
    require(fits, f"{name}.shape", shape, "(3, H, W) or (1, H, W), or a batch of such")
    require(min(shape) >= 1, f"{name}.shape", shape, "at least one pixel")
    if pixels.dtype == torch.uint8:
        pixels = pixels.to(torch.get_default_dtype()) / 255
    require(pixels.is_floating_point(), f"{name}.dtype", pixels.dtype, "floating point in [0, 1], or uint8")
    pixels = pixels if pixels.dtype == torch.float64 else pixels.float()
    low, high = (float(end) for end in pixels.detach().aminmax())  # NaN if there is any
    require(math.isfinite(low) and math.isfinite(high), name, "NaN or infinite values", "finite values")
    require(low >= -1e-3 and high <= 1 + 1e-3, name, f"{low:g} to {high:g}", "values in [0, 1]")
    return pixels


def _check_camera(name: str, camera: Camera) -> None:
    require(isinstance(camera, Camera), name, camera, "a camera: Pinhole, Fisheye, BrownConrady, KannalaBrandt")


def _check_rig(rig: StereoRig, image: Tensor) -> None:
    """Raise SettingError unless the rig is of one pair, or of as many as there are images."""
    require(isinstance(rig, StereoRig), "rig", type(rig).__name__, "a StereoRig (verged, posed)")
    shapes = [(3, 3)] if image.dim() == 3 else [(3, 3), (len(image), 3, 3)]
    for name in ("R_left", "R_right"):
        shape = tuple(getattr(rig, name).shape)
        require(shape in shapes, f"rig.{name}.shape", shape, " or ".join(map(str, shapes)))
    require(0 < rig.baseline_m < math.inf, "baseline_m", rig.baseline_m, "a positive distance in metres")


def _middle(image: Tensor) -> tuple[float, float]:
    height, width = image.shape[-2:]
    return (width - 1) / 2, (height - 1) / 2
