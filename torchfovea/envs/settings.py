"""What an environment is made of: which search, what an action and an observation are, and what is rewarded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from omegaconf import DictConfig

from torchfovea.commands.shared.composed import compose_search
from torchfovea.setting import check_types, require

__all__ = ["ACTIONS", "FIDELITIES", "OBSERVATIONS", "EnvSettings", "env_settings", "search_settings"]

FIDELITIES = ("geometric", "photometric", "cells")
OBSERVATIONS = ("memory", "gaze", "gaussians", "retina")
ACTIONS = ("fixation", "cell", "weights")
# of a search in an environment; what a user overrides wins
SIZES = ("scene=cans", "sensor.fov_deg=90", "sensor.receptive_fields=2000", "memory.cells=500")


@dataclass(frozen=True)
class EnvSettings:
    """Of `torchfovea/VisualSearch-v0`.

    Attributes:
        overrides: settings of `torchfovea search` (scene, head, sensor, budget, fusion, prior, memory, reward, stop),
            as on its command line. By default a 90° log-polar retina of 2,000 fields looks at `scene=cans` and
            remembers 500 cells.
        fidelity: `geometric` (surface points by ray casting, noise in both retinas), `photometric` (images, matched),
            or `cells`: each cell that both retinas see gets one noisy inverse range in its own direction, as in
            `torchfovea tune`; nothing hides anything there, and it is an order of magnitude faster.
        saccades: T ≥ 2, the first look straight ahead included: after T − 1 actions an episode is truncated.
        scenes: seeds of the scenes that episodes draw from, each built when it is first drawn, and kept.
        observe: which of `memory`, `gaze`, `gaussians` and `retina` (photometric) an observation has.
        action: `fixation` (pan and tilt in [−1, 1]), `cell` (its number) or `weights` (over acquisitions).
        naming: whether an action may also name the target, which ends the episode.
        map_shape: rows and columns of the map of the memory.
        gap: reward for each gap reduction (Eq. 46), from 0 to 1 in an episode.
        information: reward for each nat of global information gained (Eq. 52).
        degrees: what each degree of a saccade costs.
        found: reward when the target itself is first fixated.
    """

    overrides: tuple[str, ...] = ()
    fidelity: str = "geometric"
    saccades: int = 10
    scenes: tuple[int, ...] = tuple(range(1000, 1064))
    observe: tuple[str, ...] = ("memory", "gaze")
    action: str = "fixation"
    naming: bool = False
    map_shape: tuple[int, int] = (12, 20)
    gap: float = 1.0
    information: float = 0.0
    degrees: float = 0.0
    found: float = 0.0

    def __post_init__(self) -> None:
        """Raise SettingError for a word that is unknown or a number out of range."""
        check_types(self)
        require(self.fidelity in FIDELITIES, "fidelity", self.fidelity, "one of " + ", ".join(FIDELITIES))
        require(self.saccades >= 2, "saccades", self.saccades, "at least 2, the first look included")
        good = len(self.scenes) > 0 and all(isinstance(seed, int) and seed >= 0 for seed in self.scenes)
        require(good, "scenes", self.scenes, "one or more seeds, whole numbers of at least 0")
        known = len(self.observe) > 0 and set(self.observe) <= set(OBSERVATIONS)
        require(known, "observe", self.observe, "some of " + ", ".join(OBSERVATIONS))
        sensed = {"retina": ("photometric",), "gaussians": ("geometric", "photometric")}
        for name, fidelities in sensed.items():
            seen = name not in self.observe or self.fidelity in fidelities
            require(seen, "observe", name, f"fidelity={' or '.join(fidelities)}, which has it")
        require(self.action in ACTIONS, "action", self.action, "one of " + ", ".join(ACTIONS))
        shape = len(self.map_shape) == 2 and all(isinstance(n, int) and 1 <= n <= 1000 for n in self.map_shape)
        require(shape, "map_shape", self.map_shape, "rows and columns, 1 to 1000")
        for name in ("gap", "information", "degrees", "found"):
            require(math.isfinite(getattr(self, name)), name, getattr(self, name), "a finite weight")


def env_settings(given: dict[str, Any]) -> EnvSettings:
    """Settings from keywords, lists allowed for tuples.

    Raises:
        SettingError: for a keyword that there is none of, and what `EnvSettings` refuses.
    """
    known = {field.name for field in fields(EnvSettings)}
    for name, value in given.items():
        require(name in known, name, value, f"a setting of the environment: {', '.join(sorted(known))}")
    plain: dict[str, Any] = {
        name: tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
        for name, value in given.items()
    }
    return EnvSettings(**plain)


def search_settings(overrides: tuple[str, ...], fidelity: str) -> DictConfig:
    """The configuration of the search that an environment is."""
    sensed = "photometric" if fidelity == "photometric" else "geometric"
    chosen = [*SIZES, *overrides, f"fidelity={sensed}"]
    return compose_search(tuple(chosen))
