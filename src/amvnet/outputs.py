"""Check which files a command may write.

A command writes no file that it reads, and replaces only files of its own kind.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from amvnet.errors import InputError
from amvnet.files import LONGEST_NAME

# The format of the labels of a scan file.
FormatName = Literal["label", "npy", "csv", "ply", "pcd", "las", "laz"]
HEAD = 4096  # length of the beginning of a file that is compared with a signature, bytes


@dataclass(frozen=True)
class Signature:
    """The beginning of all files of one kind.

    Attributes:
        beginning: a regular expression that matches the beginning of each such file.
        unit: a size in bytes. The size of each such file is a multiple of it.
    """

    name: str
    beginning: bytes
    unit: int = 1

    def matches(self, path: Path) -> bool:
        """Return whether a file may be of this kind. An empty file may be of any kind.

        Raises:
            InputError: if the file cannot be read.
        """
        try:
            with path.open("rb") as file:
                head = file.read(HEAD)
        except OSError as error:
            raise InputError(
                f"{path}: expected {self.name} to replace, found a file that cannot be read "
                f"({error.strerror}); write to another place, or remove it"
            ) from None
        if not head:
            return True
        is_whole = path.stat().st_size % self.unit == 0
        return is_whole and re.match(self.beginning, head, re.DOTALL) is not None


def check_outputs(
    outputs: Mapping[Path, Signature],
    inputs: Iterable[Path | str | None] = (),
    overwrite: bool = False,
) -> None:
    """Check that a command may write some files. Call this before the work.

    A command may not write a file that it reads, under any name or link. It may replace a file only
    if the user allows it, and only by a file of the same kind. This function also checks that the
    folders of the files can be written to, so that no time is wasted on results without a place.

    Args:
        outputs: the files, each with the kind that it must have if it exists.
        inputs: files that the command reads. Entries that name no file are ignored.

    Raises:
        InputError: if one of the files may not be written.
    """
    for path in outputs:
        if len(os.fsencode(path.name)) > LONGEST_NAME:
            raise InputError(
                f"{path.parent}: expected a file name of at most {LONGEST_NAME} bytes, found "
                f"{path.name[:20]}... of {len(os.fsencode(path.name))}; give a shorter one"
            )
    existing = [path for path in outputs if os.path.lexists(path)]
    check_not_read(existing, inputs)
    for folder in {path.parent for path in outputs}:
        _check_writable(folder)
    for path in existing:
        found = _no_file(path)
        if found is not None:
            raise InputError(
                f"{path}: expected a file to write, found {found}; give the name of a file"
            )

    if existing and not overwrite:
        more = f" (and {len(existing) - 1} more)" if len(existing) > 1 else ""
        raise InputError(
            f"{existing[0]}{more}: expected no file, found one; write to another place, or say "
            "--overwrite to replace it"
        )
    for path in existing:
        if path.exists() and not outputs[path].matches(path):
            raise InputError(
                f"{path}: expected {outputs[path].name} to replace, found another file; write to "
                "another place, or remove it"
            )


def check_not_read(outputs: Iterable[Path], inputs: Iterable[Path | str | None]) -> None:
    """Raise InputError if an output is a file that the command reads, under any name or link."""
    existing = [path for path in outputs if os.path.lexists(path)]
    if not existing:
        return

    read = {_identity(source): source for source in inputs if source is not None}
    for path in existing:
        identity = _identity(path)
        if identity is not None and identity in read:
            raise InputError(
                f"{path}: expected an output that is not an input, found the input "
                f"{read[identity]}; write to another place"
            )


def _identity(path: Path | str) -> tuple[int, int] | None:
    """Return the device and the inode of the file that a path leads to; None if it is no file."""
    with suppress(OSError, ValueError):  # nothing has this name
        status = os.stat(path)
        if not stat.S_ISDIR(status.st_mode):
            return status.st_dev, status.st_ino
    return None


def _check_writable(folder: Path) -> None:
    """Raise InputError if a folder, or the first existing folder above it, is read-only."""
    place = folder
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
        raise InputError(
            f"{place}: expected a folder to write to, found one that is read-only for this user; "
            "write to another place"
        )


def _no_file(path: Path) -> str | None:
    """Return in words what a path names if it names neither a file nor a broken link, or None."""
    if path.is_dir():
        return "a folder"
    return None if path.is_file() or path.is_symlink() else "a device"
