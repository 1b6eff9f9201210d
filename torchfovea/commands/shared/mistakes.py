"""A user's mistake in one line: the setting, its value and what was expected; programming errors are left alone."""

from __future__ import annotations

import difflib
import importlib.util
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
    ValidationError,
)
from yaml import YAMLError

from torchfovea.commands.shared.extras import extra_of, install
from torchfovea.setting import SettingError, require

__all__ = ["arranged", "check_folders", "closest", "describe", "need", "setting_names"]

# Hydra's own flags: with a value, and without
VALUED = ("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd", "--package", "-p", "--cfg", "-c",
          "--experimental-rerun")  # fmt: skip
PLAIN = ("--help", "-h", "--hydra-help", "--run", "-r", "--multirun", "-m", "--resolve", "--shell-completion", "-sc")
INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")

# settings that are gone, and what does their work
RENAMED = {
    "fusion.erode": "fusion.window, for how many looks the votes for and against a surface remember",
    "matcher.left_right_widths": "matcher.left_right, true or false",
    "fit.inflation": "fit.outlier_share, for outliers fall anywhere on their line",
}


def closest(name: str, names: Iterable[str]) -> str:
    """A hint at the nearest of ``names``, or an empty string where none is near."""
    near = difflib.get_close_matches(name, list(names), n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def arranged(arguments: Sequence[str]) -> list[str]:
    """A command's arguments with Hydra's flags first: its parser takes settings on one side of them only.

    Raises:
        SettingError: for a flag that there is none of, or that lacks its value.
    """
    flags, settings, rest = [], [], list(arguments)
    while rest:
        argument = rest.pop(0)
        name, equals, _ = argument.partition("=")
        if not argument.startswith("-"):
            settings.append(_quoted(argument))
        elif name in VALUED:
            require(bool(equals or rest), name, "nothing", "a value after it")
            flags += [argument] if equals else [argument, rest.pop(0)]
        elif name in ("--info", "-i"):
            flags += [argument] if equals else [argument, rest.pop(0) if rest and rest[0] in INFO else "all"]
        else:
            known = (*PLAIN, *VALUED, "--info")
            if argument not in PLAIN:
                raise SettingError(
                    f"{argument}: expected SETTING=VALUE, or a flag such as --help{closest(name, known)}"
                )
            flags.append(argument)
    return [*flags, *settings]


def check_folders(arguments: Sequence[str]) -> None:
    """Look at the folders that Hydra would pass over in silence, or put the current one in place of.

    Args:
        arguments: arranged.

    Raises:
        SettingError: for a folder of configurations that is none, and for a run's folder without a name.
    """
    for k, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name in ("--config-dir", "-cd"):
            value = value if equals else arguments[k + 1]
            require("://" in value or Path(value).is_dir(), name, value, "an existing folder")
        require(argument != "hydra.run.dir=", "hydra.run.dir", "nothing", "a folder")


def _quoted(argument: str) -> str:
    """A setting whose value Hydra's grammar does not know, a file's name with umlauts say, as quoted text."""
    name, equals, value = argument.partition("=")
    if not value or value[0] in "[{" or set("'\"\\$") & set(value):
        return argument
    parser = OverridesParser.create()
    for written in (argument, f'{name}{equals}"{value}"'):
        with suppress(HydraException):
            parser.parse_override(written)
            return written
    return argument


def need(*modules: str) -> None:
    """Refuse to begin a work whose end needs a package that is not there.

    Raises:
        ModuleNotFoundError: for the first that is missing; `describe` names its extra.
    """
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named '{module}'", name=module)


def setting_names(cfg: DictConfig) -> list[str]:
    """The dotted names of all settings of a composed configuration, Hydra's own left out."""
    names: list[str] = []

    def walk(node: Any, prefix: str) -> None:
        for key, child in node.items() if isinstance(node, dict) else ():
            names.append(f"{prefix}{key}")
            walk(child, f"{prefix}{key}.")

    walk(OmegaConf.to_container(cfg, resolve=False), "")
    return [name for name in names if name.partition(".")[0] != "hydra"]


def describe(error: BaseException, overrides: Sequence[str], known: Iterable[str] = ()) -> str | None:
    """Say a user's mistake in one line.

    Args:
        error: what was raised.
        overrides: the command's arguments, for the values as they were typed.
        known: the names of the settings that exist, for a hint at the nearest one.

    Returns:
        The line, or None for an error that is the program's own (its traceback should be shown).
    """
    if isinstance(error, InstantiationException):
        line = _instantiation(error, overrides)
    elif isinstance(error, HydraException):
        line = _composition(error, overrides, known)
    elif isinstance(error, SettingError):
        line = str(error)
    elif isinstance(error, OmegaConfBaseException):
        line = _configuration(error, overrides)
    elif isinstance(error, yaml.MarkedYAMLError):
        line = f"{error.problem_mark or error.context_mark or 'a file'}: {error.problem}: expected YAML"
    elif isinstance(error, ModuleNotFoundError):
        line = _missing_module(error)
    elif isinstance(error, YAMLError):
        line = _broken(error)
    elif isinstance(error, OSError):
        line = _file(error, overrides)
    else:
        line = None
    return None if line is None else " ".join(line.split())


def _value(name: str, overrides: Sequence[str]) -> str | None:
    """The value typed for a setting, if any."""
    for override in reversed(overrides):
        key, equals, value = override.partition("=")
        if equals and key.lstrip("+~").split("@")[0] == name:
            return value
    return None


def _given(name: str, overrides: Sequence[str]) -> str:
    """``name = value`` as typed, or the bare name where the value was not typed."""
    value = _value(name, overrides)
    return name if value is None else f"{name} = {value}"


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _composition(error: HydraException, overrides: Sequence[str], known: Iterable[str]) -> str:
    if isinstance(error, OverrideParseException):
        if "=" not in error.override:
            return f"{error.override}: expected SETTING=VALUE"
        return f"{error.override}: expected a value that Hydra can read ({_first_line(error)})"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        if error.options and group:
            return f"{group} = {option}: expected one of {', '.join(sorted(error.options))}"
        return f"config = {error.missing_cfg_file}: expected a file of the configuration's folder"
    cause = error.__cause__
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)):
        # Hydra's message names the whole override's key; OmegaConf's may name only the part that is missing.
        quoted = re.search(r"'([^']+)'", str(error))
        name = quoted[1] if quoted else str(cause.full_key)
        if name in RENAMED:
            return f"{_given(name, overrides)}: expected {RENAMED[name]}"
        return f"{_given(name, overrides)}: expected a known setting{closest(name, known)}"
    if isinstance(cause, OmegaConfBaseException):
        return _configuration(cause, overrides) or _first_line(error)
    if unknown := re.match(r"Could not override '([^'@]+)", str(error)):  # a group that the command does not have
        return f"{_given(unknown[1], overrides)}: expected a known setting{closest(unknown[1], known)}"
    if merged := re.match(r"Error merging override [+~]*([^=@]+)", str(error)):  # a mapping for a list, and the like
        return f"{_given(merged[1], overrides)}: expected a value of the kind that the setting has"
    if several := re.match(r"Ambiguous value for argument '([^=]+)=(.*)'", str(error)):
        name, value = several.groups()
        return f"{name} = {value}: expected one value, a list [{value}], or --multirun, which runs each of them"
    return _first_line(error)


def _configuration(error: OmegaConfBaseException, overrides: Sequence[str]) -> str | None:
    name = str(error.full_key) if error.full_key else ""
    if isinstance(error, MissingMandatoryValue):
        missing = re.search(r"Missing mandatory value: (\S+)", str(error))
        return f"{name or (missing[1] if missing else 'setting')} = ???: expected a value"
    if isinstance(error, (ValidationError, InterpolationResolutionError)):
        return f"{_given(name, overrides)}: {_first_line(error)}" if name else _first_line(error)
    return None  # a key that the program asks for and no configuration has: the program's own mistake


def _instantiation(error: InstantiationException, overrides: Sequence[str]) -> str | None:
    cause = error.__cause__
    found = re.search(r"full_key: (\S+)", str(error))
    node = found[1] if found else ""
    if isinstance(cause, TypeError) and (unexpected := re.search(r"unexpected keyword argument '(\w+)'", str(cause))):
        return f"{_given(f'{node}.{unexpected[1]}'.lstrip('.'), overrides)}: expected a setting that {node} has"
    if cause is None:
        return None
    line = describe(cause, overrides)
    if isinstance(cause, SettingError) and line and node and not line.startswith(f"{node}."):
        line = f"{node}.{line}"
    return line


def _missing_module(error: ModuleNotFoundError) -> str | None:
    module = (error.name or "").partition(".")[0]
    extra = extra_of(module)
    return None if extra is None else f"{module} is not installed: expected the extra {extra} ({install(extra)})"


def _broken(error: YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    where = "configuration" if mark is None else f"{mark.name}, line {mark.line + 1}"
    return f"{where}: expected YAML ({getattr(error, 'problem', None) or _first_line(error)})"


def _file(error: OSError, overrides: Sequence[str]) -> str:
    if error.filename is None:
        return _first_line(error)
    path = str(error.filename)
    reason = error.strerror or type(error).__name__
    names = [
        key.lstrip("+") for key, equals, value in (o.partition("=") for o in overrides) if equals and value == path
    ]
    return f"{names[0]} = {path}: {reason}" if names else f"{path}: {reason}"
