"""`torchfovea memory`: draw and describe a bias (Figs. 4, 7), or study the memory by `study=`."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from torchfovea.commands.memory.honesty import plan_honesty, study_honesty
from torchfovea.commands.memory.moving import study_moving, study_resampling
from torchfovea.commands.memory.study import Rows, study_encoders, study_fusion
from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.memories import aimed, loaded_memory, memory_path
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.screen import in_words, print_figures, wide_screen
from torchfovea.commands.shared.settings import choice, number, whole
from torchfovea.files import write_csv, write_result
from torchfovea.memory.nearest import neighbour_spacing_rad
from torchfovea.memory.store import save_memory
from torchfovea.metrics import near_target
from torchfovea.perception import new_memory
from torchfovea.setting import require

__all__ = ["run"]

STUDIES = {
    "fusion": study_fusion,
    "encoders": study_encoders,
    "moving": study_moving,
    "resampling": study_resampling,
    "honesty": study_honesty,
}


def run(cfg: DictConfig) -> float:
    """Draw the configured bias, or run a study; the score is the number of cells near the target, or of rows."""
    observer, seed = build_observer(cfg), whole(cfg, "seed", 0)
    rehearse(cfg, observer.head, observer)
    whole(cfg, "looks_per_move", 0), plan_honesty(cfg)
    arena = build_arena(cfg, observer, seed)
    if OmegaConf.select(cfg, "study") is not None:
        return _study(cfg, choice(cfg, "study", tuple(STUDIES)))
    from torchfovea.commands.memory.pictures import draw_memory

    toward = torch.nn.functional.normalize(arena.world.scene.nearest_point_e.double(), dim=-1)
    cfg = aimed(cfg, arena.world.scene)
    loaded, saved = loaded_memory(cfg, observer), memory_path(cfg, "memory.save")
    if loaded is None:
        cells = build_cells(cfg, observer.head, torch.Generator().manual_seed(seed), torch.float64)
    else:
        cells = loaded.cells.double()
    folder = run_folder()
    if saved is not None:
        save_memory(saved, new_memory(observer, cells.float()))
    truth = arena.truth(cells)
    near = near_target(truth.cell_points, truth.nearest_point, number(cfg, "near_target_m"))
    spacing = torch.rad2deg(neighbour_spacing_rad(cells))
    within = (cells @ toward).acos().rad2deg() if len(cells) else spacing
    figures = {
        "cells": len(cells),
        "cells_near_target": int(near.sum()),
        "cells_within_10_deg_of_target": int((within < 10).sum()),
        "spacing_median_deg": float(spacing.median()),
        "spacing_near_target_deg": float(spacing[near].median()) if bool(near.any()) else None,
    }
    near_it = f"{figures['cells_near_target']} near the target of {cfg.scene.name}"
    title = f"memory {cfg.memory.name}: {len(cells)} cells, {near_it}"
    draw_memory(folder / "memory.png", cells, spacing, toward, title)
    write_result(folder, figures)
    print_figures(figures)
    return float(figures["cells_near_target"] or 0)


def _study(cfg: DictConfig, name: str) -> float:
    """Run a study; its table goes to NAME.csv, to the screen and, by dotted keys, to result.json."""
    for setting in ("memory.load", "memory.save"):
        require(OmegaConf.select(cfg, setting) is None, setting, OmegaConf.select(cfg, setting), "null with a study")
    folder, rows = run_folder(), Rows()
    STUDIES[name](cfg, rows)
    write_csv(folder / f"{name}.csv", rows.columns, rows.rows)
    table = Table(box=None, padding=(0, 1, 0, 0))
    shown = None if rows.shown is None else len(rows.labels) + rows.shown
    for column in rows.columns[:shown]:
        table.add_column(column, justify="right")
    for row in rows.rows:
        table.add_row(*map(in_words, row[:shown]))
    wide_screen().print(table)
    write_result(folder, rows.figures())
    return float(len(rows.rows))
