import math

import numpy as np
import pytest
import torch

from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.stereo.confidence import BLOCK_PX, REACH_WIDTHS, field_clues, read_clues
from torchfovea.stereo.readings import standing_out

RETINAS = [LogPolar(6000), Uniform(3000), LogPolar(3000, uniform_fovea=True)]
PITCH = 0.8


def plane(retina):
    x, y = retina.centers_px(dtype=torch.float64).unbind(-1)
    return (20 + 0.3 * x - 0.2 * y)[None]


@pytest.mark.parametrize("retina", RETINAS, ids=["log_polar", "uniform", "uniform_fovea"])
def test_a_plane_is_no_clue_and_an_edge_bends_by_half_its_step(retina):
    values = plane(retina)
    valid, unit = torch.ones_like(values) > 0, torch.ones_like(values)
    flat = field_clues(values, valid, unit, retina, PITCH)
    # places are those of the nearest RFs: a part of a width is left of a slant of 0.36
    width = retina.width_px(retina.centers_px(dtype=torch.float64)).clamp(min=PITCH)
    inner = retina.centers_px(dtype=torch.float64).norm(dim=-1) < retina.radius_px - 4 * width
    assert (flat.bend_px[0] < 0.3 * width)[inner].all()
    assert (flat.gap_px == 0).all()
    x = retina.centers_px(dtype=torch.float64)[:, 0]
    edge = field_clues(values + 40.0 * (x > 0), valid, 3 * unit, retina, PITCH)
    beside = inner & (x.abs() < width) & (x.abs() > 0.01)
    assert beside.any()
    # among the narrowest RFs, which the table of the nearest does not tell apart, a mirrored place may fall short
    assert ((edge.bend_px[0, beside] - 60.0).abs() < 6.0).double().mean() > 0.85
    away = inner & (x.abs() > (REACH_WIDTHS + 1.5) * width)
    assert away.any()
    assert (edge.bend_px[0] < width)[away].all()


def test_holes_are_counted_but_not_what_lies_beyond_the_retina():
    retina = Uniform(3000)
    values = plane(retina)
    hole = torch.zeros_like(values) > 0
    found = field_clues(values, hole, torch.ones_like(values), retina, PITCH)
    assert (found.bend_px == 0).all()
    reach = REACH_WIDTHS * retina.width_px(torch.zeros(1, 2)).item() / PITCH
    middle = retina.centers_px().norm(dim=-1) < retina.radius_px / 2
    torch.testing.assert_close(found.gap_px[0, middle], torch.full_like(found.gap_px[0, middle], reach))
    rim = retina.centers_px().norm(dim=-1) > 0.99 * retina.radius_px
    assert (found.gap_px[0, rim] < 0.8 * reach).all()
    half = retina.centers_px()[:, 0] < 0
    found = field_clues(values, half[None], torch.ones_like(values), retina, PITCH)
    near = middle & half & (retina.centers_px()[:, 0] > -0.6 * math.sqrt(0.5) * reach * PITCH)
    torch.testing.assert_close(found.gap_px[0, near].mean().item() / reach, 3 / 8, atol=0.05, rtol=0)


def test_where_the_images_misfit_the_circle_reaches_beyond_a_rim_that_was_extended():
    """A strip of 40 px that is 8 px nearer than the slanted wall around it, read in its middle, 20 px from its rims."""
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    wall = 5 + 0.05 * x - 0.02 * y
    strip = (x - 80).abs() < 20
    place, width_px = torch.tensor([[80.0, 60.0], [80.0, 60.0], [80.0, 60.0]]), torch.full((3,), 2.0)
    misfit = torch.tensor([0.0, 2.0, 5.0])
    found = {}
    for name, values in (("plane", wall), ("strip", wall + 8 * strip)):
        field = Disparity(torch.zeros_like(wall), values, wall > 0, Pinhole(100.0), 0.0, 0.1)
        found[name] = read_clues(field, place, values[60, 80].expand(3), width_px, misfit)
        told = read_clues(field, place, values[60, 80].expand(3), width_px)
        assert torch.equal(told.bend_px, found[name].bend_px[:1].expand(3))
    assert (found["plane"].bend_px < 0.1).all()  # places are whole pixels
    torch.testing.assert_close(found["strip"].fringe_px, torch.tensor([0.0, 0.0, 8.0]), atol=0.1, rtol=0)
    assert (found["strip"].gap_px == 0).all()
    hole = Disparity(torch.zeros_like(wall), wall, strip, Pinhole(100.0), 0.0, 0.1)
    gap = read_clues(hole, place, wall[60, 80].expand(3), width_px, misfit).gap_px
    assert gap[:2].tolist() == [0.0, 0.0]
    reach = math.sqrt(25**2 + 2**2 + BLOCK_PX**2)
    assert gap[2].item() == pytest.approx(reach * 2 / 8)  # left and right; the diagonals fall short of the rim


def test_misfit_is_counted_in_the_noises_own_standard_deviations():
    """Against NumPy: differences of windows of 40 samples of noise that falls with the width; no level is told."""
    rng = np.random.default_rng(0)
    width = np.repeat([0.5, 1.0, 2.0, 4.0], 2000)
    rest = rng.chisquare(40, width.size) / 40 / np.maximum(width, 1) ** 2
    rest[::50] *= 9
    found = torch.as_tensor(rng.random(width.size) < 0.9)
    told = standing_out(torch.as_tensor(rest), torch.as_tensor(width), found)
    level = np.log(rest * np.maximum(width, 1) ** 2)
    expected = (level - np.median(level)) / np.std(level[np.arange(width.size) % 50 > 0])
    high = found.numpy() & (expected > 1)
    np.testing.assert_allclose(told.numpy()[high], expected[high], atol=0.25, rtol=0.1)
    assert (told[~found] == 0).all() and (told >= 0).all()
    torch.testing.assert_close(standing_out(0.01 * torch.as_tensor(rest), torch.as_tensor(width), found), told)
    nothing = torch.zeros(5)
    assert (standing_out(nothing, nothing + 1, nothing == 0) == 0).all()
