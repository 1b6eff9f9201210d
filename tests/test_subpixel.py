"""The refinement on walls whose disparity is known, with textures that are sums of waves and exact noise."""

import math

import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.layout import Uniform
from torchfovea.stereo.acuity import acuity
from torchfovea.stereo.costs import Eye
from torchfovea.stereo.sheets import sheets
from torchfovea.stereo.subpixel import Neighbourhood, subpixel

SIZE, BASELINE_M, FOCAL_PX = 120, 0.1, 200.0
RETINA = Uniform(round(math.pi * SIZE**2 / 4), radius_px=SIZE / 2)  # an RF is about a pixel
CAMERA = Pinhole(FOCAL_PX)


def picture(shift_px, seed, finest_px=5.0):
    """A texture at columns moved by a shift, (H, W), about 0 with a standard deviation of 1."""
    rng = np.random.default_rng(seed)
    wave = finest_px * 8 ** rng.uniform(size=60)
    turn, phase = rng.uniform(0, 2 * math.pi, (2, 60))
    y, x = np.meshgrid(np.arange(SIZE), np.arange(SIZE) + shift_px, indexing="ij")
    waves = np.cos(2 * math.pi / wave * (x[..., None] * np.cos(turn) + y[..., None] * np.sin(turn)) + phase)
    return torch.from_numpy(waves.sum(-1) / math.sqrt(30))


def refined(true_px, start_px, contrast=0.15, noise=0.0, gain=1.0, seed=0):
    """Offsets away from the border: error, standard deviation [px], correlation, and what is left of the difference."""
    generator = torch.Generator().manual_seed(seed)
    left, right = picture(0.0, seed), picture(true_px, seed)
    pair = torch.stack([0.5 + contrast * left, 0.4 + gain * contrast * right])[:, None]
    pair = pair + noise * torch.randn(pair.shape, generator=generator, dtype=pair.dtype)
    middle = ((SIZE - 1) / 2, (SIZE - 1) / 2)
    levels = acuity(pair, RETINA, 1.0, middle)
    same, ahead = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    shift = torch.tensor([[-BASELINE_M, 0.0, 0.0]], dtype=torch.float64)
    eye = Eye(CAMERA, CAMERA, same, shift, ahead, levels[:1], levels[1:], RETINA, 1.0, middle)
    (sheet,) = sheets(RETINA, 1.0, torch.device("cpu"), torch.float64)
    reach = FOCAL_PX * BASELINE_M
    surface = torch.full_like(sheet.width_px, start_px / reach)[None]
    unit = sheet.width_px[None] / reach
    found = subpixel(eye, sheet, surface, unit, torch.ones_like(surface) > 0, Neighbourhood(2, 0.004, 0.2))
    inner = (sheet.px.norm(dim=-1) < SIZE / 2 - 14)[None]
    error = (surface + found.value * unit - true_px / reach) * reach
    return error[inner], (found.variance.sqrt() * unit * reach)[inner], found.correlation[inner], found.rest[inner]


@pytest.mark.parametrize("true_px", [6.0, 6.25, 6.5, 6.8])
@pytest.mark.parametrize("off_px", [-0.4, 0.0, 0.25])
def test_a_start_off_by_parts_of_a_pixel_is_mended_whatever_the_exposure(true_px, off_px):
    for gain in (1.0, 0.6):
        error, sigma, correlation, _ = refined(true_px, true_px + off_px, gain=gain)
        # what is left: a part of the start's error, and what bilinear reading does to a texture
        assert error.abs().median() < 0.03 + 0.15 * abs(off_px)
        assert error.median().abs() < 0.02 + 0.15 * abs(off_px)
        assert sigma.median() < 0.12
        assert correlation.median() > 0.98


def test_the_standard_deviation_is_that_of_the_errors():
    """Texture and noise of several strengths; 0.67 is a Gaussian's median, errors of neighbours are alike."""
    for contrast, noise in ((0.15, 0.02), (0.06, 0.02), (0.15, 0.06)):
        z = []
        for seed in range(3):
            error, sigma, *_ = refined(6.3, 6.3, contrast, noise, seed=seed)
            z.append((error / sigma).abs())
        assert 0.3 < torch.cat(z).median() < 1.0


def test_weak_texture_widens_the_standard_deviation_without_a_bound_of_its_own():
    clear, weak, none = (refined(6.3, 6.3, contrast, 0.02)[1].median() for contrast in (0.15, 0.02, 0.0))
    assert clear < 0.15
    assert weak > 2.5 * clear
    assert none > 0.7


def test_what_is_left_of_the_difference_is_noise_where_the_match_is_right():
    """Both images' noise is left; of a match that is 10 px off, the texture too, weak as it is."""
    noise = 0.02
    nothing, right, wrong = (
        refined(6.3, start, contrast, noise)[3].median().item()
        for start, contrast in ((6.3, 0.0), (6.3, 0.03), (16.3, 0.03))
    )
    assert nothing < 2 * noise**2  # images are read between pixels, which averages some of it away
    assert 0.8 * nothing < right < 1.1 * nothing  # the step takes a little of the noise for an offset
    assert wrong > 1.5 * right
