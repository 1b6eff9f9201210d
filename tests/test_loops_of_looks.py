"""Pictures and matches by loops in C are what the Python that defines them makes."""

import pytest
import torch
from test_compiling import CAMERA
from test_loops import both

from torchfovea import LogPolar, Observer
from torchfovea.sensing.camera import image_camera
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.cans import Cans
from torchfovea.sim.model import EgoPose
from torchfovea.sim.rays import render_together
from torchfovea.sim.scene import AttentionWorld, build_scene, stand_at
from torchfovea.sim.texture import Paint, colour
from torchfovea.sim.world import World
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM


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
