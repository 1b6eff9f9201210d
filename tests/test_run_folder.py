"""A run's folder is its own: of two writers one is refused, and a mistake leaves nothing in the way."""

import json
import shutil
import threading

import pytest

from torchfovea.cli import main
from torchfovea.commands.shared.manifest import MANIFEST, read_kept, write_kept
from torchfovea.files import create_json
from torchfovea.setting import SettingError

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


def test_the_settings_that_are_others_are_told(made, capsys):
    assert main(["search", *TINY, "saccades=3", "seed=7", "workers=2", f"hydra.run.dir={made}"]) == 1
    said = capsys.readouterr().err
    assert "seed = 0, now 7" in said and "saccades = " in said and ", now 3" in said and "workers" not in said


def test_a_complete_run_says_that_it_is_complete(made, capsys):
    assert main(["search", *TINY, f"hydra.run.dir={made}"]) == 0
    assert capsys.readouterr().out.startswith(f"complete since before, nothing is run again: {made / 'result.json'}\n")


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
        assert "episodes.csv = " in capsys.readouterr().err
    (tmp_path / "run" / "result.json").unlink()
    assert search(tmp_path / "run") == 0
    assert (tmp_path / "run" / "episodes.csv").stat().st_size > 0


@pytest.mark.parametrize("name", ["result.json", "episodes.csv", "saccades.csv"])
def test_a_digit_that_was_changed_is_noticed(made, tmp_path, name, capsys):
    """By the run that is started again, and by the table of a sweep; the size of the file is what it was."""
    spoilt = tmp_path / "runs" / "0" / name
    shutil.copytree(made, spoilt.parent)
    text = list(spoilt.read_text())
    last = max(k for k, letter in enumerate(text) if letter.isdigit())
    text[last] = str((int(text[last]) + 1) % 10)
    spoilt.write_text("".join(text))
    assert search(spoilt.parent) == 1
    assert f"{name} = changed: expected what was written; remove " in capsys.readouterr().err
    assert main(["collect", f"dir={spoilt.parents[1]}", f"hydra.run.dir={tmp_path / 'table'}"]) == 1
    assert f"{name} = changed" in " ".join(capsys.readouterr().err.split())
    (spoilt.parent / "result.json").unlink()
    assert search(spoilt.parent) == 0 == search(spoilt.parent)


def test_a_part_that_was_kept_is_read_whole_or_not_at_all(tmp_path):
    path, content = tmp_path / "part.json", [{"gap": 0.1 + 0.2, "none": float("nan"), "name": "µ"}]
    write_kept(path, content)
    assert read_kept(path) == [{"gap": 0.1 + 0.2, "none": None, "name": "µ"}]
    text = path.read_text()
    spoilt = text.replace("0.30000000000000004", "0.30000000000000016"), text[:-9], "[]", '{"content": 1}', ""
    for k in spoilt:
        path.write_text(k)
        with pytest.raises(SettingError, match=r"part.json = corrupt: expected .* remove it to make it again"):
            read_kept(path)


@pytest.mark.parametrize(
    "mistake",
    ["scene.room.height_m=nan", "scene.can_radius_m=nan", "scene.room.front_m=-1", "far_m=0.01"],
)
def test_a_mistake_does_not_stand_in_the_way_of_its_correction(tmp_path, mistake, capsys):
    assert search(tmp_path / "run", mistake) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "run" / MANIFEST).exists()
    assert search(tmp_path / "run") == 0


def test_a_mistake_does_not_remove_the_folder_that_one_stands_in(tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert search(".", "saccades=0") == 1
    assert (tmp_path / "empty").is_dir() and not list((tmp_path / "empty").iterdir())
    assert search(tmp_path / "other", "saccades=0") == 1
    assert not (tmp_path / "other").exists()


def test_a_mistake_in_a_sweep_does_not_either(tmp_path):
    grid = ["search", "--multirun", *TINY, "seed=0,1", f"hydra.sweep.dir={tmp_path}/sweep"]
    assert main([*grid, "scene.room.height_m=nan"]) == 1
    assert main(grid) == 0
