"""Keep memory that is freed, for the next time it is asked for.

OpenCV's semi-global matcher asks for tens or hundreds of megabytes for every pair and gives them back. The C library
returns blocks that large to the system, which fills them with zeros, page by page, when it hands them out anew: a
third of the matcher's time.
"""

from __future__ import annotations

import ctypes
import sys

__all__ = ["keep_memory"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)


def keep_memory(most_bytes: int = 2**30) -> bool:
    """From now on blocks of memory up to a size stay with this process when they are freed.

    The commands call it; a program of your own that matches pair after pair may.

    Args:
        most_bytes: larger blocks still go back to the system, less than 2 GiB.

    Returns:
        Whether the C library can: GNU's.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and all(mallopt(which, most_bytes) for which in (_TRIM_THRESHOLD, _MMAP_THRESHOLD))
