"""A bias that a run learns from its own episodes (Sec. 8's online re-sampling): memory.resample=remembered."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.memories import memory_path, mixture_settings, mixture_yaml
from torchfovea.commands.shared.screen import say
from torchfovea.commands.shared.settings import choice, number
from torchfovea.episode import Episode
from torchfovea.files import replacing
from torchfovea.memory.sphere import DirectionMixture
from torchfovea.perception import Observer
from torchfovea.setting import SettingError, require
from torchfovea.tuning.rivals import Noted, fit_mixture, nearest_share

__all__ = ["Best", "best_fixation", "biased", "check_resample", "refit", "rounds", "write_bias"]

NAME = "remembered"
FIRST = 16  # episodes before the first refit


class Best(NamedTuple):
    """An episode's best fixation.

    Attributes:
        direction: unit, from E, (3,).
        range_m: of the surface there.
    """

    direction: Tensor
    range_m: float


def check_resample(cfg: DictConfig, observer: Observer) -> bool:
    """Whether a run learns its bias.

    Raises:
        SettingError: for another word, and where there is no bias to learn or nothing to learn it from.
    """
    if OmegaConf.select(cfg, "memory.resample") is None:
        return False
    word = choice(cfg, "memory.resample", (NAME,))
    require(memory_path(cfg, "memory.load") is None, "memory.load", cfg.memory.load, "null with memory.resample")
    require(observer.classes is None, "memory.resample", word, "null where a class is sought: nearness is remembered")
    return True


def rounds(episodes: int) -> list[range]:
    """Numbers of the episodes between refits: 16, 32, 64, ...; a rest that is smaller than a round belongs to it."""
    found, begin, size = [], 0, FIRST
    while begin < episodes:
        rest = episodes - begin
        end = episodes if rest < 2 * size else begin + size
        found.append(range(begin, end))
        begin, size = end, 2 * size
    return found


def best_fixation(episode: Episode) -> Best:
    """Where the best fixation of an episode landed, as a gaze that has come to rest there measures it."""
    t = int(episode.reward.argmax())
    return Best(episode.direction[t], -float(episode.reward[t]))


def refit(cfg: DictConfig, found: list[Best]) -> DirectionMixture | None:
    """The Gaussian of a round's best fixations without the farthest fifth, and without those that met no object.

    None, and a line on stderr, where they are too few to fit: the bias then stays as it is.
    """
    seen = [best for best in found if best.range_m < number(cfg, "far_m")]
    try:
        require(len(seen) > 0, "fixations to remember", 0, "at least one episode whose gaze met an object")
        ranges = torch.tensor([best.range_m for best in seen], dtype=torch.float64)
        noted = Noted(torch.stack([best.direction for best in seen]), ranges, torch.zeros(len(seen), 2))
        return fit_mixture(nearest_share(noted).direction)
    except SettingError as error:
        say(f"{error}; the bias stays as it is")
        return None


def biased(cfg: DictConfig, mixture: DirectionMixture) -> DictConfig:
    """The same settings with cells drawn from a mixture."""
    changed = cfg.copy()
    OmegaConf.set_struct(changed, False)
    kept = {key: cfg.memory[key] for key in ("cells", "load", "save", "resample")}
    changed.memory = {"name": NAME, **kept, **mixture_settings(mixture)}
    return changed


def write_bias(folder: Path, mixture: DirectionMixture) -> None:
    """The last bias as a file for `search --config-dir FOLDER memory=remembered`."""
    note = (
        "What a search remembers of its own episodes: torchfovea search --config-dir THIS_RUNS_FOLDER memory=remembered"
    )
    with replacing(folder / "memory" / f"{NAME}.yaml") as temporary:
        temporary.write_text(mixture_yaml(mixture, note, NAME), encoding="utf-8")
