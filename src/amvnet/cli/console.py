"""Print lines and progress."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich import progress as rich_progress
from rich.console import Console

from amvnet.progress import Progress

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
    """Yield what shows progress: a bar on a terminal, elsewhere a line for each tenth."""
    if not on_terminal():
        yield lambda done, total: _say_each_tenth(title, done, total)
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


def _say_each_tenth(title: str, done: int, total: int) -> None:
    if done and done * 10 // total != (done - 1) * 10 // total:
        say(f"{title}: {done} of {total}")
