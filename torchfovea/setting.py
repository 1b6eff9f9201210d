"""One kind of error for what a user can get wrong: the setting, its value and what was expected, in one line."""

from __future__ import annotations

import re

__all__ = ["SettingError", "require", "require_name"]


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
