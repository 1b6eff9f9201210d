"""The reward that a configuration describes: near is good, near to a point is, or whatever a user's function says."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.shared.named import build_named, name_of
from torchfovea.commands.shared.settings import construct
from torchfovea.deciding import reward
from torchfovea.memory.classes import Classes
from torchfovea.setting import is_number, require
from torchfovea.stereo.stripes import Stripes

__all__ = ["build_classes", "build_reward", "nearest_to"]

FORM = "a function of points (..., 3) [m] that returns a reward (...) for each"
EVIDENCE = "a function (views, retina, matches) that returns likelihoods (N, K)"


def nearest_to(point: Any) -> Callable[[Tensor], Tensor]:
    """The reward r(x) = −‖x − point‖ [m].

    Args:
        point: [x, y, z] in the ego frame E [m].

    Raises:
        SettingError: for anything else.
    """
    three = isinstance(point, list | tuple) and len(point) == 3 and all(map(is_number, point))
    expected = "[x, y, z] in metres: ahead, to the left and up from the ego frame's origin"
    require(three, "reward.point", point, expected)
    where = torch.tensor([float(v) for v in point], dtype=torch.float64)
    return lambda x: reward.nearest_to(where.to(x))(x)


def build_reward(cfg: DictConfig) -> Any:
    """The group `reward`: the name of a measure of nearness, or a function of points, as `Observer.reward` takes them.

    Raises:
        SettingError: for an unknown name, what is no function of points, or what cannot be hashed.
    """
    name = name_of(cfg, "reward")
    if name in ("inverse_range", "range"):
        return name
    if name == "of_class":
        return "inverse_range"
    made: Callable[[Tensor], Tensor] = build_named(cfg, "reward", FORM, takes=("points",))
    require(callable(made), "reward", type(made).__name__, FORM)
    _require_hashable(made, "reward")
    return made


def build_classes(cfg: DictConfig) -> Classes | None:
    """What `reward=of_class` seeks; None for any other reward.

    Raises:
        SettingError: for classes that are none.
    """
    if name_of(cfg, "reward") != "of_class":
        return None
    settings = {str(key): value for key, value in cfg.reward.items() if key not in ("name", "_target_", "evidence")}
    classes = construct(Classes, settings, "reward")
    if cfg.reward.get("evidence") is None:
        return classes
    made = build_named(cfg, "reward.evidence", EVIDENCE, (), takes=("views", "retina", "matches"))
    _require_hashable(made, "reward.evidence")
    known = made.marks + 1 if isinstance(made, Stripes) else classes.count
    require(classes.count == known, "reward.count", classes.count, f"{known}, one more than reward.evidence's marks")
    return replace(classes, evidence=made)


def _require_hashable(made: object, setting: str) -> None:
    """What belongs to an observer is a key of what is kept for one."""
    expected = "a function, or an object that can be hashed, such as a frozen dataclass's"
    require(isinstance(made, Hashable), setting, type(made).__name__, expected)
