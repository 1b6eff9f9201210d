"""Whether hot functions run compiled; as they are written they remain the definition.

On the CPU `torchfovea.machine` has loops in C for them. On a GPU each is one kernel by `torch.compile`, compiled the
first time that it runs there, for half a minute or so. Its machine code is kept on disk, under a key that PyTorch makes
of all that it depends on, so that another process starts within seconds.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch

from torchfovea.setting import SettingError, require

__all__ = [
    "MODES",
    "cache_folder",
    "check_mode",
    "compiling",
    "is_compiling",
    "kernel",
    "must_compile",
    "wants_gradient",
]

MODES = ("off", "auto", "on")

_BACKEND = "inductor"
_DEVICES = ("cuda",)  # of what a kernel's tensors are on
_MODE: ContextVar[str] = ContextVar("compile", default="off")

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made")


def check_mode(mode: object) -> None:
    """Raise SettingError unless a mode is one of `MODES`."""
    require(mode in MODES, "compile", mode, "one of " + ", ".join(MODES))


@contextmanager
def compiling(mode: str) -> Iterator[None]:
    """Within it, kernels run compiled.

    Args:
        mode: `off`: not at all; `auto`: as written where they cannot be compiled, with one line of warning; `on`: there
            is no such excuse.

    Raises:
        SettingError: for another mode; with `on`, from a kernel that cannot be compiled.
    """
    check_mode(mode)
    token = _MODE.set(mode)
    try:
        yield
    finally:
        _MODE.reset(token)


def is_compiling() -> bool:
    """Whether kernels run compiled here."""
    return _MODE.get() != "off"


def must_compile() -> bool:
    """Whether what cannot be compiled is an error here."""
    return _MODE.get() == "on"


def kernel(function: Callable[_Given, _Made]) -> Callable[_Given, _Made]:
    """A pure function of (nested tuples of) tensors and settings that can run compiled on a GPU, see `compiling`.

    On the CPU, and where a gradient is wanted, it runs as written.
    """
    compiled: dict[Any, Callable[_Given, _Made] | None] = {}

    @wraps(function)
    def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        given = (args, tuple(kwargs.values()))
        if _MODE.get() == "off" or not any(tensor.device.type in _DEVICES for tensor in _tensors(given)):
            return function(*args, **kwargs)
        if torch.is_grad_enabled() and wants_gradient(given):
            return function(*args, **kwargs)
        first = _BACKEND not in compiled
        if first:
            os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_folder()))
            compiled[_BACKEND] = torch.compile(function, fullgraph=True, dynamic=True, backend=_BACKEND)
        fast = compiled[_BACKEND]
        if fast is None:
            return function(*args, **kwargs)
        try:
            # settings are constants of a kernel, sizes are not
            with torch.no_grad(), _quiet(first), torch._dynamo.config.patch(specialize_float=True):
                return fast(*args, **kwargs)
        except Exception as cause:  # of the compiler, or of the caller: then the function itself raises it, too
            result = function(*args, **kwargs)
            why = " ".join(str(cause).split("\n\n")[0].split()) or type(cause).__name__
            if must_compile():
                raise SettingError(
                    f"compile = on: expected that {function.__name__} can be compiled here, or auto ({why})"
                ) from cause
            compiled[_BACKEND] = None
            warnings.warn(f"{function.__name__} runs as written, not compiled: {why}", RuntimeWarning, stacklevel=2)
            return result

    return run


@contextmanager
def _quiet(wanted: bool) -> Iterator[None]:
    """What PyTorch says to itself while it compiles is nothing to warn a user of."""
    if not wanted:
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def wants_gradient(value: Any) -> bool:
    """Whether a gradient is asked of any of the tensors in nested tuples and lists."""
    return any(tensor.requires_grad for tensor in _tensors(value))


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """Those in nested tuples and lists."""
    if isinstance(value, tuple | list):
        for part in value:
            yield from _tensors(part)
    elif isinstance(value, torch.Tensor):
        yield value


def cache_folder() -> Path:
    """Where machine code is kept, unless PyTorch has been told another place."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "torchfovea" / "kernels"
