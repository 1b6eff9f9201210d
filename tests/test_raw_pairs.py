"""Raw pairs of the simulated room, with lenses, askew and verging, by a chessboard's calibration: as the ideal pair."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_views import turned

from torchfovea.cli import main
from torchfovea.commands.sense.points import sense
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Head
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.lens import BrownConrady
from torchfovea.sim.rays import cast, render
from torchfovea.sim.scene import AttentionWorld, build_scene
from torchfovea.stereo.calibration_files import load_calibration
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.rig import posed
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep
from torchfovea.stereo.views import posed_views

SIZE, RETINA = 260, LogPolar(3000)
AHEAD = torch.tensor([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)  # the axes of a camera in E
HERE = torch.zeros(3, dtype=torch.float64)
LEFT = BrownConrady(198.0, 195.0, 133.5, 126.0, (-0.28, 0.08, 0.0012, -0.0001, -0.01))
RIGHT = BrownConrady(192.0, 195.0, 127.0, 134.5, (-0.3, 0.1, -0.0005, 0.0001, -0.015))
PLAIN = Pinhole(195.0, 129.5, 129.5)
ACROSS = torch.tensor([0.12, 0.002, -0.003], dtype=torch.float64)
# pan, tilt and roll of the left eye in the room, and of the right eye in the left one
RIGS = {"unrectified": (0.0, (-0.015, 0.01, 0.02)), "verging": (0.05, (-0.1, 0.01, 0.02))}


@pytest.fixture(scope="module")
def room():
    return build_scene(AttentionWorld(), 0, Head())


def seen_by(room, left, right, own, rotation, shift):
    pair = ((left, own, HERE), (right, own @ rotation, own @ shift))
    return [render(room, turn, origin, camera, SIZE).image for camera, turn, origin in pair]


def by_chessboard(path, rotation, shift):
    """OpenCV's stereo calibration from 25 boards whose corners are known to a tenth of a pixel."""
    rng, boards = np.random.default_rng(0), [[], [], []]
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2) * 0.04
    while len(boards[0]) < 25:
        turn, place = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0], rng.uniform([-0.25, -0.25, 0.3], [0.15, 0.15, 0.7])
        points = torch.from_numpy(board @ turn.T + place)
        views = [lens.project(p).numpy() for lens, p in ((LEFT, points), (RIGHT, (points - shift) @ rotation))]
        if all((v > 3).all() and (v < SIZE - 4).all() for v in views):
            noisy = [(v + rng.normal(0, 0.1, v.shape)).astype(np.float32) for v in views]
            for there, value in zip(boards, (board, *noisy), strict=True):
                there.append(value)
    one, two = (cv2.calibrateCamera(boards[0], corners, (SIZE, SIZE), None, None)[1:3] for corners in boards[1:])
    found = cv2.stereoCalibrate(*boards, *one, *two, (SIZE, SIZE), flags=cv2.CALIB_FIX_INTRINSIC)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(("M1", "D1", "M2", "D2", "R", "T"), found[1:7], strict=True):
        storage.write(name, value)
    storage.release()
    return path


def truth(room, own, lens, views, px):
    """Inverse range along each left field's true ray, and whether the right eye at `ACROSS` has it in sight."""
    scale = 1 / views.scale(RETINA)
    camera = lens.scaled(scale, tuple(-scale * g for g in views.gaze_px))
    way = torch.nn.functional.normalize(camera.rays(px.double()), dim=-1) @ own.T
    hits = cast(room, HERE, way)
    line = hits.range_m[:, None] * way - own @ ACROSS
    free = cast(room, own @ ACROSS, line).range_m > line.norm(dim=-1) * (1 - 1e-4)
    return 1 / hits.range_m, free & (hits.geom >= 0)


def judged(room, images, cameras, rig, own, lens, params):
    """With the fovea on the left eye's true axis: most fields are there, and shall see the same things."""
    views = posed_views(*images, *cameras, rig, (lens.cx_px, lens.cy_px))
    sensed = sense(views, RETINA, Matcher(params, 0.4)(views, RETINA, Budget())[0], None, True)
    true, seen = truth(room, own, lens, views, sensed.matches.left_px)
    valid = sensed.observed.valid
    z = ((sensed.observed.mean[:, 2] - true) / sensed.observed.cov[:, 5].sqrt())[valid & seen].abs()
    return ((valid & seen).sum() / seen.sum()).item(), z


@pytest.mark.parametrize("name", RIGS)
def test_as_the_ideal_pair(room, tmp_path, name):
    """The same share of points, honest alike: through the true lenses, and through those that a chessboard told."""
    pan, angles = RIGS[name]
    own, rotation = AHEAD @ turned(pan, 0, 0), turned(*angles)
    ideal = seen_by(room, PLAIN, PLAIN, AHEAD, torch.eye(3, dtype=torch.float64), ACROSS)
    raw = seen_by(room, LEFT, RIGHT, own, rotation, ACROSS)
    told = load_calibration([by_chessboard(tmp_path / "stereo.yml", rotation, ACROSS)], (SIZE, SIZE))
    assert abs(told.rig.baseline_m - ACROSS.norm()) < 1e-3
    straight = posed(torch.eye(3, dtype=torch.float64), ACROSS)
    for params in (SGBM(), Sweep()):
        share, z = judged(room, ideal, (PLAIN, PLAIN), straight, AHEAD, PLAIN, params)
        for cameras, rig in (((LEFT, RIGHT), posed(rotation, ACROSS)), (told[:2], told.rig)):
            found, score = judged(room, raw, cameras, rig, own, LEFT, params)
            assert found > share - 0.03 and score.median() < 0.5
            for level, slack in ((0.674, 0.1), (1.96, 0.04)):
                assert (score < level).double().mean() > (z < level).double().mean() - slack


@pytest.fixture(scope="module")
def stored(room, tmp_path_factory):
    """The verging pair's files."""
    folder, (pan, angles) = tmp_path_factory.mktemp("pair"), RIGS["verging"]
    images = seen_by(room, LEFT, RIGHT, AHEAD @ turned(pan, 0, 0), turned(*angles), ACROSS)
    for side, image in zip(("left", "right"), images, strict=True):
        cv2.imwrite(
            str(folder / f"{side}.png"), np.rint(255 * image.movedim(0, -1).numpy()[..., ::-1]).astype(np.uint8)
        )
    by_chessboard(folder / "stereo.yml", turned(*angles), ACROSS)
    np.save(folder / "truth.npy", np.ones((SIZE, SIZE), np.float32))
    return folder


@pytest.fixture
def files(stored, monkeypatch):
    monkeypatch.chdir(stored)
    return ["left=left.png", "right=right.png", "calibration=stereo.yml"]


def test_the_command_senses_a_raw_pair(room, files, capsys):
    assert main(["sense", *files, "matcher=sgbm", "sensor.receptive_fields=3000"]) == 0
    told = capsys.readouterr()
    run = Path(told.out.splitlines()[-1])
    result = json.loads((run / "result.json").read_text())
    with np.load(run / "points.npz") as points:
        seen = {k: torch.from_numpy(points[k]).double() for k in ("mean_m", "direction", "inverse_range")}
    assert result["valid_fraction"] > 0.9 and len(seen["mean_m"]) == result["points"] > 1000
    # in the left camera's frame, whatever the lens
    own = AHEAD @ turned(RIGS["verging"][0], 0, 0)
    # the right retina looks at what the left one looks at
    way = torch.nn.functional.normalize(LEFT.rays(torch.full((1, 2), (SIZE - 1) / 2, dtype=torch.float64)), dim=-1)
    point = way * cast(room, HERE, way @ own.T).range_m[:, None]
    there = RIGHT.project((point - ACROSS) @ turned(*RIGS["verging"][1]))[0]
    assert torch.tensor(result["gaze_right_px"]) == pytest.approx(there, abs=2)
    assert "the right retina looks at [{:.0f}, {:.0f}]".format(*result["gaze_right_px"]) in told.err
    hits = cast(room, HERE, seen["direction"] @ own.T)
    assert (seen["inverse_range"] - 1 / hits.range_m).abs().median() < 0.015  # most of it the chessboard's
    assert (run / "sense.png").exists() and (run / "points.ply").exists()


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["focal_px=195"], "focal_px = 195: expected null: calibration = stereo.yml tells it"),
        (["doffs_px=3"], "doffs_px = 3: expected 0"),
        (["disparity=truth.npy"], "disparity = truth.npy: expected null for raw images"),
        (["calibration=gone.yml"], "calibration = gone.yml: expected an existing file"),
        (["calibration=null", "calibration_right=stereo.yml"], "calibration_right = stereo.yml: expected null"),
        (["calibration_images=both"], "calibration_images = both: expected one of auto, raw, rectified"),
        (["calibration_lens=thin"], "calibration_lens = thin: expected one of brown_conrady"),
        (["calibration_cameras=[1]"], r"calibration_cameras = [1]: expected [left, right]"),
        (["calibration_unit_m=0"], "calibration_unit_m = 0: expected metres"),
        (["gaze_right_px=left"], "gaze_right_px = left: expected [column, row], a pixel of the 260x260 images, or"),
        (["gaze_right_px=[1,900]"], "gaze_right_px = [1, 900]: expected [column, row]"),
        (["calibration=3"], "calibration = 3: expected text or null"),
        (["left=right.png", "right=left.png", "calibration_unit_m=-1"], "calibration_unit_m = -1"),
        (["sensor=every_pixel", "matcher=sgbm"], "sensor.layout = every_pixel: expected a retina"),
    ],
)
def test_errors_are_one_line(files, capsys, overrides, line):
    assert main(["sense", *files, *overrides]) == 1
    error = capsys.readouterr().err.strip()
    assert line in error and "\n" not in error
