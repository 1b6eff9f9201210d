import math

import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import SettingError
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.stereo.external import External, load_matcher, match_external
from torchfovea.stereo.maps import match_disparity
from torchfovea.stereo.rig import verged
from torchfovea.stereo.views import rectified_views, verged_views

CAMERAS = Pinhole(120.0, 50.0, 38.0), Pinhole(120.0, 55.0, 38.0)
SIZE = (80, 100)


@pytest.fixture
def disparity():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    values = (6 + 0.05 * x + 0.02 * y).astype(np.float32)
    values[10:14, 20:30] = np.nan
    return values


@pytest.fixture
def images(generator):
    return torch.rand(3, *SIZE, generator=generator), torch.rand(3, *SIZE, generator=generator)


@pytest.fixture
def views(images):
    return rectified_views(*images, *CAMERAS, 0.2)


def write_pfm(path, values, little=True):
    with path.open("wb") as file:
        file.write(f"Pf\n{values.shape[1]} {values.shape[0]}\n{-1 if little else 1}\n".encode())
        file.write(values[::-1].astype("<f4" if little else ">f4").tobytes())


def write_png(path, values):
    cv2 = pytest.importorskip("cv2")
    cv2.imwrite(str(path), np.where(np.isnan(values), 0, np.round(np.nan_to_num(values) * 256)).astype(np.uint16))


WRITERS = {
    "npy": lambda path, v: np.save(path, v),
    "npz": lambda path, v: np.savez(path, v),
    "pfm": write_pfm,
    "PFM": lambda path, v: write_pfm(path, v, little=False),
    "png": write_png,
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_files_read_back(tmp_path, disparity, suffix):
    path = tmp_path / f"disparity.{suffix}"
    WRITERS[suffix](path, disparity)
    values, confidence = load_disparity(path)
    assert confidence is None and values.dtype == torch.float32
    np.testing.assert_array_equal(values.isnan().numpy(), np.isnan(disparity))
    np.testing.assert_allclose(values.numpy(), disparity, atol=1 / 512 if suffix == "png" else 0)


def test_pfm_as_opencv_writes_it(tmp_path, disparity):
    cv2 = pytest.importorskip("cv2")
    cv2.imwrite(str(tmp_path / "d.pfm"), np.nan_to_num(disparity))
    np.testing.assert_array_equal(load_disparity(tmp_path / "d.pfm")[0].numpy(), np.nan_to_num(disparity))


def test_a_file_gives_what_its_disparity_gives(tmp_path, disparity, images, views):
    np.savez(tmp_path / "d.npz", disparity=disparity, confidence=np.ones(SIZE))
    retina = LogPolar(800)
    found, field = match_external(tmp_path / "d.npz", views, retina, nearest_range_m=0.5)
    expected = match_disparity(disparity, views, retina, nearest_range_m=0.5)[0]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)
    again, _ = match_external(str(tmp_path / "d.npz"), views, retina, nearest_range_m=0.5)
    assert torch.equal(again.right_px, found.right_px)
    torch.testing.assert_close(field.image, images[0].mean(0))
    every, _ = match_external(tmp_path / "d.npz", views, nearest_range_m=0.5)
    assert every.valid.sum() > 0.7 * SIZE[0] * SIZE[1]


def test_confidence_is_a_standard_deviation(disparity, views):
    confidence = np.tile(np.linspace(0, 1, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    params = External(sure_px=0.2, unsure_px=2.0, power=2.0, least_confidence=0.25)
    found, _ = match_external(lambda left, right: (disparity, confidence), views, params=params, nearest_range_m=0.5)
    plain, _ = match_disparity(disparity, views, nearest_range_m=0.5)
    c = torch.from_numpy(confidence).flatten()
    assert torch.equal(found.valid, plain.valid & (c >= 0.25))
    expected = torch.hypot(plain.right_sigma_px, 0.2 + 1.8 * (1 - c) ** 2)
    torch.testing.assert_close(found.right_sigma_px[found.valid], expected[found.valid])
    torch.testing.assert_close(found.left_sigma_px, plain.left_sigma_px)
    # on a retina the same standard deviation, in its own pixels
    retina = Uniform(2000)
    foveal, without = (
        match_external(lambda left, right, c=c: (disparity, c), views, retina, params, nearest_range_m=0.5)[0]
        for c in (np.full(SIZE, 0.5, np.float32), np.ones(SIZE, np.float32))
    )
    extra = foveal.right_sigma_px.square() - without.right_sigma_px.square()
    scale = SIZE[0] / 200
    torch.testing.assert_close(extra, torch.full_like(extra, (0.65**2 - 0.2**2) / scale**2), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("answer", "settings"),
    [
        (lambda d: np.where(np.isnan(d), 1e9, -d), {"scale": -1.0, "invalid": 1e9}),
        (lambda d: np.where(np.isnan(d), -16, np.round(256 * d)).astype(np.int32), {"scale": 1 / 256, "invalid": -16}),
        (lambda d: torch.from_numpy(d).double(), {}),
    ],
    ids=["signed", "fractions", "float64"],
)
def test_any_sign_and_unit_is_turned_into_pixels(disparity, views, answer, settings):
    params, retina = External(**settings), LogPolar(800)
    found, _ = match_external(lambda left, right: answer(disparity), views, retina, params, nearest_range_m=0.5)
    expected, _ = match_external(lambda left, right: disparity, views, retina, nearest_range_m=0.5)
    assert torch.equal(found.valid, expected.valid) and found.valid.any() and not found.valid.all()
    torch.testing.assert_close(found.right_px, expected.right_px, atol=0.01, rtol=0)


def test_a_wrong_sign_or_unit_is_told(disparity, views):
    for answer, message in (
        (-disparity, r"disparities = -12.53 to -6 px: expected .* by matcher\.scale=-1$"),
        (16 * disparity, r"px: expected .* by matcher\.scale=0\.0625$"),
    ):
        with pytest.raises(SettingError, match=message):
            match_external(lambda left, right, answer=answer: answer, views, nearest_range_m=0.5)


def test_what_tells_the_worth_of_a_disparity(disparity, views):
    """A doubt is a confidence turned round; a deviation, a variance and its logarithm say the same, at their word."""
    sigma = np.tile(np.linspace(0.1, 1, SIZE[1], dtype=np.float32), (SIZE[0], 1))

    def found(worth, **settings):
        return match_external(lambda *pair: (disparity, worth), views, None, External(**settings), None, 0.5)[0]

    expected = found(1 - sigma, least_confidence=0.3)
    for worth, settings in (
        (sigma, {"tells": "doubt", "least_confidence": 0.3}),
        (sigma, {"tells": "sigma"}),
        (sigma**2, {"tells": "variance"}),
        (2 * np.log(sigma), {"tells": "log_variance"}),
    ):
        told = found(worth, **settings)
        torch.testing.assert_close(told.right_sigma_px, expected.right_sigma_px)
        if settings["tells"] == "doubt":
            assert torch.equal(told.valid, expected.valid)
    hole = sigma.copy()
    hole[40:50] = np.nan
    told = found(hole, tells="sigma")
    assert not told.valid.reshape(SIZE)[40:50].any() and told.valid.any() and told.right_sigma_px.isfinite().all()
    with pytest.raises(SettingError, match="confidence = -2 to -1: expected 0 to inf"):
        found(sigma * 0 - 1 - (sigma > 0.5), tells="variance")


def test_a_function_sees_both_images(disparity, images, views):
    seen = []

    def matcher(left, right):
        seen.extend([left, right])
        return torch.from_numpy(disparity)

    match_external(matcher, views, nearest_range_m=0.5)
    for view, image in zip(seen, images, strict=True):
        assert view.dtype == np.float32 and view.shape == (*SIZE, 3)
        np.testing.assert_array_equal(view, image.movedim(0, -1).numpy())


def test_a_function_by_its_name(views):
    assert load_matcher("numpy:zeros") is np.zeros
    with pytest.raises(SettingError, match=r"matcher\.source = numpy:nothing"):
        load_matcher("numpy:nothing")
    with pytest.raises(SettingError, match="can be imported"):
        load_matcher("no_such_module_at_all:match")
    with pytest.raises(SettingError, match=r"package\.module:function"):
        load_matcher("numpy")
    with pytest.raises(SettingError, match=r"disparity\.shape"):  # numpy.minimum(left, right) has three axes
        match_external("numpy:minimum", views)


@pytest.mark.parametrize("camera", [Pinhole.from_fov(90.0, 100.0), Fisheye.from_fov(120.0, 100.0)], ids=["pin", "fish"])
@pytest.mark.parametrize("retina", [LogPolar(2000), Uniform(2000)], ids=["log_polar", "uniform"])
def test_verged_eyes_see_rectified_views(camera, retina, generator):
    """A wall at a constant depth has one disparity in the rectified view, whatever the vergence."""
    rig, depth = verged(0.2, 0.2), 1.5
    images = torch.rand(2, 1, 160, 160, generator=generator, dtype=torch.float64)
    size_focal = camera.focal_px * 160 / 200
    views = []

    def matcher(left, right):
        views.append((left, right))
        return np.full(left.shape[:2], size_focal * 0.2 / depth)

    matches, field = match_external(matcher, verged_views(*images, rig, camera, retina.radius_px), retina)
    assert views[0][0].shape == views[0][1].shape == (*field.disparity.shape, 3)
    rays = camera.rays(matches.left_px) @ rig.R_left.T
    point = rays / rays[:, 2:] * depth - torch.tensor([0.2, 0, 0], dtype=torch.float64)
    right = camera.project(point @ rig.R_right)
    ahead = (rays[:, 2] > 0) & (rays[:, :2].abs().amax(-1) < math.tan(math.radians(70)) * rays[:, 2])
    seen = ahead & (right.norm(dim=-1) <= 100)
    assert (matches.valid == seen).double().mean() > 0.98
    torch.testing.assert_close(matches.right_px[matches.valid], right[matches.valid], atol=1e-4, rtol=0)
    assert all(t.isfinite().all() for t in matches[:4])


def test_nothing_found_is_well_formed(views):
    nothing = np.full(SIZE, np.nan)
    found, _ = match_external(lambda left, right: nothing, views, LogPolar(800))
    assert not found.valid.any()
    assert all(t.isfinite().all() for t in found[:4])


def test_bad_files_are_named(tmp_path, disparity, views):
    bad = {
        "three.npy": lambda p: np.save(p, np.zeros((2, 3, 4))),
        "words.npy": lambda p: np.save(p, np.array([["a", "b"]])),
        "two.npz": lambda p: np.savez(p, a=disparity, b=disparity),
        "loud.npz": lambda p: np.savez(p, disparity=disparity, confidence=np.full(SIZE, 255.0)),
        "other.npz": lambda p: np.savez(p, disparity=disparity, confidence=np.zeros((2, 2))),
        "broken.npz": lambda p: p.write_bytes(b"PK nothing"),
        "text.npy": lambda p: p.write_text("no array"),
        "colour.pfm": lambda p: p.write_bytes(b"PF\n2 2\n-1\n" + bytes(48)),
        "short.pfm": lambda p: p.write_bytes(b"Pf\n20 20\n-1\n" + bytes(4)),
        "empty.pfm": lambda p: p.write_bytes(b""),
        "map.txt": lambda p: p.write_text("1 2"),
        "map.png": lambda p: p.write_bytes(b"no image"),
    }
    for name, write in bad.items():
        write(tmp_path / name)
        with pytest.raises(SettingError, match=name.replace(".", r"\.")):
            load_disparity(tmp_path / name)
    with pytest.raises(SettingError, match="an existing file"):
        load_disparity(tmp_path / "missing.npy")
    np.save(tmp_path / "small.npy", disparity[:20])
    with pytest.raises(SettingError, match=r"disparity\.shape"):
        match_external(tmp_path / "small.npy", views)


def test_bad_answers_and_settings_are_named(tmp_path, disparity, images, views):
    left, right = images

    def answer(value):
        return lambda left, right: value

    cases = [
        (answer(disparity[:5]), "disparity.shape"),
        (answer((disparity, disparity * 0 + 7)), "confidence"),
        (answer((disparity, disparity, disparity)), "3 values"),
        (answer("depth"), "disparity"),
    ]
    for matcher, message in cases:
        with pytest.raises(SettingError, match=message):
            match_external(matcher, views)
    eyes = verged_views(left, right, verged(0.1, 0.2), Pinhole.from_fov(90.0, 100.0), 100.0)
    for source, message in (
        (answer(disparity), r"disparity\.shape"),
        (3, "a function"),
        (tmp_path / "d.npz", "for a rectified pair, a disparity file"),
    ):
        with pytest.raises(SettingError, match=message):
            match_external(source, eyes, LogPolar(800))
    for name, value in {
        "sure_px": -1.0, "unsure_px": -0.5, "power": 0.0, "least_confidence": 2.0, "edge_px": 0.0,
        "rectified_fov_deg": 170.0, "scale": 0.0, "tells": "certainty",
    }.items():  # fmt: skip
        with pytest.raises(SettingError, match=f"matcher.{name}"):
            External(**{name: value})
    with pytest.raises(SettingError, match=r"least_confidence = 0\.5: expected 0 where the matcher tells a sigma"):
        External(tells="sigma", least_confidence=0.5)
