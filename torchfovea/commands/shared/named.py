"""What a configuration names: the thing itself by ``_target_``, or a user's own by ``source=module:function``.

A node of the configuration that stands for something exchangeable (a scene recipe, a renderer, a motor, a layout of
receptive fields, a matcher, a strategy, a reward) says by ``_target_`` what is called with its other settings to build
it, as Hydra's ``instantiate`` does. A node with a ``source`` instead is that function itself.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Collection, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.settings import construct, plain
from torchfovea.commands.shared.trust import load_trusted
from torchfovea.imported import load_function, made_if_class, require_takes
from torchfovea.setting import SettingError, require, require_name

__all__ = ["build_named", "name_of", "targets_of"]

OWN = ("_target_", "_partial_", "_args_", "_recursive_", "_convert_")


def name_of(cfg: DictConfig, group: str, key: str = "name") -> str:
    """What a group's choice is called.

    Raises:
        SettingError: for a node without a name, or one of ours under another's: the name says what it is, and choosing
            another is ``group=name``.
    """
    name = OmegaConf.select(cfg, f"{group}.{key}")
    require_name(name, f"{group}.{key}")
    target = OmegaConf.select(cfg, f"{group}._target_")
    ours = targets_of(group, key)
    unknown = target is None and OmegaConf.select(cfg, f"{group}.source") is None
    if name not in ours and (unknown or target in ours.values()):
        raise SettingError(f"{group}.{key} = {name}: expected one of {', '.join(ours)}, by {group}={name}")
    if target is not None and ours.get(name) not in (None, target):
        expected = f"{ours[name]}, which {name} is, or another {group}.{key}"
        raise SettingError(f"{group}._target_ = {target}: expected {expected}; for ours, {group}={name}")
    return str(name)


@lru_cache(maxsize=16)
def targets_of(group: str, key: str) -> dict[str, str | None]:
    """The ``_target_`` of each of a group's own choices, by its name."""
    found = {}
    for path in sorted((Path(conf_dir()) / group).glob("*.yaml")):
        node = OmegaConf.load(path)
        assert isinstance(node, DictConfig)
        found[str(node.get(key, path.stem))] = node.get("_target_")
    return found


def build_named(
    cfg: DictConfig,
    group: str,
    form: str,
    without: Collection[str] = ("name",),
    key: str = "name",
    takes: Sequence[str] | None = None,
) -> Any:
    """What a group of the configuration stands for.

    Args:
        cfg: the whole configuration, with `trust`.
        group: the node's name.
        form: what is expected of a user's own, for errors.
        without: settings of the node that are not the thing's own.
        key: the setting that bears its name; a node with one of our names and no `_target_` is ours.
        takes: what a thing that can be called will be called with; None: that is checked elsewhere.

    Returns:
        What `_target_` makes, or `source` names; of a class that needs no arguments an object.

    Raises:
        SettingError: in one line under the setting's name, for a `_target_` or `source` that does not exist, cannot be
            called, or not so, is not trusted or does not take these settings, and whatever it refuses itself.
    """
    node = OmegaConf.select(cfg, group)
    require(isinstance(node, DictConfig), group, node, form)
    told = plain(node)
    told.setdefault("_target_", targets_of(group, key).get(str(told.get(key))))
    if told["_target_"] is None:
        setting, source = f"{group}.source", told.get("source")
        require(source is not None, setting, None, f"package.module:function, {form}")
        made = made_if_class(load_function(source, setting))
    else:
        setting, source = group, told["_target_"]
        settings = {key: value for key, value in told.items() if key not in without}
        made = _build(settings, group, bool(OmegaConf.select(cfg, "trust")), form)
    if takes is not None and callable(made):
        require_takes(made, takes, setting, source)
    return made


def _build(node: dict[str, Any], where: str, trusted: bool, form: str) -> Any:
    """One node, what it holds first."""
    kind = load_trusted(node["_target_"], f"{where}._target_", trusted)
    settings = {key: value for key, value in node.items() if key not in OWN}
    for key, value in settings.items():
        if isinstance(value, dict) and "_target_" in value:
            settings[key] = _build(value, f"{where}.{key}", trusted, form)
    _check_names(kind, settings, where)
    if inspect.isclass(kind) and dataclasses.is_dataclass(kind) and not node.get("_partial_"):
        return construct(kind, settings, where)
    try:
        own = {"_convert_": "all", **{key: node[key] for key in OWN if key in node}, "_recursive_": False}
        return instantiate({**settings, **own})
    except InstantiationException as error:
        if isinstance(error.__cause__, SettingError):
            raise error.__cause__ from None
        cause = error.__cause__ or error
        if isinstance(cause, TypeError | ValueError):
            raise SettingError(f"{where} = {node['_target_']}: {cause}: expected {form}") from error
        raise


def _check_names(kind: Any, settings: dict[str, Any], where: str) -> None:
    """Refuse settings that what is called does not take."""
    try:
        parameters = inspect.signature(kind).parameters
    except (TypeError, ValueError):
        return
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return
    for key, value in settings.items():
        require(key in parameters, f"{where}.{key}", value, f"a setting of {kind.__name__}: {', '.join(parameters)}")
