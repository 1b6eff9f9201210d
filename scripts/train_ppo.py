"""Train PPO to look (fidelity `cells`, training scenes) and judge it beside others in search, on held-out scenes.

python scripts/train_ppo.py [family=open] [steps=150000] [scenes=16] [saccades=8] [seed=0] [out=ppo.zip]

Needs the extra `ppo`. What it saves searches by `torchfovea search acquisition=trained acquisition.policy=ppo.zip`.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from torchfovea.commands.benchmark.entries import Entry
from torchfovea.commands.benchmark.protocol import FAMILIES, SIZES, seeds_of
from torchfovea.commands.benchmark.tracks import Unit, run_unit
from torchfovea.envs import ENVIRONMENT
from torchfovea.studies.significance import bootstrap_interval

ROWS, POOL = 64, 96
ALPHAS = (0.0, 0.5, 1.0, 2.0)
OTHERS = ("ei", "thompson", "raster", "random", "oracle")


class Rows(VecEnv):
    """The vector environment as Stable-Baselines3 takes one."""

    def __init__(self, env: Any) -> None:
        self.env, self.actions, self.render_mode = env, None, None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:
        """Begin in every row."""
        seeds = [seed for seed in self._seeds if seed is not None]
        self._reset_seeds()
        return self.env.reset(seed=seeds if len(seeds) == self.num_envs else None)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions."""
        self.actions = actions

    def step_wait(self) -> tuple[Any, ...]:
        """Take them; rows that ended begin anew in the same step."""
        seen, reward, terminated, truncated, info = self.env.step(self.actions)
        over = terminated | truncated
        told: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for b in np.flatnonzero(over):
            told[b] = {"terminal_observation": info["final_obs"][b], "TimeLimit.truncated": bool(truncated[b])}
        return seen, reward.astype(np.float32), over, told

    def close(self) -> None:
        """Nothing is held."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Of the whole, for each row."""
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Rows have no settings of their own."""
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Rows have no methods of their own."""
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Never."""
        return [False] * self.num_envs


def train(family: str, steps: int, saccades: int, seed: int, out: str) -> float:
    """Train and save; the CPU seconds that it took."""
    size, begin = SIZES["quick"], time.process_time()
    overrides = (*FAMILIES[family], f"memory.cells={size.cells}")
    env = gymnasium.make_vec(
        ENVIRONMENT, num_envs=ROWS, vectorization_mode="vector_entry_point", autoreset_mode="SameStep",
        fidelity="cells", overrides=overrides, saccades=saccades, scenes=seeds_of("training", POOL), found=1.0,
    )  # fmt: skip
    model = PPO(
        "MultiInputPolicy", Rows(env), n_steps=32, batch_size=512, n_epochs=4, gamma=0.95, ent_coef=0.003, seed=seed,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -0.7}, device="cpu",
    )  # fmt: skip
    model.learn(steps)
    model.save(out)
    return time.process_time() - begin


def judge(name: str, config: tuple[str, ...], family: str, seeds: list[int], saccades: int) -> dict[str, torch.Tensor]:
    """The figures of one policy in scenes of a family, by the benchmark's own rules (geometric sensor)."""
    size = SIZES["quick"]._replace(saccades={"policy": saccades})
    rows = run_unit(Unit(Entry(name, "policy", config), family, tuple(seeds), size, 3600.0))
    return {key: torch.tensor([float(row[key]) for row in rows]) for key in ("gap_per_saccade", "found")}


def main(given: dict[str, str]) -> None:
    """Train, tune UCB's α on validation scenes, and print everybody's figures on the test scenes."""
    family, out, seed = given.get("family", "open"), given.get("out", "ppo.zip"), int(given.get("seed", "0"))
    numbers = {"steps": "150000", "scenes": "16", "saccades": "8", **given}
    steps, scenes, saccades = (int(numbers[name]) for name in ("steps", "scenes", "saccades"))
    torch.set_num_threads(1)
    print(
        f"{steps} steps of {family} in {train(family, steps, saccades, seed, out):.0f} CPU seconds: {out}", flush=True
    )

    def ucb(alpha: float) -> tuple[str, ...]:
        return ("acquisition=ucb", f"acquisition.alpha={alpha}")

    tuning = seeds_of("validation", min(scenes, 64))
    gaps = {a: float(judge("ucb", ucb(a), family, tuning, saccades)["gap_per_saccade"].mean()) for a in ALPHAS}
    best = max(gaps, key=lambda a: gaps[a])
    policies = {"ppo": ("acquisition=trained", f"acquisition.policy={out}"), f"ucb {best:g} (tuned)": ucb(best)}
    policies |= {name: (f"acquisition={name}",) for name in OTHERS}
    for name, config in policies.items():
        figures = judge(name, config, family, seeds_of("test", scenes), saccades)
        told = []
        for key, values in figures.items():
            low, high = bootstrap_interval(values, torch.Generator().manual_seed(0))[1:]
            told.append(f"{key} {values.mean():.3f} ({low:.3f} to {high:.3f})")
        print(f"{name:18} {', '.join(told)}", flush=True)


if __name__ == "__main__":
    words = dict(word.split("=", 1) for word in sys.argv[1:])
    unknown = set(words) - {"family", "steps", "scenes", "saccades", "seed", "out"}
    if unknown:
        sys.exit(f"train_ppo: {', '.join(sorted(unknown))}: expected family, steps, scenes, saccades, seed or out")
    main(words)
