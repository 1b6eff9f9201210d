"""A policy by hand in the environment, beside chance: look at what seems nearest, or is hardly known (extra `rl`).

python examples/gymnasium_loop.py
"""

import gymnasium
import numpy as np

import torchfovea.envs  # noqa: F401  registers the environment

SCENES = range(100, 106)


def nearest_or_unknown(seen: dict[str, np.ndarray]) -> np.ndarray:
    inverse_range, information, _, eligible = seen["memory"]
    score = np.where(eligible > 0, inverse_range + 0.3 * (information < 1.0), -np.inf)
    row, column = np.unravel_index(score.argmax(), score.shape)
    rows, columns = score.shape  # from left to right and top to bottom over the head's reach
    return np.array([1 - 2 * (column + 0.5) / columns, 2 * (row + 0.5) / rows - 1], np.float32)


env = gymnasium.make(
    "torchfovea/VisualSearch-v0",
    overrides=("scene=cans", "scene.outside_first_view=true", "sensor.receptive_fields=1000", "memory.cells=400"),
    scenes=SCENES,
    saccades=8,
)
env.action_space.seed(0)
for name, policy in (("by hand", nearest_or_unknown), ("chance", lambda seen: env.action_space.sample())):
    gaps = []
    for seed in SCENES:
        (seen, info), done = env.reset(seed=seed), False
        while not done:
            seen, reward, terminated, truncated, info = env.step(policy(seen))
            done = terminated or truncated
        gaps.append(info["metrics"]["gap_per_saccade"])
    print(f"{name}: gap per saccade {np.mean(gaps):.2f} over {len(gaps)} scenes")
