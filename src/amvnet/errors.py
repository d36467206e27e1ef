"""Define the exceptions for input that cannot be used, and write their messages."""

from __future__ import annotations

import difflib
import errno
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any


class InputError(ValueError):
    """Raised for input that cannot be used.

    The message is one line that states what was expected, what was found and what to do. The
    command line prints it to stderr and exits with code 2. In Python, it is a `ValueError`.
    """


def shown(value: object) -> str:
    """Return a short text on one line, for a message, that shows a value of a file or an option.

    Such values may be megabytes long, or contain themselves.
    """
    text = reprlib.Repr()
    text.maxlevel = 2
    text.maxstring = text.maxother = 100
    return re.sub(r"\s*\n\s*", " ", text.repr(value))


def listed(items: Sequence[str], limit: int) -> str:
    """Return at most `limit` of some texts, separated by commas, and how many more there are."""
    more = len(items) - limit
    return ", ".join(items[:limit]) + (f" and {more} more" if more > 0 else "")


def counted(count: int, noun: str, plural: str = "") -> str:
    """Return a number of things in words, such as "2 scans"; irregular nouns give a `plural`."""
    return f"{count} {noun}" if count == 1 else f"{count} {plural or f'{noun}s'}"


def did_you_mean(word: str, known: Iterable[str], advice: str = "correct it") -> str:
    """Return the end of an error message: the most similar known name, or else the advice."""
    names = {name.lower(): name for name in known}
    longest = 2 * max(map(len, names), default=0)  # no longer word is similar to a name
    similar = difflib.get_close_matches(word[:longest].lower(), names, n=1)
    if not similar:
        return f"; {advice}"
    return f"; did you mean {names[similar[0]]}?"


def reason_of(error: BaseException) -> str:
    """Return the first line of an error's message, or the name of its class if it has none."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0]


class SomeBroken(Exception):
    """Raised at the end if some inputs could not be used, with a line for each of these `faults`.

    All others have been processed.
    """

    def __init__(self, line: str, faults: list[str]) -> None:
        super().__init__(line)
        self.faults = faults


@contextmanager
def one_line_errors(
    message: Callable[[BaseException], str], only: tuple[type[Exception], ...] = (Exception,)
) -> Iterator[None]:
    """Turn exceptions of some classes into an `InputError` of one line, which `message` returns.

    An `InputError` passes unchanged, and so do other exceptions and an interruption by the user.

    Raises:
        InputError: if the block raises one of the exceptions to convert, or a library written in
            Rust panics.
    """
    try:
        yield
    except BaseException as error:
        # A panic of a library written in Rust is no `Exception`, and no module exports its class.
        is_panic = type(error).__name__ == "PanicException"
        is_bad_input = isinstance(error, only) or is_panic
        if isinstance(error, InputError) or not is_bad_input:
            raise
        raise InputError(message(error)) from error


# Errors of the system that concern this process, and not the file that it opens.
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


@contextmanager
def readable(path: object) -> Iterator[None]:
    """Turn an error of the system in this block, which reads a file, into an `InputError`.

    The file may have vanished since it was listed, may be private, or its disk may be broken.

    Raises:
        InputError: if the block raises an OSError that concerns the file.
    """
    try:
        yield
    except OSError as error:
        if error.errno in EXHAUSTED:
            raise
        raise InputError(
            f"{path}: expected a file that can be read, found {error.strerror or error}; check it"
        ) from None


def import_optional(module: str, extra: str) -> Any:
    """Import a module that needs the packages of an extra.

    Raises:
        InputError: if one of the packages is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"expected the package {error.name}, found none; run {installation(extra)}"
        ) from None


def installation(extra: str) -> str:
    """Return the command that adds an extra, to a clone as well as to a published package."""
    return f'pip install "amvnet[{extra}]"'


@contextmanager
def errors_of(source: object) -> Iterator[None]:
    """Begin the message of every `InputError` of this block with the name of a file or option."""
    try:
        yield
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(source)) else f"{source}: {text}") from None


# Matches messages of PyTorch, CUDA, the loader of libraries and the system if no memory is left.
NO_MEMORY = re.compile(
    r"out of memory|(can't|cannot) allocate|failed to map segment", re.IGNORECASE
)


@contextmanager
def memory_for(content: str) -> Iterator[None]:
    """Turn an error for lack of memory into an `InputError` that begins with `content`.

    Raises:
        InputError: if there is no memory left for the block.
    """
    try:
        yield
    except (MemoryError, RuntimeError, ImportError, OSError) as error:
        if not isinstance(error, MemoryError) and not NO_MEMORY.search(str(error)):
            raise
        raise InputError(
            f"{content}: expected enough memory, found none left; close other programs, or take "
            "fewer points"
        ) from None
