"""A strategy of one's own beside two of the library's, on the same scenes: doubt first, then greed.

python examples/own_strategy.py
"""

import torch
from torch import Tensor

import torchfovea as tf
from torchfovea.deciding.strategies import View, expected_improvement, upper_confidence_bound
from torchfovea.episode import Rules, run_episode
from torchfovea.memory.sphere import direction_mixture
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World


def doubt_then_greed(view: View) -> Tensor:
    """The bound's weight falls as the memory grows sure: a score for every cell, and any tensor operation will do."""
    doubt = view.std.mean(-1, keepdim=True)
    return view.mean + 4 * doubt * view.std


STRATEGIES = {"mine": doubt_then_greed, "UCB": upper_confidence_bound, "EI": expected_improvement}
SEEDS = range(4)

observer = tf.Observer(camera=tf.Pinhole.from_fov(90, 100), retina=tf.LogPolar(2000))
anywhere = direction_mixture([1.0], [[0.0, 0, 0]], [[1.0, 1, 1]])
reach = lambda directions: tf.fixate(observer.head, directions)[1]  # noqa: E731
for name, strategy in STRATEGIES.items():
    gaps = []
    for seed in SEEDS:
        scene = build_scene(Cans(outside_first_view=True), seed, observer.head)
        arena = SimulatedArena(
            World(scene, camera=observer.camera), observer, None
        )  # no matcher: surface points with noise
        memory = tf.new_memory(observer, tf.sample(anywhere, 500, seed, reach))
        generator = torch.Generator().manual_seed(seed)
        episode = run_episode(observer, memory, arena, arena.truth(memory.cells), generator, Rules(8, strategy))
        gaps.append(float(episode.gap.mean()))
    print(f"{name}: gap per saccade {sum(gaps) / len(gaps):.2f} over {len(gaps)} scenes")
