"""What a setting names by ``module:function`` or ``module.name``, imported and checked under that setting's name."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Sequence
from typing import Any

from torchfovea.setting import SettingError, require

__all__ = ["load_function", "load_object", "made_if_class", "require_takes"]


def load_function(source: object, setting: str, form: str = "package.module:function") -> Any:
    """A function, or anything else that can be called, by its name ``package.module:function``.

    Args:
        source: the name.
        setting: what it is the value of.
        form: how such a value looks, for the error.

    Raises:
        SettingError: for another form, a module that does not import, or a name that is no function.
    """
    module, colon, name = source.partition(":") if isinstance(source, str) else ("", "", "")
    require(bool(module and colon and name), setting, source, form)
    try:
        found: Any = importlib.import_module(module)
    except (ImportError, TypeError) as error:  # TypeError: of a name such as ".."
        raise SettingError(f"{setting} = {source}: expected a module that can be imported ({error})") from error
    for part in name.split("."):
        found = getattr(found, part, None)
    require(callable(found), setting, source, f"a function {name} in {module}")
    return found


def made_if_class(found: Any) -> Any:
    """An object of a class that needs no arguments, to be called in the class's place; anything else as it is."""
    return found() if isinstance(found, type) and _misfit(found, ()) is None else found


def require_takes(found: Any, arguments: Sequence[str], setting: str, source: object) -> None:
    """Refuse a user's function that cannot be called as it will be, before anything else is done.

    Args:
        found: the function.
        arguments: names of what it will be given, in order.
        setting: what it is the value of.
        source: what the user calls it.

    Raises:
        SettingError: where it takes fewer arguments, or more that have no default.
    """
    misfit = _misfit(found, arguments)
    require(misfit is None, setting, source, f"a function of ({', '.join(arguments)}): {misfit}")


def _misfit(found: Any, arguments: Sequence[str]) -> str | None:
    """Why something cannot be called with so many arguments; None: it can, or does not tell."""
    try:
        inspect.signature(found).bind(*arguments)
    except TypeError as error:
        return str(error)
    except ValueError:  # some functions written in C tell nothing
        return None
    return None


def load_object(target: object, setting: str) -> Any:
    """Something that can be called by its dotted name ``package.module.name``.

    Raises:
        SettingError: where no module of that name can be imported, or what it has there cannot be called.
    """
    parts = target.split(".") if isinstance(target, str) else []
    require(len(parts) >= 2 and all(parts), setting, target, "package.module.name")
    for depth in range(len(parts) - 1, 0, -1):
        module = ".".join(parts[:depth])
        try:
            found: Any = importlib.import_module(module)
        except ModuleNotFoundError as error:
            # the package itself is not there; or a shorter name is the module, the rest of it a class and its parts
            if error.name is not None and f"{module}.".startswith(f"{error.name}."):
                continue
            raise SettingError(f"{setting} = {target}: expected a module that can be imported ({error})") from error
        except ImportError as error:
            raise SettingError(f"{setting} = {target}: expected a module that can be imported ({error})") from error
        for part in parts[depth:]:
            found = getattr(found, part, None)
        require(callable(found), setting, target, f"something to call, {'.'.join(parts[depth:])} in {module}")
        return found
    raise SettingError(f"{setting} = {target}: expected a module that can be imported")
