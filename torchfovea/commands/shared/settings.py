"""Single settings of a composed configuration, each checked under the name the user knows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from torchfovea.setting import require, typed

__all__ = ["choice", "construct", "is_number", "is_whole", "number", "whole", "within"]

T = TypeVar("T")

MOST = 10_000_000
MOST_SEED = 2**32 - 1


def construct(kind: type[T], node: DictConfig | dict[str, Any], where: str) -> T:
    """Build a dataclass from the settings of the same names; others are ignored.

    Args:
        kind: a frozen dataclass whose fields are floats, ints, bools and strings.
        node: the settings.
        where: their group's name, for errors.

    Raises:
        SettingError: for a value of another type, and whatever the dataclass itself refuses.
    """
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.name in node:
            values[field.name] = typed(node[field.name], str(field.type), f"{where}.{field.name}")
    return kind(**values)


def choice(cfg: DictConfig, setting: str, options: tuple[str, ...]) -> str:
    """One of several words, read at a dotted name."""
    value = OmegaConf.select(cfg, setting)
    require(value in options, setting, value, "one of " + ", ".join(options))
    return str(value)


def whole(cfg: DictConfig, setting: str, least: int = 1) -> int:
    """A whole number no smaller than `least`, nor larger than any machine can do, read at a dotted name."""
    value = typed(OmegaConf.select(cfg, setting), "int", setting)
    most = MOST_SEED if setting.endswith("seed") else MOST
    require(value >= least, setting, value, f"at least {least}")
    require(value <= most, setting, value, f"{least} to {most}")
    return int(value)


def number(cfg: DictConfig, setting: str) -> float:
    """A positive number of a size that float32 can square, read at a dotted name."""
    given = OmegaConf.select(cfg, setting)
    value = float(typed(given, "float", setting))
    require(value > 0, setting, given, "a positive number")
    require(1e-9 <= value <= 1e9, setting, given, "a positive number, 1e-9 to 1e9")
    return value


def within(cfg: DictConfig, setting: str, least: float, most: float, expected: str) -> float:
    """A number from `least` to `most`, read at a name; `expected` says so."""
    value = cfg[setting]
    require(is_number(value), setting, value, f"a number: {expected}")
    require(least <= value <= most, setting, value, expected)
    return float(value)


def is_whole(value: Any) -> bool:
    """Whether it is a whole number, however it is written (1e9), and not a truth value."""
    return is_number(value) and float(value).is_integer()


def is_number(value: Any) -> bool:
    """Whether it is a finite number, and not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
