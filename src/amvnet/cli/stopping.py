"""Stop on Ctrl-C or SIGTERM, with one line and the exit code of the signal."""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from amvnet.cli.console import console, report_fault, stdout
from amvnet.files import unfinished


class Stop:
    """A request to stop, which a signal may make; `line` is printed when the command has stopped.

    Args:
        exits: whether this process belongs to the command line, and so ends with the command.

    Attributes:
        signal: number of the signal, or None if there was none.
    """

    def __init__(self, line: str, exits: bool) -> None:
        self.line = line
        self.exits = exits
        self.signal: int | None = None
        self._process = os.getpid()

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt; end the command at once if it is the second signal."""
        if os.getpid() != self._process:  # a forked worker, which has inherited this handler
            os._exit(128 + number)
        is_second = self.signal is not None
        self.signal = number
        if is_second and self.exits:
            self.end()
        raise KeyboardInterrupt

    def end(self) -> int:
        """Report that the command has stopped, and return its exit code: 128 + the signal's number.

        A process that belongs to the command line ends here. No half-written file is left. Threads
        that still compute are not waited for.
        """
        assert self.signal is not None
        code = 128 + self.signal
        report_fault(self.line)
        if not self.exits:
            return code

        for path in list(unfinished):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        console.show_cursor()  # because a progress bar hides it
        stdout.flush()
        os._exit(code)


@contextmanager
def stoppable(line: str, exits: bool) -> Iterator[Stop]:
    """Yield a `Stop`, which raises KeyboardInterrupt in the block at SIGINT or SIGTERM."""
    stop = Stop(line, exits)
    earlier = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            # A shell lets commands in the background ignore SIGINT.
            if signal.getsignal(number) is not signal.SIG_IGN:
                earlier[number] = signal.signal(number, stop.handle)
    try:
        yield stop
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
