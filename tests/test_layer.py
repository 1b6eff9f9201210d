"""The fovea in a network: half precision, compilers, transforms, several gazes an image, gradients, cortical images."""

import itertools
import math

import numpy as np
import pytest
import torch

from torchfovea.finite import require_finite
from torchfovea.sensing.features import place_features, wrap_around
from torchfovea.sensing.retina import LogPolar, Uniform, cortical, covered, fovea, interpolate, reconstruct
from torchfovea.setting import SettingError

LAYOUTS = [LogPolar(300), LogPolar(1000, rho_min_px=5.0, uniform_fovea=True), Uniform(300)]
SIZE = (40, 56)


class Sunflower:
    """A layout of a user's own, which is read over triangles."""

    count, radius_px = 200, 100.0

    def centers_px(self, device=None, dtype=None):
        k = torch.arange(self.count, dtype=torch.float64)
        rho, angle = 100 * ((k + 0.5) / self.count).sqrt(), k * math.pi * (3 - math.sqrt(5))
        return torch.stack([rho * angle.cos(), rho * angle.sin()], -1).to(device or "cpu", dtype or torch.float32)

    def width_px(self, px):
        return torch.full_like(px[..., 0], 12.5)

    def inside(self, px):
        return px.square().sum(-1) <= 100**2


def looks(generator, count=2, dtype=torch.float32):
    image = torch.rand(count, 3, *SIZE, generator=generator, dtype=dtype)
    gaze = torch.rand(count, 2, generator=generator, dtype=dtype) * torch.tensor([56.0, 40.0], dtype=dtype)
    return image, gaze


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
@pytest.mark.parametrize("retina", LAYOUTS, ids=str)
def test_half_precision_is_that_of_the_pixels_alone(retina, half, generator):
    """Whatever the images and the values are rounded to, places are not, and nothing overflows."""
    image, gaze = looks(generator)
    image = (image * 60000).to(half)
    seen = fovea(image, gaze, retina)
    exact = fovea(image.double(), gaze.double(), retina)
    rounding = torch.finfo(half).eps
    assert seen.dtype == half
    torch.testing.assert_close(seen.double(), exact, rtol=rounding, atol=0.1)
    px = 60 * torch.randn(50, 2, generator=generator)
    back, ours = interpolate(seen.double(), retina, px.double()), interpolate(seen, retina, px)
    assert ours.dtype == half
    torch.testing.assert_close(ours.double(), back, rtol=rounding, atol=0.5)
    assert reconstruct(seen, retina, 30)[0].dtype == half


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
def test_autocast_changes_nothing(half, generator):
    image, gaze = looks(generator)
    retina = LogPolar(300)
    with torch.autocast("cpu", dtype=half):
        seen = fovea(image, gaze, retina)
        half_seen = fovea(image.to(half), gaze, retina)
        back = reconstruct(seen, retina, 30)[0]
    assert torch.equal(seen, fovea(image, gaze, retina)) and torch.equal(back, reconstruct(seen, retina, 30)[0])
    assert torch.equal(half_seen, fovea(image.to(half), gaze, retina))


@pytest.mark.parametrize("retina", LAYOUTS, ids=str)
def test_several_gazes_at_each_image(retina, generator):
    image, _ = looks(generator)
    gaze = torch.rand(2, 5, 2, generator=generator) * 60
    seen, on = fovea(image, gaze, retina), covered(retina, SIZE, gaze)
    assert seen.shape == (2, 5, 3, retina.count) and on.shape == (2, 5, retina.count)
    for b, g in itertools.product(range(2), range(5)):
        torch.testing.assert_close(seen[b, g], fovea(image[b : b + 1], gaze[b, g : g + 1], retina)[0])
        assert torch.equal(on[b, g], covered(retina, SIZE, gaze[b, g : g + 1])[0])
    assert torch.equal(fovea(image[:1], gaze[:1], retina)[0], fovea(image[:1], gaze[0], retina))
    with pytest.raises(SettingError, match=r"gaze_px\.shape = \(2, 5, 2\): expected \(1, 2\) or \(1, G, 2\)"):
        fovea(image[:1], gaze, retina)


def test_vmap_is_a_loop(generator):
    image, gaze = looks(generator, 3)
    px = 60 * torch.randn(3, 10, 2, generator=generator)
    for retina in LAYOUTS:
        each = torch.vmap(lambda i, g, r=retina: fovea(i[None], g[None], r)[0])(image, gaze)
        torch.testing.assert_close(each, fovea(image, gaze, retina))
        shared = torch.vmap(lambda g, r=retina: fovea(image[:1], g[None], r)[0])(gaze)
        torch.testing.assert_close(shared, fovea(image[:1], gaze, retina))
        at = torch.vmap(lambda v, p, r=retina: interpolate(v[None], r, p)[0])(each, px)
        torch.testing.assert_close(at, torch.cat([interpolate(each[k : k + 1], retina, px[k]) for k in range(3)]))
        slopes = torch.vmap(torch.func.grad(lambda g, i, r=retina: fovea(i[None], g[None], r).square().sum()))
        assert slopes(gaze, image).isfinite().all()


@pytest.mark.parametrize("retina", LAYOUTS[1:], ids=str)  # rings and a lattice; a lattice
def test_compilers_see_one_graph(retina, generator):
    """Forward and backward, at a second size too; and nothing is warned of."""
    torch.compiler.reset()

    def look(image, gaze, px):
        seen = fovea(image, gaze, retina)
        return seen, interpolate(seen, retina, px), reconstruct(seen, retina, 20)[0]

    compiled = torch.compile(look, fullgraph=True, backend="aot_eager")
    for size in (SIZE, (30, 70)):
        image = torch.rand(2, 1, *size, generator=generator)
        gaze = (torch.rand(2, 2, generator=generator) * 30).requires_grad_()
        px = 60 * torch.randn(9, 2, generator=generator)
        slopes = []
        for run in (compiled, look):
            outputs = run(image, gaze, px)
            slopes.append(torch.autograd.grad(sum(out.square().sum() for out in outputs), gaze)[0])
        torch.testing.assert_close(compiled(image, gaze, px), look(image, gaze, px))
        torch.testing.assert_close(slopes[0], slopes[1])


def test_it_is_exported(generator):
    image, gaze = looks(generator)

    class Look(torch.nn.Module):
        def forward(self, image, gaze):
            return fovea(image, gaze, LAYOUTS[0])

    exported = torch.export.export(Look(), (image, gaze)).module()
    torch.testing.assert_close(exported(image, gaze), fovea(image, gaze, LAYOUTS[0]))


def test_values_are_looked_at_where_that_is_free():
    """An error in eager code on the CPU; elsewhere what is not finite passes through."""
    bad = torch.full((1, 1, 20, 20), math.nan)
    retina = LAYOUTS[0]
    with pytest.raises(SettingError, match="image = NaN"):
        fovea(bad, None, retina)
    assert torch.vmap(lambda image: fovea(image[None], None, retina)[0])(bad).isnan().all()
    torch.compiler.reset()
    assert torch.compile(lambda i: fovea(i, None, retina), fullgraph=True, backend="eager")(bad).isnan().all()
    # a device whose values nobody can read is not asked
    require_finite(torch.full((3,), math.nan, device="meta"), "x", "finite")
    # nor do large numbers, whose sum overflows, count as infinite
    require_finite(torch.full((9,), 3e38), "x", "finite")
    with pytest.raises(SettingError, match="x = NaN or infinite values: expected finite"):
        require_finite(torch.tensor([1.0, math.inf, -math.inf]), "x", "finite")


@pytest.mark.parametrize("retina", [*LAYOUTS, Sunflower()], ids=lambda r: type(r).__name__)
def test_gradients_in_the_gazes_and_the_places(retina, generator):
    image = torch.rand(2, 1, 12, 14, generator=generator, dtype=torch.float64, requires_grad=True)
    gaze = torch.rand(2, 2, 2, generator=generator, dtype=torch.float64) * 5 + 4
    assert torch.autograd.gradcheck(lambda i, g: fovea(i, g, retina), (image, gaze.requires_grad_()), fast_mode=True)
    values = torch.rand(1, 2, retina.count, generator=generator, dtype=torch.float64, requires_grad=True)
    px = 40 * torch.randn(12, 2, generator=generator, dtype=torch.float64)
    inside = px[retina.inside(px)].requires_grad_()
    assert torch.autograd.gradcheck(lambda v, p: interpolate(v, retina, p), (values, inside), fast_mode=True)
    # and on the axis, where the angle has no derivative, they are finite
    axis = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.grad(interpolate(values, retina, axis).sum(), axis)[0].isfinite().all()


@pytest.mark.parametrize(("rings", "sectors"), [(0, 0), (1, 1), (2, 3)])
def test_the_cortical_image_is_padded_around_the_circle(rings, sectors, generator):
    retina = LogPolar(300)
    image = cortical(torch.rand(2, 3, retina.count, generator=generator), retina)
    expected = np.pad(image.numpy(), ((0, 0), (0, 0), (0, 0), (sectors, sectors)), "wrap")
    expected = np.pad(expected, ((0, 0), (0, 0), (rings, rings), (0, 0)), "edge")
    assert np.array_equal(wrap_around(image, rings, sectors).numpy(), expected)
    for name, value in (("rings", -1), ("sectors", -1), ("sectors", retina.shape[1] + 1)):
        with pytest.raises(SettingError, match=f"{name} = {value}"):
            wrap_around(image, **{name: value})


def test_a_convolution_in_the_cortex_turns_with_the_picture(generator):
    """Turned by whole sectors, a picture makes the same features, turned."""
    retina = LogPolar(300)
    layer = torch.nn.Conv2d(2, 4, 3)
    image = cortical(torch.rand(1, 2, retina.count, generator=generator), retina)
    torch.testing.assert_close(layer(wrap_around(image.roll(5, -1))), layer(wrap_around(image)).roll(5, -1))


def test_where_each_receptive_field_is():
    for retina, octaves in itertools.product([*LAYOUTS, Sunflower()], (0, 3)):
        told = place_features(retina, octaves, dtype=torch.float64)
        assert told.shape == (retina.count, 3 + 4 * octaves) and told.abs().max() <= 1
        distance = torch.cdist(told, told).fill_diagonal_(1)
        assert distance.min() > 1e-3  # no two are told alike
    # of a log-polar retina rings are evenly spaced, and the width counts them; of a uniform one places are places
    retina = LogPolar(2000)
    told = place_features(retina, 1, dtype=torch.float64)
    steps = told[:, :2].norm(dim=-1).reshape(retina.shape)[:, 0].diff()
    torch.testing.assert_close(steps[2:], steps[-1].expand(len(steps) - 2), rtol=0.01, atol=0)
    torch.testing.assert_close(
        told[:, 2].reshape(retina.shape)[:, 3], torch.linspace(0, 1, retina.rings, dtype=torch.float64)
    )
    torch.testing.assert_close(told[:, 3:5], (math.pi * told[:, :2]).sin())
    uniform = Uniform(300)
    told = place_features(uniform, dtype=torch.float64)
    torch.testing.assert_close(told[:, :2], uniform.centers_px(dtype=torch.float64) / 100)
    assert (told[:, 2] == 0).all()
    with pytest.raises(SettingError, match="octaves = -1"):
        place_features(uniform, -1)
