"""What the memory rules out for a matcher: only what a known surface hides, and nothing in front of it."""

import math

import pytest
import torch
from test_sweep import Room, everywhere

from torchfovea.gaussian import Information, columns
from torchfovea.looking import told
from torchfovea.memory.egosphere import Prior, empty_memory
from torchfovea.memory.expected import hidden_beyond
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer
from torchfovea.sensing.head import Eyes
from torchfovea.sensing.layout import Uniform
from torchfovea.setting import SettingError
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sweep import Sweep, Volume, match_sweep

SIGMA = 0.01


def disc(point):
    return point[..., :2].norm(dim=-1) < 0.25


WALL = ((0.0, 0.0, 1.0), 2.0, everywhere)
DISC = ((0.0, 0.0, 1.0), 1.0, disc)


def knows(room, votes=(4.0, 0.0), count=20000):
    """A memory that has the true range of every cell ahead, and these votes for it."""
    cells = fibonacci_directions(count).double()
    cells = cells[cells[:, 2] > 0.2]
    range_m = room.cast(torch.zeros(3, dtype=torch.float64), cells)
    memory = empty_memory(cells, Prior())
    weight, zero = torch.full_like(range_m, SIGMA**-2), torch.zeros_like(range_m)
    slope = zero + 1.0
    known = Information(columns(zero, zero, weight / range_m), columns(slope, zero, zero, slope, zero, weight))
    return memory._replace(information=known, votes=columns(*(zero + v for v in votes)))


def rays_of(room, retina):
    origin, rotation = room.eye(0)
    rays = room.camera.rays(retina.centers_px(dtype=torch.float64)) @ rotation.T
    return origin, rays / rays.norm(dim=-1, keepdim=True)


def test_only_what_is_hidden_is_ruled_out():
    """Every true surface along the eye's rays, which are not the memory's own, stays within what is searched."""
    room, retina = Room([WALL, DISC]), Uniform(3000)
    origin, rays = rays_of(room, retina)
    least = hidden_beyond(knows(room), origin, rays)
    true = 1 / room.cast(origin, rays)
    assert (least <= true + 1e-9).all()
    x, y, _ = (origin + rays / true[:, None]).unbind(-1)
    away = (torch.hypot(x, y) - 0.25).abs() > 0.1  # of the edge, where both surfaces are kept
    assert away.double().mean() > 0.8
    # three standard deviations behind it, and what the slope of a plane adds from cell to cell, nothing is searched
    assert (least > true - 3 * SIGMA - 0.05)[away].all()


def test_a_doubtful_surface_hides_nothing():
    room, retina = Room([WALL]), Uniform(500)
    origin, rays = rays_of(room, retina)
    for votes in ((0.0, 0.0), (1.0, 0.0), (4.0, 2.0)):
        assert (hidden_beyond(knows(room, votes), origin, rays) == 0).all()
    assert (hidden_beyond(knows(room, (2.0, 0.2)), origin, rays) > 0).all()
    behind = -rays  # where the memory has no cell
    assert (hidden_beyond(knows(room), origin, behind) == 0).all()


def test_what_comes_in_front_is_found_all_the_same():
    """The memory is sure of a wall; a disc that it does not know is matched as if it knew nothing."""
    room, retina = Room([WALL, DISC]), Uniform(3000)
    origin, rays = rays_of(room, retina)
    least = hidden_beyond(knows(Room([WALL])), origin, rays)
    assert (least > 0.3).double().mean() > 0.9
    views = room.views(160)
    free, found = (
        match_sweep(views, retina, volume=volume)[1]
        for volume in (None, Volume(least, torch.full_like(least, math.inf)))
    )
    true = 1 / room.cast(origin, rays)
    new = true > 0.8

    def right(result):
        return (new & result.valid & ((result.inverse_range - true).abs() < 0.1)).sum()

    assert right(free) > 0.8 * new.sum()
    assert right(found) >= 0.98 * right(free)


def test_a_matcher_is_told_only_if_it_asks():
    observer = Observer(retina=Uniform(500))
    memory = knows(Room([WALL]))._replace(votes=columns(*[torch.zeros(1)] * 2))
    eye = torch.eye(3, dtype=torch.float64)
    here = torch.zeros(3, dtype=torch.float64)
    pose = Eyes(eye, here, eye, here)

    def foreign(views, retina, budget):
        raise AssertionError

    for matcher in (foreign, Matcher(Sweep())):
        assert told(matcher, observer, memory, pose) is matcher
    asks = Matcher(Sweep(volume="memory"))
    assert told(asks, observer, None, pose) is asks
    told_it = told(asks, observer, knows(Room([WALL]), count=2000), pose)
    assert told_it.volume.least.shape == (500,) and (told_it.volume.most == math.inf).all()


def test_a_memory_of_points_has_no_votes():
    cells = fibonacci_directions(50)
    memory = empty_memory(cells, Prior(), "cartesian")
    with pytest.raises(SettingError, match=r"matcher\.volume"):
        hidden_beyond(memory, torch.zeros(3), cells)
    with pytest.raises(SettingError, match=r"matcher\.volume"):
        Sweep(volume="some")
