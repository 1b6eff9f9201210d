"""Loops in C do what the Python that defines them does; without a C compiler that runs."""

import dataclasses
import math
from functools import partial

import pytest
import torch
from test_compiling import CAMERA, matches_of, pose_of

from torchfovea import Eligibility, Fusion, Head, LogPolar, Observer, compiled, decide, new_memory, perceive
from torchfovea.compiling import compiling
from torchfovea.gaussian import Information, columns
from torchfovea.machine import _built, _say_once, loops
from torchfovea.memory.association import associate
from torchfovea.memory.nearest import build_index, neighbour_spacing_rad
from torchfovea.memory.sphere import fibonacci_directions, latitude_longitude_directions
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.retina import fovea, reconstruct
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
CLOSE = {torch.float32: {"rtol": 2e-4, "atol": 2e-5}, torch.float64: {"rtol": 1e-9, "atol": 1e-12}}


def both(function):
    """What a function gives as written and by loops, which must be there."""
    results = []
    for mode in ("off", "on"):
        with compiling(mode):
            assert (loops(torch.ones(())) is None) == (mode == "off")
            results.append(function())
    return results


def same(one, other, dtype=torch.float64):
    """Nested tuples of tensors agree, but for the rounding of a type."""
    if isinstance(one, torch.Tensor):
        assert one.shape == other.shape and one.dtype == other.dtype
        if not one.is_floating_point():
            assert torch.equal(one, other)
            return
        scale = one.abs().max().clamp(min=1e-30)
        torch.testing.assert_close(one / scale, other / scale, **CLOSE[dtype])
    elif isinstance(one, tuple):
        for a, b in zip(one, other, strict=True):
            same(a, b, dtype)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("points", [SigmaPoints(), SigmaPoints.paper(), SigmaPoints.midpoint()])
@pytest.mark.parametrize("rotated", [True, False])
def test_a_loop_observes_as_the_definition(batch, points, rotated, dtype):
    matches, pose = matches_of(batch, 333, 1, dtype), pose_of(batch, dtype)
    camera = CAMERA if rotated else (dataclasses.replace(CAMERA, cx_px=3.0, cy_px=-2.0), CAMERA)
    half = torch.linspace(1, 2, 333, dtype=dtype)
    found = both(lambda: observe(matches, pose, camera, half, points, "inverse_range", rotated))
    assert 0.5 < float(found[0].valid.double().mean()) < 0.95
    same(*found, dtype)


def test_eyes_at_one_place_are_told_by_the_loop_too():
    pose = pose_of((2,), torch.float32)
    pose.t_right[1] = pose.t_left[1]
    for mode in ("off", "on"):
        with compiling(mode), pytest.raises(SettingError, match=r"baseline_m = 0.*: expected eyes some distance"):
            observe(matches_of((2,), 9, 1, torch.float32), pose, CAMERA, torch.ones(9))


def test_sigma_points_of_other_than_two_places_are_refused():
    told = matches_of((), 9, 1, torch.float32), pose_of((), torch.float32), CAMERA, torch.ones(9), SigmaPoints(3)
    with pytest.raises(SettingError, match="dimensions = 3: expected 4"):
        observe(*told)


def scattered(batch, count, dtype, seed=0):
    """Observations everywhere, crowded in one place, doubled, on the cube's seams; a tenth of them good for nothing."""
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, *batch, count, generator=generator, dtype=torch.float64)
    direction = torch.stack([draw(), draw(), draw()], -1)
    direction[..., : count // 4, :] = torch.tensor([0.6, 0.7, -0.4]) + 0.02 * direction[..., : count // 4, :]
    direction[..., -8:, :] = torch.tensor([[1.0, 1, 0], [1, -1, 1], [0, 0, 1], [0, 0, 1]]).repeat(2, 1).double()
    direction = direction / direction.norm(dim=-1, keepdim=True)
    root = torch.stack([draw(), draw(), draw(), draw(), draw(), draw(), draw(), draw(), draw()], -1).unflatten(
        -1, (3, 3)
    )
    square = 1e-3 * (root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64))
    cov = square[..., (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    mean = torch.stack([0 * draw(), 0 * draw(), draw().abs()], -1)
    bad = torch.rand(*batch, count, generator=generator)
    mean[bad < 0.02] = math.nan
    cov[(0.02 < bad) & (bad < 0.04)] *= -1
    cov[(0.04 < bad) & (bad < 0.06), 3] = math.inf
    direction[(0.06 < bad) & (bad < 0.08)] *= 1.1
    direction[(0.08 < bad) & (bad < 0.09)] = math.nan
    parts = (part.to(dtype) for part in (mean, cov, direction, 0.1 * draw().abs()))
    return Observations(*parts, bad < 0.95, (0.9 * bad + 0.1).to(dtype))


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("fill", [True, False])
@pytest.mark.parametrize("gates", [(0.0, 0.0), (0.01, 2.0), (0.5, 0.0), (4.0, 0.0)])
def test_a_loop_finds_the_pairs_of_the_definition(gates, fill, dtype):
    crowded = torch.cat(
        [latitude_longitude_directions(300), 0.01 * fibonacci_directions(200) + torch.tensor([0.6, 0.7, -0.4])]
    )
    cells = torch.stack([fibonacci_directions(len(crowded)), torch.nn.functional.normalize(crowded, dim=-1)]).to(dtype)
    for chosen, observed in ((cells, scattered((2,), 300, dtype)), (cells[1], scattered((), 400, dtype, 1))):
        index, spacing = build_index(chosen), neighbour_spacing_rad(chosen)
        assert bool((index.link < 0).any() and (index.link > 0).any())
        pairs, quick = both(lambda: associate(chosen, index, spacing, observed, *gates, fill))  # noqa: B023
        assert len(pairs.cell) > 10 or gates[0] == 0
        same(pairs, quick)
    none = scattered((), 8, dtype)
    same(
        *both(
            lambda: associate(
                cells[0],
                build_index(cells[0]),
                spacing[:1].expand(len(crowded)),
                none._replace(valid=none.valid & False),
                *gates,
                fill,
            )
        )
    )


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("conflict", [4.0, math.inf])
@pytest.mark.parametrize(("shared", "encoder_deg"), [(0.0, 0.0), (0.4, 0.0), (0.4, 0.05)])
def test_loops_remember_as_the_definition(batch, conflict, shared, encoder_deg, dtype):
    """Several looks, of which some contradict others, so that cells change their minds."""
    observer = Observer(
        head=Head(encoder_deg=encoder_deg),
        camera=CAMERA,
        retina=LogPolar(300),
        budget=Budget(shared=shared, lasting=shared / 2),
        fusion=Fusion(gate_deg=3.0, conflict=conflict),
    )
    cells = fibonacci_directions(500).to(dtype).expand(*batch, 500, 3)
    memory = other = new_memory(observer, cells)
    for seed in (0, 1, 0, 2):
        matches, pose = matches_of(batch, 300, seed, dtype), pose_of(batch, dtype)
        generator = torch.Generator().manual_seed(seed)
        matches = matches._replace(inlier=torch.rand(*batch, 300, generator=generator, dtype=torch.float64).to(dtype))
        memory, other = (
            perceive(observer, memory, matches, pose),
            perceive(compiled(observer, "on"), other, matches, pose),
        )
        same(memory._replace(lookup=()), other._replace(lookup=()), dtype)
    assert memory.information.matrix.dtype == torch.float64 and int((memory.looks > 0).sum()) > 20
    if conflict < math.inf:
        assert bool((memory.votes[..., 1] > memory.votes[..., 0]).any())


def test_loops_of_each_type_only_where_nothing_else_is_asked():
    with compiling("on"):
        x = torch.ones(3)
        assert loops(x, None, x) is loops(x) is not loops(x.double())
        assert loops(x, x.double()) is None and loops(x.half()) is None
        assert loops(x.requires_grad_()) is None
        with torch.no_grad():
            assert loops(x) is not None
            with torch.autograd.forward_ad.dual_level():
                assert loops(x) is None
        assert torch.func.vmap(lambda t: t * float(loops(t) is None))(torch.ones(2)).tolist() == [1, 1]


@pytest.mark.parametrize(("compiler", "said"), [("no-such-compiler", "no-such-compiler"), ("false", "fails")])
def test_without_a_compiler_what_is_written_runs_and_says_so_once(compiler, said, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _built.cache_clear(), _say_once.cache_clear()
    try:
        with compiling("auto"):
            with pytest.warns(RuntimeWarning, match=f"as written, not in C: .*{said}"):
                assert loops(torch.ones(3)) is None
            assert loops(torch.ones(3)) is None
        with compiling("on"), pytest.raises(SettingError, match=f"compile = on: expected .* in C .*{said}"):
            loops(torch.ones(3))
    finally:
        _built.cache_clear(), _say_once.cache_clear()


def test_what_is_built_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _built.cache_clear()
    try:
        with compiling("on"):
            assert loops(torch.ones(3)) is not None
        (kept,) = [path for path in tmp_path.rglob("*") if path.is_file()]
        _built.cache_clear()
        made = kept.stat().st_mtime_ns
        with compiling("on"):
            assert loops(torch.ones(3)) is not None
        assert kept.stat().st_mtime_ns == made and kept.suffix == ".so"
    finally:
        _built.cache_clear()


def test_a_compiled_observer_is_equal_but_for_that():
    assert dataclasses.replace(compiled(Observer(), "auto"), compile="off") == Observer()


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("reward", ["inverse_range", "range"])
def test_a_loop_appraises_as_the_definition(batch, reward, dtype):
    """Cells seen and not, doubted, on the floor, too near, behind, out of reach, with and without what lasts."""
    head = Head(pan_limit_deg=60.0, tilt_down_deg=30.0)
    observer = Observer(head=head, reward=reward)
    generator = torch.Generator().manual_seed(0)
    draw = partial(torch.rand, *batch, 700, generator=generator, dtype=torch.float64)
    memory = new_memory(observer, fibonacci_directions(700).to(dtype).expand(*batch, 700, 3))
    looks, sure = torch.floor(3 * draw()), 0.5 + 100 * draw()
    rows = torch.stack([0.1 * draw() - 0.05, 0.1 * draw() - 0.05, torch.ones_like(sure)], -1)
    matrix = (looks * sure)[..., None] * columns(*(rows[..., i] * rows[..., j] for i, j in PAIRS))
    vector = (looks * sure * (2.5 * draw() - 0.2))[..., None] * rows
    first = memory.information
    memory = memory._replace(
        information=Information(first.vector + columns(*vector.unbind(-1)), first.matrix + matrix),
        bearing=(memory.bearing + looks * sure).to(dtype),
        looks=looks.to(dtype),
        lasting=columns(looks * draw(), looks * 0.1 * draw()).to(dtype),
        votes=columns((looks > 0) * draw(), draw() * (draw() < 0.7)).to(dtype),
    )
    decided = [decide(one, memory) for one in (observer, compiled(observer, "on"))]
    assert 0.05 < float(decided[0].eligible.double().mean()) < 0.5
    same(*(step._replace(memory=(), state=()) for step in decided), dtype)
    floor = dataclasses.replace(observer, eligibility=Eligibility(nearest_m=1e6))
    same(*(decide(one, memory)._replace(memory=(), state=()) for one in (floor, compiled(floor, "on"))), dtype)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize("size", [(1, 1), (2, 1), (7, 64), (33, 50), (40, 40)])
@pytest.mark.parametrize("gazes", [None, (2, 2), (2, 3, 2)])
def test_loops_look_as_the_definition(gazes, size, dtype):
    """At images of any size, strided too, in the middle, at one place or several, also beyond their borders."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, *size, 3, generator=generator, dtype=torch.float64).to(dtype).movedim(-1, 1)
    gaze = None if gazes is None else 80 * torch.rand(gazes, generator=generator, dtype=torch.float64).to(dtype) - 20
    same(*both(lambda: fovea(image, gaze, LogPolar(900), scale=max(size) / 200)), dtype)
    values = torch.rand(2, 3, LogPolar(900).count, generator=generator, dtype=torch.float64).to(dtype)
    same(*both(lambda: reconstruct(values, LogPolar(900), size)), dtype)
