"""Information gain and costs against plain loops."""

import math
import time

import numpy as np
import pytest
import torch
from scipy import stats

from torchfovea.deciding import infomax as im
from torchfovea.setting import SettingError

dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def sphere(n, seed=0, dtype=torch.float64):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator(seed), dtype=dtype), dim=-1)


def test_information_gain_is_the_entropy_a_measurement_removes(monkeypatch):
    monkeypatch.setattr(im, "_BLOCK", 40)
    g = generator()
    variance = torch.rand(2, 9, generator=g, dtype=torch.float64)
    precision = torch.rand(2, 7, 9, generator=g, dtype=torch.float64) * 10
    precision[0, 2, 3] = 0
    eligible = torch.rand(2, 9, generator=g) > 0.3
    gain = im.information_gain(variance, precision, eligible)
    for b in range(2):
        for i in range(7):
            total = 0.0
            for j in range(9):
                if eligible[b, j]:
                    posterior = 1 / (1 / variance[b, j].item() + precision[b, i, j].item())
                    total += stats.norm.entropy(scale=variance[b, j].item() ** 0.5)
                    total -= stats.norm.entropy(scale=posterior**0.5)
            assert gain[b, i].item() == pytest.approx(total, abs=1e-12)
    shared = im.information_gain(variance, precision[1], eligible)
    torch.testing.assert_close(shared[1], gain[1])
    alone = im.information_gain(variance[0], precision[0])
    torch.testing.assert_close(alone, im.information_gain(variance, precision)[0])
    v, p = variance.clone().requires_grad_(), precision.clone().requires_grad_()
    assert torch.autograd.gradcheck(im.information_gain, (v, p))


def acuity(sigma_fovea, sigma_per_rad):
    return lambda angle: torch.sqrt(sigma_fovea**2 + (sigma_per_rad * angle) ** 2)


@dtypes
def test_precision_falls_with_eccentricity(dtype):
    cells, candidates = sphere(30, dtype=dtype), sphere(11, 1, dtype)
    candidates = torch.cat([candidates, cells[:1], -cells[:1]])
    precision = im.precision_by_eccentricity(candidates, cells, acuity(0.01, 0.3), 0.8)
    for i, c in enumerate(candidates.double().numpy()):
        for j, x in enumerate(cells.double().numpy()):
            angle = math.atan2(np.linalg.norm(np.cross(c, x)), c @ x)
            expected = 1 / (0.01**2 + (0.3 * angle) ** 2) if angle <= 0.8 else 0.0
            assert precision[i, j].item() == pytest.approx(expected, rel=1e-4 if dtype == torch.float32 else 1e-9)
    candidates.requires_grad_()  # one of them on a cell, and one opposite to it
    (gradient,) = torch.autograd.grad(
        im.precision_by_eccentricity(candidates, cells, acuity(0.01, 0.3)).sum(), candidates
    )
    assert torch.isfinite(gradient).all()


def test_a_fovea_looks_where_it_knows_least():
    cells = sphere(400)
    variance = torch.full((400,), 1e-4, dtype=torch.float64)
    variance[(cells @ cells[17]) > 0.95] = 1.0
    gain = im.information_gain(variance, im.precision_by_eccentricity(cells, cells, acuity(0.01, 1.0), 0.7))
    assert cells[gain.argmax()] @ cells[17] > 0.95
    assert gain[17] > 5 * gain[(cells @ cells[17]).argmin()]


def test_information_gain_of_two_thousand_by_two_thousand_is_cheap():
    variance, precision = torch.rand(2000), torch.rand(2000, 2000)
    start = time.process_time()  # the processor's, which a busy machine does not change
    im.information_gain(variance, precision)
    assert time.process_time() - start < 5  # tens of milliseconds


def test_costs():
    forward = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    directions = torch.tensor([[1.0, 0, 0], [0, 3.0, 0], [-1.0, 0, 0], [1.0, 1.0, 0]]).double().requires_grad_()
    degrees = im.saccade_degrees(forward, directions)
    assert degrees.tolist() == pytest.approx([0, 90, 180, 45])
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(degrees.sum(), (forward, directions)))
    assert im.saccade_degrees(forward.expand(5, 3), directions).shape == (5, 4)
    assert im.saccade_seconds(degrees).tolist() == pytest.approx([0, 0.219, 0.417, 0.12])
    score = torch.tensor([1.0, 2.0, 4.0, 8.0], dtype=torch.float64)
    assert im.per_cost(score, degrees, 10.0).tolist() == pytest.approx([0.1, 0.02, 4 / 190, 8 / 55])
    assert im.minus_cost(score, degrees, 0.1).tolist() == pytest.approx([1, -7, -14, 3.5])
    both = im.minus_cost(score.expand(2, 4), degrees, torch.tensor([0.0, 0.1]))
    torch.testing.assert_close(both, torch.stack([score, score - torch.tensor(0.1).double() * degrees]))
    with pytest.raises(SettingError, match="overhead"):
        im.per_cost(score, degrees, 0.0)


def test_saccade_degrees_gradcheck():
    direction, directions = sphere(2, 3).requires_grad_(), sphere(8, 4).reshape(2, 4, 3).clone().requires_grad_()
    assert torch.autograd.gradcheck(im.saccade_degrees, (direction, directions))
