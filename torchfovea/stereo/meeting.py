"""Where the right eye has what the left one looks at: a glance before the look, for images that no head has aimed.

A head turns both eyes to one thing. Two images of fixed cameras show something near at places far apart, of which one
retina would have its fovea on it and the other only its periphery. Not differentiable.
"""

from __future__ import annotations

import torch

from torchfovea.sensing.layout import Uniform
from torchfovea.stereo.sweep import match_sweep
from torchfovea.stereo.views import Views

__all__ = ["met", "right_gaze_px"]

GLANCE = Uniform(4000)
NEAREST = 9  # receptive fields, whose median no single wrong match moves


@torch.no_grad()
def right_gaze_px(views: Views, nearest_m: float = 0.3) -> tuple[float, float] | None:
    """Where the right eye sees what the left retina looks at, by a coarse sweep over all of the images.

    Sparse matches of corners would not do: where a pattern repeats, a coarse look at all of it is surer.

    Args:
        views: a single pair of images.
        nearest_m: nearest depth that is tried.

    Returns:
        Column and row of the right image, on it: as far off as the nearest receptive fields are in the median. None
        where too few are matched.
    """
    views = views._replace(gaze_right_px=None).whole()
    matches, _ = match_sweep(views, GLANCE, nearest_range_m=nearest_m)
    left_px, right_px = matches.left_px[matches.valid], matches.right_px[matches.valid]
    if len(left_px) < NEAREST:
        return None
    nearest = left_px.square().sum(-1).topk(NEAREST, largest=False).indices
    column, row = ((right_px - left_px)[nearest].median(0).values * views.scale(GLANCE)).tolist()
    height, width = views.right.shape[-2:]
    places = zip((column, row), views.gaze_px, (width, height), strict=True)
    u, v = (min(max(at + shift, 0.0), side - 1.0) for shift, at, side in places)
    return u, v


def met(views: Views, nearest_m: float = 0.3) -> Views:
    """The same views, whose right retina looks at what the left one looks at (`right_gaze_px`), if that is found."""
    there = right_gaze_px(views, nearest_m)
    return views if there is None else views._replace(gaze_right_px=there, rectified=False)
