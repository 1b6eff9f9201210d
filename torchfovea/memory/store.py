"""Memories on disk: NumPy's npz, which holds arrays and nothing that could run."""

from __future__ import annotations

import os
import zipfile
from typing import Any

import numpy as np
import torch

from torchfovea.files import replacing
from torchfovea.gaussian import Information, columns, positive_definite
from torchfovea.memory.egosphere import EgoSphere
from torchfovea.setting import SettingError, require

__all__ = ["load_memory", "save_memory"]

_PARTS = ("cells", "vector", "matrix", "bearing", "looks", "lasting", "votes")


def save_memory(path: str | os.PathLike[str], memory: EgoSphere, chart: str) -> None:
    """Write a memory; the file appears whole or not at all.

    Args:
        path: ending in .npz.
        memory: any shape, float32 or float64.
        chart: that the memory is kept in, see `torchfovea.memory.egosphere.Fusion.chart`.

    Raises:
        SettingError: for another suffix or an unknown chart.
    """
    require(str(path).endswith(".npz"), "path", path, "a name that ends in .npz")
    require(chart in ("inverse_range", "cartesian"), "chart", chart, "inverse_range or cartesian")
    parts = (memory.cells, *memory.information, memory.bearing, memory.looks, memory.lasting, memory.votes)
    arrays: dict[str, Any] = {n: part.detach().cpu().numpy() for n, part in zip(_PARTS, parts, strict=True)}
    arrays["chart"] = np.array(chart)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def load_memory(path: str | os.PathLike[str]) -> tuple[EgoSphere, str]:
    """Read a memory back, bit by bit as it was.

    Returns:
        The memory, on the CPU, and its chart.

    Raises:
        SettingError: for a file that is missing, damaged or no memory.
    """
    try:
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            arrays = {name: file[name] for name in (*_PARTS, "chart")}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise SettingError(f"path = {path}: expected a memory saved by torchfovea ({error})") from error
    chart = str(arrays.pop("chart"))
    parts = {name: torch.from_numpy(array) for name, array in arrays.items()}
    shape = parts["cells"].shape[:-1]
    ends = {"cells": (3,), "vector": (3,), "matrix": (6,), "bearing": (), "looks": (), "lasting": (2,), "votes": (2,)}
    good = chart in ("inverse_range", "cartesian") and all(parts[n].shape == (*shape, *e) for n, e in ends.items())
    good = good and all(p.is_floating_point() and bool(torch.isfinite(p).all()) for p in parts.values())
    good = good and len(shape) > 0 and bool(positive_definite(parts["matrix"], 0.0).all())
    require(good, "path", path, "a memory saved by torchfovea")
    columnar = {name: columns(*parts[name].unbind(-1)) for name, end in ends.items() if end}
    information = Information(columnar["vector"], columnar["matrix"])
    known = parts["bearing"], parts["looks"], columnar["lasting"], columnar["votes"]
    return EgoSphere(columnar["cells"], information, *known), chart
