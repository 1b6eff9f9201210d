"""Memories on disk: an exact round trip, and readable refusals."""

import numpy as np
import pytest
import torch

from torchfovea.gaussian import Information
from torchfovea.memory.egosphere import EgoSphere, Prior, new_egosphere
from torchfovea.memory.pooling import pool_patches
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.store import load_memory, save_memory
from torchfovea.memory.update import fuse
from torchfovea.setting import SettingError


def some_memory(dtype, batch=()) -> EgoSphere:
    cells = fibonacci_directions(50, dtype).expand(*batch, 50, 3)
    n = 50 * max(1, torch.Size(batch).numel())
    one = torch.ones(n, dtype=dtype)
    row = torch.nn.functional.normalize(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=dtype), dim=-1
    )
    pooled = pool_patches(0.3 * one, 0.01 * one, one, row, one, torch.arange(n), torch.Size(batch), 50)
    return fuse(new_egosphere(cells, Prior()), pooled)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("chart", ["inverse_range", "cartesian"])
def test_round_trip_is_exact(tmp_path, dtype, batch, chart):
    memory = some_memory(dtype, batch)
    save_memory(tmp_path / "memory.npz", memory, chart)
    back, told = load_memory(tmp_path / "memory.npz")
    assert told == chart
    for got, want in zip(
        (back.cells, *back.information, back.bearing, back.looks),
        (memory.cells, *memory.information, memory.bearing, memory.looks),
        strict=True,
    ):
        assert got.dtype == dtype and torch.equal(got, want)
    assert isinstance(back.information, Information) and back.information.matrix[..., 0].is_contiguous()


def test_what_is_no_memory_is_refused(tmp_path):
    memory = some_memory(torch.float32)
    with pytest.raises(SettingError, match=r"ends in \.npz"):
        save_memory(tmp_path / "memory.pt", memory, "inverse_range")
    with pytest.raises(SettingError, match="chart = polar"):
        save_memory(tmp_path / "memory.npz", memory, "polar")
    with pytest.raises(SettingError, match=r"path = .*none\.npz: expected a memory"):
        load_memory(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no memory")
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "text.npz")
    np.savez(tmp_path / "object.npz", cells=np.array([{}], dtype=object))
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "object.npz")
    save_memory(tmp_path / "good.npz", memory, "inverse_range")
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SettingError, match="expected a memory"):
        load_memory(tmp_path / "half.npz")
    with np.load(tmp_path / "good.npz") as file:
        arrays = dict(file)
    for name, value in (("looks", arrays["looks"][:3]), ("matrix", -arrays["matrix"]), ("chart", np.array("polar"))):
        np.savez(tmp_path / "bad.npz", **{**arrays, name: value})
        with pytest.raises(SettingError, match="expected a memory"):
            load_memory(tmp_path / "bad.npz")
