"""How much memory a call takes while it runs."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

__all__ = ["peak_bytes"]

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_bytes(run: Callable[[], Any], device: str = "cpu") -> int | None:
    """The most memory that a call holds beyond what there was before it; None where the system does not tell.

    Args:
        run: called once.
        device: cpu: the process's resident memory, which Linux tells; cuda: PyTorch's on the device.
    """
    gc.collect()
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        return torch.cuda.max_memory_allocated() - before
    try:
        # what the allocator keeps for later would hide what the call takes from it
        ctypes.CDLL(None).malloc_trim(0)
        before = _status("VmRSS")
        _RESET.write_text("5")
        run()
        return max(0, _status("VmHWM") - before)
    except (OSError, AttributeError, ValueError):
        return None


def _status(name: str) -> int:
    """A line of the process's status, in bytes."""
    for line in _STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise ValueError(f"{_STATUS} has no {name}")
