"""A record of the files that commands wrote, so that a user's own files are not replaced."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from amvnet.errors import InputError
from amvnet.files import atomic_write

RECORD = ".amvnet-written.json"

Stamp = tuple[int, int]  # a file's size in bytes, and when it changed last, in nanoseconds


class WrittenFiles:
    """The files in a folder that commands of this package wrote.

    A record in the folder lists them with their stamps: a file that was changed since belongs to
    the user. While a run is writing, its files are listed without stamps, so that a run that was
    killed can be repeated.

    Args:
        folder: the folder; all paths are relative to it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stamps = _read(folder / RECORD)
        self._replaced: dict[str, Stamp | None] = {}  # a user's files when they were claimed

    def check(self, paths: Iterable[Path]) -> None:
        """Check that writing these files would replace no file of the user.

        Raises:
            InputError: if a file exists that is not listed, or was changed since, or is a folder.
        """
        foreign = [path for path in paths if self.is_foreign(path)]
        for path in foreign:
            if (self.folder / path).is_dir():
                raise InputError(
                    f"{self.folder / path}: expected a file to write, found a folder; "
                    "give the name of a file in it"
                )
        if foreign:
            more = f" (and {len(foreign) - 1} more)" if len(foreign) > 1 else ""
            raise InputError(
                f"{self.folder / foreign[0]}{more}: expected no file, or one as amvnet wrote it, "
                "found another; change --out, or say --overwrite to replace it"
            )

    def is_foreign(self, path: Path) -> bool:
        """Return whether a file exists that is not listed, or was changed since."""
        stamp = _stamp_of(self.folder / path)
        if stamp is None:
            return False

        name = path.as_posix()
        return name not in self._stamps or self._stamps[name] not in (None, stamp)

    def claim(self, paths: Iterable[Path]) -> None:
        """List files before they are written."""
        paths = list(paths)
        for path in paths:
            if self.is_foreign(path):
                self._replaced[path.as_posix()] = _stamp_of(self.folder / path)
        self._update({path.as_posix(): None for path in paths})

    def finish(self, paths: Iterable[Path]) -> None:
        """List files with their stamps after they are written.

        Forget those that do not exist, and files of the user that were claimed and not replaced.
        """
        stamps = {path.as_posix(): _stamp_of(self.folder / path) for path in paths}
        for name, stamp in stamps.items():
            if stamp == self._replaced.get(name):
                stamps[name] = None
        self._update(stamps, is_finished=True)

    def _update(self, stamps: dict[str, Stamp | None], is_finished: bool = False) -> None:
        """Write the record with other stamps; entries of other runs stay."""
        if not self.folder.is_dir():
            return
        with folder_lock(self.folder):
            self._stamps = _read(self.folder / RECORD) | stamps
            if is_finished:
                for name, stamp in stamps.items():
                    if stamp is None:
                        del self._stamps[name]

            if not self._stamps:
                (self.folder / RECORD).unlink(missing_ok=True)
                return
            with atomic_write(self.folder / RECORD) as part:
                part.write_text(json.dumps(self._stamps, indent=0))


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Keep other processes out of this block for the same folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def hold(file: IO[str]) -> None:
    """Lock a file until it is closed or its process ends."""
    with suppress(OSError):  # some network file systems have no locks
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_held(path: Path) -> bool:
    """Return whether a process holds a file by `hold`."""
    with suppress(OSError), path.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@contextmanager
def protecting(paths: Sequence[Path], overwrite: bool = False) -> Iterator[None]:
    """Check that a command's output files replace no file of the user, and list them at the end.

    Args:
        paths: the files that the block may write; those that it leaves as they are stay the user's.

    Raises:
        InputError: before the block, if a user's file would be replaced.
    """
    names_by_folder: dict[Path, list[Path]] = {}
    for path in paths:
        names_by_folder.setdefault(path.parent, []).append(Path(path.name))

    if not overwrite:
        for folder, names in names_by_folder.items():
            WrittenFiles(folder).check(names)

    earlier_stamps = {path: _stamp_of(path) for path in paths}
    yield

    for folder, names in names_by_folder.items():
        changed = []
        for name in names:
            if _stamp_of(folder / name) != earlier_stamps[folder / name]:
                changed.append(name)
        WrittenFiles(folder).finish(changed)


def _read(path: Path) -> dict[str, Stamp | None]:
    """Read the stamps by name; a record that is missing or broken lists nothing."""
    try:
        entries = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}

    stamps: dict[str, Stamp | None] = {}
    for name, stamp in entries.items() if isinstance(entries, dict) else ():
        if stamp is None:
            stamps[name] = None
        elif isinstance(stamp, list) and len(stamp) == 2:
            size, changed = stamp
            stamps[name] = (size, changed)
    return stamps


def _stamp_of(path: Path) -> Stamp | None:
    """Return the stamp of a file, or of the link to one; None if there is none."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns
