"""What the writers of ONNX say and leave behind, tidied."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from amvnet.errors import InputError


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def strip(path: Path) -> None:
    """Take out a writer's notes, which name places on this machine."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    for holder in (
        model,
        graph,
        *graph.node,
        *graph.initializer,
        *graph.value_info,
        *graph.input,
        *graph.output,
    ):
        holder.ClearField("metadata_props")
    onnx.save(model, path)


@contextmanager
def quiet(name: str) -> Iterator[None]:
    """Without a writer's notes for developers; `name` is its logger's."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)


@contextmanager
def one_line(name: str, writer: str, libraries: str) -> Iterator[None]:
    """What a writer complains of as one line; their errors share no class and span pages."""
    try:
        yield
    except (InputError, OSError):
        raise
    except Exception as error:
        kind = type(error).__name__
        raise InputError(
            f"{name}: expected a graph of {writer}, found {kind}; upgrade {libraries}"
        ) from error
