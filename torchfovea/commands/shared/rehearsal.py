"""Everything that a run would build, built once before it begins: mistakes come first, also in what is not used."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.build import (
    build_cells,
    build_match,
    build_motor,
    build_noise,
    build_renderer,
    build_route,
    build_scene_of,
)
from torchfovea.commands.shared.memories import aimed, loaded_memory, memory_path
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.settings import changed, number, whole
from torchfovea.commands.shared.strategy import build_stop, build_strategy
from torchfovea.perception import Observer
from torchfovea.sensing.head import Head

__all__ = ["rehearse"]

CELLS = 64  # enough to see whether a bias can be drawn from


def rehearse(cfg: DictConfig, head: Head, observer: Observer | None = None) -> None:
    """Build what the groups of a configuration stand for: the first scene, its renderer and motor, the matcher, ...

    Args:
        cfg: with any of the groups scene, renderer, motor, motion, matcher, memory and acquisition, and the settings
            beside them.
        head: whose reach scenes and cells have.
        observer: of the configuration, if it has one.

    Raises:
        SettingError: for whatever one of them refuses.
    """
    for setting in ("episodes", "saccades"):
        if setting in cfg:
            whole(cfg, setting)
    for setting in ("far_m", "near_target_m"):
        if setting in cfg:
            number(cfg, setting)
    if OmegaConf.select(cfg, "sensor.sample") is not None:
        whole(cfg, "sensor.sample", 16)
    seed = whole(cfg, "seed", 0)
    build_noise(cfg), build_route(cfg)
    if "matcher" in cfg:
        build_match(cfg, observer)
    if "stop" in cfg:
        build_stop(cfg)
    if "renderer" in cfg:  # what only images need is not asked of who has none
        name_of(cfg, "renderer") if cfg.get("fidelity") == "geometric" else build_renderer(cfg)
    motor = build_motor(cfg) if "motor" in cfg else None
    if observer is not None and "acquisition" in cfg:
        build_strategy(cfg, observer)
    if observer is not None and "memory" in cfg:
        loaded_memory(cfg, observer), memory_path(cfg, "memory.save")
    scene = build_scene_of(cfg, head, seed) if "scene" in cfg else None
    if motor is not None and scene is not None:
        motor(scene)
    if "memory" in cfg and observer is not None:
        count = min(CELLS, whole(cfg, "memory.cells"))
        few = changed(cfg if scene is None else aimed(cfg, scene), {"memory": {"cells": count}})
        build_cells(few, head, torch.Generator().manual_seed(seed))
