"""Report the progress of a long computation, and lines about it."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[int, int], None]  # takes the number of things done, and their total
Reporter = Callable[[str], None]  # takes a line about what happens, such as `print`

QUIET_SECONDS = 20  # time from the start in which no line is due, seconds


class Tenths:
    """Decides when a line about progress is due: at most ten times, and not at the beginning."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._said = 0

    def ends(self, done: int, total: int) -> bool:
        """Return whether the last of `done` things has completed another tenth of all of them."""
        tenths = 10 * done // max(total, 1)
        if tenths <= self._said or time.monotonic() - self._start < QUIET_SECONDS:
            return False
        self._said = tenths
        return True


def counted(count: int, noun: str, plural: str = "") -> str:
    """Return a number of things in words, such as "1 scan" or "2 scans".

    Args:
        plural: the plural of the noun if it is not regular.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {plural or f'{noun}s'}"


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


def report_nothing(line: str) -> None:
    """Print nothing."""
