"""Retinal layouts and sampling against the paper's formulas, NumPy integration and OpenCV's polar warp."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torchfovea.sensing.retina import LogPolar, Uniform, cortical, covered, fovea, interpolate, reconstruct
from torchfovea.setting import SettingError

LAYOUTS = [
    LogPolar(),
    LogPolar(2000),
    LogPolar(300),
    LogPolar(uniform_fovea=True),
    LogPolar(4000, rho_min_px=20.0, uniform_fovea=True),
    Uniform(),
    Uniform(300),
]
SMALL = [LogPolar(300), LogPolar(1000, rho_min_px=5.0, uniform_fovea=True), Uniform(300)]


def name(retina):
    fovea_ = "-fovea" if getattr(retina, "uniform_fovea", False) else ""
    return f"{type(retina).__name__}{fovea_}-{retina.receptive_fields}"


def smooth_image(height, width, waves=12, seed=0, shortest=12.0):
    """A sum of plane waves, as a function of (x, y) and as pixels."""
    rng = np.random.default_rng(seed)
    frequency = 2 * math.pi / rng.uniform(shortest, 80, waves)
    angle, phase = rng.uniform(0, 2 * math.pi, (2, waves))

    def value(x, y):
        wave = frequency * (np.cos(angle) * x[..., None] + np.sin(angle) * y[..., None]) + phase
        return np.cos(wave).mean(-1)

    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return value, torch.as_tensor(value(x, y))[None, None]


# ------------------------------------------------------------------------------------------------------------- layouts


def test_log_polar_follows_the_design():
    retina = LogPolar()
    rings, sectors = retina.shape
    a = 100 ** (1 / rings)
    assert retina.base == pytest.approx(a) and retina.count == rings * sectors
    assert (a - 1) / (2 * math.pi / sectors) == pytest.approx(1, abs=0.02)
    px = retina.centers_px(dtype=torch.float64)
    for i in (0, 1, rings // 2, rings - 1):
        for s in (0, 1, sectors - 1):
            rho, theta = a ** (i + 0.5), 2 * math.pi * (s + 0.5) / sectors
            place = px[i * sectors + s]
            assert place.tolist() == pytest.approx([rho * math.cos(theta), rho * math.sin(theta)])
            assert retina.width_px(place).item() == pytest.approx(a**i * (a - 1))
    assert retina.width_px(torch.zeros(2)).item() == pytest.approx(a - 1)


def test_authors_uniform_fovea_has_their_numbers():
    retina = LogPolar(uniform_fovea=True)
    assert retina.shape == (143, 196) and retina.fovea_count == 58**2 and retina.count == 31392
    centers = retina.centers_px(dtype=torch.float64)
    inner = centers[: retina.fovea_count]
    assert inner.norm(dim=-1).max() <= 1 < centers[retina.fovea_count :].norm(dim=-1).min()
    # the disc's area is shared out equally, at about the first ring's width
    assert retina.fovea_count * retina.fovea_pitch_px**2 == pytest.approx(math.pi, rel=0.01)
    assert retina.fovea_pitch_px == pytest.approx(retina.base - 1, rel=0.1)


@settings(max_examples=60, deadline=None)
@given(st.integers(800, 200_000), st.booleans())  # of those below, 302, 317, 327, ... 788 are no such product
@example(5000, True)
def test_any_budget_is_met(budget, uniform_fovea):
    retina = LogPolar(budget, uniform_fovea=uniform_fovea)
    assert abs(retina.count - budget) <= 0.005 * budget
    assert len(retina.centers_px()) == retina.count


@settings(max_examples=40, deadline=None)
@given(st.integers(200, 60_000), st.floats(1, 1000))
def test_uniform_fills_the_disc(budget, radius):
    retina = Uniform(budget, radius)
    px = retina.centers_px(dtype=torch.float64)
    assert len(px) == retina.count and abs(retina.count / budget - 1) <= 0.005
    assert retina.inside(px * (1 - 1e-12)).all()
    assert retina.count * retina.pitch_px**2 == pytest.approx(math.pi * radius**2, rel=0.12)
    step = (px - px[0]) / retina.pitch_px
    assert torch.allclose(step, step.round(), atol=1e-6)
    assert len(torch.unique(step.round(), dim=0)) == retina.count


def test_uniform_default_is_the_pixel():
    retina = Uniform()
    assert retina.pitch_px == pytest.approx(1, abs=1e-5) and retina.shape == (200, 200)
    assert torch.equal(retina.width_px(torch.rand(3, 4, 2)), torch.full((3, 4), retina.pitch_px))


@pytest.mark.parametrize("retina", LAYOUTS, ids=name)
def test_width_is_continuous_and_differentiable(retina):
    rho = torch.linspace(0, 120, 20001, dtype=torch.float64)
    width = retina.width_px(torch.stack([rho, torch.zeros_like(rho)], -1))
    assert (width > 0).all() and (width.diff() >= 0).all() and width.diff().max() < 0.01
    px = torch.tensor([[0.0, 0.0], [30.0, -4.0]], dtype=torch.float64, requires_grad=True)
    if isinstance(retina, LogPolar):
        (gradient,) = torch.autograd.grad(retina.width_px(px).sum(), px)
        assert gradient.isfinite().all()


def test_centers_keep_device_dtype_and_work_after_inference():
    retina = LogPolar(512)
    with torch.inference_mode():
        assert fovea(torch.rand(1, 1, 20, 20), None, retina).dtype == torch.float32
    image = torch.rand(1, 1, 20, 20, requires_grad=True)
    fovea(image, None, retina).sum().backward()
    assert image.grad is not None and retina.centers_px(dtype=torch.float64).dtype == torch.float64


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: LogPolar(212), "receptive_fields = 212"),
        (lambda: LogPolar(3), "receptive_fields = 3"),
        (lambda: LogPolar(1000.5), "receptive_fields = 1000.5"),
        (lambda: LogPolar(radius_px=0), "radius_px = 0"),
        (lambda: LogPolar(rho_min_px=100), "rho_min_px = 100"),
        (lambda: LogPolar(rho_min_px=-1), "rho_min_px = -1"),
        (lambda: Uniform(2), "receptive_fields = 2"),
        (lambda: Uniform(radius_px=math.inf), "radius_px = inf"),
        (lambda: cortical(torch.rand(1, 1, 300), Uniform(300)), "retina = Uniform"),
        (lambda: cortical(torch.rand(1, 1, 3), LogPolar(300)), "values.shape"),
    ],
)
def test_layout_errors(build, message):
    with pytest.raises(SettingError, match=message):
        build()


# ------------------------------------------------------------------------------------------------------------ sampling


@pytest.mark.parametrize("retina", LAYOUTS, ids=name)
@pytest.mark.parametrize("scale", [0.7, 1.0, 1.3])
@pytest.mark.parametrize("size", [(300, 420), (301, 421)])
def test_a_ramp_gives_the_centres(retina, scale, size):
    """Every level of the pyramid is aligned: an image of coordinates is read as the RFs' own."""
    height, width = size
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    gaze = torch.tensor([[205.3, 150.2]], dtype=torch.float64)
    seen = fovea(torch.stack([x, y])[None], gaze, retina, scale)[0].T
    expected = gaze + scale * retina.centers_px(dtype=torch.float64)
    reach = scale * retina.width_px(retina.centers_px(dtype=torch.float64))[:, None]
    interior = ((expected > 2 * reach) & (expected < torch.tensor([width, height]) - 1 - 2 * reach)).all(-1)
    assert interior.float().mean() > 0.6
    assert (seen - expected)[interior].abs().max() < 1e-9


@pytest.mark.parametrize("retina", [LogPolar(300), LogPolar(2000), Uniform(400)], ids=name)
def test_rf_averages_what_it_covers(retina):
    """Against numerical integration over the RF's square."""
    value, image = smooth_image(400, 400)
    seen = fovea(image, None, retina)[0, 0].numpy()
    centers = retina.centers_px(dtype=torch.float64)
    width = (2 * retina.width_px(centers)).numpy()
    px = 2 * centers.numpy() + 199.5
    offset = (np.arange(15) - 7) / 15
    dx, dy = np.meshgrid(offset, offset)
    x = px[:, 0, None, None] + width[:, None, None] * dx
    y = px[:, 1, None, None] + width[:, None, None] * dy
    expected = value(x, y).mean((1, 2))
    inside = (np.abs(px - 199.5).max(-1) + width < 199) & (width < 60)
    error = np.sqrt(np.mean((seen - expected)[inside] ** 2))
    of_the_middle = np.sqrt(np.mean((value(px[:, 0], px[:, 1]) - expected)[inside] ** 2))
    assert error < 0.25 * of_the_middle
    assert error < 0.15 * expected[inside].std() and np.corrcoef(seen[inside], expected[inside])[0, 1] > 0.99


def test_log_polar_agrees_with_opencv_warp_polar():
    """Ring by ring, for OpenCV's own log-polar law is another: columns proportional to log(ρ + 1)."""
    _, image = smooth_image(400, 400, shortest=30)
    retina = LogPolar(20_000, radius_px=180.0)
    rings, sectors = retina.shape
    seen = cortical(fovea(image, torch.tensor([[200.0, 201.0]]), retina, scale=1.0), retina)[0, 0]
    for ring in range(0, rings, 7):
        rho = retina.base ** (ring + 0.5)
        polar = cv2.warpPolar(
            image[0, 0].float().numpy(), (2, 2 * sectors), (200, 201), 2 * rho, cv2.WARP_POLAR_LINEAR | cv2.INTER_LINEAR
        )
        expected = torch.as_tensor(polar[1::2, 1].copy()).double()
        # both read the image itself where RFs are narrow, but OpenCV rounds the place to 1/32 px; wide RFs average
        narrow = retina.base**ring * (retina.base - 1) < 2
        assert (seen[ring] - expected).abs().max() < (3e-3 if narrow else 0.05)


@pytest.mark.parametrize("retina", SMALL, ids=name)
def test_batches_equal_loops(retina):
    image = torch.rand(3, 2, 60, 50)
    gaze = torch.tensor([[20.0, 30.0], [24.5, 29.5], [-5.0, 61.0]])
    together = fovea(image, gaze, retina)
    one_image = fovea(image[:1], gaze, retina)
    assert together.shape == (3, 2, retina.count)
    for i in range(3):
        alone = fovea(image[i : i + 1], gaze[i : i + 1], retina)
        torch.testing.assert_close(together[i : i + 1], alone)
        torch.testing.assert_close(one_image[i : i + 1], fovea(image[:1], gaze[i : i + 1], retina))
    middle = torch.tensor([[24.5, 29.5]]).expand(3, 2)
    torch.testing.assert_close(fovea(image, None, retina), fovea(image, middle, retina))
    double = fovea(image.double(), gaze.double(), retina)
    torch.testing.assert_close(together.double(), double, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("retina", [LogPolar(4000), Uniform(4000)], ids=name)
def test_half_precision_is_rounded_once(retina, dtype):
    """Of an image of half precision, whose pixels add up to more than float16 holds, only the result is rounded."""
    image = torch.rand(1, 1, 400, 400).to(dtype)
    gaze = torch.tensor([[210.3, 180.7]])
    for looked in (None, gaze):
        seen = fovea(image, looked, retina)
        assert seen.dtype == dtype
        assert torch.equal(seen, fovea(image.float(), looked, retina).to(dtype))
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(fovea(image, gaze, retina), fovea(image.float(), gaze, retina).to(dtype))


@pytest.mark.parametrize("retina", [LogPolar(200), LogPolar(300, uniform_fovea=True), Uniform(64)], ids=name)
def test_gradients(retina):
    torch.manual_seed(0)
    image = torch.rand(2, 1, 13, 16, dtype=torch.float64, requires_grad=True)
    gaze = torch.tensor([[7.137, 5.911], [6.321, 6.757]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda i, g: fovea(i, g, retina), (image, gaze), fast_mode=True)
    assert torch.autograd.gradcheck(lambda i: fovea(i, None, retina), (image,), fast_mode=True)
    values = torch.rand(1, 2, retina.count, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: reconstruct(v, retina, (9, 12))[0], (values,), fast_mode=True)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.floats(0.01, 20), st.floats(-100, 100), st.floats(-100, 100))
def test_values_stay_within_the_image(height, width, scale, u, v):
    """Averages of pixels, wherever the retina looks and however small the image."""
    image = torch.rand(1, 1, height, width, dtype=torch.float64)
    for retina in SMALL:
        seen = fovea(image, torch.tensor([[u, v]]), retina, scale)
        assert seen.isfinite().all()
        assert image.min() - 1e-9 <= seen.min() and seen.max() <= image.max() + 1e-9


def test_beyond_the_border():
    retina = Uniform(300)
    image = torch.zeros(1, 1, 40, 60)
    image[..., -1] = 1
    gaze = torch.tensor([[59.0, 20.0], [1000.0, 20.0]])
    seen, on = fovea(image, gaze, retina, 0.1), covered(retina, (40, 60), gaze, 0.1)
    px = gaze[:, None] + 0.1 * retina.centers_px()
    expected = (px[..., 0] >= -0.5) & (px[..., 0] <= 59.5) & (px[..., 1] >= -0.5) & (px[..., 1] <= 39.5)
    assert torch.equal(on, expected) and not on[1].any() and on[0].any()
    assert torch.equal(seen[1], torch.ones_like(seen[1])) and (seen[0, 0][~on[0]] == 1).all()
    assert covered(retina, (40, 60), None).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: fovea(torch.rand(3, 8, 8), None, r), "image.shape"),
        (lambda r: fovea(torch.zeros(1, 1, 8, 8, dtype=torch.uint8), None, r), "image.dtype"),
        (lambda r: fovea(torch.full((1, 1, 8, 8), math.nan), None, r), "image = NaN"),
        (lambda r: fovea(torch.full((1, 1, 8, 8), -math.inf), None, r), "image = NaN"),
        (lambda r: fovea(torch.rand(1, 1, 8, 8), torch.tensor([1.0, 2.0]), r), "gaze_px.shape"),
        (lambda r: fovea(torch.rand(3, 1, 8, 8), torch.rand(2, 2), r), "gaze_px.shape"),
        (lambda r: fovea(torch.rand(1, 1, 8, 8), torch.tensor([[math.nan, 0.0]]), r), "gaze_px = NaN"),
        (lambda r: fovea(torch.rand(1, 1, 8, 8), None, r, scale=0.0), "scale = 0"),
        (lambda r: covered(r, (8, 8), torch.zeros(2)), "gaze_px.shape"),
        (lambda r: reconstruct(torch.rand(1, 1, 5), r, 8), "values.shape"),
        (lambda r: reconstruct(torch.rand(1, 1, r.count), r, 0), "size"),
        (lambda r: interpolate(torch.rand(r.count), r, torch.zeros(2)), "values.shape"),
    ],
)
def test_sampling_errors(call, message):
    with pytest.raises(SettingError, match=message):
        call(LogPolar(300))


# ------------------------------------------------------------------------------------------------------ reconstruction


@pytest.mark.parametrize("retina", LAYOUTS, ids=name)
def test_interpolation_returns_the_rfs_at_their_centres(retina):
    values = torch.rand(2, 3, retina.count, dtype=torch.float64)
    torch.testing.assert_close(interpolate(values, retina, retina.centers_px(dtype=torch.float64)), values)


@pytest.mark.parametrize("retina", LAYOUTS, ids=name)
def test_a_constant_stays_constant(retina):
    image, mask = reconstruct(torch.full((1, 1, retina.count), 0.7), retina, (50, 64))
    x, y = np.meshgrid(np.arange(64) - 31.5, np.arange(50) - 24.5)
    assert np.array_equal(mask.numpy(), np.hypot(x, y) / 0.25 <= 100)
    torch.testing.assert_close(image[0, 0][mask], torch.full((int(mask.sum()),), 0.7))
    assert (image[0, 0][~mask] == 0).all()


@pytest.mark.parametrize("retina", [LogPolar(), LogPolar(uniform_fovea=True), Uniform()], ids=name)
def test_round_trip_where_the_retina_is_finer(retina):
    _, image = smooth_image(100, 100, shortest=16)
    back, mask = reconstruct(fovea(image, None, retina), retina, 100)
    x, y = np.meshgrid(np.arange(100) - 49.5, np.arange(100) - 49.5)
    fine = mask & torch.as_tensor(np.hypot(x, y) < 47)
    error = (back - image)[0, 0][fine].abs()
    # two bilinear readings of waves of 16 px and more, in an image that spans −1 to 1
    assert error.max() < 0.06 and error.mean() < 0.01


def test_wraps_around_in_angle_and_fills_the_centre():
    retina = LogPolar(2000)
    rings, sectors = retina.shape
    theta = 2 * math.pi * (torch.arange(sectors).double() + 0.5) / sectors
    values = torch.cos(theta).expand(rings, -1).reshape(1, 1, -1)
    angle = torch.linspace(-0.2, 0.2, 41, dtype=torch.float64)
    px = 40 * torch.stack([angle.cos(), angle.sin()], -1)
    # linear interpolation of a cosine at this spacing
    assert (interpolate(values, retina, px)[0, 0] - angle.cos()).abs().max() < (2 * math.pi / sectors) ** 2 / 8 + 1e-9
    # inside ring 0 towards its mean, which is 0 here, linearly
    inner = math.sqrt(retina.base) * torch.tensor([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]], dtype=torch.float64)
    centre = interpolate(values, retina, inner)[0, 0]
    assert centre[2].abs() < 1e-12 and centre[1] == pytest.approx(centre[0].item() / 2)


def test_rings_and_sectors_can_be_given():
    assert LogPolar(1000).count == 999  # whole rings and sectors, squarest within half a per cent
    retina = LogPolar(grid=(20, 50))
    assert retina.count == 1000 and retina.shape == (20, 50) and len(retina.centers_px()) == 1000
    for bad in ((0, 50), (20, 2), (100_000, 1000)):
        with pytest.raises(SettingError, match=r"sensor\.grid"):
            LogPolar(grid=bad)
    with pytest.raises(SettingError, match=r"sensor\.grid"):
        LogPolar(grid=(2, 500))  # far from square
    with pytest.raises(SettingError, match="uniform_fovea"):
        LogPolar(grid=(20, 50), uniform_fovea=True)


def test_cortical_is_the_rings_of_the_retina():
    for retina in (LogPolar(300), LogPolar(300, uniform_fovea=True)):
        rho = retina.centers_px(dtype=torch.float64).norm(dim=-1)
        image = cortical(rho[None, None], retina)
        assert image.shape == (1, 1, *retina.shape)
        assert (image[0, 0].std(-1) < 1e-9).all() and (image[0, 0, :, 0].diff() > 0).all()
