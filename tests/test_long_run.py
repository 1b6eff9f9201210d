"""A short part of what `scripts/long_run.py` does for long: float32 holds, memory and time do not grow."""

import gc
import importlib.util
import math
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.rollout import one_episode


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).resolve().parents[1] / "scripts" / "long_run.py"
    spec = importlib.util.spec_from_file_location("long_run", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_thousands_of_float32_fusions_are_those_of_float64(script):
    drift = script.fuse_often(5000, still=False)
    assert drift.positive_definite
    assert drift.mean_sigmas < 1e-3 and drift.covariance < 1e-4


def test_staring_at_one_place_leaves_what_is_known_of_the_others(script):
    """A float32 sum of looks that are all alike rounds by more than the prior knows of the slopes."""
    drift = script.fuse_often(2000, still=True)
    assert drift.positive_definite
    assert drift.mean_sigmas < 1e-3 and drift.covariance < 1e-3


def test_an_episode_of_hundreds_of_saccades_grows_in_nothing_but_knowledge(script):
    tenths = script.search_long(300)
    assert [tenth.saccades for tenth in tenths] == list(range(30, 301, 30))
    assert all(tenth.positive_definite for tenth in tenths)
    informed = [tenth.information for tenth in tenths]
    assert all(math.isfinite(value) for value in informed) and sorted(informed) == informed
    assert tenths[-1].resident_mb - tenths[2].resident_mb < 20
    assert tenths[-1].cpu_ms < 5 * min(tenth.cpu_ms for tenth in tenths[1:])


def test_an_episode_keeps_numbers_and_no_tensors_of_every_saccade(script):
    """A tensor of one number takes half a kilobyte, and there are fifteen a saccade."""
    seen = []

    def count(t, glance):
        if t in (70, 138):
            seen.append(sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects()))

    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("search", overrides=[*script.SMALL, "saccades=140"])
        one_episode(cfg, build_observer(cfg), 0, count)
    assert seen[1] - seen[0] < 40
