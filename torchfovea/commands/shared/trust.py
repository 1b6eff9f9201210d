"""Which code a configuration may call: torchfovea's own, and any other only where the user says `trust=true`."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.config import conf_dir
from torchfovea.imported import load_object
from torchfovea.setting import SettingError, require

__all__ = ["check_said", "load_trusted", "refuse_foreign"]

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
    if not (folders or any("searchpath" in one for one in plain)) or _said(plain):
        return
    if folders:
        places = ",".join(f"file://{Path(folder).resolve()}" for folder in folders)
        plain = [*plain, f"hydra.searchpath=[{places}]"]
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        loader = hydra.config_loader

        def composed(settings: list[str]) -> Any:
            return loader.load_configuration(command, settings, RunMode.RUN, from_shell=False).hydra

        parser = OverridesParser.create()
        parsed = parser.parse_overrides(plain)
        alone = [one.input_line or "" for one in parsed if not one.is_sweep_override()]
        nodes = [composed(alone)]
        # what a sweep chooses is configured in its jobs: every choice once
        params = OmegaConf.select(nodes[0], "sweeper.params") or {}
        swept = [*parsed, *parser.parse_overrides([f"{key}={value}" for key, value in params.items()])]
        nodes += [composed([*alone, f"{o.get_key_element()}={v}"]) for o in swept for v in _values(o, folders)]
    for node in nodes:
        for setting, target in _called(OmegaConf.to_container(node, resolve=False), "hydra"):
            if not target.startswith((*HYDRAS, f"{PACKAGE}.commands.shared.config.")):
                raise SettingError(f"{setting} = {target}: expected Hydra's own, or trust=true to let it run this code")


def check_said(cfg: DictConfig) -> None:
    """Whether the user, and no file, says whom to trust; only inside a job.

    Raises:
        SettingError: for `trust` that is on without being among the command's own settings.
    """
    trusted = OmegaConf.select(cfg, "trust")
    require(isinstance(trusted, bool), "trust", trusted, "true or false")
    # as they were typed: an interpolation among them is not ours to resolve
    overrides = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    assert isinstance(overrides, list)
    require(
        not trusted or _said([str(one) for one in overrides]),
        "trust",
        "true, in a file",
        "it among the command's own settings",
    )


def _said(overrides: Sequence[str]) -> bool:
    return any(one.lstrip("+").lower() == "trust=true" for one in overrides)


def _values(override: Override, folders: Sequence[str]) -> Iterator[str]:
    """What a sweep goes through; of a range nothing, which are numbers."""
    pattern = override.value()
    if isinstance(pattern, Glob):  # of what the folders add to a group
        yield from pattern.filter([p.stem for f in folders for p in Path(f, override.key_or_group).glob("*.yaml")])
    elif override.is_sweep_override() and not override.is_range_sweep():
        yield from (str(value) for value in override.sweep_string_iterator())


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
