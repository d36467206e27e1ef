"""Digest ONNX files, and silence the libraries that write them.

These libraries leave notes in the files, and print warnings.
"""

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


def remove_notes(path: Path) -> None:
    """Remove what libraries noted in a graph's file: the notes contain paths of this machine."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    values = (*graph.initializer, *graph.value_info, *graph.input, *graph.output)
    for holder in (model, graph, *graph.node, *values):
        holder.ClearField("metadata_props")
    onnx.save(model, path)


@contextmanager
def quiet(logger_name: str) -> Iterator[None]:
    """Suppress warnings, and all messages of a library's logger except errors."""
    logger = logging.getLogger(logger_name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
