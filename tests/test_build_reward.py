"""The reward that a configuration describes."""

import csv

import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.cli import main
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.rewards import build_reward
from torchfovea.setting import SettingError


def configured(*overrides: str):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("search", overrides=list(overrides))


def test_rewards_by_name(dtype):
    assert build_reward(configured()) == "inverse_range" and build_reward(configured("reward=range")) == "range"
    near = build_reward(configured("reward=nearest_to", "reward.point=[1,0,-0.5]"))
    x = torch.tensor([[1.0, 0.0, -0.5], [1.0, 3.0, 3.5]], dtype=dtype)
    assert near(x).dtype == dtype and near(x).tolist() == [0.0, -5.0]


def test_a_users_own(tmp_path, monkeypatch):
    (tmp_path / "my_reward.py").write_text("def high(x):\n    return x[..., 2]\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    high = build_reward(configured("reward=external", "reward.source=my_reward:high"))
    assert high(torch.tensor([[1.0, 2.0, 3.0]])).tolist() == [3.0]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["reward.name=near"], "reward.name = near: expected one of external, inverse_range, nearest_to, of"),
        (["reward=nearest_to"], "reward.point = None"),
        (["reward=nearest_to", "reward.point=[1,2]"], r"reward.point = \[1, 2\]"),
        (["reward=nearest_to", "reward.point=[1,2,nan]"], r"reward.point = \[1, 2, nan\]"),
        (["reward=external"], "reward.source = None"),
        (["reward=external", "reward.source=torch:pi"], "reward.source = torch:pi: expected a function pi"),
    ],
)
def test_a_bad_reward_names_its_setting(overrides, message):
    with pytest.raises(SettingError, match=message):
        build_reward(configured(*overrides))


def test_search_seeks_a_point(tmp_path, capsys):
    """The best cell of a search for a point to the left lies to the left of that of one to the right."""
    best = []
    for side in (0.6, -0.6):
        command = [
            "search", "fidelity=geometric", "episodes=1", "saccades=8", "sensor.receptive_fields=1500",
            "memory.cells=600", "picture=false", "acquisition.alpha=0", "reward=nearest_to",
            f"reward.point=[1.5,{side},0]", f"hydra.run.dir={tmp_path}/{side}",
        ]  # fmt: skip
        assert main(command) == 0, capsys.readouterr().err
        with (tmp_path / str(side) / "saccades.csv").open() as file:
            best.append(float(list(csv.DictReader(file))[-1]["pan_rad"]))
    assert best[0] > 0.1 and best[1] < -0.1
