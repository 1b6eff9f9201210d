"""Rivals for one place of the right eye, on pairs whose hidden strip is known to the pixel."""

import pytest
import torch

from torchfovea.sensing.layout import Uniform
from torchfovea.stereo.visibility import NEAR, outdone, undisputed, unrivalled

HEIGHT, WIDTH = 40, 120
NEAR_PX, FAR_PX, EDGE = 20.0, 8.0, 70  # a near thing from column EDGE on; 12 columns left of it are hidden
STRIP = slice(EDGE - 12, EDGE)


def pair(gain=1.0, offset=0.0):
    """Both images; the right one shows the near thing at EDGE − 20 and the background's columns before EDGE − 12."""
    generator = torch.Generator().manual_seed(0)
    left = torch.rand(HEIGHT, WIDTH, generator=generator)
    right = torch.rand(HEIGHT, WIDTH, generator=generator)
    right[:, : EDGE - 20] = left[:, 8 : EDGE - 12]
    right[:, EDGE - 20 : WIDTH - 20] = left[:, EDGE:]
    return left, offset + gain * right


@pytest.mark.parametrize("exposure", [(1.0, 0.0), (0.6, 0.2)])
@pytest.mark.parametrize("extended", [2, 5, 12])
def test_a_near_thing_that_reaches_over_the_hidden_strip_is_cut_back(extended, exposure):
    left, right = pair(*exposure)
    disparity = torch.full((HEIGHT, WIDTH), FAR_PX)
    disparity[:, EDGE - extended :] = NEAR_PX
    valid = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    valid[:, :8] = False
    kept, rival_px = undisputed(left, right, disparity, valid)
    assert kept[:, STRIP].float().mean() < 0.12
    visible = valid.clone()
    visible[:, STRIP] = False
    assert kept[visible].float().mean() > 0.97  # a column on either side sees the strip with its neighbourhood
    beside = slice(EDGE - extended - 6, EDGE - extended)
    assert (rival_px[:, beside] == NEAR_PX - FAR_PX).float().mean() > 0.5
    assert (rival_px[:, EDGE + 20 :] == 0).all() and (rival_px[:, 8:30] == 0).all()


def test_outdone_against_a_loop(generator):
    count, shape = 300, (6, 25)
    cell = torch.stack([torch.randint(-2, 27, (1, count), generator=generator),
                        torch.randint(-1, 7, (1, count), generator=generator)], -1)  # fmt: skip
    disparity = 10 * torch.rand(1, count, generator=generator, dtype=torch.float64)
    misfit = torch.rand(1, count, generator=generator, dtype=torch.float64)
    valid = torch.rand(1, count, generator=generator) < 0.8
    out, dispute = outdone(cell, shape, disparity, misfit, valid)
    places = cell[0].tolist()
    inside = [bool(valid[0, i]) and 0 <= u < shape[1] and 0 <= v < shape[0] for i, (u, v) in enumerate(places)]
    best = {}
    for i, (u, v) in enumerate(places):
        if inside[i] and ((u, v) not in best or misfit[0, i] < misfit[0, best[u, v]]):
            best[u, v] = i
    for i, (u, v) in enumerate(places):
        lost, most = False, 0.0
        for k in range(-NEAR, NEAR + 1):
            j = best.get((u + k, v))
            if inside[i] and j is not None:
                differs = abs(float(disparity[0, i] - disparity[0, j]))
                if differs > 0.5 + abs(k):
                    most, lost = max(most, differs), lost or bool(1.5 * misfit[0, j] < misfit[0, i])
        assert bool(out[0, i]) == lost
        assert float(dispute[0, i]) == pytest.approx(most)


def test_fields_on_one_surface_do_not_dispute(generator):
    retina = Uniform(3000)
    left_px = retina.centers_px()[None]
    disparity = 5 + 0.2 * left_px[..., 0]
    right_px = torch.stack([left_px[..., 0] - disparity, left_px[..., 1]], -1)
    misfit = torch.rand(disparity.shape, generator=generator)
    valid = torch.ones_like(disparity) > 0
    kept, hidden_px = unrivalled(retina, 1.0, right_px, disparity, misfit, valid)
    assert kept.all() and (hidden_px == 0).all()
