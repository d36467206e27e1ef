"""What is printed: lines, and how far something is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

console = Console(highlight=False)


def say(line: str) -> None:
    """A line, left as long as it is: paths are copied from it."""
    console.print(line, markup=False, soft_wrap=True)


def silence() -> None:
    """Print nothing from here on: of several processes, one is enough."""
    console.quiet = True


def on_terminal() -> bool:
    return console.is_terminal


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, a line every tenth elsewhere; yields what is told (done, in all)."""
    if not on_terminal():
        yield lambda done, total: _tenth(title, done, total)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _tenth(title: str, done: int, total: int) -> None:
    if done and done * 10 // total != (done - 1) * 10 // total:
        say(f"{title}: {done} of {total}")
