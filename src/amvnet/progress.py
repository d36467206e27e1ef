"""How a long computation reports: its progress, and what it has to say in lines."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  # takes what is done, and the total
Say = Callable[[str], None]  # takes a line


def ends_tenth(done: int, total: int) -> bool:
    """Return whether the last of `done` things completes another tenth of all of them."""
    return done * 10 // total > (done - 1) * 10 // total


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


def say_nothing(line: str) -> None:
    """Print nothing."""
