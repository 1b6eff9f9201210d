"""Work in processes of joblib's: all of it comes back, errors as they are; commands are the same with more of them."""

import importlib.util
import os

import pytest

from torchfovea.cli import main
from torchfovea.commands.shared.parallel import spread
from torchfovea.setting import SettingError

SENSORS = ("log_polar", "uniform")
SMALL = ["episodes=3", "saccades=2", "sensor.receptive_fields=400", "memory.cells=100", "sensor.source_px=100"]


def square(k: int) -> tuple[int, int]:
    if k == 3:
        raise ValueError("three")
    return k * k, os.getpid()


@pytest.mark.parametrize(("workers", "backend"), [(1, "loky"), (2, "loky"), (2, "threading")])
def test_every_result_and_error_comes_back(workers, backend):
    found = dict(spread(square, range(6), workers, backend))
    assert isinstance(found[3], ValueError) and str(found.pop(3)) == "three"
    assert {k: value for k, (value, _) in found.items()} == {0: 0, 1: 1, 2: 4, 4: 16, 5: 25}
    here = {process == os.getpid() for _, process in found.values()}
    assert here == {(workers, backend) != (2, "loky")}


def test_work_that_is_left_ends():
    work = spread(square, range(100), 2)
    next(work)
    work.close()
    assert len(list(spread(square, range(4), 2))) == 4


def test_processes_find_what_the_command_finds_there(tmp_path, monkeypatch):
    """Also where joblib has kept processes of a command from elsewhere."""
    assert len(list(spread(square, range(4), 2))) == 4
    (tmp_path / "module_of_the_day.py").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert dict(spread(_place, range(2), 2)) == {0: (str(tmp_path), True), 1: (str(tmp_path), True)}


def _place(k: int) -> tuple[str, bool]:
    return os.getcwd(), importlib.util.find_spec("module_of_the_day") is not None


def test_a_backend_that_is_not_there():
    with pytest.raises(SettingError, match="backend = nonsense: expected loky"):
        list(spread(square, range(4), 2, "nonsense"))


def test_a_worker_that_is_killed():
    with pytest.raises(SettingError, match="workers = 2: expected processes that live"):
        list(spread(_die, range(4), 2))


def _die(k: int) -> None:
    os.kill(os.getpid(), 9)


def test_search_is_the_same_with_workers(tmp_path, capsys):
    for workers in (1, 2):
        command = ["search", *SMALL, f"workers={workers}", f"hydra.run.dir={tmp_path / str(workers)}"]
        assert main(command) == 0, capsys.readouterr().err
    alone, together = ((tmp_path / str(n) / "saccades.csv").read_text() for n in (1, 2))
    assert alone == together
    assert (tmp_path / "2" / "episode.png").exists()
    assert main(["search", *SMALL, "workers=2", "backend=gone", f"hydra.run.dir={tmp_path / 'gone'}"]) == 1
    assert "backend = gone" in capsys.readouterr().err


def test_reproduce_takes_workers_and_a_users_own_configuration(tmp_path, capsys):
    """The workers find what lies in a folder of the user's."""
    own = tmp_path / "own" / "head"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("baseline_m: 0.1\n")
    command = [
        "reproduce", "--config-dir", str(own.parent), "profile=quick", "episodes=2", "saccades=2", "workers=2",
        "memory.cells=120", "sensor.receptive_fields=300", "fig8.fov_deg=[135]", "fig8.alphas.few=[0,100]",
        "fig8.others=[pi]", "fig9.biases=[unbiased]", "fig9.alphas=[100]", "fig5.distances_m=[0.2]",
        "fig5.vergences=5", 'overrides=["head=mine"]', f"hydra.run.dir={tmp_path / 'run'}",
    ]  # fmt: skip
    assert main(command) == 0, capsys.readouterr().err
    assert len(list((tmp_path / "run" / "cells").iterdir())) == len(SENSORS) * 2 + 1
