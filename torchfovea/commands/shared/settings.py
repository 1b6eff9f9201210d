"""Single settings of a composed configuration, each checked under the name the user knows.

Whether they are numbers, words or lists of such has been checked before (`torchfovea.commands.shared.kinds`).
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Collection
from typing import Any, TypeVar

import torch
from omegaconf import DictConfig, OmegaConf

from torchfovea.setting import is_number, require, typed

__all__ = [
    "changed", "choice", "construct", "device_of", "is_whole", "number", "numbers", "plain", "whole",
    "wholes", "within", "words",
]  # fmt: skip

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


def plain(group: Any) -> dict[str, Any]:
    """A group of settings as a mapping, what stands for others resolved."""
    values = OmegaConf.to_container(group, resolve=True)
    assert isinstance(values, dict)
    return {str(name): value for name, value in values.items()}


def changed(cfg: DictConfig, settings: dict[str, Any]) -> DictConfig:
    """The configuration with some settings changed, group by group."""
    merged = OmegaConf.merge(cfg, settings)
    assert isinstance(merged, DictConfig)
    return merged


def choice(cfg: DictConfig, setting: str, options: Collection[str]) -> str:
    """One of several words, read at a dotted name."""
    value = OmegaConf.select(cfg, setting)
    require(value in options, setting, value, "one of " + ", ".join(options))
    return str(value)


def words(cfg: DictConfig, setting: str, options: Collection[str]) -> list[str]:
    """One or several of some words, read at a dotted name."""
    value = OmegaConf.select(cfg, setting)
    given = list(value) if OmegaConf.is_list(value) else [value]
    require(len(given) > 0 and set(given) <= set(options), setting, given, "some of " + ", ".join(options))
    return given


def device_of(cfg: DictConfig) -> str:
    """The setting `device`, where the machine has it."""
    device = choice(cfg, "device", ("cpu", "cuda"))
    require(device == "cpu" or torch.cuda.is_available(), "device", device, "cpu, or cuda on a machine that has it")
    return device


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
    """A number from `least` to `most`, read at a dotted name; `expected` says so."""
    value = OmegaConf.select(cfg, setting)
    require(least <= value <= most, setting, value, expected)
    return float(value)


def numbers(cfg: DictConfig, setting: str, least: float = -math.inf, most: float = sys.float_info.max) -> list[float]:
    """A list of numbers from `least` to `most`, all that are finite by default, read at a dotted name."""
    values = OmegaConf.select(cfg, setting)
    expected = "a list of numbers" if least == -math.inf else f"a list of numbers, at least {least:g}"
    require(len(values) > 0 and all(least <= value <= most for value in values), setting, values, expected)
    return [float(value) for value in values]


def wholes(cfg: DictConfig, setting: str, least: int) -> list[int]:
    """A list of whole numbers no smaller than `least`, read at a dotted name."""
    values = numbers(cfg, setting)
    require(all(v.is_integer() and v >= least for v in values), setting, values, f"whole numbers, at least {least}")
    return [int(value) for value in values]


def is_whole(value: Any) -> bool:
    """Whether it is a whole number, however it is written (1e9), and not a truth value."""
    return is_number(value) and float(value).is_integer()
