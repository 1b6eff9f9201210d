"""Pictures and matches by loops in C are what the Python that defines them makes."""

import pytest
import torch
from test_compiling import CAMERA
from test_loops import CLOSE, both, same

from torchfovea import LogPolar, Observer
from torchfovea.sensing.camera import image_camera
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.sensing.retina import interpolate
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.cans import Cans
from torchfovea.sim.model import EgoPose
from torchfovea.sim.rays import render_together
from torchfovea.sim.scene import AttentionWorld, build_scene, stand_at
from torchfovea.sim.texture import Paint, colour
from torchfovea.sim.world import World
from torchfovea.stereo.costs import Eye
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sheets import sheets
from torchfovea.stereo.subpixel import Neighbourhood, subpixel
from torchfovea.stereo.visibility import outdone


def test_a_loop_sees_what_rays_meet():
    """Boxes, turned ones too, cylinders and spheres, from an eye each in two scenes; by their edges and from above."""
    scenes = [build_scene(Cans(), 5), stand_at(build_scene(AttentionWorld(), 1), EgoPose(0.2, -0.3, 0.7))]
    camera = image_camera(CAMERA, 100, 150)
    for angles in ((0.0, 0.6, 0.3), (-0.7, 0.0, 0.0)):
        pose = eyes(Head(), Gaze(*(torch.tensor(a, dtype=torch.float64) for a in angles)))
        given = (torch.stack([pose.R_left, pose.R_right]), torch.stack([pose.t_left, pose.t_right]))
        for one, other in zip(*both(lambda: render_together(scenes, *given, camera, 150)), strict=True):  # noqa: B023
            same = one.geom == other.geom
            assert len(one.geom.unique()) > 8 and same.double().mean() > 0.9999
            assert (one.range_m - other.range_m).abs()[same].max() < 2e-5
            error = (one.image - other.image).abs().amax(0)[same]
            assert error.median() < 2e-5 and error.quantile(0.999) < 1e-3 and error.max() < 5e-3


@pytest.mark.parametrize("repeat_m", [torch.inf, 0.3])
def test_a_loop_paints_as_the_definition(repeat_m):
    """Near and far, walls and cans with and without stripes, rows of one thing and of several, of any length."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.rand(*shape, generator=generator)

    can, stripes = torch.tensor([[0.0, 0.4, 0.3], [0.0, 0.5, 0.6]]), torch.tensor([[0.0, 0, 3], [0, 0, 8], [0, 0, 0.5]])
    paint = Paint(draw(7, 3), 5 * draw(3, 3), draw(3, 3) - 0.5, can, stripes, torch.tensor([repeat_m, torch.inf, 0.7]))
    geom = torch.randint(3, (60, 90), generator=generator)
    geom[:30] = geom[:30, :1]
    point, normal = 2 * draw(3, 60, 90) - 1, torch.nn.functional.normalize(draw(3, 60, 90) - 0.5, dim=0)
    footprint_m = 10 ** (4 * draw(60, 1) - 4) * (1 + draw(60, 90))
    one, other = both(lambda: colour(paint, geom, point.unbind(0), normal.unbind(0), footprint_m))
    assert one.shape == (3, 60, 90) and one.std() > 0.1
    error = (one - other).abs().amax(0)
    # beside a seam of what repeats, rounding may put a place on either side
    assert error.median() < 1e-4 and error.quantile(0.99) < 1e-3


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("retina", [LogPolar(900), LogPolar(4000, rho_min_px=20.0, uniform_fovea=True)])
def test_a_loop_reads_between_rings_as_the_definition(retina, dtype):
    """Everywhere on the retina and beyond, in all directions, along the axes, across the seam and at the centre."""
    generator = torch.Generator().manual_seed(0)
    px = 240 * torch.rand(3000, 2, generator=generator, dtype=torch.float64) - 120
    px[1000:2000] *= 0.03
    axes = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1e-7], [1.0, -1e-7], [-1.0, -1e-7]])
    px[2000:2700] = (axes[:, None] * torch.linspace(0, 150, 100)[:, None]).flatten(0, 1)
    values = torch.rand(2, 3, retina.count, generator=generator, dtype=torch.float64)
    one, other = both(lambda: interpolate(values.to(dtype), retina, px.to(dtype)))
    assert one.shape == (2, 3, 3000)
    # a place is known to a digit of its ring
    torch.testing.assert_close(one, other, rtol=0, atol=1e-9 if dtype == torch.float64 else 2e-5)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("step", [1, 2])
def test_a_loop_outdoes_as_the_definition(step, dtype):
    """Crowded and lonely claims, on the border and beyond it, and such as do not count."""
    generator = torch.Generator().manual_seed(0)
    cell = torch.stack([torch.randint(-1, side + 1, (2, 4000), generator=generator) for side in (70, 9)], -1)
    disparity, misfit = torch.rand(2, 2, 4000, generator=generator, dtype=torch.float64)
    disparity, misfit = (12 * disparity).to(dtype), misfit.to(dtype)
    valid = torch.rand(2, 4000, generator=generator) < 0.3
    (lost, rivals), (lost_too, rivals_too) = both(lambda: outdone(cell, (9, 70), disparity, misfit, valid, step))
    assert 0.1 < float(lost.double().mean()) < 0.3 and not bool((lost & ~valid).any())
    assert torch.equal(lost, lost_too) and torch.equal(rivals, rivals_too)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("radius", [1, 2])
def test_a_loop_refines_as_the_definition(radius, dtype):
    """On closed bands and open lattices, of two pairs of images, texture and none, where few cells are trusted."""
    generator = torch.Generator().manual_seed(0)
    retina, here, like = LogPolar(900), torch.device("cpu"), {"generator": generator, "dtype": torch.float64}
    rough = torch.rand(2, 4, 48, 48, **like) - 0.5
    rough[..., :16] *= 1e-3
    levels = torch.stack([rough, 0.8 * rough.roll(1, -1) + 0.01 * torch.rand(rough.shape, **like)])
    turn = torch.eye(3, dtype=dtype).expand(2, 3, 3)
    shift, ahead = (torch.tensor([row] * 2, dtype=dtype) for row in ([-0.1, 0.0, 0.0], [0.0, 0.0, 1.0]))
    images = levels.to(dtype).unbind(0)
    eye = Eye(CAMERA, CAMERA, turn, shift, ahead, *images, retina, 48 / 200, (23.5, 23.5))
    parts = sheets(retina, 200 / 48, here, dtype)
    assert {sheet.closed for sheet in parts} == {True, False}
    for sheet in parts:
        surface = 0.5 + torch.rand(2, *sheet.width_px.shape, **like).to(dtype)
        trusted = torch.rand(surface.shape, generator=generator) < 0.6
        found = both(lambda: subpixel(eye, sheet, surface, 0.2 * surface, trusted, Neighbourhood(radius)))  # noqa: B023
        assert float(found[0].value.std()) > 0.02
        same(*map(tuple, found), dtype)


def test_a_photometric_look_by_loops():
    """A picture within what tests/test_drawing.py allows, and all but a few matches within a hundredth of a field."""
    world = World(build_scene(Cans(), 5), camera=CAMERA, source_px=96)
    gaze = Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (0.2, 0.3, 0.1)))
    looks = []
    for mode in ("off", "on"):
        observer = Observer(camera=CAMERA, retina=LogPolar(3000), compile=mode)
        arena = SimulatedArena(world, observer, Matcher(SGBM()))
        looks.append(arena.look(gaze, torch.Generator().manual_seed(0)))
    one, other = looks
    assert (one.pictures.left - other.pictures.left).abs().max() < 2e-3
    assert (one.matches.valid == other.matches.valid).double().mean() > 0.995
    both_valid = one.matches.valid & other.matches.valid
    apart = (one.matches.right_px - other.matches.right_px).norm(dim=-1)[both_valid]
    assert both_valid.double().mean() > 0.5 and apart.quantile(0.95) < 0.02
