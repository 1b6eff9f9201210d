"""One synthetic look of two eyes, from which the paths of a saccade start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import columns
from torchfovea.memory.egosphere import Memory
from torchfovea.perception import Observer, new_memory
from torchfovea.rows import stack, to_device
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.fields import for_all
from torchfovea.sensing.geometric import correspond_points, with_noise
from torchfovea.sensing.head import Eyes, eyes, fixate, to_ego

__all__ = ["Saccade", "batch_of", "flat_of", "part_of", "saccade", "shares", "support_of"]


class Saccade(NamedTuple):
    """What a saccade starts from.

    Attributes:
        observer: of patches, without what its peers do not do.
        memory: an empty one.
        matches: of a look (N,).
        pose: of the eyes.
        alpha: of the upper confidence bound that decides.
        compile: how compiled kernels are timed beside what is written, see `torchfovea.compiling`; off: not.
    """

    observer: Observer
    memory: Memory
    matches: Correspondences
    pose: Eyes
    alpha: float = 1.0
    compile: str = "off"


def saccade(observer: Observer, cells: Tensor, device: str = "cpu", seed: int = 0) -> Saccade:
    """A look of both eyes at a rolling surface, with noise, and an empty memory over `cells` (Nx, 3)."""
    gaze = fixate(observer.head, torch.tensor([1.2, 0.25, -0.1]))[0]
    pose = eyes(observer.head, gaze)
    left = observer.retina.centers_px("cpu", torch.float32)
    ray = torch.nn.functional.normalize(to_ego(pose.R_left, observer.camera.rays(left)), dim=-1)
    distance = 1.5 + 0.3 * torch.sin(3 * ray[:, 1:2]) + 0.2 * torch.cos(5 * ray[:, 2:])
    points = pose.t_left + distance * ray
    seen = torch.ones(len(left), dtype=torch.bool)
    generator = torch.Generator().manual_seed(seed)
    matches = correspond_points(points, seen, left, pose, observer.camera, observer.retina, observer.budget)
    matches = with_noise(matches, observer.retina, generator)
    moved: Saccade = to_device(Saccade(observer, new_memory(observer, cells), matches, pose), device)
    return moved


def part_of(look: Saccade, count: int) -> Saccade:
    """The same with receptive fields drawn evenly from all of them."""
    every = torch.linspace(0, look.matches.valid.shape[-1] - 1, count).long().to(look.matches.valid.device)
    kept = look.matches.take(every)
    left_px, right_px = (columns(*part.unbind(-1)) for part in kept[:2])
    return look._replace(matches=for_all(kept._replace(left_px=left_px, right_px=right_px), look.observer.retina))


def support_of(look: Saccade) -> Tensor:
    """Half the width of each left receptive field [px]."""
    return look.observer.retina.width_px(look.matches.left_px) / 2


def flat_of(matches: Correspondences) -> tuple[Tensor, Tensor]:
    """Places (N, 4) and standard deviations (N, 2), contiguous, as the peers want them."""
    px = torch.cat([matches.left_px, matches.right_px], -1).contiguous()
    return px, torch.stack([matches.left_sigma_px, matches.right_sigma_px], -1)


def shares(most: int) -> tuple[int, ...]:
    """A quarter, a half and all of a size."""
    return tuple(max(64, most // share) for share in (4, 2, 1))


def batch_of(looks: Sequence[Saccade]) -> Saccade:
    """Saccades of equal sizes as one, memories indexed together."""
    first = looks[0]
    cells = torch.stack([look.memory.cells.cpu() for look in looks])
    device = str(first.memory.cells.device)
    matches, pose = (stack([getattr(look, part) for look in looks]) for part in ("matches", "pose"))
    places = {part: columns(*getattr(matches, part).unbind(-1)) for part in ("left_px", "right_px")}
    memory = to_device(new_memory(first.observer, columns(*cells.unbind(-1))), device)
    return Saccade(first.observer, memory, matches._replace(**places), pose)
