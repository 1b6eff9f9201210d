"""One tree's side of ``bench against=COMMIT``: run as text in the tree's folder, it calls paths when it is told to.

It is the newer tree's text in both, and asks of the other that it can make its paths. Arguments: the settings. It
prints a line of JSON: the paths' names and work; then for every line that it reads, which is a path's number, one with
the wall and CPU milliseconds of a call.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import suppress
from importlib import import_module

import torch
from hydra import compose, initialize_config_dir

from torchfovea.commands.shared.config import conf_dir

__all__ = ["serve"]


def serve(settings: list[str]) -> None:
    """Make the paths, call each once, and then as asked."""
    try:
        found = import_module("torchfovea.commands.bench.builders")
        make, known = found.builders_of, found.PATHS
    except ModuleNotFoundError:  # before it had a home of its own
        found = import_module("torchfovea.commands.bench.command")
        make, known = found._builders, found.PATHS
    with suppress(ModuleNotFoundError):  # as its command does, if it does
        import_module("torchfovea.allocation").keep_memory()
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("bench", settings)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    wanted = known if cfg.paths is None else (cfg.paths,) if isinstance(cfg.paths, str) else tuple(cfg.paths)
    with torch.no_grad():
        paths = [path for build in make(cfg, cfg.device, wanted) for path in build() if path.name in wanted]
        for path in paths:
            path.run()
        print(json.dumps([[path.name, path.work] for path in paths]), flush=True)
        for line in sys.stdin:
            path = paths[int(line)]
            wall, cpu = time.perf_counter(), time.process_time()
            path.run()
            if cfg.device != "cpu":
                torch.cuda.synchronize()
            spent = time.perf_counter() - wall, time.process_time() - cpu
            print(json.dumps([1e3 * seconds / path.units for seconds in spent]), flush=True)


if __name__ == "__main__":
    serve(sys.argv[1:])
