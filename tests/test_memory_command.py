"""`torchfovea memory` as a user runs it: every bias of conf/memory, the studies, the errors."""

import csv
import json
from pathlib import Path

import pytest
import torch

from torchfovea.cli import main
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.judge import judge_cells
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.store import load_memory
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World

BIASES = sorted(path.stem for path in (Path(conf_dir()) / "memory").glob("*.yaml"))
SMALL = ["episodes=1", "sensor.receptive_fields=1500", "memory.cells=300", "scene=cans"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return tmp_path


def memory(capsys, *overrides):
    assert main(["memory", *overrides]) == 0, capsys.readouterr().err
    run = Path(capsys.readouterr().out.splitlines()[-1])
    return run, json.loads((run / "result.json").read_text())


@pytest.mark.parametrize("bias", BIASES)
def test_every_bias_is_drawn(folder, capsys, bias):
    run, result = memory(capsys, f"memory={bias}", "memory.cells=500")
    assert abs(result["cells"] - 500) < 60  # regular topologies come in steps
    assert 0 <= result["cells_near_target"] <= result["cells"]
    assert (run / "memory.png").read_bytes().startswith(b"\x89PNG")


def test_a_bias_toward_the_target_puts_cells_there(folder, capsys):
    near = [memory(capsys, f"memory={name}", "memory.cells=1000")[1]["cells_near_target"] for name in ("target", "top")]
    assert near[0] > 3 * near[1]


def test_honesty_is_judged_by_sensor_size_and_look(folder, capsys):
    more = ["sensor.source_px=96", "sensor.fov_deg=90", "honesty.cells=[200,400]", "honesty.looks=[2,1]"]
    run, result = memory(capsys, *SMALL, "study=honesty", "episodes=2", *more)
    assert len((run / "honesty.csv").read_text().splitlines()) == 1 + 3 * 2 * 2
    for sensor in ("sgbm", "sweep", "geometric"):
        for looks in (1, 2):
            figures = {k.split(".")[-1]: v for k, v in result.items() if k.startswith(f"{sensor}.400.{looks}.")}
            assert figures["coverage_95_low"] <= figures["coverage_95"] <= figures["coverage_95_high"]
            assert 0 <= figures["coverage_50"] <= figures["coverage_95"] <= 1
            assert 0 < figures["median_error"] <= figures["mean_error"]
            assert 0.5 < figures["believed"] <= 1 and 0 < figures["straddling"] < 1
    # the geometric sensor draws its noise from its budget
    assert 0.7 < result["geometric.400.1.nees_mean"] < 1.4 and result["geometric.400.1.outlier_share"] < 0.05


@pytest.mark.parametrize(
    ("setting", "named"),
    [("honesty.sensors=[sgbm,eyes]", "honesty.sensors"), ("honesty.cells=[]", "honesty.cells"),
     ("honesty.looks=[0]", "honesty.looks"), ("honesty.looks=5", "honesty.looks")],
)  # fmt: skip
def test_honesty_names_what_it_cannot_judge(folder, capsys, setting, named):
    assert main(["memory", "study=honesty", setting]) != 0
    assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    ("study", "more", "rows"),
    [
        ("fusion", ["saccades=2"], 10),
        ("encoders", ["saccades=2"], 8),
        ("moving", ["saccades=2"], 6),
        ("resampling", ["saccades=6"], 3),
    ],
)
def test_studies(folder, capsys, study, more, rows):
    run, result = memory(capsys, *SMALL, f"study={study}", *more)
    table = list(csv.reader((run / f"{study}.csv").read_text().splitlines()))
    assert len(table) == 1 + rows
    assert all("." in key for key in result) and len(result) >= rows


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("study=all", "study = all: expected one of fusion, encoders, moving, resampling"),
        ("memory.cells=0", "memory.cells = 0: expected at least 1"),
        ("memory.weights=[-1.0]", "weights"),
        ("memory.covariances=[[-1.0,1.0,1.0]]", "covariances[0]"),
        ("near_target_m=-1", "near_target_m = -1"),
        ("head.encoder_deg=-1", "head.encoder_deg = -1"),
        ("prior.slope_std=0", "prior.slope_std = 0"),
    ],
)
def test_mistakes_get_one_line(folder, capsys, override, message):
    assert main(["memory", override]) == 1
    error = capsys.readouterr().err.strip()
    assert message in error and len(error.splitlines()) == 1


def test_cells_straddle_edges_and_nothing_else():
    """In an empty corner of planes only the seams straddle; a can's outline does."""
    world = World(build_scene(Cans(), 0))
    cells = fibonacci_directions(4000, torch.float64)
    judge = judge_cells(world, cells)
    hits = world.panorama(cells)
    assert 0.02 < judge.straddles.double().mean() < 0.5
    torch.testing.assert_close(judge.rho, 1 / hits.range_m)
    down = (cells[:, 2] < -0.9) & (hits.normal[:, 2] > 0.999)
    assert judge.straddles[down].double().mean() < 0.05


def test_cells_that_were_drawn_can_be_searched_with_and_drawn_again(folder, capsys):
    _, result = memory(capsys, "memory=top", "memory.cells=200", "memory.save=cells.npz")
    saved = load_memory("cells.npz")
    assert len(saved.cells) == result["cells"] and int(saved.looks.sum()) == 0
    assert memory(capsys, "memory.load=cells.npz")[1] == pytest.approx(result, rel=1e-4)
    small = ["fidelity=geometric", "saccades=2", "sensor.receptive_fields=400", "picture=false", "episodes=1"]
    assert main(["search", *small, "memory.load=cells.npz", "memory.save=known.npz"]) == 0, capsys.readouterr().err
    assert torch.equal(load_memory("known.npz").cells, saved.cells) and int(load_memory("known.npz").looks.max()) == 2
    capsys.readouterr()
    assert main(["memory", "study=fusion", "memory.load=cells.npz"]) != 0
    assert "memory.load = cells.npz: expected null with a study" in " ".join(capsys.readouterr().err.split())
