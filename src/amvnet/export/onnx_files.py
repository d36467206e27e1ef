"""Tidy what the writers of ONNX print, raise and leave in their files."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from amvnet.errors import one_line_errors


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def strip(path: Path) -> None:
    """Remove a writer's notes from a graph; they name places on this machine."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    values = (*graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for holder in (model, graph, *graph.node, *values):
        holder.ClearField("metadata_props")
    onnx.save(model, path)


@contextmanager
def quiet(name: str) -> Iterator[None]:
    """Suppress a writer's warnings and notes for developers; `name` is its logger's."""
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
    """Turn a writer's exceptions, which share no class and span pages, into one line."""

    def message(error: BaseException) -> str:
        kind = type(error).__name__
        return f"{name}: expected a graph of {writer}, found {kind}; upgrade {libraries}"

    return one_line_errors(message, leave=(OSError,))
