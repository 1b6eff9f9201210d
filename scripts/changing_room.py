"""A room that changes: `python scripts/changing_room.py gone|moved SCENES [OVERRIDE...]` (of `torchfovea search`).

After ten saccades the nearest can is taken away, or set down at the mirrored place, with its pole. Told: how many
saccades the gaze still goes to where it was, how many the memory still believes it there, and whether what is the
nearest thing then is found within fifteen more; scenes whose mirrored place is taken or out of sight are left out.
"""

from __future__ import annotations

import sys
from statistics import median

import torch
from hydra import compose, initialize_config_dir

from torchfovea.commands.shared.build import build_arena, build_cells, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.memory.egosphere import Memory, cartesian_belief, trust
from torchfovea.perception import new_memory
from torchfovea.search import search
from torchfovea.sim.cans import point_in_sight
from torchfovea.sim.compile import displaced
from torchfovea.sim.model import Scene
from torchfovea.sim.truth import truth_of

BEFORE, AFTER = 10, 15
NEAR_M = 0.15  # about the can's nearest point: the can itself
ASIDE_M = 0.25  # so far from the middle is the mirrored place another one


def changed(scene: Scene, how: str) -> Scene | None:
    """The scene after the change, or None where it makes no fair one."""
    (geom,) = scene.target_geoms
    target = scene.solids[geom]
    things = [s.name for s in scene.solids if s.name in (target.name, target.name.replace("can", "pole"))]
    if how == "gone":
        return displaced(scene, things, (0.0, 0.0, -100.0))
    across = target.position_m[1]
    if abs(across) < ASIDE_M:
        return None
    after = displaced(scene, things, (0.0, -2 * across, 0.0))
    fair = after.nearest.geom == geom and point_in_sight(after) is not None
    return after if fair else None


def believed_at(memory: Memory, point: torch.Tensor, true: torch.Tensor) -> bool:
    """Whether some cell believes a surface about a point where there is none in truth (Nx, 3)."""
    believed, there = ((p - point.to(p)).norm(dim=-1) < NEAR_M for p in (cartesian_belief(memory).mean, true))
    return bool((believed & ~there & (memory.looks > 0) & (trust(memory) >= 0.5)).any())


def main(how: str, scenes: int, overrides: list[str]) -> None:
    """Print the figures."""
    torch.set_num_threads(1)
    with initialize_config_dir(config_dir=str(conf_dir()), version_base=None):
        cfg = compose("search", overrides=["scene=cans", "fidelity=geometric", "profile=reduced", *overrides])
    observer = build_observer(cfg)
    held, stayed, believed, found, seed = [], [], [], [], 0
    while len(found) < scenes:
        arena, generator = build_arena(cfg, observer, seed), torch.Generator().manual_seed(seed)
        seed += 1
        before = arena.world.scene
        after = changed(before, how)
        if after is None:
            continue
        memory = new_memory(observer, build_cells(cfg, observer.head, generator))
        true = truth_of(after, memory.cells).cell_points
        old, on, looks, known, hit = before.nearest_point_e, False, 0, 0, None
        course = search(arena, observer, memory, BEFORE + AFTER, generator, build_strategy(cfg, observer))
        for t, glance in enumerate(course):
            fixated = arena.world.fixated(glance.move.gaze)
            if t < BEFORE:
                on |= fixated.is_target
            else:
                known = t - BEFORE + 1 if believed_at(glance.step.memory, old, true) else known
                if hit is None and fixated.geom == after.nearest.geom:
                    hit = t - BEFORE
            if t == BEFORE - 1:
                arena.world.scene = after
            chosen = glance.step.points.mean[glance.step.cell]
            if t >= BEFORE and looks == t - BEFORE and float((chosen - old.to(chosen)).norm()) < NEAR_M:
                looks += 1
        held.append(on), stayed.append(looks), believed.append(known), found.append(hit)
    caught = [h for h in found if h is not None]
    print(f"{how}, {scenes} scenes; the can had been found in {sum(held)}")
    print(
        f"decisions for its old place after the first look at the change: median {median(stayed)}, most {max(stayed)}"
    )
    late = sum(looks == AFTER for looks in believed)
    print(f"looks until nothing is believed there: median {median(believed)}; in {late} scenes more than {AFTER - 1}")
    print(f"nearest thing found in {len(caught)}, median after {median(caught) if caught else '-'} saccades")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
