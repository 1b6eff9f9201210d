"""docs/own.md's parts of a user's own, as they stand there: one file and one YAML each, outside of the package."""

import csv
import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch

from torchfovea.cli import main
from torchfovea.sensing.own_layout import check_retina
from torchfovea.sensing.retina import fovea, reconstruct

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "own.md").read_text(encoding="utf-8")
PARTS = {
    title: re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL)
    for title, text in re.findall(r"^### (.*?)\n(.*?)(?=^### |\Z)", PAGE, re.DOTALL | re.MULTILINE)
}
TINY = [
    "episodes=1", "saccades=3", "sensor.receptive_fields=1500", "sensor.source_px=150", "memory.cells=300",
    "picture=false", "budget=ours",
]  # fmt: skip


def written(title: str, folder: Path) -> list[str]:
    """Write a part's two files into a folder; its command's arguments."""
    (code, python), (config, yaml), (_, command) = PARTS[title]
    assert (code, config) == ("python", "yaml")
    for text in (python, yaml):
        path = folder / text.splitlines()[0].removeprefix("# ")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return shlex.split(command)[1:]


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """An empty folder of a user's, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if (tmp_path / f"{name}.py").exists():
            del sys.modules[name]


def test_the_page_has_the_five():
    assert list(PARTS) == ["A matcher", "A strategy", "A retina", "A scene", "A renderer"]


@pytest.mark.parametrize("title", list(PARTS))
def test_a_part_of_a_users_own_searches(title, mine, capsys):
    arguments = written(title, mine)
    assert len([path for path in mine.rglob("*") if path.is_file()]) == 2
    fidelity = "geometric" if title in ("A strategy", "A scene") else "photometric"
    assert main([*arguments, *TINY, f"fidelity={fidelity}", "hydra.run.dir=run"]) == 0, capsys.readouterr().err
    result = json.loads((mine / "run" / "result.json").read_text())
    assert 0 <= result["gap_per_saccade"] <= 1
    with (mine / "run" / "saccades.csv").open() as file:
        rows = list(csv.DictReader(file))
    # something was seen: the memory knows more than before it looked
    assert len(rows) == 3 and float(rows[-1]["global_information"]) > 0
    # and it is not run for whoever did not say so
    distrusted = [one for one in arguments if one != "trust=true"]
    assert main([*distrusted, *TINY, "hydra.run.dir=refused"]) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and "trust=true" in said[0] and "_target_" in said[0]


def test_a_part_by_its_function_alone(mine, capsys):
    for title in ("A strategy", "A renderer", "A retina"):
        written(title, mine)
    sources = [
        "acquisition=external", "acquisition.source=cautious:cautious", "renderer=external", "renderer.source=fog:fog",
        "sensor=external", "sensor.source=sunflower:Sunflower",
    ]  # fmt: skip
    small = [one for one in TINY if not one.startswith("sensor.receptive")]
    assert main(["search", *sources, *small, "hydra.run.dir=run"]) == 0, capsys.readouterr().err


def test_a_users_own_matcher_senses_a_rectified_pair_too(mine, capsys):
    """A real pair, 2 to 5 m away, by the same few lines."""
    pytest.importorskip("skimage.data")
    arguments = [one for one in written("A matcher", mine) if one != "search"]
    more = "pair=motorcycle", "matcher.nearest_m=1.5", "matcher.ranges=64"
    small = "sensor.receptive_fields=3000"
    assert main(["sense", *arguments, *more, small, "hydra.run.dir=run"]) == 0, capsys.readouterr().err
    result = json.loads((mine / "run" / "result.json").read_text())
    assert result["valid_fraction"] > 0.5 and result["median_error_m"] < 0.3
    assert (mine / "run" / "sense.png").exists()
    assert main(["sense", *arguments, *more, "sensor=every_pixel", "hydra.run.dir=none"]) == 1
    assert "sensor.layout = every_pixel" in capsys.readouterr().err


def test_workers_have_a_users_own_parts_too(mine, capsys):
    arguments = written("A renderer", mine)
    assert main([*arguments, *TINY, "episodes=2", "workers=2", "hydra.run.dir=run"]) == 0, capsys.readouterr().err
    assert main([*arguments, *TINY, "episodes=2", "hydra.run.dir=alone"]) == 0
    assert (mine / "run" / "saccades.csv").read_text() == (mine / "alone" / "saccades.csv").read_text()


def test_the_retinas_pictures_come_back(mine):
    """A smooth picture, seen by the sunflower and put together again over its triangles, is itself."""
    written("A retina", mine)
    from sunflower import Sunflower

    retina = check_retina(Sunflower(4000, rho_min_px=4.0))
    x = torch.linspace(-1, 1, 200)
    picture = (0.5 + 0.3 * torch.sin(3 * x) * torch.cos(2 * x[:, None]))[None, None]
    back, seen = reconstruct(fovea(picture, None, retina), retina, 200)
    assert not back[..., ~seen].any()
    # between the outermost centres the sunflower goes on as flat as it must
    within = x.square() + x.square()[:, None] < 0.9**2
    assert (back - picture)[..., within].abs().max() < 0.01


@pytest.mark.parametrize(
    ("title", "change", "message"),
    [
        ("A matcher", ("return tf.Correspondences(px", "return tf.Correspondences(px[:5]"), "matcher's left_px"),
        ("A matcher", (", valid), None", ", valid)"), "matcher = Correspondences"),
        ("A strategy", ("return view.mean", "return view.mean.sum() + 0 * view.std[..., :2] #"), "scores"),
        ("A retina", ("(k + 0.5) / self.count)", "(1 - k / self.count))"), "narrow ones first"),
        ("A retina", ("def inside", "def outside"), "sensor = Sunflower: expected a layout with count"),
        ("A scene", ("return scene_of", "return (0, scene_of"), "scene = tuple"),
        ("A renderer", ("return frame._replace(image=", "return (lambda image: image)("), "renderer = Tensor"),
    ],
)
def test_a_part_that_returns_the_wrong_thing_is_one_line(title, change, message, mine, capsys):
    arguments = written(title, mine)
    (code,) = [path for path in mine.glob("*.py")]
    text = code.read_text()
    assert change[0] in text
    text = text.replace(*change)
    code.write_text(text.replace("self, seed)\n", "self, seed))\n") if title == "A scene" else text)
    assert main([*arguments, *TINY, "hydra.run.dir=run"]) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and message in said[0], said
