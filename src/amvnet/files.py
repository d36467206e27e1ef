"""Output files that appear whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from amvnet.errors import InputError

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
