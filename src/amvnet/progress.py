"""How a long computation reports: its progress, and what it has to say in lines."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  # takes what is done, and the total
Say = Callable[[str], None]  # takes a line


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


def say_nothing(line: str) -> None:
    """Print nothing."""
