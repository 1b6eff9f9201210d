"""Biases fitted to where the nearest objects of the benchmark's training scenes stand: no search, no gradient.

python scripts/fit_bias.py FOLDER [scenes=64] [components=2]

Leaves FOLDER/memory/fitted_FAMILY.yaml for each family. They take part in the benchmark with --config-dir FOLDER, as
{name: fitted bias, track: policy, config: ["memory=fitted_{family}", "acquisition=ei"]}, see docs/benchmark.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from torchfovea.commands.benchmark.protocol import FAMILIES, seeds_of
from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.composed import compose_search
from torchfovea.commands.shared.memories import mixture_yaml
from torchfovea.commands.shared.rollout import kept_scene
from torchfovea.sim.truth import truth_of
from torchfovea.tuning.rivals import fit_mixture


def targets(family: str, scenes: int) -> torch.Tensor:
    """Directions of the nearest points in training scenes, (scenes, 3)."""
    cfg = compose_search(FAMILIES[family])
    observer, ahead = build_observer(cfg), torch.tensor([[1.0, 0.0, 0.0]])
    truths = [truth_of(kept_scene(cfg, observer.head, seed), ahead) for seed in seeds_of("training", scenes)]
    return torch.nn.functional.normalize(torch.stack([truth.nearest_point.double() for truth in truths]), dim=-1)


def main(folder: Path, scenes: int = 64, components: int = 2) -> None:
    """Fit and write."""
    (folder / "memory").mkdir(parents=True, exist_ok=True)
    for family in FAMILIES:
        note = f"Fitted to the nearest points of {scenes} training scenes of the benchmark's family {family}"
        text = mixture_yaml(fit_mixture(targets(family, scenes), components), note, f"fitted_{family}")
        (folder / "memory" / f"fitted_{family}.yaml").write_text(text, encoding="utf-8")
        print(family, flush=True)


if __name__ == "__main__":
    words = dict(word.split("=", 1) for word in sys.argv[2:])
    if len(sys.argv) < 2 or set(words) - {"scenes", "components"}:
        sys.exit("fit_bias: expected FOLDER [scenes=...] [components=...]")
    main(Path(sys.argv[1]), **{name: int(value) for name, value in words.items()})
