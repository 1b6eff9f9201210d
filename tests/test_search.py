"""`torchfovea search` as a user runs it: its files, its figures, its errors."""

import csv
import json
from pathlib import Path

import pytest
import torch

from torchfovea.cli import main
from torchfovea.memory.store import load_memory

SMALL = ["episodes=1", "saccades=3", "sensor.receptive_fields=2000", "memory.cells=1500", "sensor.source_px=200"]
RESULT = {
    "gap_final",
    "gap_per_saccade",
    "regret_per_saccade",
    "global_information_per_saccade",
    "local_information_per_saccade",
    "saccades_to_target",
    "found",
    "target_error_m",
    "degrees_travelled",
    "seconds_per_saccade",
    "episodes",
}
SACCADES = (
    "episode,saccade,pan_rad,tilt_rad,vergence_rad,range_m,reward,gap,regret,global_information,local_information,"
    "aimed_m,phantom"
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return tmp_path


def search(capsys, *overrides):
    assert main(["search", *SMALL, *overrides]) == 0, capsys.readouterr().err
    run = Path(capsys.readouterr().out.splitlines()[-1])
    return run, json.loads((run / "result.json").read_text())


@pytest.mark.parametrize(
    "overrides",
    [
        ["fidelity=geometric", "episodes=2", "sensor=uniform"],
        ["fidelity=photometric"],
        ["fidelity=geometric", "motor=physics", "scene=cans", "scene.outside_first_view=true", "sensor.fov_deg=90"],
        ["fidelity=geometric", "reading=printed"],
        ["fidelity=geometric", "sensor.camera=fisheye", "sensor.fov_deg=150", "acquisition=ei", "memory=geodesic"],
    ],
    ids=["uniform", "photometric", "physics", "printed", "fisheye"],
)
def test_files_and_figures(folder, capsys, overrides):
    run, result = search(capsys, *overrides)
    assert result.keys() >= RESULT
    assert {"episode.png", "episodes.csv", "saccades.csv", "result.json"} <= {p.name for p in run.iterdir()}
    rows = list(csv.reader((run / "saccades.csv").read_text().splitlines()))
    assert ",".join(rows[0]) == SACCADES
    assert len(rows) == 1 + 3 * result["episodes"]
    assert [float(v) for v in rows[1][2:5]] == [0, 0, 0]  # t = 1 is the initial gaze
    gaps = [float(row[7]) for row in rows[1:]]
    assert all(0 <= g <= 1 for g in gaps)
    assert result["gap_per_saccade"] == pytest.approx(sum(gaps) / len(gaps), abs=1e-6)
    assert (run / "episode.png").stat().st_size > 10_000


def test_same_seed_same_run_and_explicit_settings_beat_the_profile(folder, capsys):
    overrides = ["fidelity=geometric", "profile=quick"]
    first, _ = search(capsys, *overrides)
    again, result = search(capsys, *overrides)
    other, _ = search(capsys, *overrides, "seed=1")
    assert (first / "saccades.csv").read_text() == (again / "saccades.csv").read_text()
    assert (first / "saccades.csv").read_text() != (other / "saccades.csv").read_text()
    assert result["episodes"] == 1  # the profile says more


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["scene=foo"], "scene = foo: expected one of attention_world, cans"),
        (["sensor=foo"], "sensor = foo: expected one of"),
        (["acquisition=foo"], "acquisition = foo: expected one of"),
        (["memory=foo"], "memory = foo: expected one of"),
        (["acquisition.alpha=-1"], "acquisition.alpha = -1"),
        (["acquisition.alpha=abc"], "acquisition.alpha = abc: expected a number"),
        (["memory.cells=0"], "memory.cells = 0: expected at least 1"),
        (["memory.cells=1.5"], "memory.cells = 1.5: expected a whole number"),
        (["sensor.fov_deg=180"], "sensor.fov_deg = 180"),
        (["sensor.receptive_fields=3"], "sensor.receptive_fields = 3"),
        (["saccades=0"], "saccades = 0"),
        (["episodes=-2"], "episodes = -2"),
        (["fidelity=perfect"], "fidelity = perfect: expected one of photometric, geometric"),
        (["motor=magic"], "motor = magic: expected one of external, instant, physics"),
        (["head.baseline_m=0"], "head.baseline_m = 0"),
        (["prior.std=0"], "prior.std = 0"),
        (["fusion.name=mean"], "fusion.name = mean"),
        (["matcher.block_px=4"], "matcher.block_px = 4"),
        (["far_m=0.1"], "far_m = 0.1"),
        (["memory.weights=[0]"], "weights = "),
        (["memory.means=[[-1,0,0]]", "memory.covariances=[[1e-4,1e-4,1e-4]]"], "reachable = "),
        (["scene=cans", "scene.cans=1"], "scene.cans = 1"),
        (["sensor.nothing=1"], "sensor.nothing = 1: expected a known setting"),
        (["seed=-1"], "seed = -1"),
        (["device=cudaa"], "device = cudaa: expected one of cpu, cuda"),
        (["picture=nan"], "picture = nan: expected true or false"),
        (["stop.probability=0.1", "stop.tolerance=text"], "stop.tolerance = text"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(folder, capsys, overrides, line):
    assert main(["search", *SMALL, "fidelity=geometric", *overrides]) != 0
    printed = capsys.readouterr()
    assert printed.err.startswith("torchfovea search: ") and len(printed.err.splitlines()) == 1, printed.err
    assert line in printed.err
    assert not list(folder.rglob("result.json")) and not list(folder.rglob("*.csv"))


def test_a_device_that_will_not_be_used_is_refused(folder, capsys, monkeypatch):
    """Photometric episodes and moving heads run on the CPU alone; also where a GPU is there."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    for overrides in (["fidelity=photometric"], ["fidelity=geometric", "motor=physics"]):
        assert main(["search", *SMALL, *overrides, "device=cuda"]) == 1
        assert "device = cuda: expected cpu, or fidelity=geometric motor=instant" in capsys.readouterr().err
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["search", *SMALL, "fidelity=geometric", "device=cuda"]) == 1
    assert "device = cuda: expected cpu, or cuda on a machine that has it" in capsys.readouterr().err


def test_encoder_noise_is_that_of_the_seed_whatever_the_batch(folder, capsys):
    common = ["fidelity=geometric", "episodes=3", "head.encoder_deg=0.5", "picture=false"]
    courses = []
    for batch in (1, 2, 3):
        run, _ = search(capsys, *common, f"batch={batch}")
        courses.append((run / "saccades.csv").read_text())
    assert courses[0] == courses[1] == courses[2]
    second, _ = search(capsys, *common, "episodes=1", "seed=1")
    rows = [line.partition(",")[2] for line in courses[0].splitlines() if line.startswith("1,")]
    assert rows == [line.partition(",")[2] for line in (second / "saccades.csv").read_text().splitlines()[1:]]


@pytest.mark.parametrize("more", [[], ["motor=physics"]], ids=["together", "one by one"])
def test_a_search_goes_on_from_a_saved_memory(folder, capsys, more):
    alike = ["fidelity=geometric", "picture=false", *more]
    search(capsys, *alike, "episodes=2", "memory.save=first.npz")
    search(capsys, *alike, "memory.load=first.npz", "memory.save=second.npz")
    first, second = (load_memory(name) for name in ("first.npz", "second.npz"))
    assert torch.equal(first.cells, second.cells) and int(first.looks.max()) == 3
    gained = second.looks - first.looks
    assert gained.min() == 0 and int(gained.max()) == 3  # three more saccades


def test_memories_that_do_not_fit_are_refused_before_the_work(folder, capsys):
    alike = ["fidelity=geometric", "picture=false"]
    search(capsys, *alike, "memory.save=patches.npz")
    for setting, message in (
        ("memory.load=none.npz", "memory.load = none.npz: expected a memory"),
        ("memory.load=3", "memory.load = 3: expected text or null"),
        ("memory.save=memory.pt", "memory.save = memory.pt: expected a name that ends in .npz"),
        ("memory.save=away/memory.npz", "memory.save = away/memory.npz: expected a name"),
        ("memory.load=patches.npz fusion=aligned prior=cartesian", "fusion.chart = cartesian: expected inverse_range"),
        ("memory.load=patches.npz prior.std=0.3", "the prior of the memory"),
    ):
        assert main(["search", *SMALL, *alike, *setting.split()]) != 0
        said = capsys.readouterr().err
        assert message in " ".join(said.split()), said
