"""Report the progress of a long computation, and lines about it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

Progress = Callable[[int, int], None]  # takes the number of things done, and their total
TitledProgress = Callable[[str], AbstractContextManager[Progress]]  # takes what the things are for
Reporter = Callable[[str], None]  # takes a line about what happens, such as `print`

QUIET_SECONDS = 20  # time after the start in which no line is due, seconds


class Tenths:
    """Decides when a line about progress is due: at most ten times, and not near the start."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._reported = 0  # number of tenths at the last line

    def ends(self, done: int, total: int) -> bool:
        """Return whether a line is due, because another tenth of `total` things is done."""
        tenths = 10 * done // max(total, 1)
        if tenths <= self._reported or time.monotonic() - self._start < QUIET_SECONDS:
            return False
        self._reported = tenths
        return True


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


def report_nothing(line: str) -> None:
    """Print nothing."""
