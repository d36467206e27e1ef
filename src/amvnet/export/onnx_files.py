"""Handle ONNX files and the libraries that write them, with their warnings and notes."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def strip(path: Path) -> None:
    """Remove a library's notes from a graph, which contain paths of this machine."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    values = (*graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for holder in (model, graph, *graph.node, *values):
        holder.ClearField("metadata_props")
    onnx.save(model, path)


@contextmanager
def quiet(name: str) -> Iterator[None]:
    """Suppress warnings, and what the logger `name` of a library says besides errors."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
