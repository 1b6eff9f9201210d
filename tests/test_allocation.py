"""Freed memory that stays: the system hands out no pages for the second block."""

import platform
import subprocess
import sys
from pathlib import Path

import torchfovea

# in a process of its own, whose allocator nobody else has told anything
PROGRAM = """
import resource, runpy, sys
import numpy as np
keeps = "keep" in sys.argv and runpy.run_path(sys.argv[1])["keep_memory"]()
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(2**27, np.uint8)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(int(keeps), faults)
"""


def faults(*asked):
    path = Path(torchfovea.__file__).parent / "allocation.py"
    out = subprocess.run([sys.executable, "-c", PROGRAM, path, *asked], capture_output=True, text=True, check=True)
    return tuple(map(int, out.stdout.split()))


def test_a_block_that_is_freed_comes_back_without_new_pages():
    glibc = sys.platform == "linux" and platform.libc_ver()[0] == "glibc"
    (_, before), (keeps, after) = faults(), faults("keep")
    assert bool(keeps) == glibc
    assert not glibc or after < before / 10
