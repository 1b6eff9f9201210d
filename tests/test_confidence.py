import math

import pytest
import torch

from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.stereo.confidence import REACH_WIDTHS, field_clues

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
