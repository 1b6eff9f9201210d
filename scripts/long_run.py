"""Runs for long what a robot does all day, and measures what must not grow: memory, time and error.

    python scripts/long_run.py [fusions, 1000000] [saccades, 10000]

Prints a line of JSON for fusions of varied looks, one for looks all alike, and one for each tenth of the episode.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.rollout import one_episode
from torchfovea.gaussian import gaussian_from_information, positive_definite
from torchfovea.memory.egosphere import Prior, empty_memory
from torchfovea.memory.pooling import pool_patches
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.update import fuse

SMALL = ["fidelity=geometric", "sensor.receptive_fields=200", "memory.cells=100", "near_target_m=0.5"]


class Drift(NamedTuple):
    """Of a float32 memory from a float64 one after so many fusions.

    Attributes:
        fusions: into each cell.
        mean_sigmas: largest distance of a mean, in standard deviations of the float64 memory.
        mean_look_sigmas: the same in standard deviations of one look.
        covariance: largest relative error of a variance.
        positive_definite: whether every information matrix is.
    """

    fusions: int
    mean_sigmas: float
    mean_look_sigmas: float
    covariance: float
    positive_definite: bool


def fuse_often(fusions: int, still: bool, cells: int = 16) -> Drift:
    """Enter looks of noisy surfaces into a float32 and a float64 memory.

    Args:
        fusions: into every cell.
        still: whether every look sees a cell's surface at one place, so that the others stay as unknown as they were;
            otherwise each look sees another place.
        cells: how many.
    """
    generator, spread = torch.Generator().manual_seed(0), 0.01
    rows = torch.randn(1 if still else 64, cells, 3, generator=generator, dtype=torch.float64)
    rows = torch.nn.functional.normalize(rows, dim=-1).expand(64, cells, 3)
    looks = 0.3 + spread * torch.randn(64, cells, generator=generator, dtype=torch.float64)
    memories, pools = [], []
    for dtype in (torch.float32, torch.float64):
        one = torch.ones(cells, dtype=dtype)
        memories.append(empty_memory(fibonacci_directions(cells, dtype), Prior(0.7, 0.3, 0.2, 1.1)))
        arange = torch.arange(cells)
        pools.append(
            [
                pool_patches(look.to(dtype), spread**2 * one, one, row.to(dtype), one, arange, (cells,))
                for look, row in zip(looks, rows, strict=True)
            ]
        )
    for k in range(fusions):
        memories = [fuse(memory, pool[k % len(pool)]) for memory, pool in zip(memories, pools, strict=True)]
    short, long = (gaussian_from_information(memory.information) for memory in memories)
    off = (short.mean.double() - long.mean).abs()
    variances = [g.cov.double()[..., (0, 3, 5)] for g in (short, long)]
    return Drift(
        fusions,
        float((off / variances[1].sqrt()).max()),
        float(off[..., 0].max() / spread),
        float((variances[0] / variances[1] - 1).abs().max()),
        bool(positive_definite(memories[0].information.matrix, 0.0).all()),
    )


class Tenth(NamedTuple):
    """A tenth of an episode.

    Attributes:
        saccades: done by its end.
        resident_mb: of the process, at its end.
        cpu_ms: a saccade.
        positive_definite: whether every information matrix was, at every saccade.
        information: mean trace of a cell's information, at its end.
    """

    saccades: int
    resident_mb: float
    cpu_ms: float
    positive_definite: bool
    information: float


def search_long(saccades: int, *settings: str) -> list[Tenth]:
    """A geometric episode of the smallest sizes."""
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("search", overrides=[*SMALL, f"saccades={saccades}", *settings])
        tenths: list[Tenth] = []
        began, whole = time.process_time(), True

        def each(t: int, glance: Any) -> None:
            nonlocal began, whole
            matrix = glance.step.memory.information.matrix
            whole &= bool(positive_definite(matrix, 0.0).all())
            if (t + 1) % (saccades // 10) == 0:
                trace = float(matrix[..., (0, 3, 5)].sum(-1).mean())
                cpu_ms = 1e3 * (time.process_time() - began) / (saccades // 10)
                tenths.append(Tenth(t + 1, resident_mb(), cpu_ms, whole, trace))
                began = time.process_time()

        one_episode(cfg, build_observer(cfg), 0, each)
    return tenths


def resident_mb() -> float:
    """What the process holds in memory now; Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


if __name__ == "__main__":
    given = [int(a) for a in sys.argv[1:]]
    fusions, saccades = (*given, *(1_000_000, 10_000)[len(given) :])
    for still in (False, True):
        print(json.dumps({"still": still, **fuse_often(fusions, still)._asdict()}), flush=True)
    for tenth in search_long(saccades):
        print(json.dumps(tenth._asdict()), flush=True)
