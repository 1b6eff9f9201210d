"""The same seed gives the same search: to the byte in another process, to a tolerance with other threads."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SMALL = "fidelity=geometric episodes=1 saccades=2 sensor.receptive_fields=400 memory.cells=60 picture=false seed=3"


def searched(folder, threads, hash_seed):
    """The tables of a search in a process of its own, as bytes."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": path}
    command = [sys.executable, "-m", "torchfovea", "search", *SMALL.split(), f"hydra.run.dir={folder}"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return (folder / "episodes.csv").read_bytes(), (folder / "saccades.csv").read_bytes()


def test_the_same_seed_gives_the_same_search(tmp_path):
    first = searched(tmp_path / "first", "1", "0")
    again = searched(tmp_path / "again", "1", "7")
    assert again[1] == first[1]
    # sums are split otherwise: a decision between equals may fall otherwise later, not at the first look
    threads = searched(tmp_path / "threads", "2", "0")
    rows = [next(csv.DictReader(tables[1].decode().splitlines())) for tables in (first, threads)]
    for name, value in rows[0].items():
        if value:
            assert float(rows[1][name]) == pytest.approx(float(value), rel=1e-2, abs=1e-3), name
