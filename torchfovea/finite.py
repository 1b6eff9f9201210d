"""Checks of tensors' values, where looking at them costs nothing."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfovea.setting import require

__all__ = ["require_finite"]


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
