"""Keep the memory of this process from one scan to the next, and measure memory."""

from __future__ import annotations

import ctypes
import os
import resource
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

# Options of glibc's mallopt, from malloc.h.
M_TRIM_THRESHOLD = -1  # free memory above which memory is returned to the system, bytes
M_MMAP_MAX = -4  # highest number of blocks that have a mapping of their own
M_ARENA_MAX = -8  # highest number of heaps
DEFAULTS = {M_MMAP_MAX: 65536, M_TRIM_THRESHOLD: 128 * 1024}  # glibc's default values

MEMINFO = Path("/proc/meminfo")
CONTROL_GROUP = Path("/sys/fs/cgroup")  # this process's control group in a container

_is_kept = False  # whether `keep_freed_memory` took effect


def keep_freed_memory() -> bool:
    """Let this process keep the memory that it frees, instead of returning it to the system.

    By default, glibc requests each block over 32 MiB from the system, and returns it when it is
    freed. The system fills every new block with zeros, which takes time. The process keeps at most
    as much memory as its largest scan needed. All threads share one heap, because a thread's own
    heap cannot hold a block over 64 MiB.

    This changes the allocator of the whole process.

    Returns:
        Whether the C library supports it: glibc on Linux does.
    """
    global _is_kept
    # No block has a mapping of its own, no memory is returned (-1), and there is one heap.
    _is_kept = _set_options({M_MMAP_MAX: 0, M_TRIM_THRESHOLD: -1, M_ARENA_MAX: 1})
    return _is_kept


@contextmanager
def return_freed_memory() -> Iterator[None]:
    """Return freed memory to the system within the block, even after `keep_freed_memory`.

    A very large scan frees and requests large blocks in turn. In a kept heap, this leaves gaps into
    which no other block fits.
    """
    if not _is_kept:
        yield
        return
    _set_options(DEFAULTS)
    try:
        yield
    finally:
        keep_freed_memory()


def _set_options(options: Mapping[int, int]) -> bool:
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # musl has no mallopt
        return False
    return all(mallopt(option, value) for option, value in options.items())


def available_memory() -> int:
    """Return how much memory this process can still take, in bytes.

    This is the memory that the machine has available, or less if the control group allows less. On
    systems other than Linux, half of the machine's memory is assumed.
    """
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    available = total // 2
    with suppress(OSError, ValueError, StopIteration):
        lines = MEMINFO.read_text().splitlines()
        line = next(line for line in lines if line.startswith("MemAvailable:"))
        available = int(line.split()[1]) * 1024  # the line reads "MemAvailable:  123 kB"
    with suppress(OSError, ValueError):  # "max" is no number
        limit = int((CONTROL_GROUP / "memory.max").read_text())
        available = min(available, limit - int((CONTROL_GROUP / "memory.current").read_text()))
    return available


def peak_memory() -> int:
    """Return the peak memory of this process in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux counts in KiB
