"""`torchfovea replay`: what a search recorded, and what is kept of a recording that cannot be read to its end."""

import csv
import json
import re
import shutil

import cv2
import numpy as np
import pytest
import torch

from torchfovea.cli import main
from torchfovea.memory.store import load_memory
from torchfovea.recordings.folder import Recorder
from torchfovea.recordings.frames import Calibration
from torchfovea.sensing.head import Gaze, Head, eyes, fixate
from torchfovea.sensing.lens import BrownConrady
from torchfovea.sim.rays import cast, render
from torchfovea.sim.scene import AttentionWorld, build_scene

COMMON = ["sensor.receptive_fields=500", "memory.cells=400", "seed=2", "budget=ours"]


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A recorded search of four saccades."""
    folder = tmp_path_factory.mktemp("search")
    more = ["record=true", "episodes=1", "saccades=4", "scene=cans", "sensor.source_px=96", "picture=false"]
    save = f"memory.save={folder / 'end.npz'}"
    assert main(["search", *COMMON, *more, save, f"hydra.run.dir={folder / 'run'}"]) == 0
    return folder


@pytest.fixture
def recording(searched, tmp_path):
    """A copy of its recording, to be spoilt."""
    return shutil.copytree(searched / "run" / "recording", tmp_path / "recording")


def replay(folder, recording, *more):
    return main(["replay", *COMMON, f"recording={recording}", f"hydra.run.dir={folder}", *more])


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def same_memory(one, other):
    one, other = load_memory(one), load_memory(other)
    for a, b in zip((*one.information, one.looks), (*other.information, other.looks), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_replay_is_the_search_again(searched, tmp_path, capsys):
    assert replay(tmp_path, searched / "run" / "recording") == 0
    same_memory(searched / "end.npz", tmp_path / "memory.npz")
    course, told = rows(searched / "run" / "saccades.csv"), rows(tmp_path / "fixations.csv")
    assert len(course) == len(told) == 4
    for now, after, proposed in zip(course, course[1:], told, strict=False):
        for name in ("pan_rad", "tilt_rad", "vergence_rad"):
            assert float(proposed[name]) == pytest.approx(float(now[name]), abs=1e-6)
            assert float(proposed[f"next_{name}"]) == pytest.approx(float(after[name]), abs=1e-5)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["frames"] == result["frames_with_images"] == 4 and result["stopped"] is None
    assert (tmp_path / "replay.png").stat().st_size > 10_000
    cloud = np.load(tmp_path / "points.npz")
    assert len(cloud["mean_m"]) == result["cells_seen"] > 100
    assert str(cloud["cov_order"]).startswith("xx xy xz") and "x forward" in str(cloud["frame"])
    coloured = (np.abs(cloud["colour"] - 0.5) > 1e-6).any(-1)
    assert coloured.mean() > 0.95
    assert (tmp_path / "points.ply").read_bytes().startswith(b"ply\n")


def test_a_session_goes_on_from_the_memory_of_another(searched, tmp_path):
    recording = searched / "run" / "recording"
    assert replay(tmp_path / "a", recording, "picture=false") == 0
    assert replay(tmp_path / "b", recording, "picture=false", f"memory.load={tmp_path / 'a' / 'memory.npz'}") == 0
    first, second = (load_memory(tmp_path / name / "memory.npz") for name in "ab")
    assert int(second.looks.sum()) > int(first.looks.sum())


@pytest.mark.parametrize("skip", [False, True])
def test_what_was_read_is_kept(recording, tmp_path, capsys, skip):
    (recording / "right" / "000002.png").unlink()
    status = replay(tmp_path / "run", recording, "picture=false", f"skip={str(skip).lower()}")
    said = capsys.readouterr().err.splitlines()
    line = next(line for line in said if "frame 2" in line)
    assert "000002.png: expected an image, but there is no such file" in line
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert (status, result["frames"]) == ((0, 4) if skip else (1, 2))
    assert result["frames_passed_over"] == int(skip) and result["frames_with_images"] == (3 if skip else 2)
    assert load_memory(tmp_path / "run" / "memory.npz").looks.max() >= 1
    assert len(said) == 1


@pytest.mark.parametrize(
    ("spoil", "more", "line"),
    [
        (lambda path: (path / "left" / "000000.png").unlink(), [], "frame 0: frame = .*no such file"),
        (lambda path: (path / "frames.csv").unlink(), [], "recording = .*: expected a folder with frames.csv"),
        (lambda path: shutil.rmtree(path), [], "recording = .*but there is nothing"),
        (lambda path: None, ["bag.left=/x"], "bag.left = /x: expected no such setting"),
        (lambda path: None, ["sensor.fov_deg=90"], "sensor.fov_deg = 90: expected no such setting"),
        (lambda path: None, ["skip=3"], "skip = 3: expected true or false"),
        (
            lambda path: None,
            ["acquisition=oracle"],
            "acquisition = oracle: expected one that does not ask where the target is",
        ),
    ],
    ids=["first", "table", "nothing", "bag", "fov", "skip", "an oracle"],
)
def test_a_mistake_is_one_line_and_leaves_nothing(recording, tmp_path, capsys, spoil, more, line):
    spoil(recording)
    assert replay(tmp_path / "run", recording, *more) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert re.search(line, said[0])
    assert not (tmp_path / "run").exists()


def test_a_recording_without_a_head_asks_for_it(recording, tmp_path, capsys):
    path = recording / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "head": None}))
    assert replay(tmp_path / "run", recording) == 1
    assert "head = None: expected vizzy, human" in capsys.readouterr().err
    assert replay(tmp_path / "run", recording, "head=vizzy", "picture=false") == 0


def test_only_images_are_recorded(tmp_path, capsys):
    assert main(["search", "record=true", "fidelity=geometric", f"hydra.run.dir={tmp_path / 'run'}"]) == 1
    assert "record = True: expected images, fidelity=photometric" in capsys.readouterr().err


@pytest.fixture(scope="module")
def unequal(tmp_path_factory):
    """A recording by two lenses that differ, whose calibration is OpenCV's file alone."""
    folder, head = tmp_path_factory.mktemp("unequal"), Head()
    left = BrownConrady(100.0, 100.0, 80.0, 78.0, (-0.1, 0.02, 0, 0, 0))
    right = BrownConrady(112.0, 110.0, 77.0, 83.0, (-0.16, 0.03, 0.001, 0, 0))
    room = build_scene(AttentionWorld(), 0, head)
    writer = Recorder(folder / "recording", Calibration(left, right, (160, 160)))
    points = torch.tensor([[1.5, 0.3, -0.3], [1.5, 0.1, -0.2]], dtype=torch.float64)
    for k, gaze in enumerate(zip(*fixate(head, points)[0], strict=True)):
        pose = eyes(head, Gaze(*gaze))
        turned = ((pose.R_left, pose.t_left, left), (pose.R_right, pose.t_right, right))
        writer.write(k, *(render(room, R, t, camera, 160).image for R, t, camera in turned), Gaze(*gaze))
    (folder / "recording" / "calibration.json").unlink()
    file = cv2.FileStorage(str(folder / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    for name, lens in (("1", left), ("2", right)):
        matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
        file.write(f"M{name}", matrix)
        file.write(f"D{name}", np.array(lens.distortion))
    file.write("R", np.eye(3))
    file.write("T", np.array([-head.baseline_m, 0, 0]))
    file.release()
    return folder, room


@pytest.mark.parametrize("matcher", ["sgbm", "sweep"])
def test_eyes_that_differ_by_a_calibrations_file(unequal, tmp_path, matcher):
    """The memory's points are where the room's surfaces are."""
    folder, room = unequal
    more = ["sensor.receptive_fields=3000", "memory.cells=3000", "head=vizzy", f"matcher={matcher}", "picture=false"]
    assert replay(tmp_path, folder / "recording", *more, f"calibration={folder / 'stereo.yml'}") == 0
    with np.load(tmp_path / "points.npz") as cloud:
        points, cov = (torch.from_numpy(cloud[name]).double() for name in ("mean_m", "cov_m2"))
    range_m = points.norm(dim=-1)
    ray = points / range_m[:, None]
    off = range_m - cast(room, torch.zeros(3, dtype=torch.float64), ray).range_m
    x, y, z = ray.unbind(-1)  # the covariance's order: xx xy xz yy yz zz
    sigma = (cov * torch.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z], -1)).sum(-1).sqrt()
    assert len(points) > 1000 and (off / range_m).abs().median() < 0.08 and (off / sigma).abs().median() < 0.8


def test_a_folder_without_a_calibration_says_so(unequal, tmp_path, capsys):
    folder = unequal[0] / "recording"
    assert replay(tmp_path, folder, "head=vizzy") == 1
    assert "calibration.json: expected a recording's calibration.json" in capsys.readouterr().err
    assert replay(tmp_path, folder, "head=vizzy", "calibration_lens=brown_conrady") == 1
    assert "calibration_lens = brown_conrady: expected no such setting" in capsys.readouterr().err
