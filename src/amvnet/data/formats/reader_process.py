"""Read files in a separate process with limited memory, time and disk space.

The libraries for packed and indexed formats take as much memory as a file claims or unpacks to, and
some abort their process on broken bytes. One separate process reads all files, one after the other.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from threading import Lock
from typing import Any, BinaryIO, cast

import numpy as np

from amvnet.data.formats.cloud import reading
from amvnet.errors import InputError
from amvnet.files import unfinished

try:
    import resource
except ImportError:  # Windows has no limits
    resource = None  # type: ignore[assignment]

# The limits grow with the size of the file.
MEMORY = 700 << 20  # largest memory of the process for an empty file, bytes
MEMORY_PER_BYTE = 10  # the additional memory for each byte of the file, bytes
MAX_MEMORY = 4 << 30  # largest memory of the process for any file, bytes
# The processor time is many times what the slowest good file takes on a fast processor.
SECONDS = 60.0  # largest processor time for an empty file, seconds
BYTES_PER_SECOND = 3e5  # the bytes of the file for which the process gets an additional second
DISK = 64 << 20  # the largest temporary file for an empty file, bytes
DISK_PER_BYTE = 20  # the additional size of a temporary file for each byte of the file, bytes

STOP_SECONDS = 0.2  # the time in which the process must end by itself, seconds
ADVICE = "copy the file again, or write it again"
CODE = f"from {__name__} import serve; serve()"


def call(function: Callable[..., dict[str, Any]], path: Path, *arguments: Any) -> dict[str, Any]:
    """Call a function that reads a file, in the process with limits.

    Args:
        function: a function of a module, which returns arrays and values that JSON can hold.
        arguments: the other arguments, which JSON has to hold.

    Raises:
        InputError: if the function raises it, or exceeds a limit.
    """
    global _process
    size = size_of(path)
    request = {
        "module": function.__module__,
        "function": function.__name__,
        "path": str(path),
        "arguments": arguments,
        "folder": os.sep if path.is_absolute() else os.getcwd(),
        "size": size,
        "seconds": SECONDS + size / BYTES_PER_SECOND,
    }

    with _lock:
        if _process is None:
            _process = _Process()

        try:
            values = _process.exchange(request)
        except BaseException as error:  # even an interrupt: the next call would get this reply
            reason = _process.stop()
            _process = None
            if not isinstance(error, (OSError, EOFError)):
                raise
            raise InputError(
                f"{path}: expected a file that can be read, found a file that {reason}; {ADVICE}"
            ) from None

    if "error" in values:
        raise InputError(values["error"])
    return values


def size_of(path: Path) -> int:
    """Return the size of a file, or of all files in a folder, in bytes."""
    if not path.is_dir():
        return path.stat().st_size
    return sum(entry.stat().st_size for entry in path.iterdir() if entry.is_file())


class _Process:
    """The process with limits, seen from the process that uses it."""

    def __init__(self) -> None:
        self._folder = Path(mkdtemp(prefix="amvnet-"))
        unfinished.add(self._folder)
        environment = dict(os.environ, TMPDIR=str(self._folder))
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        # Each thread takes memory, so there is only one.
        environment["OMP_NUM_THREADS"] = "1"
        environment["OPENBLAS_NUM_THREADS"] = "1"

        # The process has its own session, so that Ctrl-C reaches only its user, the process that
        # started it. The user then stops it. If the user ends, the process ends as well.
        self._popen = subprocess.Popen(
            [sys.executable, "-P", "-c", CODE],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            start_new_session=True,
        )
        self._replies = os.fdopen(os.dup(cast(BinaryIO, self._popen.stdout).fileno()), "rb")

    def exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request; return the reply. Raise EOFError or OSError if the process has ended."""
        cast(BinaryIO, self._popen.stdin).write(json.dumps(request).encode() + b"\n")
        line = self._replies.readline()
        if not line.endswith(b"\n"):
            raise EOFError
        values: dict[str, Any] = json.loads(line)

        for name, (dtype, shape) in values.pop("arrays").items():
            array = np.empty(shape, dtype)
            if array.size and self._replies.readinto(array.data.cast("B")) < array.nbytes:
                raise EOFError
            values[name] = array
        return values

    def stop(self) -> str:
        """End the process. If it had already ended, return the reason in words."""
        cast(BinaryIO, self._popen.stdin).close()
        try:
            code = self._popen.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            code = self._popen.wait()
        cast(BinaryIO, self._popen.stdout).close()
        self._replies.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        unfinished.discard(self._folder)
        is_slow = hasattr(signal, "SIGXCPU") and code == -signal.SIGXCPU

        return "takes too long" if is_slow else "stops its reader"


_process: _Process | None = None
_lock = Lock()


def _forget() -> None:
    """Forget the process with limits after a fork: it belongs to the parent."""
    global _process, _lock
    _process = None
    _lock = Lock()


@atexit.register
def _stop() -> None:
    if _process is not None:
        _process.stop()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


# --- within the process ---


def serve() -> None:
    """Answer the requests that come through standard input, until it ends."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries may print, but not between the replies
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    for line in sys.stdin.buffer:
        request = json.loads(line)
        os.chdir(request["folder"])  # the caller's folder may have changed
        _set_limits(request["size"], request["seconds"])

        try:
            with reading(request["path"], "a file that can be read", ADVICE):
                function = getattr(import_module(request["module"]), request["function"])
                values = function(Path(request["path"]), *request["arguments"])
        except InputError as error:
            values = {"error": str(error)}
        _send(replies, values)
        del values  # frees memory for the next file


def _set_limits(size: int, seconds: float) -> None:
    """Limit this process for a file of `size` bytes, and its processor time to `seconds` more."""
    if resource is None:
        return
    usage = resource.getrusage(resource.RUSAGE_SELF)
    used = usage.ru_utime + usage.ru_stime
    _limit(resource.RLIMIT_DATA, min(MEMORY + MEMORY_PER_BYTE * size, MAX_MEMORY))
    _limit(resource.RLIMIT_CPU, math.ceil(used + seconds))
    _limit(resource.RLIMIT_FSIZE, DISK + DISK_PER_BYTE * size)


def _limit(kind: int, value: int) -> None:
    _, hard_limit = resource.getrlimit(kind)
    if hard_limit != resource.RLIM_INFINITY:
        value = min(value, hard_limit)
    with suppress(ValueError, OSError):  # some systems refuse to set a limit
        resource.setrlimit(kind, (value, hard_limit))


def _send(replies: BinaryIO, values: dict[str, Any]) -> None:
    """Write a line of JSON, followed by the bytes of the arrays."""
    arrays = []
    shapes = {}
    others = {}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            arrays.append(np.ascontiguousarray(value))
            shapes[name] = (value.dtype.str, value.shape)
        else:
            others[name] = value

    replies.write(json.dumps({**others, "arrays": shapes}).encode() + b"\n")
    for array in arrays:
        if array.size:
            replies.write(array.data.cast("B"))
    replies.flush()
