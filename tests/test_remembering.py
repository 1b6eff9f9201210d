"""A bias that a search learns from its own episodes."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from torchfovea.cli import main
from torchfovea.commands.search import remembering
from torchfovea.commands.search.remembering import Best, refit, rounds

SMALL = ["fidelity=geometric", "saccades=2", "sensor.receptive_fields=600", "memory.cells=200", "picture=false"]
CFG = OmegaConf.create({"far_m": 6.0})


def around(mean, count, seed=0):
    rng = np.random.default_rng(seed)
    v = np.array(mean) + 0.1 * rng.standard_normal((count, 3))
    return torch.tensor(v / np.linalg.norm(v, axis=1, keepdims=True))


def test_rounds_double_and_leave_no_small_rest():
    for episodes in (1, 15, 16, 31, 32, 47, 100, 112, 1000):
        parts = rounds(episodes)
        assert [k for part in parts for k in part] == list(range(episodes))
        sizes = [len(part) for part in parts]
        assert sizes[:-1] == [16 * 2**k for k in range(len(sizes) - 1)]
        assert len(sizes) == 1 or sizes[-1] >= sizes[-2]


def test_a_bias_has_the_moments_of_the_near_fixations_that_met_an_object():
    near, far = around([0.8, 0.4, -0.3], 40), around([0.5, -0.8, 0.2], 10, 1)
    found = [Best(u, 1.0) for u in near] + [Best(u, 2.0) for u in far] + [Best(far[0], 6.0)] * 30
    mixture = refit(CFG, found)
    v = near.numpy()
    np.testing.assert_allclose(mixture.means[0].numpy(), v.mean(0), atol=1e-9)
    covariance = (mixture.cholesky @ mixture.cholesky.mT)[0].numpy()
    np.testing.assert_allclose(covariance, np.cov(v.T, bias=True) + 0.05**2 * np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("found", "named"),
    [
        ([Best(torch.tensor([1.0, 0.0, 0.0]), 6.0)] * 5, "fixations to remember = 0: expected at least one"),
        ([Best(torch.tensor([1.0, 0.0, 0.0]), 1.0)] * 5, "directions to fit = 1: expected at least 2 different"),
    ],
)
def test_too_little_to_remember_is_said_and_changes_nothing(found, named, capsys):
    assert refit(CFG, found) is None
    said = capsys.readouterr().err
    assert named in said and len(said.splitlines()) == 1


def search(capsys, tmp_path, name, *overrides):
    run = tmp_path / name
    assert main(["search", *SMALL, f"hydra.run.dir={run}", *overrides]) == 0, capsys.readouterr().err
    with (run / "episodes.csv").open() as file:
        return [
            {k: v for k, v in row.items() if k not in ("episode", "seconds_per_saccade")}
            for row in csv.DictReader(file)
        ]


@pytest.mark.parametrize(
    "more", [["batch=3"], ["motor=physics", "workers=2", "backend=threading"]], ids=["together", "elsewhere"]
)
def test_a_round_plays_with_what_the_round_before_has_found(more, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(remembering, "FIRST", 3)
    alike = ["memory.resample=remembered", *more]
    both = search(capsys, tmp_path, "both", "episodes=6", *alike)
    first = search(capsys, tmp_path, "first", "episodes=3", *alike)
    plain = search(capsys, tmp_path, "plain", "episodes=6", *more)
    assert both[:3] == first == plain[:3]
    kept = Path(shutil.copytree(tmp_path / "first" / "memory", tmp_path / "kept" / "memory")).parent
    learned = ["memory=remembered", f"--config-dir={kept}", *more]
    assert both[3:] == search(capsys, tmp_path, "second", "seed=3", "episodes=3", *learned)
    gained = "global_information_per_saccade"
    assert [row[gained] for row in both[3:]] != [row[gained] for row in plain[3:]]


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["memory.resample=often"], "memory.resample = often: expected"),
        (["memory.resample=remembered", "family=marked"], "memory.resample = remembered: expected null where a class"),
    ],
)
def test_what_cannot_be_remembered_is_named_before_any_work(settings, named, tmp_path, capsys):
    assert main(["search", *SMALL, f"hydra.run.dir={tmp_path}/run", *settings]) == 1
    said = capsys.readouterr().err
    assert named in said and len(said.splitlines()) == 1
    assert not (tmp_path / "run" / "episodes.csv").exists()
