"""Where does a gradient gain on a fit? `python scripts/gradients.py [--ways=bias,weights,both] KEPT [settings]`.

For each seed a bias is fitted to the targets of `start_episodes` training scenes, with the α that is best on
validation scenes; from there gradients climb for `episodes`: `bias` (and α), `weights` (α and `tune_weights`, the bias
as it is) or `both`. Each is judged beside a bias fitted in all the episodes together, on held-out scenes that are the
seed's own, and the difference has Student's 95% interval over the seeds. What a seed came to is kept in the folder
KEPT, one for each problem; with --only SEED a call makes that one alone. The settings are those of `torchfovea tune`.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.tune.command import build_problem
from torchfovea.commands.tune.judge import build_start
from torchfovea.files import write_tensors
from torchfovea.setting import require
from torchfovea.tuning.bias import decode
from torchfovea.tuning.problem import Problem, evaluate_bias
from torchfovea.tuning.rivals import best_alpha, fitted_bias, remembered_bias
from torchfovea.tuning.study import student
from torchfovea.tuning.train import Schedule, train
from torchfovea.untrusted import read_tensors

WAYS = ("bias", "weights", "both")
SIZES = {"episodes": 1024, "validation_scenes": 256, "heldout_scenes": 1024}  # what is null


def climb(problem: Problem, start: torch.Tensor, way: str, schedule: Schedule) -> tuple[Problem, torch.Tensor]:
    """The vector that a gradient finds, and the problem that reads it."""
    shape = problem.shape
    if way == "bias":
        shape = replace(shape, tuned=())
    own = Problem(problem.task, problem.distribution, shape, problem.cells, problem.dtype)
    begin = torch.cat([start[: shape.policy.stop], start[problem.shape.policy.stop :]])
    schedule = replace(schedule, estimator="policy") if way == "weights" else schedule
    return own, train(own, begin, schedule).best


def one_seed(cfg: DictConfig, problem: Problem, seed: int, ways: list[str]) -> dict[str, torch.Tensor]:
    """Held-out scores of every bias, scene by scene."""
    sizes = {name: value if cfg[name] is None else int(cfg[name]) for name, value in SIZES.items()}
    named = {name: cfg[name] for name in (field.name for field in fields(Schedule)) if name in cfg}
    schedule = Schedule(**{**named, **{k: v for k, v in sizes.items() if k != "heldout_scenes"}, "seed": seed})
    begin, spent, checked = build_start(cfg, problem.shape), int(cfg.start_episodes), sizes["validation_scenes"]
    start = fitted_bias(problem, begin, spent, seed, checked)
    whole = spent + sizes["episodes"]
    found = {"unbiased": (problem, best_alpha(problem, begin, checked)[0])}
    found["fitted"] = problem, fitted_bias(problem, begin, whole, seed, checked)
    found["remembered"] = problem, remembered_bias(problem, begin, whole, seed, checked)
    found |= {way: climb(problem, start, way, schedule) for way in ways}
    for name, (own, vector) in found.items():
        weights = decode(own.shape, vector, torch.zeros(1, own.shape.task_numbers).to(vector)).weights
        what = " ".join(f"{key} {float(getattr(weights, key)):.3g}" for key in ("alpha", *own.shape.tuned))
        print(f"  seed {seed}  {name}: {what}", flush=True)
    judge = int(cfg.heldout_seed) + seed
    return {
        name: evaluate_bias(own, vector, own.exam("heldout", judge, sizes["heldout_scenes"]), strict=False)
        for name, (own, vector) in found.items()
    }


def told(values: list[float]) -> str:
    """Mean and Student's 95% interval over seeds."""
    mean, low, high = student(values)
    return f"{mean:+.4f} ({low:+.4f} to {high:+.4f})"


def compare(kept: Path, settings: list[str], ways: list[str], seeds: list[int]) -> None:
    """Print every bias's score, and its difference from the fitted one."""
    torch.set_num_threads(1)
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("tune", overrides=["warm_episodes=0", "start_episodes=256", *settings])
    problem = build_problem(cfg)
    found = []
    for seed in seeds:
        path = kept / f"{seed}.pt"
        if not path.exists():
            write_tensors(path, one_seed(cfg, problem, seed, ways))
        found.append(read_tensors(path))
    print("bias, score, minus fitted")
    for name in found[0]:
        scores = [float(one[name].mean()) for one in found]
        print(f"{name}, {told(scores)}, {told([float((one[name] - one['fitted']).mean()) for one in found])}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kept", type=Path, help="folder of what the seeds came to")
    parser.add_argument("--ways", default="bias", help="some of " + ",".join(WAYS))
    parser.add_argument("--seeds", type=int, default=5, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--only", type=int, help="this one alone")
    parser.add_argument("settings", nargs="*", help="of torchfovea tune")
    given = parser.parse_args()
    ways = given.ways.split(",")
    require(set(ways) <= set(WAYS), "ways", given.ways, "some of " + ",".join(WAYS))
    seeds = range(given.first, given.first + given.seeds) if given.only is None else [given.only]
    compare(given.kept, given.settings, ways, list(seeds))
