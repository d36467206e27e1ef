"""Digest ONNX files, finish them, and silence the libraries that write them.

These libraries leave notes in the files, and print warnings.
"""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# The version of the file format: the last one that ONNX Runtime 1.14 reads.
IR_VERSION = 8


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def finish(path: Path) -> None:
    """Make a graph's file readable to ONNX Runtime 1.14, and say nothing of this machine in it.

    Libraries write a later version of the file, import operators that no node uses, and note paths.
    """
    import onnx

    model = onnx.load(path)
    graph = model.graph
    model.ir_version = IR_VERSION
    domains = {node.domain for node in graph.node}
    opsets = [opset for opset in model.opset_import if opset.domain in domains]
    del model.opset_import[:]
    model.opset_import.extend(opsets)

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
