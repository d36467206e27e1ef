"""Print lines, tables and progress to stdout, and faults to stderr.

Only this module prints. It escapes characters that are not printable, shortens long texts, and
never fails, so that labels are written even if nobody can read the lines about them.
"""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

from rich import progress as rich_progress
from rich.console import Console, RenderableType

from amvnet.fleet.secrets import without_secrets
from amvnet.progress import Progress, Tenths

LONGEST_LINE = 5000  # longest line that is printed in full, characters
MAX_LINES = 2000  # largest number of lines that are printed of one text
LEAST_FOR_PACE = 10  # of fewer things, one that takes long decides the pace, which then misleads


class SafeStream:
    """The stream `stdout` or `stderr`, on which nothing fails. What cannot be written is lost."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def _stream(self) -> Any:
        """The current stream, because tests or a progress bar may have replaced it."""
        stream = getattr(sys, self.name)
        return getattr(stream, "rich_proxied_file", stream)

    def write(self, text: str) -> None:
        """Write a text. Characters that the stream cannot encode are escaped."""
        stream = self._stream
        encoding = getattr(stream, "encoding", None) or "utf-8"
        with self._never_failing():
            stream.write(text.encode(encoding, "backslashreplace").decode(encoding))

    def flush(self) -> None:
        """Write the text in the buffer."""
        with self._never_failing():
            self._stream.flush()

    @contextmanager
    def _never_failing(self) -> Iterator[None]:
        """Lose this and all later output if the stream is closed or its disk is full."""
        try:
            yield
        except (OSError, ValueError, AttributeError) as error:  # after >&- the stream is None
            # What libraries write to the stream must not fail either.
            with suppress(OSError, ValueError, AttributeError), open(os.devnull, "w") as nothing:
                os.dup2(nothing.fileno(), self._stream.fileno())
            # A closed stream is no fault: the user closed it, or a reader such as head has enough.
            if self.name == "stdout" and isinstance(error, OSError) and error.errno != errno.EPIPE:
                report_fault(f"stdout cannot be written ({error.strerror}); the work goes on")


stdout = SafeStream("stdout")
stderr = SafeStream("stderr")
console = Console(file=stdout, markup=False, emoji=False, highlight=False)  # type: ignore[arg-type]


def report(line: str) -> None:
    """Print a line without wrapping it, because paths are copied from it."""
    console.print(printable(line), soft_wrap=True)


def report_lines(text: str) -> None:
    """Print a text of several lines, but at most `MAX_LINES` of them."""
    lines = text.split("\n")
    for line in lines[:MAX_LINES]:
        report(line)
    if len(lines) > MAX_LINES:
        report(f"... ({len(lines) - MAX_LINES} more lines)")


def show(table: RenderableType) -> None:
    """Print a table without styles, line by line as `report` prints lines."""
    plain = Console(
        file=stdout,  # type: ignore[arg-type]
        width=console.width,
        color_system=None,
        emoji=False,
        markup=False,
    )
    with plain.capture() as captured:
        plain.print(table)
    report_lines(captured.get().rstrip("\n"))


def report_fault(line: str) -> None:
    """Print a line about a fault to stderr."""
    stderr.write(f"amvnet: {printable(line)}\n")
    stderr.flush()


def printable(text: str) -> str:
    """Return a text on one line, without secrets, for printing.

    A long text is shortened, and characters that are not printable are escaped.
    """
    text = without_secrets(text)
    if len(text) > LONGEST_LINE:
        text = f"{text[:LONGEST_LINE]}... ({len(text):,} characters)"
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def silence() -> None:
    """Print nothing from now on, because another process of the job prints."""
    console.quiet = True


def on_terminal() -> bool:
    """Return whether the output is a terminal."""
    return console.is_terminal


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Yield a function that shows progress: as a bar on a terminal, elsewhere as lines."""
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
    """Reports in at most ten lines how much is done, how fast, and how long the rest takes."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.start = time.monotonic()
        self.tenths = Tenths()

    def __call__(self, done: int, total: int) -> None:
        """Report the progress if another tenth of the work is done."""
        if self.tenths.ends(done, total):
            line = f"{self.title}: {done} of {total}"
            if total >= LEAST_FOR_PACE:
                line += self._pace(done, total, time.monotonic() - self.start)
            report(line)

    def _pace(self, done: int, total: int, elapsed: float) -> str:
        """Return the rate and the time left after some seconds: ", 2.1 a second, 0:01:16 left"."""
        rate = done / elapsed
        pace = f"{rate:.3g} a second" if rate >= 1 else f"{1 / rate:.3g} s each"
        left = timedelta(seconds=round((total - done) / rate))
        return f", {pace}, {left} left"
