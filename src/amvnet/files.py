"""Output files that appear whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from amvnet.data.formats.raw import count_rows as count_rows
from amvnet.errors import InputError

PARTS = f".{'[0-9a-f]' * 32}.part*"  # the names of files that `whole_file` has not finished


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Let a file appear whole or not at all: write to the path this yields, a rename does the rest.

    The temporary file lies in the same folder (made where it is missing) and keeps the ending of
    `path`. It is removed where the block raises.

    Raises:
        InputError: where the folder cannot be made or the file not be written.
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
    """Make a folder and those above it.

    Raises:
        InputError: where it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: expected a folder to write to, found {error.strerror}; give another"
        ) from None
