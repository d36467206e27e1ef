"""Memory of this process: kept from one scan to the next, and how much it was at most."""

from __future__ import annotations

import ctypes
import resource
import sys

# glibc's mallopt, from malloc.h
M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8


def keep_freed_memory() -> bool:
    """Let this process keep what it frees; returns whether the C library could be told so (glibc's can).

    By default glibc fetches each map of more than 32 MiB anew from the system, which fills it with zeros page by page:
    up to half of a scan's time. What is kept is what the largest scan took. All threads share one heap, as those of
    threads by themselves take no map of more than 64 MiB.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # musl has none
        return False
    return all(
        mallopt(option, value)
        for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1), (M_ARENA_MAX, 1))
    )


def peak_memory() -> int:
    """Bytes of memory that this process has taken at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )
