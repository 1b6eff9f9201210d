"""The README's example runs as printed."""

import re
from pathlib import Path

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def test_the_example_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    assert "is nearest; in truth" in capsys.readouterr().out
    step, world = names["step"], names["world"]
    assert (step.points.mean[step.cell] - world.scene.nearest_point_e).norm() < 0.15


def test_every_command_is_named():
    from torchfovea.cli import COMMANDS

    assert set(re.findall(r"^\| `(\w+)` \|", README, re.MULTILINE)) == set(COMMANDS)
