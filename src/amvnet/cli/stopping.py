"""Stop on Ctrl-C or SIGTERM: within a second, with one line and the signal's exit code."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from amvnet.cli.console import console, report_fault, stdout
from amvnet.files import unfinished

SECONDS_TO_END = 0.6  # time that a command has to end by itself, seconds


class Stop:
    """Whether a signal has asked the command to stop, and how it stops.

    Args:
        line: what is said when the command has stopped.
        exits: whether this process belongs to the command line, and ends with the command.
    """

    def __init__(self, line: str, exits: bool) -> None:
        self.line = line
        self.exits = exits
        self.signal: int | None = None
        self._process = os.getpid()
        self._ending = threading.Lock()  # taken by the first call of `end`

    @property
    def exit_code(self) -> int:
        """128 + the number of the signal: 130 after Ctrl-C, 143 after SIGTERM."""
        assert self.signal is not None
        return 128 + self.signal

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt; the process exits if that does not end the command soon."""
        if os.getpid() != self._process:  # a worker has this handler from the process that forked
            os._exit(128 + number)
        is_second = self.signal is not None
        self.signal = number
        if self.exits:
            # An exception within the C++ code that torch runs when it is imported aborts.
            if is_second or _is_importing(frame):
                self.end()
            deadline = threading.Timer(SECONDS_TO_END, self._insist)
            deadline.daemon = True
            deadline.start()
        raise KeyboardInterrupt

    def _insist(self) -> None:
        """End the processes that the command may be waiting for, and then this one."""
        for child in multiprocessing.active_children():
            child.kill()
        time.sleep(SECONDS_TO_END / 3)
        self.end()

    def end(self) -> None:
        """Say that the command has stopped; end the process if it is the command line's.

        It leaves no half-written file. Threads that still compute are not waited for.
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
        console.show_cursor()  # a bar hides it
        stdout.flush()
        os._exit(self.exit_code)


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a frame, or one that called it, imports a module."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def stoppable(line: str, exits: bool) -> Iterator[Stop]:
    """Yield a `Stop`, which raises a KeyboardInterrupt in the block at SIGINT and SIGTERM."""
    stop = Stop(line, exits)
    earlier = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as in the background of a shell
                earlier[number] = signal.signal(number, stop.handle)
    try:
        yield stop
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
