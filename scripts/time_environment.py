"""Steps a CPU second of the environment, one by one and as a batch, in one process and with one thread.

python scripts/time_environment.py [rows ...]
"""

from __future__ import annotations

import sys
import time
from typing import Any

import gymnasium
import torch

from torchfovea.envs import ENVIRONMENT

SCENES, LEAST = tuple(range(8)), 640  # steps that are timed, at least


def single(fidelity: str) -> float:
    """Steps a CPU second of one environment, resets included."""
    env: Any = gymnasium.make(ENVIRONMENT, fidelity=fidelity, scenes=SCENES).unwrapped
    env.action_space.seed(0)
    for seed in range(30):  # builds the scenes
        env.reset(seed=seed)
    start = time.process_time()
    for _ in range(80):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return 80 / (time.process_time() - start)


def batch(fidelity: str, rows: int) -> float:
    """Steps a CPU second of so many rows together, resets included."""
    env = gymnasium.make_vec(
        ENVIRONMENT, num_envs=rows, vectorization_mode="vector_entry_point", fidelity=fidelity, scenes=SCENES
    )
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())
    steps, start = max(20, LEAST // rows), time.process_time()
    for _ in range(steps):
        env.step(env.action_space.sample())
    return rows * steps / (time.process_time() - start)


if __name__ == "__main__":
    torch.set_num_threads(1)
    for kind in ("geometric", "cells"):
        one = single(kind)
        print(f"{kind}: one by one {one:.0f} steps a CPU second")
        for count in [int(word) for word in sys.argv[1:]] or [16, 64, 256]:
            many = batch(kind, count)
            print(f"{kind}: {count} rows {many:.0f} steps a CPU second, {many / one:.1f} times as many", flush=True)
