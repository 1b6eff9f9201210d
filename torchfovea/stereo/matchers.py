"""One door to every matcher: block matching, the foveated plane sweep, and any other that a user brings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Budget, Correspondences, Disparity
from torchfovea.sensing.layout import Retina
from torchfovea.setting import require
from torchfovea.stereo.external import DisparityFunction, External, match_external, resolve_source
from torchfovea.stereo.matching import match_sgbm
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep, SweepRange, Volume, match_sweep
from torchfovea.stereo.views import Views, batched_views

__all__ = ["Match", "Matcher", "Narrowed", "checked_matches", "match_all"]

# receptive fields, and pixels, that are matched at once: 200 MB hold either, and more gain nothing
FIELDS, PIXELS = 64_000, 2_000_000


@runtime_checkable
class Match(Protocol):
    """What matches two images: a `Matcher`, or any function like it."""

    def __call__(self, views: Views, retina: Retina, budget: Budget, /) -> tuple[Correspondences, Any]:
        """Match two images.

        Args:
            views: the images with their cameras, and how these stand: two eyes or a rectified pair.
            retina: of both.
            budget: where a correspondence's standard deviation comes from; a matcher may know better.

        Returns:
            A correspondence for each receptive field of the left eye, in order, in the pixels of `Views.cameras`, and
            what was found, to be drawn: a `Disparity`, a `SweepRange` or None.
        """
        ...


@runtime_checkable
class Narrowed(Protocol):
    """A `Match` that may ask where to look; one that does not lacks this method."""

    def within(self, volume: Callable[[float], Volume], /) -> Match:
        """The `Match` of one look.

        Args:
            volume: tells where surfaces can be, so many standard deviations behind what is known; it costs time.
        """
        ...


class Matcher(NamedTuple):
    """A built-in matcher with its parameters; it is a `Match`, and `Narrowed`.

    Attributes:
        params: their type says which matcher it is.
        nearest_m: nearest range that is searched or believed [m].
        source: of an external matcher: a function of two images or its name ``package.module:function``, or for a
            rectified pair a disparity file.
        volume: where the sweep looks; None: everywhere.
    """

    params: SGBM | Sweep | External
    nearest_m: float = 0.3
    source: str | DisparityFunction | None = None
    volume: Volume | None = None

    @property
    def asks(self) -> bool:
        """Whether the memory tells it where to look: ``matcher.volume=memory``."""
        return isinstance(self.params, Sweep) and self.params.volume == "memory"

    def within(self, volume: Callable[[float], Volume], /) -> Matcher:
        """See `Narrowed`."""
        if not (isinstance(self.params, Sweep) and self.asks):
            return self
        return self._replace(volume=volume(self.params.volume_sigmas))

    def __call__(
        self, views: Views, retina: Retina | None, budget: Budget, /
    ) -> tuple[Correspondences, Disparity | SweepRange]:
        """Match two images; see `Match`. Without a retina every pixel of a rectified pair is a receptive field.

        Raises:
            SettingError: as the matchers do, and for an external matcher without a source.
        """
        params = self.params
        if isinstance(params, SGBM):
            return match_sgbm(views, retina, params, budget, self.nearest_m)
        if isinstance(params, Sweep):
            return match_sweep(views, retina, params, budget, self.nearest_m, volume=self.volume)
        source = resolve_source(self.source, views.rectified)
        return match_external(source, views, retina, params, budget, self.nearest_m)


def match_all(
    matchers: Sequence[Match], views: Sequence[Views], retina: Retina, budget: Budget
) -> list[tuple[Correspondences, Any]]:
    """What matchers answer to a pair each; sweeps that differ in their volumes alone match together.

    Args:
        matchers: as many as there are pairs.
        views: single pairs.
        retina: of all.
        budget: of all.
    """
    found: list[tuple[Correspondences, Any]] = []
    most = max(1, min(FIELDS // retina.count, PIXELS // (2 * views[0].left[0].numel())))
    for start in range(0, len(views), most):
        own, pairs = matchers[start : start + most], views[start : start + most]
        together, batch = _as_one(own), batched_views(pairs)
        if together is None or batch is None:
            found += [match(pair, retina, budget) for match, pair in zip(own, pairs, strict=True)]
        else:
            matches, ranges = together(batch, retina, budget)
            assert isinstance(ranges, SweepRange)
            found += [(matches.take(b), ranges.take(b)) for b in range(len(pairs))]
    return found


def _as_one(matchers: Sequence[Match]) -> Matcher | None:
    """Sweeps of some rows as one; None for one row, and for what matches single pairs only."""
    first = matchers[0]
    if len(matchers) == 1 or not isinstance(first, Matcher) or not isinstance(first.params, Sweep):
        return None
    plain = first._replace(volume=None)
    volumes = []
    for other in matchers:
        if not isinstance(other, Matcher) or other._replace(volume=None) != plain:
            return None
        volumes.append(other.volume)
    told = [volume for volume in volumes if volume is not None]
    if not told:
        return plain
    if len(told) < len(matchers):
        return None
    return plain._replace(volume=Volume(*(torch.stack(bounds) for bounds in zip(*told, strict=True))))


def checked_matches(answer: object, retina: Retina) -> tuple[Correspondences, Any]:
    """What a `Match` returned, or an error under the setting `matcher`.

    Raises:
        SettingError: for anything but correspondences of the retina's receptive fields and what was found.
    """
    expected = "(Correspondences, found)"
    pair = isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], Correspondences)
    require(pair, "matcher", f"{type(answer).__name__} from (views, retina, budget)", expected)
    assert isinstance(answer, tuple)
    matches = answer[0]
    for name, part in matches._asdict().items():
        shape = (retina.count, 2)[: 2 if name in ("left_px", "right_px") else 1]
        fits = isinstance(part, Tensor) and tuple(part.shape) == shape
        fits = fits or (part is None and name in matches._field_defaults)
        require(fits, f"matcher's {name}", getattr(part, "shape", part), f"{shape}, one for each receptive field")
    return matches, answer[1]
