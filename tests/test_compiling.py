"""Compiled kernels give what the functions as written give; without a compiler those run."""

import dataclasses
from functools import partial

import pytest
import torch

import torchfovea.compiling as compiling_module
from torchfovea import Fusion, Gaze, Head, LogPolar, Observer, Pinhole, compiled, decide, eyes, new_memory, perceive
from torchfovea.compiling import compiling, kernel
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.setting import SettingError

CAMERA = Pinhole.from_fov(100.0, 100.0)


def matches_of(batch: tuple[int, ...], count: int, seed: int, dtype: torch.dtype) -> Correspondences:
    """Correspondences near and far, a few without noise or out of order."""
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.rand, *batch, count, generator=generator, dtype=torch.float64)
    left = torch.stack([100 * draw() - 50, 100 * draw() - 50], -1)
    right = left - torch.stack([12 * draw() - 2, 0.5 * draw()], -1)
    sigma = torch.where(draw() < 0.05, -1.0, 0.2 + draw()), 0.2 + draw()
    parts = (part.to(dtype) for part in (left, right, *sigma))
    return Correspondences(*parts, draw() < 0.9)


def pose_of(batch: tuple[int, ...], dtype: torch.dtype):
    shift = torch.linspace(0, 0.2, 2, dtype=dtype).expand(*batch) if batch else torch.zeros((), dtype=dtype)
    return eyes(Head(), Gaze(shift, 0.1 + shift, 0.15 + shift))


@pytest.fixture
def traced(monkeypatch):
    """Each kernel of a GPU as one graph, run by PyTorch itself on the CPU: machine code takes minutes, and a compiler.

    No loops in C.
    """
    monkeypatch.setattr(compiling_module, "_BACKEND", "eager")
    monkeypatch.setattr(compiling_module, "_DEVICES", ("cpu",))
    monkeypatch.setattr("torchfovea.machine._REALS", {})


def test_a_compiled_observer_sees_and_decides_as_the_definition(traced):
    fusion = Fusion(gate_deg=3.0)
    observer = Observer(head=Head(encoder_deg=0.05), camera=CAMERA, retina=LogPolar(300), fusion=fusion)
    fast = compiled(observer, "on")
    memory = other = new_memory(observer, fibonacci_directions(500).float())
    for seed in (0, 1):
        matches, pose = matches_of((), 300, seed, torch.float32), pose_of((), torch.float32)
        memory, other = perceive(observer, memory, matches, pose), perceive(fast, other, matches, pose)
        step, same = decide(observer, memory), decide(fast, other)
        assert int(step.cell) == int(same.cell) and torch.equal(step.eligible, same.eligible)
        assert torch.equal(memory.looks, other.looks) and int((memory.looks > 0).sum()) > 20
        pairs = ((memory.information, other.information), (step.points, same.points), (step.reward, same.reward))
        for ours, theirs in (*pairs, ((memory.votes,), (other.votes,)), (step.gaze, same.gaze)):
            for one, two in zip(ours, theirs, strict=True):
                torch.testing.assert_close(two, one, rtol=2e-4, atol=2e-4)


def test_without_a_compiler_the_function_runs_and_says_so_once(monkeypatch):
    def no_compiler(graph, inputs):
        raise RuntimeError("no compiler here")

    monkeypatch.setattr(compiling_module, "_BACKEND", no_compiler)
    monkeypatch.setattr(compiling_module, "_DEVICES", ("cpu",))
    twice = kernel(lambda x: (2 * x,))
    with compiling("auto"):
        with pytest.warns(RuntimeWarning, match="not compiled: .*no compiler here"):
            assert twice(torch.ones(3))[0].tolist() == [2, 2, 2]
        assert twice(torch.ones(3))[0].tolist() == [2, 2, 2]
    thrice = kernel(lambda x: (3 * x,))
    with compiling("on"), pytest.raises(SettingError, match=r"compile = on: expected .* compiled"):
        thrice(torch.ones(3))


def test_gradients_go_the_way_that_is_written(monkeypatch):
    def never(graph, inputs):
        raise AssertionError("a gradient was compiled")

    monkeypatch.setattr(compiling_module, "_BACKEND", never)
    monkeypatch.setattr(compiling_module, "_DEVICES", ("cpu",))
    square = kernel(lambda pair: (pair[0] * pair[1],))
    x = torch.ones(3, requires_grad=True)
    with compiling("on"):
        square((x, x))[0].sum().backward()
    assert x.grad.tolist() == [2, 2, 2]


def test_a_mode_that_there_is_not_is_named():
    with pytest.raises(SettingError, match="compile = maybe: expected one of off, auto, on"):
        compiled(Observer(), "maybe")
    assert dataclasses.replace(compiled(Observer(), "auto"), compile="off") == Observer()
