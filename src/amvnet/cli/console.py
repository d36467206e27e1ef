"""Print lines and progress."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich import progress as rich_progress
from rich.console import Console

from amvnet.progress import Progress

LEAST_SECONDS = 5  # between two lines about progress
MOST_SECONDS = 60

console = Console(highlight=False)


def say(line: str) -> None:
    """Print a line without wrapping it, because paths are copied from it."""
    console.print(line, markup=False, soft_wrap=True)


def silence() -> None:
    """Print nothing from now on: of several processes, one is enough."""
    console.quiet = True


def on_terminal() -> bool:
    """Return whether the output is a terminal."""
    return console.is_terminal


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Yield what shows progress: a bar on a terminal, elsewhere lines with the pace."""
    if not on_terminal():
        yield ProgressLines(title)
        return

    columns = (
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
    )
    with rich_progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class ProgressLines:
    """Says in lines what is done, how fast, and how long the rest takes.

    A line is due for each tenth, and once a minute; in between are at least some seconds.

    Args:
        title: the beginning of each line.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.start = time.monotonic()
        self.last = self.start
        self.tenths = 0

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        tenths = 10 * done // max(total, 1)
        since_last = now - self.last
        is_due = tenths > self.tenths or since_last >= MOST_SECONDS
        if not done or not is_due or since_last < LEAST_SECONDS:
            return

        self.last = now
        self.tenths = tenths
        say(f"{self.title}: {done} of {total}, {self._pace(done, total, now - self.start)}")

    def _pace(self, done: int, total: int, elapsed: float) -> str:
        """Return the rate and the time left: "2.1 a second, 0:01:16 left"."""
        rate = done / elapsed
        pace = f"{rate:.3g} a second" if rate >= 1 else f"{1 / rate:.3g} s each"
        left = timedelta(seconds=round((total - done) / rate))
        return f"{pace}, {left} left"
