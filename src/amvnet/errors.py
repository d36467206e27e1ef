"""Exceptions for input that cannot be used, all of it or some of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """Input that cannot be used.

    The message is one line that says what was expected, what was found and what to do. The
    command line prints it to stderr and exits with code 2; from Python it is a `ValueError`.
    """


class SomeBroken(Exception):
    """Some of several inputs could not be used, and the others are done.

    Attributes:
        faults: one line for each broken input.
    """

    def __init__(self, line: str, faults: list[str]) -> None:
        super().__init__(line)
        self.faults = faults


@contextmanager
def one_line_errors(
    message: Callable[[BaseException], str],
    only: tuple[type[Exception], ...] = (Exception,),
    leave: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Turn whatever a library raises on bad input into an `InputError` of one line.

    An `InputError` passes as it is. A panic of a library written in Rust, which is no `Exception`,
    is turned into one too; an interrupt by the user is not.

    Args:
        message: makes the line from the exception.
        only: the exceptions that are turned; others pass.
        leave: exceptions among these that pass all the same.
    """
    try:
        yield
    except BaseException as error:
        is_panic = type(error).__name__ == "PanicException"
        is_bad_input = isinstance(error, only) or is_panic
        if isinstance(error, (InputError, *leave)) or not is_bad_input:
            raise
        raise InputError(message(error)) from error
