"""Keeps the memory of one scan for the next, where the C library would hand it back to the system in between."""

from __future__ import annotations

import ctypes
import sys

# glibc's mallopt, from malloc.h
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4


def keep_memory() -> bool:
    """Let this process keep what it frees; returns whether the C library could be told so (glibc's can).

    By default glibc fetches each map of more than 32 MiB anew from the system, which fills it with zeros page by page:
    up to half of a scan's time. What is kept is what the largest scan took.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # musl has none
        return False
    return bool(mallopt(M_MMAP_MAX, 0)) and bool(mallopt(M_TRIM_THRESHOLD, -1))
