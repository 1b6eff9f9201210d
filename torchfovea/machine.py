"""Hot loops in C, built by this machine's own compiler when they are first asked for.

Where observations meet cells, what to do is decided one by one, and tensors that hold every intermediate result, or
compilers of such code, spend their time on memory. The C files beside the modules do that in one loop each; the Python
beside them remains the definition, to which tests pin them. Building takes a second. What is built is kept on disk
under a key of the sources, the compiler and the processor's instructions: it cannot be stale.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import struct
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfovea.compiling import cache_folder, is_compiling, must_compile, wants_gradient
from torchfovea.setting import SettingError

__all__ = ["Loops", "columns_of", "loops"]

_REALS = {torch.float32: "float", torch.float64: "double"}
# no loop asks for errno or traps; not-a-number and infinity mean what they mean
_FLAGS = ("-std=gnu11", "-O3", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")


class Loops:
    """The functions of the C files, for one floating-point type."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library

    def __call__(self, name: str, *arguments: Any) -> int:
        """Call a function that returns an int64, negative where memory runs out.

        Args:
            name: of the function.
            arguments: contiguous tensors and None, as pointers; floats as double, ints as int64; tuples of all these
                as pointers to structures.

        Raises:
            MemoryError: where it runs out.
        """
        function = getattr(self._library, name)  # which the library keeps
        function.restype = ctypes.c_int64
        found = int(function(*map(_argument, arguments)))
        if found < 0:
            raise MemoryError(name)
        return found


def _argument(value: Any) -> Any:
    if isinstance(value, tuple):
        return struct.pack("".join("d" if isinstance(part, float) else "q" for part in value), *map(_number, value))
    return ctypes.c_double(value) if isinstance(value, float) else ctypes.c_int64(_number(value))


def _number(value: Any) -> Any:
    """A number as it is, a tensor's place in memory, 0 for None: each takes eight bytes."""
    return 0 if value is None else value.data_ptr() if isinstance(value, Tensor) else value


def loops(*tensors: Tensor | None) -> Loops | None:
    """The loops for some floating-point tensors, where they are wanted (`compiling`) and can run; None: as written.

    That is on the CPU, in float32 or float64, all of one type, where no gradient is asked for and nothing traces.

    Raises:
        SettingError: with `compile` on, where there is no C compiler, or it fails.
    """
    # what traces comes first: it cannot follow the rest
    if torch.compiler.is_compiling() or not is_compiling() or torch._C._functorch.peek_interpreter_stack():
        return None
    given = [t for t in tensors if t is not None]
    kind = given[0].dtype
    if kind not in _REALS or any(t.device.type != "cpu" or t.dtype != kind for t in given):
        return None
    if (torch.is_grad_enabled() and wants_gradient(given)) or torch.autograd.forward_ad._current_level >= 0:
        return None
    built = _built(_REALS[kind])
    if isinstance(built, str):
        if must_compile():
            raise SettingError(f"compile = on: expected that loops in C can be built here, or auto ({built})")
        _say_once(built)
        return None
    return built


def columns_of(values: Tensor) -> Tensor:
    """Vectors (..., k) component by component and contiguous, (k, ...): what `torchfovea.gaussian.columns` is."""
    return values.movedim(-1, 0).contiguous()


@lru_cache(maxsize=1)
def _say_once(why: str) -> None:
    warnings.warn(f"loops run as written, not in C: {why}", RuntimeWarning, stacklevel=4)


@lru_cache(maxsize=2)
def _built(real: str) -> Loops | str:
    """The loops, built or from the disk; or why there are none."""
    folder = Path(__file__).parent
    sources, headers = (sorted(folder.rglob(kind)) for kind in ("*.c", "*.h"))
    compiler = shlex.split(os.environ.get("CC", "cc"))
    try:
        native = _runs([*compiler, "-march=native", "-dM", "-E", "-x", "c", os.devnull])
        command = [*compiler, *_FLAGS, *(["-march=native"] if native else []), f"-DREAL={real}"]
        macros = native or _runs([*compiler, "-dM", "-E", "-x", "c", os.devnull]) or b""
        texts = [source.read_bytes() for source in (*sources, *headers)]
        key = hashlib.sha256(b"\0".join([*texts, macros, *map(os.fsencode, command)])).hexdigest()[:32]
        kept = cache_folder() / f"loops-{key}.so"
        if not kept.is_file():
            kept.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=kept.parent) as aside:
                made = Path(aside) / kept.name
                done = subprocess.run(
                    [*command, *map(str, sources), "-o", str(made), "-lm"], capture_output=True, text=True, check=False
                )
                if done.returncode != 0:
                    return _first_line(done.stderr) or f"{compiler[0]} fails"
                os.replace(made, kept)
        return Loops(ctypes.CDLL(str(kept)))
    except OSError as error:
        return str(error)


def _runs(command: Sequence[str]) -> bytes | None:
    """What a command prints; None where it fails."""
    done = subprocess.run(command, capture_output=True, check=False)
    return done.stdout if done.returncode == 0 else None


def _first_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if "error" in line.lower()] or text.split("\n")
    return lines[0][:200]
