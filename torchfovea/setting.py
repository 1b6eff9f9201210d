"""One kind of error for what a user can get wrong: the setting, its value and what was expected, in one line."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from collections.abc import Sequence
from functools import lru_cache
from numbers import Real
from typing import Any

__all__ = ["SettingError", "check_types", "is_number", "require", "require_name", "typed"]

PLAIN = {"float": float, "int": int, "bool": bool, "str": str}
ALIASES = {"Range": "tuple[float, float]", "Grid": "tuple[int, int]"}


class SettingError(ValueError):
    """A setting, an input or a file that torchfovea cannot work with; its message is one readable line."""


def require(condition: bool, setting: str, value: object, expected: str) -> None:
    """Check a user's value.

    Args:
        condition: whether the value is acceptable.
        setting: the name the user knows it by, such as ``sensor.fov_deg``.
        value: what was given.
        expected: what would have been acceptable.

    Raises:
        SettingError: ``setting = value: expected ...`` where the condition is false.
    """
    if not condition:
        raise SettingError(f"{setting} = {value}: expected {expected}")


def require_name(name: object, setting: str) -> None:
    """Check a user's name for something, of which names of files are made: none of them may lead out of their folder.

    Raises:
        SettingError: for what is no text, is empty, begins with a dot or holds what separates folders.
    """
    good = isinstance(name, str) and re.fullmatch(r"[^./\\:\0][^/\\:\0]*", name) is not None
    require(good, setting, name, "a name, without a path")


def check_types(settings: Any, group: str = "") -> None:
    """Compare a frozen dataclass's fields with their annotations; called first by those that validate themselves.

    Args:
        settings: whose fields are looked at, as far as they are numbers, words, truth values, tuples of such (`typed`)
            or settings themselves; whole numbers become int, however they were written.
        group: what stands before the fields' names in errors, such as ``sensor.``.

    Raises:
        SettingError: for the first field of another type.
    """
    for name, kind, made in _fields(settings.__class__):
        given = getattr(settings, name)
        if type(given) is PLAIN.get(kind) and given == given and kind != "int":
            continue
        require(made is None or isinstance(given, made), f"{group}{name}", given, f"the settings {kind}")
        found = typed(given, kind, f"{group}{name}")
        if isinstance(found, int | tuple):
            object.__setattr__(settings, name, found)


@lru_cache(maxsize=256)
def _fields(kind: type) -> list[tuple[str, str, Any]]:
    """The fields of a dataclass, their annotations, and the classes of those that are settings themselves."""
    found = [(field, field.default_factory) for field in dataclasses.fields(kind)]
    own = [made if isinstance(made, type) and made.__name__ == str(field.type) else None for field, made in found]
    return [(field.name, str(field.type), made) for (field, _), made in zip(found, own, strict=True)]


def is_number(value: Any) -> bool:
    """Whether it is a finite number, and not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def typed(value: Any, kind: str, setting: str) -> Any:
    """A value of a dataclass field's type, told by its name, such as `float`, `int | None` or `tuple[float, ...]`.

    Raises:
        SettingError: for a value of another type.
    """
    if kind.endswith("| None"):
        return None if value is None else typed(value, kind.removesuffix("| None").strip(), setting)
    kind = ALIASES.get(kind, kind)
    if kind.startswith("tuple["):
        inside = re.split(r",\s*(?![^[]*\])", kind.removeprefix("tuple[").removesuffix("]"))
        listed = isinstance(value, Sequence) and not isinstance(value, str)
        long = inside[-1] == "..." or (listed and len(value) == len(inside))
        require(listed and long, setting, value, "a list" if inside[-1] == "..." else f"a list of {len(inside)}")
        return tuple(typed(v, inside[0], setting) for v in value)
    if kind in ("float", "int"):
        number = isinstance(value, Real) and not isinstance(value, bool) and value == value
        number = number and (abs(value) <= sys.float_info.max or abs(value) == math.inf)
        if kind == "float":
            require(number, setting, value, "a number")
            return float(value)
        require(number and float(value).is_integer() and abs(value) < 2**63, setting, value, "a whole number")
        return int(value)
    plain = kind not in ("bool", "str") or type(value).__name__ == kind
    require(plain, setting, value, "true or false" if kind == "bool" else "text")
    return value
