"""Output files that appear whole or not at all, and YAML files."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from amvnet.errors import InputError

LARGEST_YAML = 50_000  # bytes; PyYAML takes a second for as many
DEEPEST_YAML = 50  # levels
PARTS = f".{'[0-9a-f]' * 32}.part*"  # names of files that `atomic_write` has not finished


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename it to `path` if the block succeeds.

    The temporary file lies in the same folder, which is made if necessary, and keeps the ending of
    `path`. It is removed if the block raises.

    Raises:
        InputError: if the folder cannot be made or the file cannot be written.
    """
    path = Path(path)
    make_folder(path.parent)
    part = path.with_name(f".{uuid.uuid4().hex}.part{path.suffix}")

    try:
        yield part
        os.replace(part, path)
    except (PermissionError, IsADirectoryError) as error:
        raise InputError(
            f"{path}: expected a file that can be written, found {error.strerror}; give another"
        ) from None
    finally:
        part.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder and its parents.

    Raises:
        InputError: if it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: expected a folder to write to, found {error.strerror}; give another"
        ) from None


def read_yaml(path: Path, content: str) -> Any:
    """Return what a YAML file holds: dictionaries, lists, texts, numbers. Nothing is executed.

    Args:
        path: the file.
        content: what the file should hold, for messages, such as "a label map".

    Raises:
        InputError: if the file cannot be read, is too large, or is not YAML.
    """
    expected = f"{path}: expected {content} (YAML)"
    try:
        size = path.stat().st_size
        if size <= LARGEST_YAML:
            return yaml.load(path.read_text(encoding="utf-8"), _BoundedLoader)
    except OSError as error:
        raise InputError(f"{expected}, found {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{expected}, found bytes that are not text; give another file") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: numbers and dates
        reason = " ".join(str(error).split())
        raise InputError(f"{expected}, found {reason}; correct the file") from None
    raise InputError(f"{expected} of at most {LARGEST_YAML} bytes, found {size}; give another file")


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader, but for values of limited depth: deep ones take seconds."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self._depth == DEEPEST_YAML:
            raise yaml.YAMLError(f"more than {DEEPEST_YAML} levels")
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node
