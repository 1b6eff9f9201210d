"""Geometry keeps its digits under automatic mixed precision, which a network beside it may want."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

__all__ = ["unrounded"]

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made")


def unrounded(function: Callable[_Given, _Made]) -> Callable[_Given, _Made]:
    """A function whose products are of its arguments' type also within `torch.autocast`, which rounds them."""

    @wraps(function)
    def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        rounding = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
        if not rounding:
            return function(*args, **kwargs)
        with ExitStack() as stack:
            for device in rounding:
                stack.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return run
