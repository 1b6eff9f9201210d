"""`torchfovea sense`: the real pair, a user's own files, and errors."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchfovea.cli import main
from torchfovea.cloud import write_ply
from torchfovea.commands.shared.images import read_image
from torchfovea.setting import SettingError
from torchfovea.stereo.disparity_files import load_disparity

SIZE = (160, 200)
FOCAL, BASELINE = 180.0, 0.1


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    return tmp_path


@pytest.fixture
def plane(folder):
    """A textured plane 1.5 m away: 12 px of disparity, as PNG and PFM files."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.random((SIZE[0], SIZE[1] + 12)).astype(np.float32), (0, 0), 1.2)
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    cv2.imwrite("left.png", texture[:, : SIZE[1]])
    cv2.imwrite("right.png", texture[:, 12:])
    cv2.imwrite("truth.pfm", np.full(SIZE, 12, np.float32))
    return [
        "left=left.png",
        "right=right.png",
        f"focal_px={FOCAL}",
        "cx_px=99.5",
        "cy_px=79.5",
        f"baseline_m={BASELINE}",
    ]


def sense(capsys, *overrides):
    assert main(["sense", *overrides]) == 0, capsys.readouterr().err
    run = Path(capsys.readouterr().out.splitlines()[-1])
    return run, json.loads((run / "result.json").read_text())


def points_of(run):
    """points.npz, closed again."""
    with np.load(run / "points.npz") as file:
        return dict(file)


def test_the_motorcycle(folder, capsys):
    run, result = sense(capsys, "pair=motorcycle", "sensor.receptive_fields=12000")
    assert result["valid_fraction"] > 0.8 and result["median_error_m"] < 0.05
    assert result["coverage_50"] < result["coverage_90"] <= result["coverage_95"] <= result["coverage_99"]
    assert {"points.ply", "points.npz", "sense.png", "result.json"} <= {p.name for p in run.iterdir()}
    points = points_of(run)
    assert len(points["mean_m"]) == result["points"] and np.isfinite(points["cov_m2"]).all()
    assert 1.5 < np.median(points["mean_m"][:, 2]) < 5
    assert len(points["inlier"]) == result["points"] and ((points["inlier"] > 0) & (points["inlier"] <= 1)).all()
    # no two points look at one source pixel
    pixel = np.round(points["left_px"] * 500 / 200)
    assert len(np.unique(pixel, axis=0)) == len(pixel)
    assert result["valid_fraction"] != result["valid_fraction_by_area"] and 0 < result["hidden_valid_by_area"] < 1
    assert result["coverage_95_by_area"] < result["coverage_95"] and math.isfinite(result["nll_by_area"])


def test_points_survive_a_judgement_that_fails(folder, capsys, plane):
    """A truth of another sign: nothing lies within 5 standard deviations, and the points are there."""
    np.save("wrong.npy", np.full(SIZE, 150, np.float32))
    run, result = sense(capsys, *plane, "disparity=wrong.npy", "sensor.receptive_fields=4000", "matcher=sgbm")
    assert len(points_of(run)["mean_m"]) == result["points"] > 500
    assert result["valid_fraction"] > 0.5 and result.get("outlier_share", 1) == 1


@pytest.mark.parametrize("sensor", ["log_polar", "uniform", "every_pixel"])
def test_own_files_with_truth(folder, capsys, plane, sensor):
    small = ["matcher=sgbm"] if sensor == "every_pixel" else ["sensor.receptive_fields=8000"]
    _, result = sense(capsys, *plane, "disparity=truth.pfm", f"sensor={sensor}", *small)
    assert result["valid_fraction"] > 0.6
    assert result["median_error_m"] < 0.02


def test_offset_axes_are_the_same_geometry(folder, capsys, plane):
    run, _ = sense(capsys, *plane, "doffs_px=6", "sensor=every_pixel", "matcher=sgbm")
    depth = np.median(points_of(run)["mean_m"][:, 2])
    assert depth == pytest.approx(FOCAL * BASELINE / 18, rel=0.01)


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["pair=car"], "pair = car: expected one of motorcycle"),
        ([], "left = null: expected an image file"),
        (["left=left.png", "right=gone.png"], "right = gone.png: expected an existing file"),
        (["left=left.png", "right=small.png"], "right = 100x100 px: expected the left image's 200x160 px"),
        (["left=left.png", "right=right.png"], "focal_px = null: expected the calibration"),
        (["left=left.png", "right=text.png"], "right = text.png: expected an image"),
        (["left=left.png", "right=nan.npy"], "NaN or infinite"),
        (["OWN", "baseline_m=0"], "baseline_m = 0: expected a positive number"),
        (["OWN", "focal_px=wide"], "focal_px = wide: expected a number"),
        (["OWN", "disparity=left.png"], "disparity = left.png: expected a disparity map"),
        (["OWN", "disparity=half.npy"], "disparity = (80, 100)"),
        (["OWN", "cx_px=[1,2]"], "cx_px = [1, 2]: expected a number"),
        (["OWN", "cx_px=nan"], "cx_px = nan: expected a number"),
        (["OWN", "cy_px=1e9"], "cy_px = 1000000000.0: expected a number of pixels within 100 images"),
        (["OWN", "focal_px=1e300"], "focal_px = 1e+300: expected a positive number of pixels"),
        (["OWN", "focal_px=1e-300"], "focal_px = 1e-300: expected a positive number of pixels"),
        (["OWN", "baseline_m=1e300"], "baseline_m = 1e+300: expected a positive number of metres"),
        (["OWN", "doffs_px=null"], "doffs_px = None: expected a number"),
        (["OWN", "doffs_px=[]"], "doffs_px = []: expected a number"),
        (["OWN", "doffs_px=1e9"], "doffs_px = 1000000000.0: expected a number of pixels within"),
        (["OWN", "gaze_px=5"], "gaze_px = 5: expected [column, row]"),
        (["OWN", "gaze_px=[5]"], "gaze_px = [5]: expected [column, row]"),
        (["OWN", "gaze_px=[5,a]"], "gaze_px = [5, 'a']: expected [column, row]"),
        (["OWN", "gaze_px=[500,5]"], "gaze_px = [500, 5]: expected [column, row]"),
        (["OWN", "left=1"], "left = 1: expected a file's name"),
        (["OWN", "disparity=0"], "disparity = 0: expected a file's name"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(folder, capsys, plane, overrides, line):
    cv2.imwrite("small.png", np.zeros((100, 100), np.uint8))
    Path("text.png").write_text("no image")
    np.save("nan.npy", np.full((*SIZE, 3), np.nan, np.float32))
    np.save("half.npy", np.zeros((80, 100), np.float32))
    overrides = [o for item in overrides for o in (plane if item == "OWN" else [item])]
    assert main(["sense", *overrides]) != 0
    printed = capsys.readouterr()
    assert printed.err.startswith("torchfovea sense: ") and len(printed.err.splitlines()) == 1, printed.err
    assert line in printed.err
    assert not list(folder.rglob("result.json")) and not list(folder.rglob("points.*"))


def test_an_image_without_texture_gives_no_points_and_no_error(folder, capsys):
    cv2.imwrite("grey.png", np.full(SIZE, 128, np.uint8))
    own = ["left=grey.png", "right=grey.png", "focal_px=180", "cx_px=99.5", "cy_px=79.5", "baseline_m=0.1"]
    run, result = sense(capsys, *own, "sensor.receptive_fields=2000")
    assert result["points"] == 0 and result["valid_fraction"] == 0
    assert len(points_of(run)["mean_m"]) == 0


def test_disparity_files(tmp_path):
    truth = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.save(tmp_path / "a.npy", truth)
    np.savez(tmp_path / "a.npz", disparity=truth)
    cv2.imwrite(str(tmp_path / "a.pfm"), truth)
    cv2.imwrite(str(tmp_path / "a.png"), (truth * 256).astype(np.uint16))
    for name in ("a.npy", "a.npz", "a.pfm"):
        np.testing.assert_array_equal(load_disparity(tmp_path / name, "disparity")[0], truth)
    np.testing.assert_array_equal(
        load_disparity(tmp_path / "a.png", "disparity")[0], np.where(truth == 0, np.nan, truth)
    )
    (tmp_path / "b.npy").write_text("x")
    with pytest.raises(SettingError, match=r"disparity = .*b\.npy"):
        load_disparity(tmp_path / "b.npy", "disparity")
    assert read_image(tmp_path / "a.npy", "left").shape == (3, 3, 4)


def test_ply_reads_back(tmp_path):
    rng = np.random.default_rng(0)
    mean, cov, colour, inlier = rng.normal(size=(5, 3)), rng.random((5, 6)), rng.random((5, 3)), rng.random(5)
    write_ply(tmp_path / "p.ply", mean, cov, colour, inlier)
    head, body = (tmp_path / "p.ply").read_bytes().split(b"end_header\n")
    assert b"element vertex 5" in head and b"property float inlier" in head and b"property uchar blue" in head
    record = np.dtype([("f", "<f4", 10), ("c", "u1", 3)])
    read = np.frombuffer(body, record)
    np.testing.assert_allclose(read["f"], np.concatenate([mean, cov, inlier[:, None]], -1), rtol=1e-6)
    np.testing.assert_array_equal(read["c"], (colour * 255).round())
