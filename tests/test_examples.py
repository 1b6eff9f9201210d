"""The examples run as they stand, and say what they promise.

The live loop, the glimpses and the ROS 2 node have tests of their own.
"""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def gaps(said):
    """What each line of an example says of a policy."""
    return {name: float(gap) for name, gap in re.findall(r"^(.+): gap per saccade (\d\.\d+)", said, re.M)}


def test_a_policy_by_hand_beats_chance(capsys):
    runpy.run_path(str(EXAMPLES / "gymnasium_loop.py"))
    found = gaps(capsys.readouterr().out)
    assert found["by hand"] > found["chance"]


def test_a_strategy_of_ones_own_stands_beside_the_librarys(capsys):
    runpy.run_path(str(EXAMPLES / "own_strategy.py"))
    found = gaps(capsys.readouterr().out)
    assert found.keys() == {"mine", "UCB", "EI"} and min(found.values()) > 0.3


def test_a_sweep_ends_in_one_table_and_goes_on_where_it_was(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sweep.py", str(tmp_path)])
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(EXAMPLES / "sweep.py"))
        assert end.value.code == 0
    rows = re.findall(r"^([02]) (log_polar|uniform) 0\.\d\d$", capsys.readouterr().out, re.M)
    assert rows == 2 * [(alpha, sensor) for alpha in "02" for sensor in ("log_polar", "uniform")]


def test_the_notebook_runs_from_top_to_bottom(capsys, monkeypatch):
    import matplotlib.pyplot as plt

    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    notebook = json.loads((EXAMPLES / "first_look.ipynb").read_text(encoding="utf-8"))
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        assert not cell.get("outputs"), "outputs are not kept"
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    said = capsys.readouterr().out
    matched, fields, seen = map(int, re.findall(r"\d+", said.replace(",", ""))[:3])
    assert 0.5 * fields < matched <= fields and seen > 300
