"""Episodes of a configuration: one by one, or many at once by the geometric sensor."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.arena import Truth
from torchfovea.commands.shared.build import build_arena, build_cells, build_motor, build_scene_of
from torchfovea.commands.shared.memories import aimed, loaded_memory
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.settings import device_of, number, whole
from torchfovea.commands.shared.strategy import build_stop, build_strategy
from torchfovea.deciding.strategies import Strategy
from torchfovea.episode import Each, Episode, Rules, run_episode, run_episodes
from torchfovea.memory.egosphere import Memory
from torchfovea.metrics import near_target
from torchfovea.perception import Observer, new_memory
from torchfovea.rows import stack, to_device
from torchfovea.sensing.head import Head
from torchfovea.setting import require
from torchfovea.sim.arenas import GeometricArenas
from torchfovea.sim.model import Scene
from torchfovea.sim.truth import truth_of

__all__ = ["batched", "episodes_device", "kept_scene", "one_episode", "prepare_episode", "roll_out", "sample_of"]

StrategyFor = Callable[[Sequence[Truth]], Strategy]


def batched(cfg: DictConfig) -> bool:
    """Whether the episodes of a configuration can advance together."""
    still = "motion" not in cfg or name_of(cfg, "motion") == "still"
    return bool(cfg.fidelity == "geometric" and name_of(cfg, "motor") == "instant" and still)


def episodes_device(cfg: DictConfig) -> str:
    """Where episodes are computed.

    Raises:
        SettingError: for a device that there is none of here, and episodes that run on the CPU alone.
    """
    device = device_of(cfg)
    require(device == "cpu" or batched(cfg), "device", device, "cpu, or fidelity=geometric motor=instant motion=still")
    return device


def sample_of(cfg: DictConfig) -> int | None:
    """How many receptive fields a look goes through; None: all."""
    return None if OmegaConf.select(cfg, "sensor.sample") is None else whole(cfg, "sensor.sample", 16)


def one_episode(
    cfg: DictConfig,
    observer: Observer,
    seed: int,
    each: Each | None = None,
    record: str | None = None,
    strategy: Strategy | None = None,
) -> Episode:
    """The episode of one seed, with whatever sensor, renderer and motor.

    Args:
        cfg: a search's.
        observer: of that configuration.
        seed: of scene, cells and noise.
        each: see `torchfovea.episode.run_episodes`.
        record: a folder for it, if one is given.
        strategy: in place of the configuration's own.
    """
    generator = torch.Generator().manual_seed(seed)
    arena = build_arena(cfg, observer, seed)
    if record is not None:
        arena.record(record)
    memory = loaded_memory(cfg, observer)
    if memory is None:
        memory = new_memory(observer, build_cells(aimed(cfg, arena.world.scene), observer.head, generator))
    truth = arena.truth(memory.cells)
    if strategy is None:
        strategy = build_strategy(cfg, observer, _aim(truth, number(cfg, "near_target_m")))
    rules = _rules(cfg, strategy)
    return run_episode(observer, memory, arena, truth, generator, rules, each)


def _rules(cfg: DictConfig, strategy: Strategy) -> Rules:
    far_m, near_target_m = number(cfg, "far_m"), number(cfg, "near_target_m")
    return Rules(whole(cfg, "saccades"), strategy, build_stop(cfg), far_m, near_target_m)


def _aim(truth: Truth, near_m: float) -> Tensor:
    """Where the oracle looks (3,): the middle of what cells see near the nearest point; itself, if none does.

    The nearest point of a can above or below E lies on its rim, and a cell there may see, or believe, what is behind.
    """
    near = near_target(truth.cell_points, truth.nearest_point, near_m)
    point = truth.cell_points[near].mean(0) if bool(near.any()) else truth.nearest_point
    return torch.nn.functional.normalize(point, dim=-1)


def _text(cfg: DictConfig, *names: str) -> str:
    """Some settings as a key; JSON, which is written in a tenth of the time that YAML takes."""
    parts = {name: cfg[name] for name in names if name in cfg}
    return json.dumps(
        {k: OmegaConf.to_container(v, resolve=True) if OmegaConf.is_config(v) else v for k, v in parts.items()}
    )


def _settings(text: str) -> DictConfig:
    cfg = OmegaConf.create(json.loads(text))
    assert isinstance(cfg, DictConfig)
    return cfg


@lru_cache(maxsize=64)
def _scene(settings: str, head: Head, seed: int) -> Scene:
    return build_scene_of(_settings(settings), head, seed)


@lru_cache(maxsize=64)
def _start(settings: str, observer: Observer, seed: int) -> tuple[Memory, Tensor]:
    """The memory of a seed, and where its generator stands after its cells were drawn."""
    generator = torch.Generator().manual_seed(seed)
    memory = new_memory(observer, build_cells(_settings(settings), observer.head, generator))
    return memory, generator.get_state()


def kept_scene(cfg: DictConfig, head: Head, seed: int) -> Scene:
    """The scene of a seed, kept for the next call with the same settings."""
    return _scene(_text(cfg, "scene", "trust"), head, seed)


def prepare_episode(cfg: DictConfig, observer: Observer, seed: int) -> tuple[Scene, Memory, Truth, torch.Generator]:
    """What an episode starts from; scenes and memories are kept for the next call with the same settings."""
    scene = kept_scene(cfg, observer.head, seed)
    generator, memory = torch.Generator().manual_seed(seed), loaded_memory(cfg, observer)
    if memory is not None:
        return scene, memory, truth_of(scene, memory.cells), generator
    memory, state = _start(_text(aimed(cfg, scene), "memory"), observer, seed)
    generator.set_state(state)
    return scene, memory, truth_of(scene, memory.cells), generator


def roll_out(
    cfg: DictConfig,
    observer: Observer,
    seeds: Sequence[int],
    strategy: StrategyFor | None = None,
    each: Each | None = None,
) -> list[Episode]:
    """Episodes of several seeds (a seed may come more than once) together, by the geometric sensor.

    Args:
        cfg: a search's.
        observer: of that configuration.
        seeds: one for each episode.
        strategy: from the truths to a strategy for them all; by default the configuration's.
        each: see `torchfovea.episode.run_episodes`.
    """
    parts = [prepare_episode(cfg, observer, seed) for seed in seeds]
    scenes, memories, truths, generators = (list(part) for part in zip(*parts, strict=True))
    device = episodes_device(cfg) if "device" in cfg else "cpu"
    memory = to_device(stack(memories), device)
    if strategy is None:
        aims = stack([_aim(truth, number(cfg, "near_target_m")) for truth in truths]).to(device)
        chosen = build_strategy(cfg, observer, aims)
    else:
        chosen = strategy(truths)
    return run_episodes(
        observer,
        memory,
        GeometricArenas(scenes, observer, sample_of(cfg), device, build_motor(cfg)(scenes[0]), seeds),
        truths,
        generators,
        _rules(cfg, chosen),
        each,
    )
