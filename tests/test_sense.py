"""`torchfovea sense`: the real pair, a user's own files, and errors."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchfovea.cli import main
from torchfovea.cloud import write_ply
from torchfovea.commands.shared.images import exposed, read_levels
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
    assert "the left camera's frame: x right" in str(points["frame"]) and "cov_m2 m^2" in str(points["units"])
    assert str(points["cov_order"]).startswith("xx xy xz yy yz zz")
    assert b"comment metres, the left camera's frame" in (run / "points.ply").read_bytes()[:300]
    assert len(points["inlier"]) == result["points"] and ((points["inlier"] > 0) & (points["inlier"] <= 1)).all()
    # no two points look at one source pixel
    pixel = np.round(points["left_image_px"] - np.array([370, 249.5]))
    assert len(np.unique(pixel, axis=0)) == len(pixel)
    assert result["image_seen"] == 1 and np.ptp(pixel[:, 0]) > 700 and np.ptp(pixel[:, 1]) > 480
    assert result["rows_px"] < 0.15 and not result["warnings"]
    assert result["valid_fraction"] != result["valid_fraction_by_area"] and 0 < result["hidden_valid_by_area"] < 1
    assert result["coverage_95_by_area"] < result["coverage_95"] and math.isfinite(result["nll_by_area"])


def test_points_survive_a_judgement_that_fails(folder, capsys, plane):
    """A truth in other units: nothing is judged by it, or nothing is right, and the points are there."""
    np.save("wrong.npy", np.full(SIZE, 150, np.float32))
    overrides = [*plane, "disparity=wrong.npy", "sensor.receptive_fields=2000"]
    run, result = sense(capsys, *overrides)
    assert len(points_of(run)["mean_m"]) == result["points"] > 500 and "median_error_m" not in result
    (warning,) = result["warnings"]
    assert "disparity: 12.5 times what" in warning and "units of 1/12.5 px" in warning and "not judged" in warning
    run, result = sense(capsys, *overrides, "health=warn")
    assert len(points_of(run)["mean_m"]) == result["points"] > 500
    assert result["valid_fraction"] > 0.5 and result["outlier_share"] == 1 and len(result["warnings"]) == 1


@pytest.mark.parametrize("sensor", ["log_polar", "uniform", "every_pixel"])
def test_own_files_with_truth(folder, capsys, plane, sensor):
    small = ["matcher=sgbm"] if sensor == "every_pixel" else ["sensor.receptive_fields=8000"]
    _, result = sense(capsys, *plane, "disparity=truth.pfm", f"sensor={sensor}", *small)
    assert result["valid_fraction"] > 0.6
    assert result["median_error_m"] < 0.02


def test_eyes_may_look_at_different_pixels(folder, capsys, plane):
    """The plane is 12 px further left in the right image; the truth is judged all the same."""
    files = [
        *plane,
        "disparity=truth.pfm",
        "gaze_px=[120,80]",
        "gaze_right_px=[108,80]",
        "sensor.receptive_fields=4000",
    ]
    run, result = sense(capsys, *files)
    assert result["valid_fraction"] > 0.6 and result["median_error_m"] < 0.02
    assert np.median(points_of(run)["mean_m"][:, 2]) == pytest.approx(1.5, rel=0.01)


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
        (["OWN", "baseline_m=0"], "baseline_m = 0: expected 0.001 to 10 metres"),
        (["OWN", "baseline_m=193"], "baseline_m = 193: expected 0.001 to 10 metres"),
        (["OWN", "focal_px=wide"], "focal_px = wide: expected a number"),
        (
            ["OWN", "disparity=left.png"],
            "disparity = left.png: expected the pixels that a stored 1 stands for (disparity_unit_px",
        ),
        (["OWN", "disparity=half.npy"], "disparity = (80, 100)"),
        (["OWN", "cx_px=[1,2]"], "cx_px = [1, 2]: expected a number"),
        (["OWN", "cx_px=nan"], "cx_px = nan: expected a number"),
        (["OWN", "cy_px=1e9"], "cy_px = 1000000000.0: expected a number of pixels within 100 images"),
        (["OWN", "focal_px=1e300"], "focal_px = 1e+300: expected a positive number of pixels"),
        (["OWN", "focal_px=1e-300"], "focal_px = 1e-300: expected a positive number of pixels"),
        (["OWN", "baseline_m=1e300"], "baseline_m = 1e+300: expected 0.001 to 10 metres"),
        (["OWN", "doffs_px=null"], "doffs_px = None: expected a number"),
        (["OWN", "doffs_px=[]"], "doffs_px = []: expected a number"),
        (["OWN", "doffs_px=1e9"], "doffs_px = 1000000000.0: expected a number of pixels within"),
        (["OWN", "gaze_px=5"], "gaze_px = 5: expected a list"),
        (["OWN", "gaze_px=[5]"], "gaze_px = [5]: expected [column, row]"),
        (["OWN", "gaze_px=[5,a]"], "gaze_px = [5, 'a']: expected a list"),
        (["OWN", "gaze_px=[500,5]"], "gaze_px = [500, 5]: expected [column, row]"),
        (["OWN", "left=1"], "left = 1: expected text or null"),
        (["OWN", "disparity=0"], "disparity = 0: expected text or null"),
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


def small(*more):
    return [*more, "sensor.receptive_fields=1500"]


def with_orientation(path, orientation):
    """Give a JPEG file an EXIF orientation."""
    data = Path(path).read_bytes()
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + orientation.to_bytes(2, "big") + b"\x00\x00"
    tiff = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01" + entry + b"\x00\x00\x00\x00"
    Path(path).write_bytes(data[:2] + b"\xff\xe1" + (len(tiff) + 2).to_bytes(2, "big") + tiff + data[2:])


def refused(capsys, *overrides):
    """The one line of a run that stops before any work is lost."""
    before = set(Path.cwd().rglob("points.*"))
    assert main(["sense", *overrides]) != 0
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 1 and set(Path.cwd().rglob("points.*")) == before
    return printed


def test_pictures_that_cannot_be_this_pair_are_refused(folder, capsys, plane):
    swapped = ["left=right.png", "right=left.png", *plane[2:]]
    line = refused(capsys, *small(*swapped))
    assert "100% of" in line and "beyond infinity" in line and "(health=warn goes on)" in line
    assert len(sense(capsys, *small(*swapped), "health=warn")[1]["warnings"]) == 1
    cv2.imwrite("low.png", np.roll(cv2.imread("right.png"), 4, 0))
    assert "rows of" in refused(capsys, *small(*plane), "right=low.png")
    assert "the same picture as left" in refused(capsys, *small(*plane), "right=left.png")
    assert "health = strict: expected one of" in refused(capsys, *small(*plane), "health=strict")


def test_a_turned_picture_is_refused_or_taken_as_it_is_stored(folder, capsys, plane):
    for name in ("left", "right"):
        cv2.imwrite(f"{name}.jpg", cv2.imread(f"{name}.png"), [cv2.IMWRITE_JPEG_QUALITY, 98])
        with_orientation(f"{name}.jpg", 6)
    cv2.imwrite("right.jpg", cv2.imread("right.png"), [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert cv2.imread("left.jpg").shape[:2] == SIZE[::-1]
    overrides = small(*plane, "left=left.jpg", "right=right.jpg")
    assert "left: its EXIF orientation turns the picture" in refused(capsys, *overrides)
    _, result = sense(capsys, *overrides, "disparity=truth.pfm", "health=warn")
    assert result["median_error_m"] < 0.02 and len(result["warnings"]) == 1
    with_orientation("right.jpg", 1)
    assert not read_levels(Path("right.jpg"), "right").turned


@pytest.mark.parametrize("kind", ["12 bits in 16", "16 bits", "floating point"])
def test_levels_are_what_they_were(folder, plane, kind):
    """The same pictures stored in other types are the same pictures."""
    ends = {"12 bits in 16": (4095, np.uint16, "png"), "16 bits": (65535, np.uint16, "png")}
    scale, dtype, end = ends.get(kind, (255, np.float32, "npy"))
    pictures = []
    for name in ("left", "right"):
        stored = np.rint(cv2.imread(f"{name}.png").astype(np.float64) * (scale / 255)).astype(dtype)
        if end == "png":
            cv2.imwrite(f"{name}_.png", stored)
        else:
            np.save(f"{name}_.npy", stored)
        pictures.append(read_levels(Path(f"{name}_.{end}"), name))
    left, _, faults = exposed(*pictures)
    np.testing.assert_allclose(left.numpy(), cv2.imread("left.png").transpose(2, 0, 1) / 255, atol=0.5 / scale)
    assert [fault.kind for fault in faults] == ["bits"] * (kind != "16 bits")


def test_rows_that_are_a_little_apart_widen_the_covariances(folder, capsys, plane):
    moved = cv2.warpAffine(cv2.imread("right.png"), np.float32([[1, 0, 0], [0, 1, 0.9]]), SIZE[::-1], borderMode=1)
    cv2.imwrite("low.png", moved)
    overrides = small(*plane, "right=low.png")
    run, result = sense(capsys, *overrides)
    (warning,) = result["warnings"]
    assert result["rows_px"] == pytest.approx(0.9, abs=0.15) and "widened" in warning
    without, plain = sense(capsys, *overrides, "health=off")
    assert plain["rows_px"] == 0 and plain["points"] == result["points"]
    assert (points_of(run)["inverse_range_std"] > points_of(without)["inverse_range_std"]).all()


def test_a_foreign_disparity_in_other_units_is_refused(folder, capsys, plane):
    np.save("raw.npy", np.full(SIZE, 12 * 16, np.int16))
    np.save("good.npy", np.full(SIZE, 12, np.int16))
    np.save("holes.npy", np.where(np.arange(SIZE[1]) % 9 == 0, 0, 12) * np.ones((SIZE[0], 1), np.int16))
    external = small(*plane, "matcher=external", "budget=ours")
    assert "matcher.source: 16 times what" in refused(capsys, *external, "matcher.source=raw.npy")
    assert "of it is 0: expected NaN" in refused(capsys, *external, "matcher.source=holes.npy")
    assert not sense(capsys, *external, "matcher.source=good.npy")[1]["warnings"]


def test_a_truth_of_an_image_and_its_mask(folder, capsys, plane):
    """Quarters of a pixel in 8 bits, and TIFF; what the mask hides or does not know is not judged."""
    truth = np.full(SIZE, 12, np.float32)
    truth[:, 100:] = 30  # wrong, and masked
    truth[:40] = 0
    cv2.imwrite("quarters.png", (truth * 4).astype(np.uint8))
    cv2.imwrite("truth.tiff", np.where(truth == 0, np.nan, truth))
    np.testing.assert_array_equal(
        load_disparity("quarters.png", "disparity", unit_px=0.25)[0], load_disparity("truth.tiff", "disparity")[0]
    )
    np.testing.assert_array_equal(
        load_disparity("truth.tiff", "disparity", unknown=30)[0][41:, 99:101], [[12, np.nan]] * 119
    )
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, 100:], mask[:40] = 128, 0
    cv2.imwrite("mask.png", mask)
    quarters = small(*plane, "disparity=quarters.png", "disparity_unit_px=0.25")
    _, judged = sense(capsys, *quarters, "mask=mask.png")
    assert judged["median_error_m"] < 0.02 and judged["outlier_share"] < 0.05 and judged["hidden_valid"] > 0.3
    _, unmasked = sense(capsys, *quarters, "health=off")
    assert unmasked["outlier_share"] > 0.3


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["mask=mask.png"], "mask = mask.png: expected null without a disparity"),
        (["disparity=truth.pfm", "mask=gone.png"], "mask = gone.png: expected an existing file"),
        (["disparity=truth.pfm", "mask=text.png"], "mask = text.png: expected a grey image"),
        (["disparity=truth.pfm", "mask=none.png"], "mask = none.png: expected a mask that leaves something"),
        (["disparity=truth.pfm", "mask=half.npy"], "mask = (80, 100): expected the disparity's (160, 200)"),
        (["disparity=truth.pfm", "disparity_unit_px=0"], "disparity_unit_px = 0.0: expected the pixels"),
        (["disparity=truth.pfm", "disparity_unknown=no"], "disparity_unknown = no: expected a number"),
        (["span=all"], "span = all: expected one of whole, shorter"),
    ],
)
def test_a_mistaken_mask_is_one_line(folder, capsys, plane, overrides, line):
    Path("text.png").write_text("no image")
    np.save("half.npy", np.ones((80, 100), bool))
    cv2.imwrite("none.png", np.zeros(SIZE, np.uint8))
    assert line in refused(capsys, *small(*plane), *overrides)


def test_what_a_shorter_span_leaves_out_is_said(folder, capsys, plane):
    _, result = sense(capsys, *small(*plane), "span=shorter")
    assert result["image_seen"] == pytest.approx(math.pi * 80**2 / (160 * 200), abs=0.01)


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
    assert read_levels(tmp_path / "a.npy", "left").levels.shape == (3, 3, 4)


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
