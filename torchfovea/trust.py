"""Which code a configuration may call: torchfovea's own, and any other only where the user says `trust=true`."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import OmegaConf

from torchfovea.config import conf_dir
from torchfovea.imported import load_object
from torchfovea.setting import SettingError, require

__all__ = ["load_trusted", "refuse_foreign"]

PACKAGE = "torchfovea"
# what Hydra itself is configured with: its own parts, its installed plugins, the log's formatters
HYDRAS = ("hydra._internal.", "hydra_plugins.", "logging.", "colorlog.")
FOLDERS = ("--config-dir", "-cd", "--config-path", "-cp")


def load_trusted(target: object, setting: str, trusted: bool) -> Any:
    """What a ``_target_`` names.

    Raises:
        SettingError: for a name outside of torchfovea where nobody said `trust=true`, which is then not imported; for
            one inside that is somebody else's (``torchfovea.cli.os.system``); for what does not exist.
    """
    expected = f"a name of {PACKAGE}'s own, or trust=true to let a configuration run this code"
    known = isinstance(target, str) and target.startswith(f"{PACKAGE}.")
    require(known or trusted, setting, target, expected)
    found = load_object(target, setting)
    origin = inspect.getmodule(found)
    require(trusted or (origin is not None and origin.__name__.startswith(f"{PACKAGE}.")), setting, target, expected)
    return found


def refuse_foreign(command: str, arguments: Sequence[str]) -> None:
    """Refuse a folder of configurations that would have Hydra itself call foreign code, before Hydra reads it.

    Hydra builds its callbacks, launcher, sweeper and log from the composed configuration; a stranger's folder
    (``--config-dir``) may have replaced them.

    Raises:
        SettingError: for such a folder, without `trust=true` among the arguments.
    """
    folders, plain = _split(arguments)
    if not (folders or any("searchpath" in one for one in plain)) or "trust=true" in [one.lower() for one in plain]:
        return
    if folders:
        places = ",".join(f"file://{Path(folder).resolve()}" for folder in folders)
        plain = [*plain, f"hydra.searchpath=[{places}]"]
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        cfg = hydra.config_loader.load_configuration(
            command, overrides=plain, run_mode=RunMode.MULTIRUN, from_shell=False, validate_sweep_overrides=False
        )
    for setting, target in _called(OmegaConf.to_container(cfg.hydra, resolve=False), "hydra"):
        own = target.startswith((*HYDRAS, f"{PACKAGE}.config."))
        if not own:
            raise SettingError(f"{setting} = {target}: expected Hydra's own, or trust=true to let it run this code")


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The folders of configurations among a command's arguments, and its settings."""
    folders, settings, rest = [], [], iter(arguments)
    for one in rest:
        flag, equals, value = one.partition("=")
        if flag in FOLDERS:
            folders.append(value if equals else next(rest, ""))
        elif not one.startswith("-"):
            settings.append(one)
    return folders, settings


def _called(node: Any, where: str) -> Iterator[tuple[str, str]]:
    """Every name that something in a node would be called by, with its setting."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key in ("_target_", "()", "class") and isinstance(value, str):
                yield f"{where}.{key}", value
            yield from _called(value, f"{where}.{key}")
    elif isinstance(node, list):
        for k, value in enumerate(node):
            yield from _called(value, f"{where}[{k}]")
