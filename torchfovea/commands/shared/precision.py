"""The paper's Fig. 1, what its commands share: one scene through a uniform and a log-polar retina of as many fields."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.mistakes import need
from torchfovea.commands.shared.settings import choice
from torchfovea.gaussian import Gaussian
from torchfovea.metrics import information
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Retina

__all__ = ["CAMERA", "EGO", "Dots", "PlotFrame", "bearings_deg", "both_sensors", "headline", "measured"]

LAYOUTS = ("uniform", "log_polar")
SHARED = ("camera", "fov_deg", "radius_px", "sample", "source_px")  # what both sensors have alike, beside their number


class PlotFrame(NamedTuple):
    """How a frame is drawn: to the right, forward and up.

    Attributes:
        axes: what these are called.
        turned: (3, 3), from the frame to them.
    """

    axes: tuple[str, str, str]
    turned: tuple[tuple[float, float, float], ...]


CAMERA = PlotFrame(("x, right", "z, forward", "−y, up"), ((1, 0, 0), (0, 0, 1), (0, -1, 0)))
EGO = PlotFrame(("−y, right", "x, forward", "z, up"), ((0, -1, 0), (1, 0, 0), (0, 0, 1)))


class Dots(NamedTuple):
    """Points that are drawn together.

    Attributes:
        name: the headline.
        points_m: (N, 3), in a frame.
        seen_deg: (N, 2), where the left eye sees them: right of its axis and above it.
        colour: (N, 3) in [0, 1], or (N,) information [nats].
    """

    name: str
    points_m: Tensor
    seen_deg: Tensor
    colour: Tensor


def both_sensors(cfg: DictConfig, retina: Retina | None) -> dict[str, DictConfig]:
    """The configuration with each of the two layouts, the configured one as it is; empty without ``figure1=true``.

    Args:
        cfg: with `figure1` and the group sensor.
        retina: that the configuration describes, whose number of receptive fields the other gets.

    Raises:
        SettingError: for a sensor that is neither.
    """
    if not cfg.figure1:
        return {}
    need("matplotlib")
    layout = choice(cfg, "sensor.layout", LAYOUTS)
    assert retina is not None
    found = {}
    for name in LAYOUTS:
        other = OmegaConf.load(Path(conf_dir()) / "sensor" / f"{name}.yaml")
        alike = {key: cfg.sensor[key] for key in SHARED} | {"receptive_fields": retina.count}
        node = cfg.sensor if name == layout else OmegaConf.merge(other, alike)
        changed = cfg.copy()
        OmegaConf.update(changed, "sensor", node, merge=False)
        found[name] = changed
    return found


def bearings_deg(eye: Eyes, points_m: Tensor) -> Tensor:
    """Where the left one of two eyes sees points (N, 3): right of its axis and above it, (N, 2) [degrees]."""
    x, y, z = ((points_m - eye.t_left.to(points_m)) @ eye.R_left.to(points_m)).unbind(-1)
    return torch.rad2deg(torch.stack([torch.atan2(x, z), torch.atan2(-y, torch.hypot(x, z))], -1))


def measured(name: str, eye: Eyes, points: Gaussian, kept: Tensor, inlier: Tensor | None) -> Dots:
    """What a retina measured, as precise as it says it is (Eq. 44).

    Args:
        name: the headline.
        eye: whose left one it is.
        points: (N, 3) [m] and (N, 6) [m²].
        kept: bool (N,), those that are valid.
        inlier: how probably each is no false match, (N,); those that are rather false are left out.
    """
    shown = kept if inlier is None else kept & (inlier > 0.5)
    mean, cov = points.mean[shown], points.cov[shown]
    return Dots(name, mean, bearings_deg(eye, mean), information(cov) if len(cov) else torch.empty(0))


def headline(layout: str, retina: Retina) -> str:
    """What a cloud is called that a retina measured."""
    return f"{layout.replace('_', '-')}, {retina.count:,} receptive fields"
