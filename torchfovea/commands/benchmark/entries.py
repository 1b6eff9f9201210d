"""What takes part: a function, a configuration or a command, checked before anything runs."""

from __future__ import annotations

import hashlib
import inspect
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.benchmark.protocol import TRACKS
from torchfovea.imported import load_function
from torchfovea.setting import require

__all__ = ["FAMILY", "Entry", "entries_of"]

FAMILY = "{family}"
"""In an entry's configuration, the name of the family that it is asked about."""

# settings that an entry may choose, by track; everything else is the protocol's
OPEN = {
    "policy": ("acquisition", "memory", "reward"),
    "matcher": ("matcher", "budget"),
    "memory": ("fusion", "prior"),
    "whole": ("acquisition", "memory", "reward", "matcher", "budget", "fusion", "prior", "reading", "sensor"),
}


@dataclass(frozen=True)
class Entry:
    """Somebody's answer to a track.

    Attributes:
        name: in the leaderboard.
        track: which.
        config: settings of `torchfovea search`, of the groups that the track leaves open; `FAMILY` in them is the
            family's name.
        function: ``module:function``, in the track's form.
        command: a program with its arguments, see `torchfovea.commands.benchmark.processes`.
    """

    name: str
    track: str
    config: tuple[str, ...] = ()
    function: str | None = None
    command: str | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for an entry that cannot take part."""
        word = isinstance(self.name, str) and self.name != "" and not set(self.name) & set("/\\\n|<>")
        require(word, "entry.name", self.name, "a name without / \\ | < >")
        where = f"entry {self.name}"
        require(self.track in TRACKS, f"{where}: track", self.track, "one of " + ", ".join(TRACKS))
        for override in self.config:
            group = override.partition("=")[0].lstrip("+").partition(".")[0]
            allowed = OPEN[self.track]
            require(group in allowed, f"{where}: config", override, f"settings of {', '.join(allowed)}")
        given = [self.function is not None, self.command is not None]
        require(sum(given) <= 1, where, "a function and a command", "one of them")
        require(any(given) or len(self.config) > 0, where, "nothing", "a function, a config or a command")
        whole = self.track == "whole" and self.command is not None
        require(not whole, f"{where}: command", self.command, "a function (a strategy) or a config in the track whole")

    def describe(self) -> dict[str, Any]:
        """What the record says of it; of a function's own file, and of a command's first, a hash."""
        told: dict[str, Any] = {"name": self.name, "track": self.track, "config": list(self.config)}
        if self.function is not None:
            told |= {"function": self.function, "source_hash": _file_hash(_source_of(self.function))}
        if self.command is not None:
            files = [Path(word) for word in shlex.split(self.command) if Path(word).is_file()]
            told |= {"command": self.command, "source_hash": _file_hash(files[-1] if files else None)}
        return told


def _source_of(function: str) -> Path | None:
    try:
        return Path(inspect.getsourcefile(inspect.unwrap(load_function(function, "function"))) or "")
    except TypeError:  # built in
        return None


def _file_hash(path: Path | None) -> str | None:
    return None if path is None or not path.is_file() else hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def entries_of(cfg: DictConfig, tracks: list[str]) -> list[Entry]:
    """The entries of the settings `entries` (ours) and `mine`, those of the tracks that run.

    Raises:
        SettingError: for one that cannot take part, two of a name, or none.
    """
    found: list[Entry] = []
    for setting in ("entries", "mine"):
        nodes: Any = OmegaConf.to_container(cfg[setting], resolve=True) if cfg[setting] is not None else []
        require(isinstance(nodes, list), setting, nodes, "a list of entries")
        for node in nodes:
            known = {"name", "track", "config", "function", "command"}
            good = isinstance(node, dict) and {"name", "track"} <= set(node) <= known
            require(good, setting, node, "entries {name, track, config|function|command}")
            config = node.get("config") or []
            require(isinstance(config, list), f"entry {node['name']}: config", config, "a list of settings")
            found.append(Entry(**{**node, "config": tuple(str(line) for line in config)}))
    names = [(entry.track, entry.name) for entry in found]
    twice = [name for name in names if names.count(name) > 1]
    require(not twice, "entries", twice[:1], "names that are each there once in a track")
    chosen = [entry for entry in found if entry.track in tracks]
    require(len(chosen) > 0, "entries", "none", f"at least one in the tracks {', '.join(tracks)}")
    for entry in chosen:  # mistakes come first
        if entry.function is not None:
            load_function(entry.function, f"entry {entry.name}: function")
    return chosen
