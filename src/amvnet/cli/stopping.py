"""Stop on Ctrl-C or SIGTERM within a second, with one line and the exit code of the signal."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from amvnet.cli.console import console, report_fault, stdout
from amvnet.files import unfinished

SECONDS_TO_END = 0.6  # time that a command has to end by itself, seconds


class Stop:
    """A request to stop, which a signal may make.

    Args:
        line: the line to print when the command has stopped.
        exits: whether this process belongs to the command line, and so ends with the command.

    Attributes:
        signal: number of the signal, or None if there was none.
    """

    def __init__(self, line: str, exits: bool) -> None:
        self.line = line
        self.exits = exits
        self.signal: int | None = None
        self._process = os.getpid()
        self._ending = threading.Lock()  # taken by the first call of `end`

    @property
    def exit_code(self) -> int:
        """The number of the signal + 128: 130 after Ctrl-C, 143 after SIGTERM."""
        assert self.signal is not None
        return 128 + self.signal

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, and exit soon if that does not end the command."""
        if os.getpid() != self._process:  # a forked worker, which has inherited this handler
            os._exit(128 + number)
        is_second = self.signal is not None
        self.signal = number
        if self.exits:
            # An exception while torch is imported would abort the process within C++ code.
            if is_second or _is_importing(frame):
                self.end()
            # In a destructor, the interruption is printed with a traceback and lost.
            sys.unraisablehook = _ignore
            deadline = threading.Timer(SECONDS_TO_END, self._insist)
            deadline.daemon = True
            deadline.start()
        raise KeyboardInterrupt

    def _insist(self) -> None:
        """End the processes that the command may be waiting for, and then this process."""
        for child in multiprocessing.active_children():
            child.kill()
        time.sleep(SECONDS_TO_END / 3)
        self.end()

    def end(self) -> None:
        """Report that the command has stopped. End the process if it belongs to the command line.

        No half-written file is left. Threads that still compute are not waited for.
        """
        if not self._ending.acquire(blocking=False):
            return
        report_fault(self.line)
        if not self.exits:
            return

        for path in list(unfinished):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        console.show_cursor()  # because a progress bar hides it
        stdout.flush()
        os._exit(self.exit_code)


def _ignore(unraisable: object) -> None:
    """Print nothing about an exception that Python cannot raise."""


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a frame, or one that called it, imports a module."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def stoppable(line: str, exits: bool) -> Iterator[Stop]:
    """Yield a `Stop`, which raises KeyboardInterrupt in the block at SIGINT or SIGTERM.

    Args:
        line: the line to print when the command has stopped.
        exits: whether this process belongs to the command line.
    """
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
