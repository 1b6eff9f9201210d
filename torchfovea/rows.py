"""Many of a kind as one with a leading axis: memories, looks, moves; and each of them again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchfovea.memory.nearest import CellIndex, index_of_set, join_indices
from torchfovea.setting import require

__all__ = ["each", "row", "stack", "to_device"]


def stack(rows: Sequence[Any]) -> Any:
    """Rows of nested named tuples of tensors and numbers, as one with a leading axis.

    Indices of cells are joined. Whatever else there is (a memory's prior and chart) must be the same for all.

    Raises:
        SettingError: for rows that cannot be one batch.
    """
    first = rows[0]
    if isinstance(first, CellIndex):
        return join_indices(rows)
    if isinstance(first, tuple):
        return type(first)(*(stack(parts) for parts in zip(*rows, strict=True)))
    if first is None:
        return None
    if isinstance(first, bool):
        return torch.tensor(rows)
    if isinstance(first, float | int):
        return torch.tensor(rows, dtype=torch.float64)
    if isinstance(first, Tensor):
        shapes = {tuple(part.shape) for part in rows}
        require(len(shapes) == 1, "rows", sorted(shapes), "the same shape for all")
        return torch.stack(list(rows))
    other = next((part for part in rows if part != first), first)
    require(other == first, "rows", f"{first} and {other}", "the same for all")
    return first


def row(value: Any, b: int) -> Any:
    """Row b of every tensor, and of every index of cells, in nested tuples; whatever else stays as it is."""
    if isinstance(value, CellIndex):
        return index_of_set(value, b)
    if isinstance(value, tuple):
        parts = [row(part, b) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value[b] if isinstance(value, Tensor) else value


def each(change: Callable[[Tensor], Tensor], value: Any, kept: tuple[type, ...] = ()) -> Any:
    """Every tensor in nested tuples changed; whatever else there is stays, and so does what is of a kept kind."""
    if isinstance(value, tuple) and not isinstance(value, kept):
        parts = [each(change, part, kept) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return change(value) if isinstance(value, Tensor) else value


def to_device(value: Any, device: torch.device | str) -> Any:
    """Nested tuples with their tensors on another device."""
    return each(lambda part: part.to(device), value)
