"""Marks read from pictures: which way the stripes around a receptive field run, and what that tells of the class.

Between places around a field differences of brightness vote for the direction in which it changes, each with one voice
(the structure tensor of Förstner, Gülch 1987, without its strengths). Stripes that the fields resolve agree; where
fields are too wide for them grey is left, and other texture, which does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.marks import field_width_rad, readable
from torchfovea.sensing.retina import Retina, interpolate
from torchfovea.sensing.triangulation import triangulate
from torchfovea.setting import check_types, require
from torchfovea.stereo.views import Views

__all__ = ["Stripes", "StripesShown", "direction_votes"]

_SIDE = 9  # places a side around a field
_FAINT = 1e-3  # squared differences, in shares of the brightness, that are noise


class StripesShown(NamedTuple):
    """What N receptive fields show.

    Attributes:
        votes: from `direction_votes`, (N, 2).
        red: red's share of the light (N,).
        width_m: of the fields on the object (N,); inf where the match tells no range.
    """

    votes: Tensor
    red: Tensor
    width_m: Tensor


@dataclass(frozen=True)
class Stripes:
    """What tells marks on red things: a `torchfovea.memory.classes.Evidence`.

    That a thing bears a mark its colour tells, which one the direction of its stripes. Class k of n has their normal at
    the angle π (k − ½)/n above the horizontal, so that none runs upright, as outlines do. A field of the width w on the
    object, of whose light the share q is red and around which the mean vote is v, has the likelihood

        1 of class 0,   exp(γ (q − q₀) + κ e^(−(w/d)²) v·u_k) of class k

    with u_k at twice the angle: a von Mises distribution, flat where fields are wider than the stripes. The three
    numbers are fitted to known scenes by `scripts/fit_stripes.py`.

    Attributes:
        marks: n, the classes being 0 to n.
        detail_m: d, the stripes' width.
        concentration: κ.
        redness: γ.
        red: q₀.
    """

    marks: int = 2
    detail_m: float = 0.008
    concentration: float = 25.2
    redness: float = 12.8
    red: float = 0.51

    def __post_init__(self) -> None:
        """Raise SettingError for impossible numbers."""
        check_types(self, "evidence.")
        require(2 <= self.marks <= 63, "evidence.marks", self.marks, "2 to 63 marks")
        require(1e-5 <= self.detail_m <= 1, "evidence.detail_m", self.detail_m, "0.00001 to 1 metre")
        for name in ("concentration", "redness"):
            require(0 <= getattr(self, name) <= 1000, f"evidence.{name}", getattr(self, name), "0 to 1000")
        require(0 <= self.red <= 1, "evidence.red", self.red, "a share of the light, 0 to 1")

    def __call__(self, views: Views, retina: Retina, matches: Correspondences) -> Tensor:
        """What the left eye's picture tells of each field, (N, n + 1)."""
        return self.likelihood(self.see(views, retina, matches))

    def see(self, views: Views, retina: Retina, matches: Correspondences) -> StripesShown:
        """What the left eye's fields show; how far that is, and so how wide they are on it, the matches say."""
        colour = views.fovea(views.colour()[:1], retina)[0]
        px, cameras, turns = matches[:2], views.cameras(retina), views.rig[:2]
        left, right = (c.rays(place) @ turn.mT.to(place) for c, place, turn in zip(cameras, px, turns, strict=True))
        baseline = left.new_tensor([views.rig.baseline_m, 0.0, 0.0])
        point, ahead = triangulate(left, right, torch.zeros_like(baseline), baseline)
        away = torch.where(ahead & matches.valid, point.norm(dim=-1), torch.inf)
        width_m = away * field_width_rad(cameras[0], retina, views.told(None), px[0])
        # places half a stripe apart, where the fields are no wider
        step_px = (retina.width_px(px[0]).square() + views.scale(retina) ** -2).sqrt()
        step_px = step_px * (self.detail_m / 2 / width_m).clamp(min=1)
        return StripesShown(direction_votes(colour, self.is_marked(colour), retina, step_px), _red(colour), width_m)

    def is_marked(self, colour: Tensor) -> Tensor:
        """Probability that what has colours (3, ...) bears a mark, by their red alone, if half of all things do."""
        return (self.redness * (_red(colour) - self.red)).sigmoid()

    def likelihood(self, seen: StripesShown) -> Tensor:
        """Of what fields show, under every class (N, n + 1). Differentiable."""
        votes = seen.votes
        angle = 2 * math.pi * (torch.arange(self.marks, dtype=votes.dtype, device=votes.device) + 0.5) / self.marks
        # an image's y points down
        agreed = votes @ torch.stack([angle.cos(), -angle.sin()])
        agreed = self.concentration * readable(seen.width_m, self.detail_m)[:, None] * agreed
        return torch.nn.functional.pad(self.redness * (seen.red - self.red)[:, None] + agreed, (1, 0)).exp()


def direction_votes(colour: Tensor, weight: Tensor, retina: Retina, step_px: Tensor) -> Tensor:
    """The mean vote around each receptive field.

    Args:
        colour: red, green and blue of the fields (3, N), 0 to 1.
        weight: 0 to 1 (N,), of what each sees; outlines are lines, too, and should not vote.
        retina: their layout.
        step_px: from one place around a field to the next (N,) [retinal px].

    Returns:
        (N, 2): cosine and sine of twice the angle, from the image's x to its y, in which brightness changes; shorter
        than 1 where votes differ or are few. Differentiable.
    """
    place = torch.arange(_SIDE, dtype=colour.dtype, device=colour.device) - (_SIDE - 1) / 2
    y, x = torch.meshgrid(place, place, indexing="ij")
    centre = retina.centers_px(colour.device, colour.dtype)
    around = centre[:, None, None] + step_px[:, None, None, None] * torch.stack([x, y], -1)
    light, share = interpolate(torch.stack([colour.mean(0), weight])[None], retina, around)[0]
    light = light / light.mean((-1, -2), keepdim=True).clamp(min=1e-2)
    # over 2 x 2 places, so that both differences are taken at one point
    across = (light[:, 1:] + light[:, :-1]).diff(dim=-1) / 2
    down = (light[:, :, 1:] + light[:, :, :-1]).diff(dim=-2) / 2
    voice = share[:, 1:, 1:] * share[:, 1:, :-1] * share[:, :-1, 1:] * share[:, :-1, :-1]
    voice = voice / (voice.sum((-1, -2), keepdim=True) + _SIDE)  # a row's worth of votes for nothing
    energy = across.square() + down.square() + _FAINT
    votes = (across.square() - down.square()) / energy, 2 * across * down / energy
    return torch.stack([(voice * vote).sum((-1, -2)) for vote in votes], -1)


def _red(colour: Tensor) -> Tensor:
    """Red's share of the light, of colours (3, ...)."""
    return colour[0] / colour.sum(0).clamp(min=1e-3)
