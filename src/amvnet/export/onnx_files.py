"""Tame the libraries that write ONNX: their warnings, exceptions, and notes in the files."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from amvnet.errors import one_line_errors


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def strip(path: Path) -> None:
    """Remove the notes of the writing library from a graph; they contain paths of this machine."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    values = (*graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for holder in (model, graph, *graph.node, *values):
        holder.ClearField("metadata_props")
    onnx.save(model, path)


@contextmanager
def quiet(name: str) -> Iterator[None]:
    """Suppress warnings, and what the logger `name` of a library says below errors."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def writer_errors(name: str, writer: str, libraries: str) -> AbstractContextManager[None]:
    """Turn any exception of a library, which may span pages, into an InputError of one line.

    An OSError, such as a full disk, passes as it is.

    Args:
        name: of the graph.
        writer: the library that writes it.
        libraries: what the user should upgrade.
    """

    def message(error: BaseException) -> str:
        kind = type(error).__name__
        return f"{name}: expected a graph of {writer}, found {kind}; upgrade {libraries}"

    return one_line_errors(message, leave=(OSError,))
