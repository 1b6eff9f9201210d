"""What an observation is: the memory as a map, the gaze, the sensed Gaussians, the retina's image; their spaces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from torchfovea.envs.rows import SearchRows
from torchfovea.envs.settings import EnvSettings
from torchfovea.memory.egosphere import trust
from torchfovea.perception import Observer, observed
from torchfovea.rows import row
from torchfovea.search import Look
from torchfovea.sensing.head import Gaze, Head, cyclopean, eyes
from torchfovea.sensing.layout import LogPolar, cortical
from torchfovea.sensing.retina import fovea
from torchfovea.setting import require

__all__ = ["CHANNELS", "Shown", "map_index", "memory_map", "observation_space", "observations", "shown_of"]

# the map's channels: inverse range [1/m], information −log|Σ| [nats / 10], inlier probability, whether it is eligible
CHANNELS = ("inverse_range", "information", "inlier", "eligible")
_LOW, _HIGH = (0.0, -10.0, 0.0, 0.0), (10.0, 10.0, 1.0, 1.0)
_MOST = 1e3  # of a Gaussian's numbers


class Shown(NamedTuple):
    """What a map shows of cells.

    Attributes:
        mean: of their points (..., Nx, 3) [m].
        nats: information of those, −log|Σ|, (..., Nx).
        sure: inlier probability (..., Nx).
        eligible: which may be fixated, bool (..., Nx).
    """

    mean: Tensor
    nats: Tensor
    sure: Tensor
    eligible: Tensor


def shown_of(rows: SearchRows, some: list[int]) -> Shown:
    """What is known in some rows."""
    known = Shown(rows.step.points.mean, rows.nats, trust(rows.memory), rows.step.eligible)
    return known if some == list(range(rows.count)) else Shown(*(part[some] for part in known))


def observation_space(settings: EnvSettings, observer: Observer, fields: int) -> spaces.Dict:
    """The space of one row's observations, a dictionary of what `settings.observe` names.

    Args:
        settings: of the environment.
        observer: whose retina it is.
        fields: N, how many receptive fields a look goes through.

    `memory`: (4, rows, columns), `CHANNELS` at directions within the head's reach, left to right and top to bottom.
    `gaze`: the unit line of sight in E, (3,). `gaussians`: (N, 10) of every receptive field, mean (3) in the fusion's
    chart, packed covariance (6) and inlier probability, all zero where nothing was matched. `retina`: both eyes'
    cortical images, (6, rings, sectors) in [0, 1].
    """
    made: dict[str, spaces.Space[Any]] = {}
    for name in settings.observe:
        if name == "memory":
            low, high = (np.asarray(v, np.float32)[:, None, None] for v in (_LOW, _HIGH))
            shape = (len(CHANNELS), *settings.map_shape)
            made[name] = spaces.Box(np.broadcast_to(low, shape).copy(), np.broadcast_to(high, shape).copy())
        elif name == "gaze":
            made[name] = spaces.Box(-1.0, 1.0, (3,), np.float32)
        elif name == "gaussians":
            made[name] = spaces.Box(-_MOST, _MOST, (fields, 10), np.float32)
        else:
            retina = observer.retina
            good = isinstance(retina, LogPolar) and not retina.uniform_fovea
            require(good, "observe", "retina", "a log-polar retina without a uniform fovea")
            assert isinstance(retina, LogPolar)
            made[name] = spaces.Box(0.0, 1.0, (6, *retina.shape), np.float32)
    return spaces.Dict(made)


def map_index(cells: Tensor, head: Head, shape: tuple[int, int]) -> Tensor:
    """The cell nearest to each place of the map: cells (..., Nx, 3) to (..., rows · columns) int64.

    Places are evenly spaced in azimuth, from the leftmost that the head pans to, and in elevation, from the highest.
    """
    side = math.radians(head.pan_limit_deg)
    high, low = math.radians(head.tilt_up_deg), -math.radians(head.tilt_down_deg)
    rows, columns = shape
    elevation = high - (torch.arange(rows, dtype=torch.float64) + 0.5) / rows * (high - low)
    azimuth = side - (torch.arange(columns, dtype=torch.float64) + 0.5) / columns * 2 * side
    e, a = (grid.reshape(-1) for grid in torch.meshgrid(elevation, azimuth, indexing="ij"))
    place = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1).to(cells)
    return (cells @ place.mT).argmax(-2)


def memory_map(known: Shown, index: Tensor, shape: tuple[int, int]) -> Tensor:
    """The map (..., 4, rows, columns) of what is known, float32; see `CHANNELS` and `observation_space`.

    Args:
        known: of the cells.
        index: of the cells, see `map_index`.
        shape: rows and columns.
    """
    at = index.expand(*known.sure.shape[:-1], index.shape[-1])
    x, y, z, nats, sure, eligible = (
        part.gather(-1, at).float() for part in (*known.mean.unbind(-1), known.nats, known.sure, known.eligible)
    )
    inverse = (x * x + y * y + z * z).clamp(min=1e-6).rsqrt()
    values = torch.stack([inverse, nats / 10, sure, eligible], -2)
    low, high = (torch.tensor(v, device=values.device)[:, None] for v in (_LOW, _HIGH))
    found: Tensor = torch.minimum(torch.maximum(values, low), high).unflatten(-1, shape)
    return found


def observations(rows: SearchRows, some: list[int], index: Tensor) -> dict[str, np.ndarray]:
    """Observations of some rows, (K, ...) each."""
    settings, found = rows.settings, {}
    for name in settings.observe:
        if name == "memory":
            found[name] = memory_map(shown_of(rows, some), index, settings.map_shape).cpu().numpy()
        elif name == "gaze":
            sight = cyclopean(rows.observer.head, Gaze(*(angle[some] for angle in rows.gaze)))[0][..., 2]
            found[name] = sight.float().clamp(-1, 1).cpu().numpy()
        else:
            made = [_sensed(name, rows, *rows.looks[own]) for own in some]
            found[name] = torch.stack(made).float().cpu().numpy()
    return found


def _sensed(name: str, rows: SearchRows, look: Look | None, k: int, gaze: Gaze) -> Tensor:
    """What one row's last look, the k-th of those together, brought."""
    assert look is not None
    observer = rows.observer
    if name == "retina":
        assert isinstance(observer.retina, LogPolar)
        pictures = look.pictures[k]
        images = torch.cat([pictures.left, pictures.right])[None]
        return cortical(fovea(images, None, observer.retina)[0], observer.retina).clamp(0, 1)
    matches = row(look.matches, k)
    pose = eyes(observer.head, Gaze(*(angle[k] for angle in gaze)))
    seen = observed(observer, matches, pose)
    sure = torch.ones_like(seen.support_rad) if seen.inlier is None else seen.inlier
    values = torch.cat([seen.mean, seen.cov, sure[..., None]], -1)
    return torch.where(seen.valid[..., None], values, 0.0).nan_to_num().clamp(-_MOST, _MOST)
