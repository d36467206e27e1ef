"""Zip archives: read from anyone with every guard, and written whole, with the same bytes for the same content."""

from __future__ import annotations

import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from amvnet.errors import InputError
from amvnet.files import atomic_write

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what every unpacker knows
ENCRYPTED = 0x1  # bit of an entry's flags
LEVEL = 6  # of deflate: 9 takes five to eight times as long for a sixth less
LONG_AGO = (
    1980,
    1,
    1,
    0,
    0,
    0,
)  # the time of every entry, so that the same content gives the same bytes
UNIX = 3  # the system that wrote an entry
FOLDER_BIT = 0x10  # of MS-DOS
# What zipfile raises for broken data; an offset before the beginning is an OSError or an OverflowError.
BROKEN = (
    zipfile.BadZipFile,
    OSError,
    EOFError,
    OverflowError,
    RuntimeError,
    ValueError,
    zlib.error,
    struct.error,
)


@dataclass(frozen=True)
class Archive:
    """A zip archive that is open for reading.

    Attributes:
        path: its file.
        sizes: name -> declared bytes, of every entry that is a file.
        folders: names of the entries for folders, with their last slash.
    """

    path: Path
    sizes: dict[str, int]
    folders: frozenset[str]
    _zip: zipfile.ZipFile

    def read(self, name: str) -> bytes:
        """Unpack one file; never more than its declared size is unpacked, so check that first.

        Raises:
            InputError: where the data are broken.
        """
        try:
            data = self._zip.read(name)
        except BROKEN as error:
            raise InputError(
                f"{self.path}: expected {name} whole, found it broken ({_reason(error)}); pack it again"
            ) from None
        if len(data) != self.sizes[name]:
            raise InputError(
                f"{self.path}: expected {self.sizes[name]} bytes in {name} as it declares, found {len(data)}; "
                "pack it again"
            )
        return data


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Open an archive of anyone's. Nothing is unpacked and no name in it becomes a path.

    Raises:
        InputError: where it is missing or no zip archive, or an entry is encrypted, leaves the archive's
            folder, stands there twice or is packed in a way that not every unpacker knows.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a zip archive, found no file; check the path")
    try:
        archive = zipfile.ZipFile(path)
    except BROKEN as error:
        raise InputError(
            f"{path}: expected a zip archive, found a broken or another file ({_reason(error)}); pack it again"
        ) from None
    with archive:
        entries = archive.infolist()
        _check_entries(path, entries)
        yield Archive(
            path,
            {entry.filename: entry.file_size for entry in entries if not entry.is_dir()},
            frozenset(entry.filename for entry in entries if entry.is_dir()),
            archive,
        )


@contextmanager
def write_archive(path: Path) -> Iterator[Callable[[str, bytes], None]]:
    """Write an archive that appears whole or not at all; yields what adds a file, or a folder (NAME/, b"").

    Entries stand in the order in which they are added; at no time is more than one in memory.

    Raises:
        InputError: where the file cannot be written.
    """
    with atomic_write(path) as part, zipfile.ZipFile(part, "w") as archive:
        yield lambda name, data: archive.writestr(_entry(name), data, compresslevel=LEVEL)


def _entry(name: str) -> zipfile.ZipInfo:
    """An entry that says nothing of this machine or of the time."""
    entry = zipfile.ZipInfo(name, LONG_AGO)
    entry.create_system = UNIX
    if name.endswith("/"):
        entry.external_attr = (stat.S_IFDIR | 0o755) << 16 | FOLDER_BIT
    else:
        entry.external_attr = (stat.S_IFREG | 0o644) << 16
        entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    for entry in entries:
        if entry.flag_bits & ENCRYPTED:
            raise InputError(
                f"{path}: expected no password, found {entry.filename!r} encrypted; pack without one"
            )
        if not _is_inside(entry.orig_filename):
            raise InputError(
                f"{path}: expected paths below the archive's own folder, found {entry.orig_filename!r}; "
                "pack with relative names and slashes"
            )
        if entry.compress_type not in METHODS:
            raise InputError(
                f"{path}: expected files stored or deflated, found {entry.filename!r} by method "
                f"{entry.compress_type}; pack with plain zip"
            )
    names = Counter(entry.filename.rstrip("/") for entry in entries)
    if twice := [name for name, times in names.items() if times > 1]:
        raise InputError(
            f"{path}: expected every name once, found {twice[0]!r} {names[twice[0]]} times; pack it again"
        )


def _is_inside(name: str) -> bool:
    """Whether a name stays below the folder that it is unpacked to, on every system."""
    odd = "\\" in name or "\0" in name or bool(PureWindowsPath(name).drive)
    return not (odd or name.startswith("/") or ".." in PurePosixPath(name).parts)


def _reason(error: Exception) -> str:
    said = getattr(error, "strerror", None) or str(error)
    return " ".join(said.split()) or type(error).__name__
