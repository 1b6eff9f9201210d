"""Rays traced as tensors meet what MuJoCo's rays meet, and arenas sensed together are arenas sensed alone."""

import math

import pytest
import torch

from torchfovea.arena import Arenas
from torchfovea.compiling import compiling
from torchfovea.perception import Observer
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.fields import draw_fields
from torchfovea.sensing.head import Gaze, Head, eyes, to_ego
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.setting import SettingError
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.arenas import GeometricArenas
from torchfovea.sim.cans import Cans
from torchfovea.sim.model import EgoPose
from torchfovea.sim.rays import cast
from torchfovea.sim.scene import AttentionWorld, build_scene, stand_at
from torchfovea.sim.solids import solids_of
from torchfovea.sim.trace import occluded, ranges, trace
from torchfovea.sim.world import World


@pytest.fixture(scope="module")
def scenes():
    moved = stand_at(build_scene(AttentionWorld(), 1), EgoPose(0.2, -0.3, 0.7))
    return [build_scene(Cans(), 0), build_scene(AttentionWorld(), 0), moved]


@pytest.fixture
def gaze():
    angles = ([0.3, -0.5, 0.1], [0.2, 0.0, 0.4], [0.2, 0.1, 0.3])
    return Gaze(*(torch.tensor(a, dtype=torch.float64) for a in angles))


@pytest.mark.parametrize("fov_deg", [90, 150])
def test_the_same_surfaces_as_mujoco(scenes, gaze, fov_deg):
    observer = Observer(camera=Pinhole.from_fov(fov_deg, 100), retina=Uniform(4000))
    px = observer.retina.centers_px(dtype=torch.float64)
    unit = torch.nn.functional.normalize(observer.camera.rays(px), dim=-1)
    pose, solids = eyes(observer.head, gaze), solids_of(scenes)
    direction = to_ego(pose.R_left, unit.expand(3, -1, -1))
    range_m, geom = trace(solids, pose.t_left, direction)
    points = pose.t_left[:, None] + range_m[..., None] * direction
    hidden = occluded(solids, pose.t_right, points)
    assert bool(hidden.any(1).all())
    for b, scene in enumerate(scenes):
        hits = cast(scene, pose.t_left[b], direction[b])
        assert torch.allclose(range_m[b], hits.range_m, atol=1e-9, rtol=0)
        assert torch.equal(geom[b], hits.geom)
        world = World(scene, camera=observer.camera)
        seen = world.correspond(Gaze(*(a[b] for a in gaze)), observer.camera.rays(px))
        ahead = ((points[b] - pose.t_right[b]) * pose.R_right[b, :, 2]).sum(-1) > 0
        assert torch.equal(seen.visible_right, (geom[b] >= 0) & ~hidden[b] & ahead)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_loops_meet_what_tensors_meet(scenes, kind):
    """Rays in all directions, from the middle and from above a thing, along the axes and down its own."""
    rng, solids = torch.Generator().manual_seed(0), solids_of(scenes, dtype=kind)
    spread = torch.randn(3, 3000, 3, generator=rng, dtype=torch.float64)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double().expand(3, 6, 3)
    above = torch.tensor([[0.0, 0, -1], [1e-9, 0, -1]]).double().expand(3, 2, 3)
    direction = torch.cat([spread, axes, above], 1).to(kind)
    c, s = solids.rotation[..., 0]
    x, y = (solids.cylinders.centre[k, :, 0, 0] - solids.translation[k, :, 0] for k in (0, 1))
    over = torch.stack([c * x + s * y, c * y - s * x, 0.2 + 0 * x], -1)
    for origin in (torch.zeros_like(over), over):
        told = []
        for mode in ("off", "on"):
            with compiling(mode):
                range_m = ranges(solids, origin, direction)
                unit = torch.nn.functional.normalize(direction, dim=-1)
                told.append(
                    (range_m, occluded(solids, 0.9 * origin, origin[:, None] + 0.999 * range_m[..., None] * unit))
                )
        (one, hidden), (other, same) = told
        # grazing rays are met, or not, by rounding
        near = (one - other).abs() <= (1e-4 if kind == torch.float32 else 1e-9) * one
        assert near.double().mean() > (0.995 if kind == torch.float32 else 0.9999)
        assert (hidden == same).double().mean() > 0.995 and bool(near[:, -8:].all())
    assert bool(hidden.any())


def test_float32_is_near_float64(scenes, gaze):
    direction = torch.nn.functional.normalize(
        torch.randn(3, 500, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    origin = torch.zeros(3, 3)
    single, _ = trace(solids_of(scenes, dtype=torch.float32), origin, direction)
    double, _ = trace(solids_of(scenes), origin.double(), direction.double())
    assert single.dtype == torch.float32
    assert ((single - double).abs() < 1e-3).double().mean() > 0.99


def test_directions_of_any_length(scenes, gaze, dtype):
    rng = torch.Generator().manual_seed(0)
    direction = torch.randn(3, 500, 3, generator=rng, dtype=torch.float64).to(dtype)
    solids, origin = solids_of(scenes, dtype=dtype), torch.zeros(3, 3, dtype=dtype)
    unit = torch.nn.functional.normalize(direction, dim=-1)
    for length in (2.0, 1e-3, 1e6):
        for got, want in zip(trace(solids, origin, length * unit), trace(solids, origin, unit), strict=True):
            assert ((got - want).abs() <= 1e-5).double().mean() > 0.99
    for bad in (0.0, math.nan, math.inf):
        with pytest.raises(SettingError, match="directions_e"):
            trace(solids, origin, bad * unit)


@pytest.mark.parametrize("beside_m", [0.0, 0.9, 1.01])
def test_rays_along_an_axis(scenes, beside_m, dtype):
    """From below the furniture's height, beside and under cans, up, down and level: what MuJoCo meets."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(dtype)
    solids, checked = solids_of(scenes[:1], dtype=dtype), 0
    rotation, translation = (torch.from_numpy(x) for x in scenes[0].world_from_ego)
    for solid in scenes[0].solids:
        if solid.shape == "cylinder":
            radius_m, half_m = solid.size_m[:2]
            shift = torch.tensor([0.0, beside_m * radius_m, half_m + 0.02], dtype=torch.float64)
            place = rotation.T @ (torch.tensor(solid.position_m, dtype=torch.float64) + shift - translation)
            range_m, _ = trace(solids, place.to(dtype)[None], axes[None])
            hits = cast(scenes[0], place, axes.double())
            torch.testing.assert_close(range_m[0].double(), hits.range_m, atol=1e-5, rtol=1e-5)
            checked += 1
    assert checked > 2
    assert not occluded(solids, torch.zeros(1, 3, dtype=dtype), torch.zeros(1, 4, 3, dtype=dtype)).any()


@pytest.mark.parametrize("sample", [None, 300])
def test_together_is_alone(scenes, gaze, sample):
    observer = Observer(camera=Pinhole.from_fov(90, 100), retina=LogPolar(1000))
    batch = GeometricArenas(scenes, observer, sample)
    single = Arenas([SimulatedArena(World(s, camera=observer.camera), observer, None, sample) for s in scenes])
    together, alone = batch.saccade(gaze), single.saccade(gaze)
    assert together.base is alone.base is None
    for a, b in zip(together[:3], alone[:3], strict=True):
        for x, y in zip(a, b, strict=True) if isinstance(a, Gaze) else [(a, b)]:
            assert torch.allclose(x, y, atol=1e-9)
    for a, b in zip(batch.fixation(gaze), single.fixation(gaze), strict=True):
        assert torch.allclose(a, b, atol=1e-9) if a.is_floating_point() else torch.equal(a, b)
    looks = []
    for arenas in (batch, single):
        looks.append(arenas.look(gaze, [torch.Generator().manual_seed(k) for k in range(3)]).matches)
    for a, b in zip(*looks, strict=True):
        if a is None or b is None:
            assert a is b
            continue
        assert a.shape[1] == (sample or observer.retina.count)
        assert torch.equal(a, b) if a.dtype == torch.bool else torch.allclose(a, b, atol=1e-8)


def test_drawn_receptive_fields():
    generator = torch.Generator().manual_seed(0)
    assert draw_fields(10, None, generator) is None and draw_fields(10, 10, generator) is None
    counts = torch.zeros(10)
    for _ in range(400):
        chosen = draw_fields(10, 4, generator)
        assert len(chosen) == 4 and bool((chosen.diff() > 0).all())
        counts[chosen] += 1
    assert bool(((counts / 400 - 0.4).abs() < 0.1).all())


def test_heads_err_independently(scenes, gaze):
    """Rows with other seeds have other encoder errors, each its own whoever is beside it."""
    observer = Observer(head=Head(encoder_deg=1.0))

    def errors(seeds):
        rows = slice(0, len(seeds))
        arenas = GeometricArenas(scenes[rows], observer, seeds=seeds)
        asked = Gaze(*(angle[rows] for angle in gaze))
        told = [torch.stack(list(arenas.saccade(asked).gaze), -1) for _ in range(2)]
        return torch.stack([t - torch.stack(list(asked), -1) for t in told])

    together, pair, alone = errors([4, 7, 4]), errors([4, 7]), errors([7])
    torch.testing.assert_close(together[:, 2], together[:, 0])
    torch.testing.assert_close(pair[:, 1], together[:, 1])
    assert bool(((together[:, 0] - together[:, 1]).abs() > 1e-6).all())
    assert bool(((alone[0] - alone[1]).abs() > 1e-6).all())
    with pytest.raises(SettingError, match="seeds = 1"):
        GeometricArenas(scenes, observer, seeds=[1])
