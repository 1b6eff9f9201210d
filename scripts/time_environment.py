"""Steps a CPU second of the environment, one by one and as a batch, in one process and with one thread.

python scripts/time_environment.py [rows ...] [settings of a search, such as compile=on]

A step is a saccade that was asked for; what resets cost is in the time and not among the steps. Beside the batch stands
what is arithmetic in a geometric step of so many rows: tracing the rays, and observing, fusing and deciding.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import torch

from torchfovea.envs import ENVIRONMENT
from torchfovea.perception import decide, perceive
from torchfovea.sensing.head import eyes

SCENES, LEAST = tuple(range(8)), 640  # steps that are timed, at least


def seconds(work: Callable[[], object]) -> float:
    """CPU seconds of it."""
    start = time.process_time()
    work()
    return time.process_time() - start


def single(fidelity: str, overrides: tuple[str, ...]) -> float:
    """Steps a CPU second of one environment."""
    env: Any = gymnasium.make(ENVIRONMENT, fidelity=fidelity, scenes=SCENES, overrides=overrides).unwrapped
    env.action_space.seed(0)

    def steps(count: int) -> None:
        for _ in range(count):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    for seed in range(30):  # builds the scenes
        env.reset(seed=seed)
    steps(20)
    return 81 / seconds(lambda: steps(81))  # whole episodes of nine saccades


def batch(fidelity: str, rows: int, overrides: tuple[str, ...]) -> tuple[float, Any]:
    """Steps a CPU second of so many rows together, and the environment."""
    env: Any = gymnasium.make_vec(
        ENVIRONMENT, num_envs=rows, vectorization_mode="vector_entry_point", fidelity=fidelity, scenes=SCENES,
        overrides=overrides, autoreset_mode="SameStep",
    )  # fmt: skip
    env.action_space.seed(0)
    env.reset(seed=0)

    def steps(count: int) -> None:
        for _ in range(count):
            env.step(env.action_space.sample())

    steps(9)
    count = 9 * max(2, LEAST // rows // 9)
    return rows * count / seconds(lambda: steps(count)), env


def arithmetic(env: Any) -> tuple[float, float]:
    """Rows a CPU second of tracing rays alone, and of observing, fusing and deciding alone."""
    rows = env.rows
    observer, memory, gaze = rows.observer, rows.memory, rows.gaze
    arenas, pose = rows.places.arenas, eyes(observer.head, gaze)
    look = arenas.look(gaze, rows.generators)

    def think() -> None:
        decide(observer, perceive(observer, memory, look.matches, pose))

    sensing, thinking = (
        min(seconds(work) for _ in range(5)) for work in (lambda: arenas.look(gaze, rows.generators), think)
    )
    return rows.count / sensing, rows.count / thinking


def main(words: list[str]) -> None:
    """Print a line for each fidelity and batch."""
    torch.set_num_threads(1)
    overrides = tuple(word for word in words if "=" in word)
    counts = [int(word) for word in words if "=" not in word] or [16, 64, 256]
    for kind in ("geometric", "cells"):
        one = single(kind, overrides)
        print(f"{kind}: one by one {one:.0f} steps a CPU second", flush=True)
        for count in counts:
            many, env = batch(kind, count, overrides)
            print(f"{kind}: {count} rows {many:.0f} steps a CPU second, {many / one:.1f} times as many", flush=True)
            if kind == "geometric":
                sensing, thinking = arithmetic(env)
                both = 1 / (1 / sensing + 1 / thinking)
                print(f"  rays alone {sensing:.0f}, observing, fusing, deciding {thinking:.0f}, both {both:.0f}")


if __name__ == "__main__":
    main(sys.argv[1:])
