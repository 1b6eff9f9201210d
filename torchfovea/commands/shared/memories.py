"""Memories that a run goes on from and leaves (the settings memory.load and memory.save), and biases as files."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.settings import changed
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.sphere import DirectionMixture
from torchfovea.memory.store import check_memory_path, load_memory
from torchfovea.perception import Observer, check_owner
from torchfovea.setting import require
from torchfovea.sim.model import Scene

__all__ = ["aimed", "loaded_memory", "memory_path", "mixture_settings", "mixture_yaml"]


def memory_path(cfg: DictConfig, setting: str) -> str | None:
    """A file's name or None; of memory.save one that can be written."""
    path = OmegaConf.select(cfg, setting)
    if path is not None and setting == "memory.save":
        check_memory_path(path, setting)
    return None if path is None else str(path)


def loaded_memory(cfg: DictConfig, observer: Observer) -> Memory | None:
    """The memory of the setting memory.load; None: there is none, and episodes begin with an empty one.

    Raises:
        SettingError: for no memory, a batch of them, and one of another chart or prior than the observer's.
    """
    path = memory_path(cfg, "memory.load")
    if path is None:
        return None
    memory = load_memory(path, "memory.load")
    require(memory.cells.dim() == 2, "memory.load", path, f"one memory, and no batch of {len(memory.cells)}")
    check_owner(observer, memory)
    return memory


def aimed(cfg: DictConfig, scene: Scene) -> DictConfig:
    """The settings with a memory that is centred on the scene's own target, if it has no mean of its own."""
    if "means" not in cfg.memory or cfg.memory.means is not None:
        return cfg
    mean = torch.nn.functional.normalize(scene.nearest_point_e, dim=-1).tolist()
    return changed(cfg, {"memory": {"means": [mean]}})


def mixture_settings(mixture: DirectionMixture) -> dict[str, Any]:
    """A bias as the group `memory` has it: weights, means and covariances."""
    covariance = mixture.cholesky @ mixture.cholesky.mT
    return {
        "weights": [round(v, 6) for v in mixture.logits.softmax(-1).tolist()],
        "means": [[round(v, 6) for v in row] for row in mixture.means.tolist()],
        "covariances": [[[round(v, 8) for v in row] for row in matrix] for matrix in covariance.tolist()],
    }


def mixture_yaml(mixture: DirectionMixture, note: str, name: str) -> str:
    """A bias in the form of conf/memory/*.yaml, with a comment on its first line."""
    content = {"name": name, "cells": 20000, **mixture_settings(mixture)}
    return f"# {note}\n" + OmegaConf.to_yaml(OmegaConf.create(content))
