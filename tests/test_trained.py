"""Policies from files: what Stable-Baselines3's PPO saved searches as a strategy, or is refused in one line."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.composed import compose_search
from torchfovea.envs.adapter import policy_strategy, trained
from torchfovea.perception import decide, new_memory
from torchfovea.setting import SettingError

SHAPE = (3, 5)
SEEN = spaces.Dict({
    "memory": spaces.Box(-10, 10, (4, *SHAPE), np.float32), "gaze": spaces.Box(-1, 1, (3,), np.float32),
})  # fmt: skip
SMALL = ("fidelity=geometric", "sensor.receptive_fields=300", "memory.cells=80")


def by_map(seen, size=2):
    """An action that any change of the map or the gaze would move."""
    signal = seen["memory"].reshape(len(seen["memory"]), -1).sum(1) + seen["gaze"].sum(1)
    return np.stack([np.sin(signal + k) for k in range(size)], 1).astype(np.float32)


def saved(action_space, answer, seen=SEEN):
    def predict(given, deterministic):
        assert deterministic and set(given) == set(seen.spaces) and given["memory"].shape[1:] == (4, *SHAPE)
        return answer(given), None

    return SimpleNamespace(observation_space=seen, action_space=action_space, predict=predict)


@pytest.fixture
def stored(monkeypatch, tmp_path):
    """Puts a model where Stable-Baselines3 would find it in a file, and names the file."""
    (tmp_path / "ppo.zip").write_bytes(b"")

    def store(load):
        module = ModuleType("stable_baselines3")
        module.PPO = SimpleNamespace(load=load)
        monkeypatch.setitem(sys.modules, "stable_baselines3", module)
        return str(tmp_path / "ppo.zip")

    return store


@pytest.fixture(scope="module")
def place():
    observer = build_observer(compose_search(SMALL))
    cells = torch.nn.functional.normalize(
        torch.randn(80, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([3.0, 0, 0]), dim=-1
    )
    return observer, new_memory(observer, cells)


@pytest.mark.parametrize(
    ("kind", "action_space", "answer"),
    [
        ("fixation", spaces.Box(-1, 1, (2,), np.float32), by_map),
        ("fixation", spaces.Box(-1, 1, (3,), np.float32), lambda seen: by_map(seen, 3)),
        ("weights", spaces.Box(-1, 1, (4,), np.float32), lambda seen: by_map(seen, 4)),
        ("cell", spaces.Discrete(80), lambda seen: (by_map(seen)[:, 0] * 39 + 40).astype(int)),
    ],
)
def test_a_file_says_by_its_spaces_what_its_actions_are(stored, place, kind, action_space, answer):
    path = stored(lambda path, device: saved(action_space, answer))
    observer, memory = place
    ours = decide(observer, memory, strategy=trained(path, observer))
    expected = decide(observer, memory, strategy=policy_strategy(answer, observer, kind, SHAPE))
    assert int(ours.cell) == int(expected.cell) >= 0


def test_files_of_something_else_are_refused_in_one_line(stored, place, monkeypatch, capsys, tmp_path):
    observer, _ = place

    def broken(path, device):
        raise ValueError("not a zip file")

    with pytest.raises(SettingError, match=r"acquisition\.policy = .*ppo\.zip: expected a PPO .*not a zip file"):
        trained(stored(broken), observer)
    blind = saved(spaces.Box(-1, 1, (2,), np.float32), by_map, spaces.Dict({"gaze": SEEN["gaze"]}))
    with pytest.raises(SettingError, match=r"expected a PPO that sees a memory"):
        trained(stored(lambda path, device: blind), observer)
    path = stored(broken)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)  # as where it is not installed
    run = ["search", "acquisition=trained", f"acquisition.policy={path}", *SMALL, f"hydra.run.dir={tmp_path}/run"]
    assert main(run) == 1
    assert "torchfovea[ppo]" in capsys.readouterr().err


def test_what_ppo_saves_searches_and_takes_part_in_the_benchmark(tmp_path):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    import gymnasium

    env = gymnasium.make(
        "torchfovea/VisualSearch-v0", fidelity="cells", overrides=SMALL[1:], scenes=(0,), saccades=3, map_shape=SHAPE
    )
    model = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=2, batch_size=2, seed=0, device="cpu")
    model.save(tmp_path / "mine")
    search = ["search", *SMALL, "episodes=1", "saccades=3", "picture=false", "acquisition=trained"]
    assert main([*search, f"acquisition.policy={tmp_path}/mine.zip", f"hydra.run.dir={tmp_path}/run"]) == 0
    assert (tmp_path / "run" / "result.json").exists()
