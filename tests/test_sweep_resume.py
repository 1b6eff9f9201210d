"""Sweeps that are killed and started again, results that are corrupt, and the table of it all."""

import csv
import json
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchfovea.cli import main
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.manifest import config_hash

TINY = [
    "fidelity=geometric", "episodes=1", "saccades=2", "sensor.receptive_fields=200", "memory.cells=60", "picture=false",
]  # fmt: skip
GRID = ["seed=0,1", "acquisition=ucb,pi,random", "sensor=log_polar,uniform"]


def sweep(folder: Path, *grid: str) -> list[str]:
    return ["search", "--multirun", *TINY, *(grid or GRID), f"hydra.sweep.dir={folder}"]


def table(folder: Path) -> list[dict]:
    """The sweep's table by `collect`, without what no two runs share."""
    out = folder.parent / f"{folder.name}_table"
    assert main(["collect", f"dir={folder}", f"hydra.run.dir={out}"]) == 0
    with (out / "collect.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert json.loads((out / "result.json").read_text())["rows"] == len(rows)
    return [{key: value for key, value in row.items() if key != "seconds_per_saccade"} for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sweeps") / "whole"
    assert main(sweep(folder)) == 0
    return folder


@pytest.mark.slow
def test_a_killed_sweep_resumes_to_the_same_table(whole, tmp_path, capsys):
    folder = tmp_path / "killed"
    process = subprocess.Popen(
        [sys.executable, "-m", "torchfovea", *sweep(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    enough, deadline = random.randint(1, 9), time.monotonic() + 240
    while process.poll() is None and time.monotonic() < deadline:
        if len(list(folder.rglob("result.json"))) >= enough:
            break
        time.sleep(0.02)
    process.kill()
    process.wait()
    done = {path: path.stat().st_mtime_ns for path in folder.rglob("result.json")}
    assert enough <= len(done) <= 12
    assert main(sweep(folder)) == 0
    assert {path: path.stat().st_mtime_ns for path in done} == done  # nothing complete was made again
    assert len(list(folder.rglob("result.json"))) == 12
    assert table(folder) == table(whole)
    shown = capsys.readouterr().out
    assert "acquisition" in shown and "gap_per_saccade" in shown and "collect.csv: 12 runs, " in shown


def test_no_worker_outlives_a_killed_command():
    # two that would work for minutes
    script = (
        "import os, time\n"
        "from torchfovea.commands.shared.parallel import spread\n"
        "def work(k):\n"
        "    time.sleep(600 if k > 1 else 0.5)\n"
        "    return os.getpid()\n"
        "done = spread(work, range(6), 2)\n"
        "print(next(done)[1], next(done)[1], flush=True)\n"
        "list(done)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as command:
        assert command.stdout is not None
        workers = {int(pid) for pid in command.stdout.readline().split()}
        command.kill()
    deadline = time.monotonic() + 60
    while workers and time.monotonic() < deadline:
        time.sleep(0.2)
        workers = {pid for pid in workers if Path(f"/proc/{pid}").exists() and _runs(pid)}
    assert not workers


def _runs(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"  # a zombie has ended


def test_the_sweep_of_fig_5_makes_only_what_is_missing(tmp_path):
    command = [
        "characterize", "experiment=fig5", "profile=quick", "sensor.receptive_fields=100", "distances=2",
        "vergences=2", "advantage_source_px=[200]", f"hydra.sweep.dir={tmp_path / 'fig5'}",
    ]  # fmt: skip
    assert main(command) == 0
    results = sorted((tmp_path / "fig5").rglob("result.json"))
    assert len(results) == 4  # two fields of view, two baselines
    results[0].unlink()
    kept = {path: path.stat().st_mtime_ns for path in results[1:]}
    assert main(command) == 0
    assert results[0].exists() and {path: path.stat().st_mtime_ns for path in kept} == kept


def test_other_settings_are_refused_and_nothing_is_overwritten(whole, capsys):
    ours = ("manifest.json", "result.json", "episodes.csv", "saccades.csv")
    before = {path: path.read_bytes() for path in whole.rglob("*") if path.name in ours}
    rows = table(whole)
    assert main([*sweep(whole), "saccades=3"]) == 1
    said = capsys.readouterr().err
    assert "job 0" in said and "job 11" in said and "made with other settings" in said
    assert {path: path.read_bytes() for path in before} == before
    assert table(whole) == rows


def test_one_bad_job_and_one_corrupt_file_leave_the_rest_alone(tmp_path, capsys):
    folder = tmp_path / "sweep"
    assert main(sweep(folder, "acquisition.alpha=0,-1,2")) == 1
    said = capsys.readouterr().err
    assert "job 1" in said and "acquisition.alpha = -1" in said and "job 2" not in said
    (folder / "0" / "result.json").write_text('{"gap_fin')
    rows = table(folder)
    said = " ".join(capsys.readouterr().err.split())
    assert [row["run"] for row in rows] == ["2"] and rows[0]["acquisition.alpha"] == "2"
    assert "collect: 0:" in said and "result.json" in said and "collect: 1: no result.json" in said
    assert main(sweep(folder, "acquisition.alpha=0,1,2")) == 1
    said = capsys.readouterr().err
    assert "result.json" in said and "remove it to run again" in said
    assert (folder / "0" / "result.json").read_text() == '{"gap_fin'
    assert json.loads((folder / "1" / "result.json").read_text())["episodes"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["dir=/nowhere/at/all"], "dir = /nowhere/at/all: expected a folder of runs"),
        ([], "dir"),
    ],
)
def test_collect_needs_a_folder_of_runs(arguments, message, tmp_path, capsys):
    assert main(["collect", *arguments, f"hydra.run.dir={tmp_path}/out"]) == 1
    assert message in capsys.readouterr().err


def test_an_unwritable_folder_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert main(sweep(tmp_path / "file" / "sweep", "seed=0")) != 0
    assert "file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("experiment", "choices", "plain"),
    [
        (
            "fig8",
            ["sensor=uniform", "sensor.fov_deg=90", "acquisition.alpha=inf"],
            ["fidelity=geometric", "episodes=20", "sensor.sample=8000", "memory.cells=2000"],
        ),
        (
            "fig9",
            ["memory=top", "acquisition.alpha=100"],
            ["fidelity=geometric", "episodes=20", "sensor.sample=8000", "memory.cells=2000", "sensor.fov_deg=135"],
        ),
    ],
)
def test_an_experiment_is_a_multirun_of_plain_overrides(experiment, choices, plain):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        by_name = compose("search", overrides=[f"experiment={experiment}", *choices])
        by_hand = compose("search", overrides=[*plain, *choices])
        whole = compose("search", overrides=[f"experiment={experiment}"], return_hydra_config=True)
    assert OmegaConf.to_container(by_name) == OmegaConf.to_container(by_hand)
    assert config_hash(by_name) == config_hash(by_hand)
    assert whole.hydra.mode.name == "MULTIRUN"
    assert {choice.partition("=")[0] for choice in choices} <= set(whole.hydra.sweeper.params)


def test_the_hash_minds_what_decides_the_figures_alone():
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        base, other, incidental = (
            config_hash(compose("search", overrides=list(o))) for o in ((), ("seed=1",), ("workers=2", "batch=1"))
        )
    assert base == incidental != other


def test_joblib_launcher_runs_a_sweep(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    assert main([*sweep(tmp_path / "sweep", "seed=0,1"), *launcher]) == 0
    assert len(list((tmp_path / "sweep").rglob("result.json"))) == 2
