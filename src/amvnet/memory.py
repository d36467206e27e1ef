"""Memory of this process: keep it from one scan to the next, and ask for its peak."""

from __future__ import annotations

import ctypes
import resource
import sys

# Options of glibc's mallopt, from malloc.h.
M_TRIM_THRESHOLD = -1
M_MMAP_MAX = -4
M_ARENA_MAX = -8


def keep_freed_memory() -> bool:
    """Let this process keep the memory that it frees, instead of returning it to the system.

    By default glibc asks the system for each block over 32 MiB and returns it when it is freed, and
    the system fills every new block with zeros. Kept is at most what the largest scan needed. All
    threads share one heap, because the heaps of single threads hold no block over 64 MiB.

    This changes the allocator of the whole process.

    Returns:
        Whether the C library supports it: glibc on Linux does.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # musl has none
        return False

    options = ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1), (M_ARENA_MAX, 1))
    return all(mallopt(option, value) for option, value in options)


def peak_memory() -> int:
    """Return the peak memory of this process in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
