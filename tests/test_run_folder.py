"""A run's folder is its own: of two writers one is refused, and a mistake leaves nothing in the way."""

import json
import threading

import pytest

from torchfovea.cli import main
from torchfovea.commands.shared.manifest import MANIFEST
from torchfovea.files import create_json

TINY = [
    "fidelity=geometric", "episodes=1", "saccades=2", "sensor.receptive_fields=400", "memory.cells=60", "picture=false",
]  # fmt: skip


def search(folder, *overrides):
    return main(["search", *TINY, f"hydra.run.dir={folder}", *overrides])


def content(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.suffix != ".log"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "run"
    assert search(folder) == 0
    return folder


def test_one_of_many_writers_makes_a_file(tmp_path):
    start, won = threading.Barrier(8), []

    def write(k):
        start.wait()
        if create_json(tmp_path / "it.json", {"by": k, "long": "x" * 100_000}):
            won.append(k)

    threads = [threading.Thread(target=write, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [json.loads((tmp_path / "it.json").read_text())["by"]] == won
    assert [path.name for path in tmp_path.iterdir()] == ["it.json"]


def test_of_two_runs_that_begin_together_one_is_refused(tmp_path, monkeypatch, capsys):
    """The other run makes its manifest after this one has seen none."""
    from torchfovea.commands.shared import manifest

    def other_first(path, content):
        create_json(path, {**content, "config_hash": "another's"})
        return create_json(path, content)

    monkeypatch.setattr(manifest, "create_json", other_first)
    assert search(tmp_path / "run") == 1
    assert "made with other settings (another's, now" in capsys.readouterr().err
    assert not (tmp_path / "run" / "result.json").exists()


@pytest.mark.parametrize(
    "command",
    [
        ["search", *TINY, "saccades=3"],
        ["search", *TINY, "episodes=0"],
        ["memory", "sensor.receptive_fields=400", "memory.cells=60"],
        ["doctor"],
    ],
    ids=["other settings", "a mistake", "memory", "doctor"],
)
def test_another_run_is_refused_and_touches_nothing(made, command, capsys):
    before = content(made)
    assert main([*command, f"hydra.run.dir={made}"]) == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and ("other settings" in said or "resumes" in said or "episodes" in said)
    assert content(made) == before


def test_the_same_settings_in_another_order_are_the_same_run(made, capsys):
    before = content(made)
    assert main(["search", *TINY[::-1], f"hydra.run.dir={made}"]) == 0
    assert content(made) == before


@pytest.mark.parametrize("result", ["{}", '{"gap_per_saccade": "abc"}', '{"gap_per_saccade": [1]}'])
def test_a_result_without_its_score_is_not_complete(made, tmp_path, result, capsys):
    assert search(tmp_path / "run") == 0
    (tmp_path / "run" / "result.json").write_text(result)
    assert search(tmp_path / "run") == 1
    assert "gap_per_saccade = " in capsys.readouterr().err


def test_a_table_that_was_emptied_or_removed_is_noticed(tmp_path, capsys):
    assert search(tmp_path / "run") == 0
    for spoil in (lambda p: p.write_text(""), lambda p: p.unlink()):
        spoil(tmp_path / "run" / "episodes.csv")
        assert search(tmp_path / "run") == 1
        assert "episodes.csv = 0 bytes: expected the " in capsys.readouterr().err
    (tmp_path / "run" / "result.json").unlink()
    assert search(tmp_path / "run") == 0
    assert (tmp_path / "run" / "episodes.csv").stat().st_size > 0


@pytest.mark.parametrize(
    "mistake",
    ["scene.room.height_m=nan", "scene.can_radius_m=nan", "scene.room.front_m=-1", "far_m=0.01"],
)
def test_a_mistake_does_not_stand_in_the_way_of_its_correction(tmp_path, mistake, capsys):
    assert search(tmp_path / "run", mistake) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "run" / MANIFEST).exists()
    assert search(tmp_path / "run") == 0


def test_a_mistake_in_a_sweep_does_not_either(tmp_path):
    grid = ["search", "--multirun", *TINY, "seed=0,1", f"hydra.sweep.dir={tmp_path}/sweep"]
    assert main([*grid, "scene.room.height_m=nan"]) == 1
    assert main(grid) == 0
