"""Recordings: what is kept of a search, that it plays again as it was, and what is refused."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchfovea.memory.moving import motion
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, new_memory
from torchfovea.recordings.folder import COLUMNS, Folder, Recorder
from torchfovea.recordings.frames import Calibration, gaze_from_angles, read_calibration, write_calibration
from torchfovea.recordings.pictures import as_kept, read_picture, write_picture
from torchfovea.recordings.playback import Playback, observer_of
from torchfovea.recordings.poses import matrix_from_quaternion, quaternion_from_matrix
from torchfovea.search import search
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.head import Head, fixate
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.lens import BrownConrady
from torchfovea.setting import SettingError
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep

SIDE, LOOKS = 128, 3
CAMERA = Pinhole(64.0, 63.5, 63.5)


def rotation(generator) -> torch.Tensor:
    return torch.from_numpy(
        Rotation.random(rng=np.random.default_rng(int(torch.randint(99, (), generator=generator)))).as_matrix()
    )


def raised(error):
    raise error


def written(folder, frames=3, calibration=None, **more):
    """A recording of grey images, 8 x 6."""
    calibration = calibration or Calibration(Pinhole(5.0, 3.5, 2.5), Pinhole(5.0, 3.5, 2.5), (8, 6), Head())
    recorder = Recorder(folder, calibration)
    for k in range(frames):
        image = torch.full((3, 6, 8), 0.25 * (k % 4))
        recorder.write(0.5 * k, image, image, gaze_from_angles(0.1 * k, 0.0, 0.05), **more)
    return recorder


def edited(folder, change):
    """Change the rows of frames.csv, each a dictionary."""
    with (folder / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with (folder / "frames.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0].keys())
        table.writeheader()
        table.writerows(rows)


def test_quaternions_against_scipy():
    rng = np.random.default_rng(0)
    turns = [
        *Rotation.random(20, rng=rng),
        *(Rotation.from_rotvec(math.pi * axis) for axis in np.eye(3)),
        Rotation.identity(),
    ]
    for turn in turns:
        q = quaternion_from_matrix(torch.from_numpy(turn.as_matrix()))
        told = np.roll(q.numpy(), -1)  # SciPy's scalar comes last
        assert min(np.abs(told - turn.as_quat()).max(), np.abs(told + turn.as_quat()).max()) < 1e-12
        again = matrix_from_quaternion(3 * q)
        torch.testing.assert_close(again, torch.from_numpy(turn.as_matrix()), atol=1e-12, rtol=0)
    with pytest.raises(SettingError, match=r"quaternion = "):
        matrix_from_quaternion(torch.zeros(4))


def test_pictures_keep_sixteen_bits_and_are_read_in_eight_too(tmp_path):
    import cv2

    image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
    write_picture(tmp_path / "one.png", image)
    assert torch.equal(read_picture(tmp_path / "one.png"), as_kept(image))
    assert float((as_kept(image) - image).abs().max()) <= 0.5 / 65535 + 1e-7
    assert torch.equal(as_kept(as_kept(image)), as_kept(image))
    grey = (image[0] * 255).round().byte().numpy()
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    np.testing.assert_allclose(read_picture(tmp_path / "grey.png")[1].numpy(), grey / 255, atol=1e-7)


def test_a_recording_comes_back_as_it_was(tmp_path):
    generator = torch.Generator().manual_seed(1)
    lens = BrownConrady(4.0, 4.5, 3.0, 2.0, (0.1, 0.01, 0.001, 0.002))
    calibration = Calibration(Fisheye(4.0, 3.0, 2.0), lens, (8, 6), Head(baseline_m=0.1), rendered=True)
    recorder = Recorder(tmp_path / "r", calibration)
    told = []
    for k in range(4):
        noise = torch.randn(6, 6, generator=generator, dtype=torch.float64)
        base = motion(rotation(generator), torch.rand(3, generator=generator), noise @ noise.mT) if k > 0 else None
        left, right = torch.rand(2, 3, 6, 8, generator=generator)
        frame = (
            0.1 * k,
            left if k != 2 else None,
            right,
            gaze_from_angles(*torch.rand(3, generator=generator).tolist()),
            base,
        )
        recorder.write(*frame)
        told.append(frame)
    recording = Folder(tmp_path / "r")
    assert len(recording) == 4 and recording.calibration == calibration
    for (time_s, left, right, gaze, base), frame in zip(told, recording.frames(raised), strict=True):
        assert frame.time_s == time_s and frame.gaze == gaze
        assert frame.left is None if left is None else torch.equal(frame.left, as_kept(left))
        assert torch.equal(frame.right, as_kept(right))
        if base is None:
            assert frame.base is None
        else:
            for one, other in zip(frame.base, base, strict=True):
                torch.testing.assert_close(one, other, atol=1e-12, rtol=1e-12)
    assert (tmp_path / "r" / "frames.csv").read_text().splitlines()[0] == ",".join(COLUMNS)


def test_a_table_by_hand_needs_three_columns(tmp_path):
    written(tmp_path, 3)

    def change(rows):
        for k, row in enumerate(rows):
            kept = {name: row[name] for name in ("time_s", "left", "right")}
            row.clear()
            row.update(kept | {"x_m": str(0.3 * k), "y_m": "0", "yaw_rad": str(0.2 * k)})

    edited(tmp_path, change)
    frames = list(Folder(tmp_path).frames(raised))
    assert frames[0].base is None and float(frames[2].gaze.pan) == 0.0
    turn = Rotation.from_euler("z", 0.2)
    np.testing.assert_allclose(frames[1].base.rotation.numpy(), turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(frames[2].base.translation.numpy(), turn.inv().apply([0.3, 0, 0]), atol=1e-12)


def test_a_column_that_nothing_reads_is_refused(tmp_path):
    """A misspelt angle would be missing, and so 0."""
    written(tmp_path, 2)
    table = tmp_path / "frames.csv"
    table.write_text(table.read_text().replace("pan_rad", "pan_deg"))
    with pytest.raises(SettingError, match=r"frames.csv: columns = pan_deg: expected none but time_s, .*pan_rad"):
        Folder(tmp_path)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            lambda rows: rows[2].update(left="left/none.png"),
            "frame 2: frame = .*none.png: expected an image, but",
        ),
        (lambda rows: rows[2].update(time_s="0.1"), "frame 2: time_s = 0.1: expected at least 0.5.*runs backward"),
        (lambda rows: rows[2].update(tilt_rad="nan"), "frame 2: tilt_rad = nan: expected a finite number"),
        (lambda rows: rows[2].update(qw="x"), "frame 2: qw = x: expected a finite number"),
        (lambda rows: rows[2].update(time_s=""), "frame 2: time_s = : expected a finite number"),
    ],
    ids=["missing", "backward", "nan", "pose", "no time"],
)
def test_a_frame_that_cannot_be_used_is_named_and_may_be_passed_over(tmp_path, change, line):
    written(tmp_path, 4)
    edited(tmp_path, change)
    frames = Folder(tmp_path).frames(raised)
    assert [next(frames).time_s, next(frames).time_s] == [0.0, 0.5]
    with pytest.raises(SettingError, match=line):
        next(frames)
    lines = []
    passed = list(Folder(tmp_path).frames(lambda error: lines.append(str(error))))
    assert len(passed) == 4 and len(lines) == 1
    assert passed[2].left is None and passed[2].right is None and passed[3].left is not None


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(SettingError, match=r"recording = .*: expected a folder with frames.csv"):
        Folder(tmp_path)
    recorder = written(tmp_path, 1)
    with pytest.raises(SettingError, match=r"time_s = -1: expected at least 0"):
        recorder.write(-1, None, None, gaze_from_angles(0, 0, 0))
    with pytest.raises(SettingError, match=r"left = \(3, 4, 4\): expected \(3, 6, 8\)"):
        recorder.write(1.0, torch.zeros(3, 4, 4), None, gaze_from_angles(0, 0, 0))
    with pytest.raises(SettingError, match=r"expected a folder without a recording"):
        written(tmp_path, 1)
    path = tmp_path / "calibration.json"
    content = json.loads(path.read_text())
    for change, line in (
        ({"left": {"model": "Box"}}, "model = Box: expected one of Pinhole, Fisheye"),
        ({"head": {"baseline": 1}}, "head.baseline = 1: expected one of baseline_m"),
        ({"head": {"baseline_m": -1}}, "baseline_m = -1"),
        ({"size_px": [8]}, "expected size_px, left, right and head"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(SettingError, match=line):
            read_calibration(path)
    path.unlink()
    with pytest.raises(SettingError, match=r"expected a recording's calibration.json"):
        Folder(tmp_path)
    other = Calibration(CAMERA, replace(CAMERA, cx_px=60.0), (SIDE, SIDE))
    write_calibration(path, other)
    assert read_calibration(path) == other
    # each retina lies about its own axis
    assert observer_of(Observer(), other).camera_right is None
    two = observer_of(Observer(), other._replace(right=replace(CAMERA, focal_px=110.0)))
    assert two.cameras == (two.camera, two.camera_right) and two.camera_right.focal_px > two.camera.focal_px


@pytest.mark.parametrize("matcher", [SGBM(), Sweep(hypotheses=64)], ids=["sgbm", "sweep"])
def test_a_recorded_search_played_again_is_the_search(tmp_path, matcher):
    head = Head(encoder_deg=0.1)
    observer = Observer(head=head, camera=Pinhole.from_fov(90, 100), retina=LogPolar(700))
    world = World(build_scene(Cans(), 1, head), camera=observer.camera, source_px=SIDE)
    cells = fibonacci_directions(1500)
    memory = new_memory(observer, cells[fixate(head, cells)[1]])
    arena = SimulatedArena(world, observer, Matcher(matcher), sample=500)
    arena.record(tmp_path)
    first = list(search(arena, observer, memory, LOOKS, torch.Generator().manual_seed(3)))

    recording = Folder(tmp_path)
    again = observer_of(Observer(head=recording.calibration.head, retina=observer.retina), recording.calibration)
    robot = Playback(recording, again, Matcher(matcher), sample=500, ahead=2)
    second = list(search(robot, again, memory, len(recording), torch.Generator().manual_seed(3)))
    assert len(second) == LOOKS
    for one, other in zip(first, second, strict=True):
        assert one.move.gaze == other.move.gaze and int(one.step.cell) == int(other.step.cell)
        assert abs(one.move.degrees - other.move.degrees) < 1.0  # as far as encoders tell
        for a, b in zip(one.step.gaze, other.step.gaze, strict=True):
            torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)
    for a, b in zip(first[-1].step.memory.information, second[-1].step.memory.information, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)
    assert int((second[-1].step.memory.looks > 0).sum()) > 100
