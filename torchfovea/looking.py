"""From two images to a look: what a robot with cameras, the simulator's and a recording have in common."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.perception import Observer
from torchfovea.search import Look
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.setting import require
from torchfovea.stereo.matchers import Match, checked_matches
from torchfovea.stereo.sweep import SweepRange
from torchfovea.stereo.views import Views

__all__ = ["Pictures", "look_at"]


class Pictures(NamedTuple):
    """What a photometric look leaves to be drawn.

    Attributes:
        left: the left eye's image, (3, H, W) in [0, 1].
        right: the right eye's.
        found: what the matcher found, of the rectified view or along the left rays; of a user's own, anything.
    """

    left: Tensor
    right: Tensor
    found: Disparity | SweepRange | Any


def look_at(
    observer: Observer,
    views: Views,
    matcher: Match,
    generator: torch.Generator | None = None,
    sample: int | None = None,
) -> Look:
    """Match two images as a `Robot` does when it looks.

    Args:
        observer: whose retina and error budget the eyes have.
        views: the images with their cameras, and how these stand (`torchfovea.stereo.views`).
        matcher: see `torchfovea.stereo.matchers.Match`.
        generator: draws the sample.
        sample: how many receptive fields count, drawn anew each time; None: all of them.

    Raises:
        SettingError: as the matcher does, and for a matcher that returns something else.
    """
    matches, found = checked_matches(matcher(views, observer.retina, observer.budget), observer.retina)
    if sample is not None:
        require(generator is not None, "generator", None, "a torch.Generator, which draws the sample")
        assert generator is not None
        chosen = draw_fields(observer.retina.count, sample, generator)
        if chosen is not None:
            matches = for_all(matches.take(chosen), observer.retina)
    return Look(matches, Pictures(views.left, views.right, found))
