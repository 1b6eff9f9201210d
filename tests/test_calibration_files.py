"""Calibration files: one rig written in five formats is one rig; points as OpenCV has them; what is wrong is named."""

import math

import cv2
import numpy as np
import pytest
import torch
import yaml

from torchfovea.gaussian import Gaussian
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.chart import cartesian_from_inverse_range
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.sensing.triangulation import observe
from torchfovea.setting import SettingError
from torchfovea.stereo.calibration_files import Options, load_calibration
from torchfovea.stereo.maps import match_disparity
from torchfovea.stereo.views import rectified_views

SIZE = (640, 480)
K1 = np.array([[533.4, 0, 342.5], [0, 531.9, 234.7], [0, 0, 1]])
K2 = np.array([[537.0, 0, 327.4], [0, 536.6, 249.9], [0, 0, 1]])
D1, D2 = np.array([-0.28, 0.04, 0.0012, -0.0001, 0.12]), np.array([-0.3, 0.14, -0.0005, 0.0001, -0.05])
# OpenCV's way: X_right = R X_left + T
R, T = cv2.Rodrigues(np.array([0.01, 0.12, -0.02]))[0], np.array([-0.12, 0.003, 0.008])
R1, R2, P1, P2 = cv2.stereoRectify(K1, D1, K2, D2, SIZE, R, T[:, None])[:4]
LEFT, RIGHT = (BrownConrady(k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(d)) for k, d in ((K1, D1), (K2, D2)))


def stored(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def written(path, document):
    path.write_text(yaml.safe_dump(document))
    return path


def camera_info(path, k, d, turn, projection, model="plumb_bob"):
    def matrix(a):
        return {"rows": len(a), "cols": a.size // len(a), "data": a.ravel().tolist()}

    document = {"image_width": 640, "image_height": 480, "camera_name": path.stem, "camera_matrix": matrix(k)}
    document |= {"distortion_model": model, "distortion_coefficients": matrix(d[None])}
    return written(path, document | {"rectification_matrix": matrix(turn), "projection_matrix": matrix(projection)})


def message(path, k, d, turn, projection):
    """As ``ros2 topic echo`` prints it."""
    document = {"height": 480, "width": 640, "distortion_model": "plumb_bob", "d": d.tolist(), "k": k.ravel().tolist()}
    document |= {"r": turn.ravel().tolist(), "p": projection.ravel().tolist()}
    written(path, document).write_text(path.read_text() + "---\n")
    return path


def camchain(path, turn, shift, model="radtan", d=(D1, D2), **more):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    chain = {}
    for i, (k, bent) in enumerate(zip((K1, K2), d, strict=True)):
        numbers = [float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])]
        chain[f"cam{i}"] = {"camera_model": "pinhole", "distortion_model": model, "intrinsics": numbers}
        chain[f"cam{i}"] |= {"distortion_coeffs": [float(v) for v in bent[:4]], "resolution": list(SIZE)} | more
    chain["cam1"]["T_cn_cnm1"] = pose.tolist()
    return written(path, chain)


def kitti(path, **more):
    def line(name, a):
        return f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(a))}"

    # cameras 2 and 3, whose poses are told about camera 0
    base, far = cv2.Rodrigues(np.array([0.1, -0.05, 0.02]))[0], np.array([0.06, 0.01, -0.02])
    lines = ["calib_time: 09-Jan-2012 13:57:47", line("corner_dist", [0.0995])]
    entries = ((2, K1, D1, base, far, R1, P1), (3, K2, D2, R @ base, R @ far + T, R2, P2))
    for i, k, d, turn, shift, rect, projection in entries:
        parts = {
            "S": SIZE,
            "K": k,
            "D": d,
            "R": turn,
            "T": shift,
            "S_rect": (600, 400),
            "R_rect": rect,
            "P_rect": projection,
        }
        lines += [line(f"{name}_{i:02d}", value) for name, value in parts.items()]
    path.write_text("\n".join(lines) + "\n")
    return path


def in_five_formats(folder):
    whole = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": R, "T": T}
    tail = {"R1": R1, "R2": R2, "P1": P1, "P2": P2}
    sized = {"image_width": 640, "image_height": 480}
    yield "opencv", [stored(folder / "stereo.yml", **whole)]
    yield "opencv xml", [stored(folder / "stereo.xml", **whole, **tail, **sized)]
    names = {"cameraMatrix1": K1, "distCoeffs1": D1[None], "cameraMatrix2": K2, "distCoeffs2": D2[None]}
    yield "opencv, other names", [stored(folder / "other.yml", **names, R=cv2.Rodrigues(R)[0], T=T[:, None])]
    inner, outer = {k: whole[k] for k in ("M1", "D1", "M2", "D2")}, {"R": R, "T": T, **tail}
    yield "opencv, two files", [stored(folder / "intrinsics.yml", **inner), stored(folder / "extrinsics.yml", **outer)]
    own = [
        stored(folder / f"{side}.yml", camera_matrix=k, distortion_coefficients=d, **sized, **more)
        for side, k, d, more in (("left", K1, D1, {}), ("right", K2, D2, {"R": R, "T": T}))
    ]
    yield "opencv, a file a camera", own
    for kind, name in ((camera_info, "info"), (message, "echo")):
        sides = (("left", K1, D1, R1, P1), ("right", K2, D2, R2, P2))
        yield f"ros {name}", [kind(folder / f"{name}_{s}.yaml", *parts) for s, *parts in sides]
    yield "kitti", [kitti(folder / "calib_cam_to_cam.txt")]


def test_one_rig_in_every_format(tmp_path):
    seen = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.3, 1.0]], dtype=torch.float64)
    for name, paths in in_five_formats(tmp_path):
        got = load_calibration(paths, SIZE)
        assert (got.left, got.rectified) == (LEFT, False) and got.right == RIGHT, name
        rig = got.rig
        assert rig.baseline_m == pytest.approx(np.linalg.norm(T))
        # a point of the left camera as the right one has it, through the rectified frame and OpenCV's way
        there = (seen @ rig.R_left.mT - torch.tensor([rig.baseline_m, 0, 0], dtype=torch.float64)) @ rig.R_right
        np.testing.assert_allclose(there, seen.numpy() @ R.T + T, atol=1e-8, err_msg=name)


def test_kalibr_radtan_and_equidistant(tmp_path):
    brown = load_calibration([camchain(tmp_path / "a.yaml", R, T)], SIZE)
    assert brown.left == BrownConrady(533.4, 531.9, 342.5, 234.7, tuple(D1[:4])) and not brown.rectified
    np.testing.assert_allclose((brown.rig.R_left.mT @ brown.rig.R_right).T, R, atol=1e-9)
    fish = load_calibration([camchain(tmp_path / "b.yaml", R, T, "equidistant")], SIZE)
    assert fish.right == KannalaBrandt(537.0, 536.6, 327.4, 249.9, tuple(D2[:4]))
    chain = yaml.safe_load((tmp_path / "a.yaml").read_text())
    imu = np.eye(4)
    imu[:3, :3], imu[:3, 3] = cv2.Rodrigues(np.array([0.3, 1.0, -0.7]))[0], (0.1, 0.2, 0.3)
    chain["cam0"]["T_cam_imu"] = imu.tolist()
    chain["cam1"]["T_cam_imu"] = (np.array(chain["cam1"].pop("T_cn_cnm1")) @ imu).tolist()
    by_imu = load_calibration([written(tmp_path / "c.yaml", chain)], SIZE)
    torch.testing.assert_close(by_imu.rig.R_left, brown.rig.R_left)


def test_rectified_images_of_files_that_tell_both(tmp_path):
    for name, paths in in_five_formats(tmp_path):
        size = (600, 400) if name == "kitti" else SIZE
        kinds = ("auto", "rectified") if name == "kitti" else ("rectified",)
        if name in ("opencv", "opencv, other names", "opencv, a file a camera"):
            with pytest.raises(SettingError, match="calibration_images = rectified: expected the other"):
                load_calibration(paths, size, "rectified")
            continue
        for images in kinds:
            got = load_calibration(paths, size, images)
            assert got.rectified and isinstance(got.left, Pinhole), name
            assert got.left.focal_px == pytest.approx(P1[0, 0]) and got.left.cy_px == pytest.approx(P1[1, 2])
            assert got.right.cx_px == pytest.approx(P2[0, 2])
            assert got.rig.baseline_m == pytest.approx(-P2[0, 3] / P2[0, 0])


def test_kittis_projections_and_middleburys_numbers(tmp_path):
    four = tmp_path / "calib.txt"
    shifts = (0.0, -386.1448, 45.38225, -337.2877)
    four.write_text(
        "".join(f"P{i}: 718.856 0 607.1928 {s} 0 718.856 185.2157 0 0 0 1 0\n" for i, s in enumerate(shifts))
    )
    got = load_calibration([four], (1241, 376), options=Options(cameras=(2, 3)))
    assert got.rectified and got.rig.baseline_m == pytest.approx((45.38225 + 337.2877) / 718.856)
    with pytest.raises(SettingError, match=r"calibration_cameras = None: expected which two of \[0, 1, 2, 3\]"):
        load_calibration([four], (1241, 376))
    with pytest.raises(SettingError, match=r"calibration_cameras = \[2, 7\]: expected two of"):
        load_calibration([four], (1241, 376), options=Options(cameras=(2, 7)))
    quarter = tmp_path / "middlebury.txt"
    quarter.write_text("cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]\ndoffs=31.086\nbaseline=193.001\nndisp=70\n")
    got = load_calibration([quarter], (741, 497))
    assert got[:2] == (Pinhole(994.978, 311.193, 254.877), Pinhole(994.978, 311.193 + 31.086, 254.877))
    assert got.rectified and got.rig.baseline_m == pytest.approx(0.193001)


def test_points_are_opencvs(tmp_path):
    """The same disparity, with doffs: cv2.reprojectImageTo3D to 1e-5, where the disparity is as good as certain."""
    height, width = 60, 80
    path = tmp_path / "calib.txt"
    path.write_text(
        "cam0=[90.5 0 37.25; 0 90.5 31.5; 0 0 1]\ncam1=[90.5 0 42.75; 0 90.5 31.5; 0 0 1]\ndoffs=5.5\nbaseline=120\n"
        f"width={width}\nheight={height}\n"
    )
    got = load_calibration([path], (width, height))
    disparity = torch.rand(height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 20 + 1
    image = torch.zeros(1, height, width, dtype=torch.float64)
    views = rectified_views(image, image, got.left, got.right, got.rig.baseline_m)
    sure = Budget(sigma_over_width=1e-6, match_px=0.0)
    matches, _ = match_disparity(disparity, views, None, sure, nearest_range_m=0.01)
    eye = torch.eye(3, dtype=torch.float64)
    rig = Eyes(eye, torch.zeros(3, dtype=torch.float64), eye, torch.tensor([0.12, 0, 0], dtype=torch.float64))
    seen = observe(matches, rig, views.cameras(None), torch.full_like(matches.left_px[:, 0], 0.5))
    points = cartesian_from_inverse_range(Gaussian(seen.mean, seen.cov), seen.direction).mean
    # Q as stereoRectify makes it: W = (d + cx_right − cx_left)/b
    turn = np.array([[1, 0, 0, -37.25], [0, 1, 0, -31.5], [0, 0, 0, 90.5], [0, 0, 1 / 0.12, 5.5 / 0.12]])
    expected = cv2.reprojectImageTo3D(disparity.float().numpy(), turn).reshape(-1, 3)
    reached = seen.valid & (matches.right_px[:, 0] >= 0)
    assert reached.double().mean() > 0.7
    np.testing.assert_allclose(points[reached], expected[reached], rtol=1e-5, atol=1e-6)


def change(path, **values):
    """The stereo file with some of it changed; None leaves it out."""
    whole = {"M1": K1, "D1": D1, "M2": K2, "D2": D2, "R": R, "T": T, "image_width": 640, "image_height": 480}
    return stored(path, **{k: v for k, v in (whole | values).items() if v is not None})


def test_lengths_in_millimetres(tmp_path):
    path = change(tmp_path / "mm.yml", T=1000 * T)
    with pytest.raises(SettingError, match=r"baseline = 120.* m: expected .*calibration_unit_m = 0.001"):
        load_calibration([path], SIZE)
    got = load_calibration([path], SIZE, options=Options(unit_m=0.001))
    assert got.rig.baseline_m == pytest.approx(np.linalg.norm(T))


def test_a_fisheye_of_opencvs_is_told(tmp_path):
    path = change(tmp_path / "fish.yml", D1=D1[:4], D2=D2[:4])
    assert isinstance(load_calibration([path], SIZE).left, BrownConrady)
    got = load_calibration([path], SIZE, options=Options(lens="kannala_brandt"))
    assert got.left == KannalaBrandt(533.4, 531.9, 342.5, 234.7, tuple(D1[:4]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: change(p, image_width=1280), "size = 1280x480: expected 640x480 px"),
        (
            lambda p: change(p, M1=2 * K1, M2=2 * K2, image_width=None),
            r"optical axis of the left camera = \(685, 469.4\)",
        ),
        (lambda p: change(p, M1=K1 / 2, M2=K2 / 2, image_width=None), "another image size"),
        (lambda p: change(p, R=1.1 * R), "R = .*: expected a rotation"),
        (lambda p: change(p, R=-R), "R = .*: expected a rotation"),
        (lambda p: change(p, R=R.T @ R, T=-T), r"right camera as the left one sees it = \(-0.12.*exchanged"),
        (lambda p: change(p, R=None), "expected R and T, from the left camera to the right one, which it lacks"),
        (lambda p: change(p, M2=None), "expected both camera matrices"),
        (lambda p: change(p, R=np.full((3, 3), math.nan)), "not all are finite"),
        (lambda p: change(p, M1=-K1), "fx_px = -533.4"),
        (lambda p: camchain(p, R, T, "fov"), "distortion_model = fov"),
        (lambda p: camchain(p, R, T, camera_model="omni"), "cam0.camera_model = omni: expected pinhole"),
        (lambda p: camera_info(p, K1, D1, R1, P1), "calibration_right = None: expected the right camera's camera_info"),
        (lambda p: written(p, {"a": 1, "b": 2}), "it has a, b"),
        (lambda p: written(p, {"\ufffd\x00": 1, "\ufffdNUMPY": 2}), "it has none of their names$"),
        (lambda p: written(p, [1, 2]), "expected a calibration file"),
        (lambda p: p.with_name("gone"), "gone: expected an existing file"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, make, message):
    with pytest.raises(SettingError, match=message) as caught:
        load_calibration([make(tmp_path / "it.yml")], SIZE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cam0=[1 0 x; 0 1 0; 0 0 1]\ncam1=[1 0 0; 0 1 0; 0 0 1]\nbaseline=1", "expected numbers of a calibration"),
        ("cam0=[90 0 320; 0 90 240; 0 0 1]\nbaseline=120", "expected cam1 or doffs, which it lacks"),
        ("cam0=[90 0 320; 0 90 240; 0 0 1]\ndoffs=0", "expected baseline, which it lacks"),
        ("cam0=[90 0 320; 0 90 240; 0 0 1]\ncam1=[90 0 325; 0 90 240; 0 0 1]\ndoffs=9\nbaseline=9", "doffs = 9.0"),
        ("P0: 1 2 3\nP1: 1 2 3", "3 numbers for 12"),
        ("P0: 90 0 320 0 0 90 240 0 0 0 1 0\nP1: 90 0 320 0 0 90 240 0 0 0 1 0", "a baseline"),
        ("P1: 90 0 320 0 0 90 240 0 0 0 1 0", "cameras = .1.: expected at least two"),
        ("%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: x", "calibration = "),
        ("a: [", "expected a calibration file"),
        ("", "expected a calibration file"),
    ],
)
def test_broken_text(tmp_path, text, message):
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(SettingError, match=message) as caught:
        load_calibration([path], SIZE)
    assert "\n" not in str(caught.value)
