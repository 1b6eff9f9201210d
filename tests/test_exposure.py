import pytest
import torch

from torchfovea.stereo.exposure import alike


@pytest.mark.parametrize(
    "curve",
    [lambda x: x, lambda x: 0.6 * x, lambda x: 0.8 * x + 0.15, lambda x: x**0.5, lambda x: x**2.2],
    ids=["same", "gain", "offset", "gamma .5", "gamma 2.2"],
)
def test_any_rising_curve_is_undone(curve, generator):
    left = torch.rand(1, 60, 80, generator=generator, dtype=torch.float64)
    found = alike(torch.stack([left, curve(left)]))
    assert torch.equal(found[0], left)
    # straight between the quantiles: a gamma bends by a part of their distance, most at its steep end
    assert (found[1] - left).abs().max() < 0.02
    assert (found[1] - left).abs().median() < 1e-3


@pytest.mark.parametrize("level", [0.0, 0.4, 1.0])
def test_flat_images_stay_finite(level, generator):
    flat = torch.full((1, 20, 20), level)
    texture = torch.rand(1, 20, 20, generator=generator)
    for pair in ((flat, flat), (flat, texture), (texture, flat)):
        found = alike(torch.stack(pair))
        assert found.isfinite().all() and found.min() >= 0 and found.max() <= 1
