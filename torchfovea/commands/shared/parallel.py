"""Work spread over processes by joblib: on this machine (loky), or wherever a backend of joblib's reaches."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import torch
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError
from omegaconf import DictConfig, OmegaConf

from torchfovea.allocation import keep_memory
from torchfovea.commands.shared.settings import whole
from torchfovea.setting import SettingError, require

__all__ = ["spread", "workers_of"]

Item = TypeVar("Item")
Result = TypeVar("Result")

_LOOK_S = 1.0


def workers_of(cfg: DictConfig) -> tuple[int, str]:
    """The settings `workers`, how many processes, and `backend`, of joblib, that they belong to."""
    backend = OmegaConf.select(cfg, "backend")
    require(isinstance(backend, str) and bool(backend), "backend", backend, "loky, or another backend of joblib's")
    with _configured(str(backend)):
        pass
    return whole(cfg, "workers"), str(backend)


def spread(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int, backend: str = "loky"
) -> Iterator[tuple[int, Result | Exception]]:
    """Each item's number with its result or its error, as they come.

    Args:
        function: what to do with an item; importable, where the workers are processes.
        items: what to do it with.
        workers: how many at once; with 1 everything happens here, one after the other.
        backend: of joblib: loky (processes of this machine, one thread each, which end within seconds when this one is
            killed), threading, or one that a package registered with joblib (ray, dask).

    Raises:
        SettingError: for an unknown backend, or a worker that was killed.
    """
    numbered = list(enumerate(items))
    if workers == 1 or len(numbered) < 2:
        for k, item in numbered:
            yield _attempt(function, k, item)
        return
    settings: dict[str, Any] = {}
    if backend == "loky":
        # joblib keeps its processes for the next call: not for one from elsewhere, which finds other modules
        origin = os.getpid(), os.getcwd(), tuple(sys.path)
        settings = {"inner_max_num_threads": 1, "initializer": _begin, "initargs": origin}
    with _configured(backend, n_jobs=min(workers, len(numbered)), **settings):
        together = Parallel(return_as="generator_unordered")
    found = together(delayed(_attempt)(function, k, item) for k, item in numbered)
    try:
        yield from map(tuple, found)  # and not from found itself, which would then be closed before we do it
    except TerminatedWorkerError as error:
        expected = "processes that live until their work is done"
        raise SettingError(f"workers = {workers}: expected {expected} ({' '.join(str(error).split())})") from error
    finally:
        with warnings.catch_warnings():  # who goes away early needs no advice to ask for less
            warnings.simplefilter("ignore", UserWarning)
            found.close()


def _configured(backend: str, **settings: Any) -> parallel_config:
    """Joblib's configuration with a backend that there is."""
    try:
        return parallel_config(backend, **settings)
    except (ValueError, ImportError) as error:
        raise SettingError(f"backend = {backend}: expected loky, or another backend of joblib's ({error})") from error


def _attempt(function: Callable[[Item], Result], number: int, item: Item) -> tuple[int, Result | Exception]:
    try:
        return number, function(item)
    except Exception as error:
        return number, error


def _begin(command: int, folder: str, path: tuple[str, ...]) -> None:
    os.chdir(folder)
    sys.path[:] = path
    torch.set_num_threads(1)
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"  # read when it is imported
    keep_memory()
    threading.Thread(target=_end_with, args=(command,), daemon=True).start()


def _end_with(command: int) -> None:
    while os.getppid() == command:
        time.sleep(_LOOK_S)
    os._exit(1)
