"""Checks of tensors: that they are some, and of their values where looking at them costs nothing."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.setting import SettingError, require

__all__ = ["require_finite", "require_tensor"]


def require_finite(values: Tensor, setting: str, expected: str) -> None:
    """Check that values are finite, on the CPU in ordinary eager code.

    Elsewhere nothing is asked: on a GPU the answer would have to be waited for, and `torch.compile`, `torch.export` and
    `torch.func`'s transforms have no values to look at. What is not finite then passes through.

    Args:
        values: any tensor.
        setting: the name that the user knows it by.
        expected: what would have been acceptable.

    Raises:
        SettingError: for NaN or infinite values, where they can be seen.
    """
    if torch.compiler.is_compiling() or values.device.type != "cpu" or torch._C._functorch.peek_interpreter_stack():
        return
    values = values.detach()
    # a sum is many times faster than isfinite; that of large numbers may overflow
    finite = bool(values.sum().isfinite()) or bool(values.isfinite().all())
    require(finite, setting, "NaN or infinite values", expected)


def require_tensor(value: object, setting: str, expected: str) -> None:
    """Check that an input is a tensor, not an array, a list or a number.

    Raises:
        SettingError: for anything else; it names the type.
    """
    if not isinstance(value, Tensor):
        raise SettingError(f"{setting} = {type(value).__name__}: expected {expected}")
