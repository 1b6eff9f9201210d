"""Memories on disk: NumPy's npz, which holds arrays and nothing that could run."""

from __future__ import annotations

import os
from dataclasses import astuple, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.files import replacing
from torchfovea.gaussian import Information, columns, positive_definite
from torchfovea.memory.egosphere import Memory, Prior, empty_memory
from torchfovea.setting import SettingError, require
from torchfovea.untrusted import read_arrays

__all__ = ["check_memory_path", "load_memory", "save_memory"]

# of the tensors that are kept as they are; the index and the spacing follow from the cells
_ENDS = {"cells": (3,), "vector": (3,), "matrix": (6,), "bearing": (), "looks": (), "lasting": (2,), "votes": (2,)}


def check_memory_path(path: str | os.PathLike[str], setting: str = "path") -> None:
    """Refuse a path that `save_memory` could not write to, before the work is done.

    Raises:
        SettingError: for another suffix than .npz, or a folder that is not there.
    """
    folder = os.path.dirname(os.path.abspath(path))
    good = str(path).endswith(".npz") and os.path.isdir(folder) and os.access(folder, os.W_OK)
    require(good, setting, path, "a name that ends in .npz, in a folder that exists and can be written")


def save_memory(path: str | os.PathLike[str], memory: Memory) -> None:
    """Write a memory with all that it owns; the file appears whole or not at all.

    Args:
        path: ending in .npz.
        memory: one or a batch, float32 or float64.

    Raises:
        SettingError: for another suffix, or a folder that is not there.
    """
    check_memory_path(path)
    parts = (memory.cells, *memory.information, memory.bearing, memory.looks, memory.lasting, memory.votes)
    arrays: dict[str, Any] = {n: part.detach().cpu().numpy() for n, part in zip(_ENDS, parts, strict=True)}
    arrays["prior"] = np.array(astuple(memory.prior), dtype=np.float64)
    arrays["chart"] = np.array(memory.chart)
    for name in ("axis", "classes"):
        part = getattr(memory, name)
        if part is not None:
            arrays[name] = part.detach().cpu().numpy()
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def load_memory(path: str | os.PathLike[str], setting: str = "path") -> Memory:
    """Read a memory back, bit by bit as it was, on the CPU; it needs nothing else to go on.

    Args:
        path: from `save_memory`.
        setting: the name that the user knows the path by.

    Raises:
        SettingError: for a file that is missing, damaged or no memory.
    """
    try:
        arrays = read_arrays(path)
        parts = {name: torch.from_numpy(arrays[name]) for name in _ENDS}
        names = (field.name for field in fields(Prior))
        prior = Prior(**{name: float(number) for name, number in zip(names, arrays["prior"], strict=True)})
        axis, classes = (torch.from_numpy(arrays[n]) if n in arrays else None for n in ("axis", "classes"))
        _check(parts, axis, classes)
        columnar = {name: columns(*parts[name].unbind(-1)) for name, end in _ENDS.items() if end}
        empty = empty_memory(columnar["cells"], prior, str(arrays["chart"]))
    except Exception as error:  # a damaged file fails in as many ways as there are layers below
        raise SettingError(f"{setting} = {path}: expected a memory saved by torchfovea ({error})") from error
    return empty._replace(
        information=Information(columnar["vector"], columnar["matrix"]),
        bearing=parts["bearing"],
        looks=parts["looks"],
        lasting=columnar["lasting"],
        votes=columnar["votes"],
        axis=axis,
        classes=classes,
    )


def _check(parts: dict[str, Tensor], axis: Tensor | None, classes: Tensor | None) -> None:
    """Raise SettingError unless these can be a memory."""
    shape = parts["cells"].shape[:-1]
    every = [*parts.values(), *(part for part in (axis, classes) if part is not None)]
    good = all(parts[name].shape == (*shape, *end) for name, end in _ENDS.items())
    good = good and len(shape) > 0 and (axis is None or axis.shape == (*shape[:-1], 3))
    good = good and (classes is None or (classes.shape[:-1] == shape and bool((classes > 0).all())))
    require(good, "shapes", [tuple(part.shape) for part in every], "those of one set of cells")
    kind = parts["cells"].dtype
    sums = [parts["vector"], parts["matrix"]]
    good = kind in (torch.float32, torch.float64) and all(part.dtype == torch.float64 for part in sums)
    good = good and all(part.dtype == kind for part in every if not any(part is one for one in sums))
    good = good and all(bool(torch.isfinite(part).all()) for part in every)
    require(good, "values", "of several kinds or not finite", "finite numbers of one kind, sums in float64")
    counted = (parts[name] for name in ("bearing", "looks", "votes"))
    good = all(bool((part >= 0).all()) for part in counted) and bool(positive_definite(parts["matrix"], 0.0).all())
    require(good, "values", "negative counts or no covariance", "a memory's")
