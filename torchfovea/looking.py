"""From two images to a look: what a robot with cameras, the simulator's and a recording have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.memory.classes import Classes
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.expected import hidden_beyond
from torchfovea.perception import Observer
from torchfovea.search import Look
from torchfovea.sensing.correspondence import Correspondences, Disparity
from torchfovea.sensing.fields import draw_fields, for_all
from torchfovea.sensing.head import Eyes, to_ego
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require
from torchfovea.stereo.matchers import Match, Narrowed, checked_matches, match_all
from torchfovea.stereo.sweep import SweepRange, Volume
from torchfovea.stereo.views import Views

__all__ = ["Pictures", "look_at", "look_at_all", "told"]


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
        SettingError: as the matcher does, and for a matcher, or an evidence of classes, that returns something else.
    """
    return _look(observer, views, matcher(views, observer.retina, observer.budget), generator, sample)


def look_at_all(
    observer: Observer,
    views: Sequence[Views],
    matchers: Sequence[Match],
    generators: Sequence[torch.Generator],
    sample: int | None = None,
) -> list[Look]:
    """`look_at` with several pairs of images, each with its matcher and generator; sweeps match them together."""
    answers = match_all(matchers, views, observer.retina, observer.budget)
    return [_look(observer, *each, sample) for each in zip(views, answers, generators, strict=True)]


def _look(
    observer: Observer, views: Views, answer: object, generator: torch.Generator | None, sample: int | None
) -> Look:
    """What a matcher's answer comes to."""
    matches, found = checked_matches(answer, observer.retina)
    if observer.classes is not None:
        matches = matches._replace(classes=_told_of_classes(observer.classes, views, observer.retina, matches))
    if sample is not None:
        require(generator is not None, "generator", None, "a torch.Generator, which draws the sample")
        assert generator is not None
        chosen = draw_fields(observer.retina.count, sample, generator)
        if chosen is not None:
            matches = for_all(matches.take(chosen), observer.retina)
    return Look(matches, Pictures(views.left, views.right, found))


def _told_of_classes(classes: Classes, views: Views, retina: Retina, matches: Correspondences) -> Tensor:
    """What the pictures tell of each field's class, (N, K)."""
    form = "a function (views, retina, matches) that tells classes in pictures"
    require(classes.evidence is not None, "classes.evidence", None, form)
    assert classes.evidence is not None
    answer, shape = classes.evidence(views, retina, matches), (retina.count, classes.count)
    fits = isinstance(answer, Tensor) and tuple(answer.shape) == shape and bool((answer > 0).all())
    fits = fits and bool(answer.isfinite().all())
    given = getattr(answer, "shape", type(answer).__name__)
    require(fits, "classes.evidence", given, f"positive likelihoods {shape}, one row for each receptive field")
    return answer


def told(matcher: Match, observer: Observer, memory: Memory | None, eyes: Eyes) -> Match:
    """The matcher of one look, which knows from the memory where surfaces can be, if it asks.

    Args:
        matcher: any; one that is not `torchfovea.stereo.matchers.Narrowed` stays as it is.
        observer: whose eyes these are.
        memory: before the look; None: nothing is known.
        eyes: where they are.
    """
    if memory is None or not isinstance(matcher, Narrowed):
        return matcher
    known = memory

    def volume(sigmas: float) -> Volume:
        centers_px = observer.retina.centers_px(known.cells.device, known.cells.dtype)
        rays = to_ego(eyes.R_left.to(known.cells), observer.camera.rays(centers_px))
        least = hidden_beyond(known, eyes.t_left.to(known.cells), rays, sigmas)
        return Volume(least, torch.full_like(least, torch.inf))

    return matcher.within(volume)
