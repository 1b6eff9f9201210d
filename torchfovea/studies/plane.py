"""A textured plane, drawn for both eyes without a renderer: exact geometry to judge matchers against.

The texture is noise of equal contrast in every octave, so that there is something to match at every distance and for
every receptive field. An octave fades where a pixel's footprint on the plane outgrows it: images are free of aliasing.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchfovea.sensing.camera import Camera, image_camera
from torchfovea.sensing.head import Eyes, to_ego
from torchfovea.setting import require
from torchfovea.studies.characterization import plane_points

__all__ = ["draw_plane", "octave_noise"]

OCTAVES = 13  # with knots 1 m apart, and half as far in each that follows
TABLE = 256  # knots of an octave's random surface along a side, after which it repeats
UNSEEN = 1e-9  # an octave of less contrast is left out


def octave_noise(place_m: Tensor, footprint_m: Tensor, generator: torch.Generator) -> Tensor:
    """Noise of equal contrast in every octave.

    Args:
        place_m: (..., 2), places on the surface.
        footprint_m: (...), size of what looks at each place; finer octaves fade.
        generator: draws the surface: the same state, the same surface.

    Returns:
        (...) in (0, 1). Differentiable in the place.
    """
    total = torch.zeros_like(footprint_m)
    flat = place_m.reshape(1, -1, 1, 2)
    for k in range(OCTAVES):
        spacing = 0.5**k
        table = torch.randn(TABLE, TABLE, generator=generator, dtype=place_m.dtype)
        shift = TABLE * torch.rand(2, generator=generator, dtype=place_m.dtype)
        # two more knots on either side: cubic interpolation goes on across the seam
        wrapped = F.pad(table[None, None].to(place_m), (2, 2, 2, 2), mode="circular")
        fade = torch.exp(-0.8 * (footprint_m / spacing) ** 2)
        if float(fade.detach().max()) < UNSEEN:
            continue
        grid = 2 * (torch.remainder(flat / spacing + shift.to(place_m), TABLE) + 2) / (TABLE + 3) - 1
        surface = F.grid_sample(wrapped, grid, mode="bicubic", align_corners=True).reshape(footprint_m.shape)
        total = total + fade * surface
    return 0.5 + 0.5 * torch.tanh(0.35 * total)


def draw_plane(
    camera: Camera, radius_px: float, size_px: int, pose: Eyes, distance_m: float, seed: int
) -> tuple[Tensor, Tensor]:
    """Images of the textured plane x = distance in E.

    Args:
        camera: of both eyes, in retinal pixels.
        radius_px: the retina's radius; the image spans its diameter.
        size_px: side of the images.
        pose: poses of the eyes, without batch axes; their dtype is the images'.
        distance_m: the plane.
        seed: of the texture, which both eyes and every distance share.

    Returns:
        Left and right (1, size, size) in [0, 1]; grey where a pixel looks past the plane.

    Raises:
        SettingError: for an empty image or a plane that is not in front.
    """
    require(size_px >= 2, "source_px", size_px, "at least 2 pixels")
    require(distance_m > 0, "distance_m", distance_m, "a positive distance in metres")
    eye = image_camera(camera, radius_px, size_px)
    side = torch.arange(size_px, dtype=pose.t_left.dtype)
    px = torch.stack(torch.broadcast_tensors(side, side[:, None]), -1).reshape(-1, 2)
    images = []
    for rotation, origin in ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right)):
        rays = to_ego(rotation, eye.rays(px))
        points, meets = plane_points(rays, origin, distance_m)
        length = rays.norm(dim=-1)
        slant = torch.where(meets, rays[..., 0], length) / length
        footprint = (points - origin).norm(dim=-1) / (eye.focal_px * slant)
        shade = octave_noise(points[..., 1:], footprint, torch.Generator().manual_seed(seed))
        images.append(torch.where(meets, shade, torch.full_like(shade, 0.5)).reshape(1, size_px, size_px))
    return images[0], images[1]
