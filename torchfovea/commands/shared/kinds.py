"""What kind of value a setting takes, told by the values that the configuration's own files give it.

Every command's settings are compared with these before the command is called: a number where the files have a word, a
list where they have a number or what is no number at all is refused in one line, whether the command would read it
first, last or not at all. What a number's range is, and which words there are, is for those to say who read them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.settings import is_whole
from torchfovea.setting import SettingError

__all__ = ["BESIDES", "Kinds", "check_groups", "check_kinds", "kinds_of"]

# what a setting may be besides what the files give it, where they give it null or leave it to other settings
BESIDES = {
    "null": "noise pair bag.camera sensor.sample mine entries",
    "int": (
        "memory.cells sensor.sample distances vergences propagation.samples every acquisition.saccades "
        "against threads episodes scenes judged_scenes looks validation_scenes heldout_scenes check_episodes "
        "reward.evidence.marks"
    ),
    "float": (
        "calibration_unit_m focal_px cx_px cy_px baseline_m disparity_unit_px disparity_unknown "
        "stop.probability seconds reward.evidence.detail_m matcher.half_from_px"
    ),
    "str": (
        "pair matcher.source study viewer families paths tracks report conditions arms size resume recording "
        "left right mask disparity calibration calibration_right calibration_lens gaze_right_px bag.joints "
        "bag.odometry bag.pan bag.tilt bag.vergence memory.load memory.save memory.resample memory.topology "
        "in_family against history"
    ),
    "list[int]": "calibration_cameras sensor.grid realised.source_px",
    "list[float]": "gaze_px gaze_right_px fovs_deg",
    "list[str]": "families paths report pairs overrides scene_overrides.attention_world",
    "list[map]": "mine",
    "map": "reward.evidence",
}
WORDS = {"bool": "true or false", "int": "a whole number", "float": "a number", "str": "text", "map": "a mapping"}


class Kinds(NamedTuple):
    """What a setting, or an element of its lists, may be.

    Attributes:
        names: of null, bool, int, float, str, list and map; none: anything.
        elements: of its lists; None: of none.
    """

    names: frozenset[str]
    elements: Kinds | None = None

    def take(self, value: Any) -> bool:
        """Whether a value is of these kinds."""
        kind = _kind(value)
        if not self.names - {"null"}:
            return True
        if kind in ("int", "float"):
            return "float" in self.names or ("int" in self.names and is_whole(value))
        if kind == "list" and kind in self.names and self.elements is not None:
            return all(map(self.elements.take, value))
        return kind in self.names

    def __str__(self) -> str:
        """In words."""
        said = [WORDS[name] for name in ("bool", "int", "float", "str", "map") if name in self.names]
        said = [word for word in said if not (word == WORDS["int"] and "float" in self.names)]
        if "list" in self.names:
            said.append("a list" if self.elements is None else f"a list, each of it {self.elements}")
        return " or ".join([*said, *(["null"] if "null" in self.names else [])])


def check_kinds(cfg: DictConfig, command: str) -> None:
    """Refuse settings that are not of the kinds that the files have.

    Args:
        cfg: a command's, whole.
        command: its name.

    Raises:
        SettingError: for the first such setting.
    """
    kinds = kinds_of(command)
    for resolve in (False, True):  # what others stand for comes first
        for name, value in _settings(OmegaConf.to_container(cfg, resolve=resolve), kinds):
            known, stands = kinds[name], isinstance(value, str) and (value == "???" or "${" in value)
            if not stands and not known.take(value):
                raise SettingError(f"{name} = {value}: expected {known}")


def check_groups(command: str) -> None:
    """Refuse to do without a group of which the running command's file names a choice."""
    chosen = HydraConfig.get().runtime.choices
    for group, choice in _defaults(command):
        if choice is not None and chosen.get(group, "") is None:
            options = sorted(path.stem for path in (Path(conf_dir()) / group).glob("*.yaml"))
            raise SettingError(f"{group} = null: expected one of {', '.join(options)}")


@lru_cache(maxsize=16)
def kinds_of(command: str) -> dict[str, Kinds]:
    """The kinds of every setting that a command's own file, what all share or a group's file gives a value."""
    folder, found = Path(conf_dir()), dict[str, Kinds]()
    roots = [folder / "base.yaml", folder / f"{command}.yaml"]
    groups = [group for group, _ in _defaults(command)]
    for path in [*roots, *(path for group in groups for path in sorted((folder / group).glob("*.yaml")))]:
        text = path.read_text(encoding="utf-8")
        whole = path in roots or re.search(r"^# @package _global_", text, re.MULTILINE) is not None
        node = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        assert isinstance(node, dict)
        own = {str(key): value for key, value in node.items() if key not in ("defaults", "hydra")}
        _note(found, own if whole else {path.parent.name: own}, "")
    for kind, names in BESIDES.items():
        for name in names.split():
            if name in found:
                found[name] = _joined(found[name], _named(kind))
    return found


@lru_cache(maxsize=16)
def _defaults(command: str) -> tuple[tuple[str, str | None], ...]:
    """The groups that a command's file names, with its choices."""
    plain = yaml.safe_load((Path(conf_dir()) / f"{command}.yaml").read_text(encoding="utf-8"))
    return tuple(item for entry in plain["defaults"] if isinstance(entry, dict) for item in entry.items())


def _settings(node: Any, kinds: dict[str, Kinds], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting whose kinds are known; what belongs to somebody else's code is not ours to judge."""
    target = node.get("_target_")
    foreign = isinstance(target, str) and not target.startswith("torchfovea.")
    for key, value in node.items() if not foreign else ():
        name = f"{prefix}{key}"
        if name in kinds:
            yield name, value
            if isinstance(value, dict):
                yield from _settings(value, kinds, f"{name}.")


def _note(found: dict[str, Kinds], node: dict[str, Any], prefix: str) -> None:
    for key, value in node.items():
        name = f"{prefix}{key}"
        found[name] = _joined(found.get(name), _told(value))
        if isinstance(value, dict):
            _note(found, value, f"{name}.")


def _named(kind: str) -> Kinds:
    """Of "int", "list[int]", ..."""
    name, _, element = kind.removesuffix("]").partition("[")
    return Kinds(frozenset([name]), _named(element) if element else None)


def _told(value: Any) -> Kinds:
    kind = _kind(value)
    if kind == "other":
        return Kinds(frozenset())
    if kind != "list":
        return Kinds(frozenset([kind]))
    elements: Kinds | None = None
    for one in value:
        elements = _joined(elements, _told(one))
    return Kinds(frozenset(["list"]), elements)


def _joined(one: Kinds | None, other: Kinds) -> Kinds:
    if one is None:
        return other
    parts = [kinds.elements for kinds in (one, other) if kinds.elements is not None]
    elements = _joined(*parts) if len(parts) == 2 else parts[0] if parts else None
    return Kinds(one.names | other.names, elements)


def _kind(value: Any) -> str:
    """Of one value; what stands for another (``${...}``, ``???``), is empty or no number: other."""
    if value is None:
        return "null"
    if isinstance(value, float) and value != value:
        return "other"
    if isinstance(value, str) and (not value or value == "???" or "${" in value):
        return "other"
    return {bool: "bool", int: "int", float: "float", str: "str", list: "list", dict: "map"}.get(type(value), "other")
