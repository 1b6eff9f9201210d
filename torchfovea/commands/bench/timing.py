"""Timing side by side: what is compared takes turns, so that a busy machine slows all alike."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from torchfovea.compiling import compiling

__all__ = [
    "Growth", "Path", "Peer", "Timing", "compiled_peer", "copy_bandwidth", "in_mode", "interleaved", "nbytes", "same",
    "slope",
]  # fmt: skip

_FEWEST, _MOST = 3, 400  # rounds
_REST_S = 0.02  # before each: threads of what ran last (BLAS, OpenMP) spin on for a while
_COPIED = 16 << 20  # floats: far more than a cache holds


class Timing(NamedTuple):
    """Milliseconds of one call: median, quartiles, the median of all threads' CPU time, and of how many calls."""

    median_ms: float
    low_ms: float
    high_ms: float
    cpu_ms: float
    runs: int


class Peer(NamedTuple):
    """Another way to the same result.

    Attributes:
        name: what a user would call it.
        run: does it.
        scale: what its time is multiplied by; more than 1 where it runs on a part of the work.
    """

    name: str
    run: Callable[[], Any]
    scale: float = 1.0


class Growth(NamedTuple):
    """The same work at several sizes.

    Attributes:
        axis: RFs, cells or batch.
        sizes: growing.
        runs: one for each size.
    """

    axis: str
    sizes: tuple[int, ...]
    runs: tuple[Callable[[], Any], ...]


class Path(NamedTuple):
    """A hot path and what it is compared with.

    Attributes:
        name: of the path; the first of several of one name gives the figures of `result.json`.
        work: in words, with its size.
        device: where it ran.
        run: ours.
        peers: the first gives the ratio of `result.json`.
        check: raises unless ours and all peers compute the same thing; called before anything is timed.
        moved: bytes of the inputs, each read once, and of the outputs, each written once; 0: not counted.
        growths: how the time grows.
        units: pieces of work in a call; times are of one piece.
    """

    name: str
    work: str
    device: str
    run: Callable[[], Any]
    peers: tuple[Peer, ...]
    check: Callable[[], None]
    moved: int = 0
    growths: tuple[Growth, ...] = ()
    units: int = 1


def in_mode(mode: str, work: Callable[..., Any], *args: Any) -> Any:
    """What a function gives where kernels run compiled, see `torchfovea.compiling`."""
    with compiling(mode):
        return work(*args)


def compiled_peer(mode: str, make: Callable[[str], Callable[[], Any]]) -> tuple[Peer, ...]:
    """The same work compiled, and called once for that; none where the mode is off.

    Args:
        mode: see `torchfovea.compiling`.
        make: what does the work in a mode.
    """
    if mode == "off":
        return ()
    quick = make(mode)
    quick()
    return (Peer("ours, compiled", quick),)


def nbytes(*parts: Any) -> int:
    """Bytes of all tensors in nested tuples."""
    total = 0
    for part in parts:
        if isinstance(part, torch.Tensor):
            total += part.numel() * part.element_size()
        elif isinstance(part, tuple):
            total += nbytes(*part)
    return total


def same(what: str, ours: Any, theirs: Any, tolerance: float, share: float = 1.0) -> None:
    """Raise unless two results agree, so that nothing is timed that does not do the work.

    Args:
        what: for the message.
        ours: array or tensor.
        theirs: the same shape.
        tolerance: of a difference, absolute where numbers are below one and relative above.
        share: of the numbers that must agree; less than 1 where rounding may decide a gate or a tie.

    Raises:
        RuntimeError: if they do not.
    """
    a, b = (np.asarray(t.detach().cpu() if isinstance(t, torch.Tensor) else t, np.float64) for t in (ours, theirs))
    if a.shape != b.shape or a.size == 0:
        raise RuntimeError(f"{what}: shapes {a.shape} and {b.shape}")
    near = np.abs(a - b) <= tolerance * np.maximum(1, np.abs(b))
    if near.mean() < share:
        raise RuntimeError(
            f"{what}: ours and the peer's differ by up to {np.abs(a - b).max():.3g} ({near.mean():.2%} agree)"
        )


def interleaved(
    runs: Sequence[Callable[[], Any]], seconds: float, device: str = "cpu", warm: bool = False
) -> list[Timing]:
    """Time functions in turns, each round in another order.

    Args:
        runs: what to call.
        seconds: for all of them together; every one runs at least three times.
        device: waited for, where it is not the CPU.
        warm: whether they have been called already; else each is called once first, which does not count.
    """
    wait: Callable[[], None] = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    taken: list[list[float]] = [[] for _ in runs]
    spent: list[list[float]] = [[] for _ in runs]
    for run in () if warm else runs:
        run()
    wait()
    begin = time.perf_counter()
    for turn in range(_MOST):
        if turn >= _FEWEST and time.perf_counter() - begin > seconds:
            break
        for place in range(len(runs)):
            which = (place + turn) % len(runs)
            time.sleep(_REST_S)
            start, cpu = time.perf_counter(), time.process_time()
            runs[which]()
            wait()
            taken[which].append(1e3 * (time.perf_counter() - start))
            spent[which].append(1e3 * (time.process_time() - cpu))
    quartiles = [[float(q) for q in np.quantile(t, (0.5, 0.25, 0.75))] for t in taken]
    middles = [float(np.median(cpu)) for cpu in spent]
    return [
        Timing(middle, low, high, cpu, len(t))
        for (middle, low, high), cpu, t in zip(quartiles, middles, taken, strict=True)
    ]


def copy_bandwidth(seconds: float, device: str = "cpu") -> float:
    """Bytes a second that copying a large tensor moves, read and written, in the median."""
    source = torch.ones(_COPIED, device=device)
    target = torch.empty_like(source)
    timing = interleaved([lambda: target.copy_(source)], seconds, device)[0]
    return 2 * nbytes(source) / (timing.median_ms / 1e3)


def slope(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Least-squares slope of log time over log size: 1 is in proportion."""
    x, y = ([math.log(v) for v in values] for values in (sizes, times))
    middle = sum(x) / len(x)
    return sum((a - middle) * b for a, b in zip(x, y, strict=True)) / sum((a - middle) ** 2 for a in x)
