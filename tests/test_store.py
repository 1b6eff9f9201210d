"""Memories on disk: an exact round trip, and readable refusals."""

import numpy as np
import pytest
import torch

from torchfovea.gaussian import Information
from torchfovea.memory.egosphere import Memory, Prior, empty_memory
from torchfovea.memory.pooling import pool_patches
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.store import load_memory, save_memory
from torchfovea.memory.update import fuse
from torchfovea.perception import Observer, decide, new_memory, perceive
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import SettingError


def some_memory(dtype, batch=(), chart="inverse_range") -> Memory:
    cells = fibonacci_directions(50, dtype).expand(*batch, 50, 3)
    n = 50 * max(1, torch.Size(batch).numel())
    one = torch.ones(n, dtype=dtype)
    row = torch.nn.functional.normalize(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=dtype), dim=-1
    )
    pooled = pool_patches(0.3 * one, 0.01 * one, one, row, one, torch.arange(n), (*batch, 50))
    axis = torch.tensor([1.0, 0, 0], dtype=dtype).expand(*batch, 3)
    return fuse(empty_memory(cells, Prior(0.7, 0.3, 0.2, 1.1), chart), pooled)._replace(axis=axis)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_round_trip_is_exact(tmp_path, dtype, batch, chart):
    memory = some_memory(dtype, batch, chart)
    save_memory(tmp_path / "memory.npz", memory)
    back = load_memory(tmp_path / "memory.npz")
    assert back.chart == chart and back.prior == memory.prior
    for got, want in zip(leaves(back), leaves(memory), strict=True):
        assert got.dtype == want.dtype and torch.equal(got, want)
    assert isinstance(back.information, Information) and back.information.matrix[..., 0].is_contiguous()
    blank = memory._replace(axis=None)
    save_memory(tmp_path / "blank.npz", blank)
    assert load_memory(tmp_path / "blank.npz").axis is None


def leaves(value):
    """The tensors of nested tuples."""
    if isinstance(value, torch.Tensor):
        return [value]
    return [leaf for part in value for leaf in leaves(part)] if isinstance(value, tuple) else []


def test_a_loaded_memory_goes_on_as_the_one_that_was_saved(tmp_path):
    observer = Observer(retina=LogPolar(300))
    px = observer.retina.centers_px()
    sigma, seen = torch.full((len(px),), 0.5), torch.ones(len(px), dtype=torch.bool)
    matches = Correspondences(px, px - torch.tensor([3.0, 0.0]), sigma, sigma, seen)
    zero = torch.tensor(0.0)
    poses = [eyes(observer.head, Gaze(zero + pan, zero, zero)) for pan in (0.0, 0.1)]
    memory = perceive(observer, new_memory(observer, fibonacci_directions(80, torch.float32)), matches, poses[0])
    save_memory(tmp_path / "memory.npz", memory)
    steps = [
        decide(observer, perceive(observer, one, matches, poses[1]), torch.Generator().manual_seed(0))
        for one in (memory, load_memory(tmp_path / "memory.npz"))
    ]
    assert int((steps[0].memory.looks == 2).sum()) > 5
    for got, want in zip(leaves(steps[1]), leaves(steps[0]), strict=True):
        assert torch.equal(got, want)


def test_what_is_no_memory_is_refused(tmp_path):
    memory = some_memory(torch.float32)
    with pytest.raises(SettingError, match=r"ends in \.npz"):
        save_memory(tmp_path / "memory.pt", memory)
    with pytest.raises(SettingError, match="in a folder that exists"):
        save_memory(tmp_path / "none" / "memory.npz", memory)
    with pytest.raises(SettingError, match=r"path = .*none\.npz: expected a memory"):
        load_memory(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no memory")
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "text.npz")
    np.savez(tmp_path / "object.npz", cells=np.array([{}], dtype=object))
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "object.npz")
    save_memory(tmp_path / "good.npz", memory)
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "half.npz")
    with np.load(tmp_path / "good.npz") as file:
        arrays = dict(file)
    bad = {
        "looks": (arrays["looks"][:3], -arrays["looks"] - 1, arrays["looks"].astype(np.int64)),
        "bearing": (-arrays["bearing"] - 1,),
        "matrix": (-arrays["matrix"],),
        "cells": (arrays["cells"][:0], 2 * arrays["cells"]),
        "prior": (arrays["prior"][:2], -arrays["prior"]),
        "axis": (np.zeros((4, 3), np.float32),),
        "chart": (np.array("polar"),),
    }
    for name, value in ((name, value) for name, values in bad.items() for value in values):
        np.savez(tmp_path / "bad.npz", **{**arrays, name: value})
        with pytest.raises(SettingError, match="expected a memory"):
            load_memory(tmp_path / "bad.npz")
