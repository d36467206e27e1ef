"""Zip archives: safe reading of archives of any origin, and writing with reproducible bytes."""

from __future__ import annotations

import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from amvnet.errors import InputError
from amvnet.files import atomic_write

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # that every unpacker supports
ENCRYPTED = 0x1  # bit of an entry's flags
LEVEL = 6  # of deflate: 9 takes five to eight times as long and saves a sixth
# Time of every entry, the earliest of the format: the same content gives the same bytes.
LONG_AGO = (1980, 1, 1, 0, 0, 0)
UNIX = 3  # code of the system that wrote an entry
FOLDER_BIT = 0x10  # of an entry's MS-DOS attributes
# zipfile raises these for broken data: for example OSError or OverflowError for a negative offset.
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
        path: path of the archive.
        sizes: by name, the size in bytes that each file in the archive declares.
        folders: names of the entries for folders, each with its trailing slash.
    """

    path: Path
    sizes: dict[str, int]
    folders: frozenset[str]
    _zip: zipfile.ZipFile

    def read(self, name: str) -> bytes:
        """Return the content of one file.

        No more bytes are unpacked than `sizes` declares: check that number before the call.

        Raises:
            InputError: if the data are broken.
        """
        try:
            data = self._zip.read(name)
        except BROKEN as error:
            raise InputError(
                f"{self.path}: expected {name} intact, found it broken ({_reason(error)}); "
                "pack it again"
            ) from None

        if len(data) != self.sizes[name]:
            raise InputError(
                f"{self.path}: expected {self.sizes[name]} bytes in {name} as it declares, "
                f"found {len(data)}; pack it again"
            )

        return data


@dataclass(frozen=True)
class ArchiveWriter:
    """A zip archive that is open for writing."""

    _zip: zipfile.ZipFile

    def add(self, name: str, data: bytes) -> None:
        """Add a file, or a folder (NAME/, without data)."""
        self._zip.writestr(_entry(name), data, compresslevel=LEVEL)


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Open an archive of any origin for reading.

    Nothing is unpacked to disk, and no name in the archive is used as a path.

    Raises:
        InputError: if the file is missing or not a zip archive, or if an entry is encrypted,
            leads out of the archive's folder, occurs twice or is compressed by an uncommon method.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a zip archive, found no file; check the path")
    try:
        archive = zipfile.ZipFile(path)
    except BROKEN as error:
        raise InputError(
            f"{path}: expected a zip archive, found a broken or another file ({_reason(error)}); "
            "pack it again"
        ) from None

    with archive:
        entries = archive.infolist()
        _check_entries(path, entries)

        sizes = {}
        folders = set()
        for entry in entries:
            if entry.is_dir():
                folders.add(entry.filename)
            else:
                sizes[entry.filename] = entry.file_size

        yield Archive(path, sizes, frozenset(folders), archive)


@contextmanager
def write_archive(path: Path) -> Iterator[ArchiveWriter]:
    """Write an archive that appears whole or not at all.

    Entries keep the order in which they are added. Only one is in memory at a time.

    Raises:
        InputError: if the file cannot be written.
    """
    with atomic_write(path) as part, zipfile.ZipFile(part, "w") as archive:
        yield ArchiveWriter(archive)


def _entry(name: str) -> zipfile.ZipInfo:
    """Return the entry of a file or folder, the same on every machine and at any time."""
    entry = zipfile.ZipInfo(name, LONG_AGO)
    entry.create_system = UNIX
    if name.endswith("/"):
        entry.external_attr = (stat.S_IFDIR | 0o755) << 16 | FOLDER_BIT
    else:
        entry.external_attr = (stat.S_IFREG | 0o644) << 16
        entry.compress_type = zipfile.ZIP_DEFLATED

    return entry


def _check_entries(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Check every entry before any is read; see `open_archive`."""
    for entry in entries:
        if entry.flag_bits & ENCRYPTED:
            raise InputError(
                f"{path}: expected no password, found {entry.filename!r} encrypted; "
                "pack without one"
            )

        if not _is_inside(entry.orig_filename):
            raise InputError(
                f"{path}: expected paths below the archive's own folder, "
                f"found {entry.orig_filename!r}; pack with relative names and slashes"
            )

        if entry.compress_type not in METHODS:
            raise InputError(
                f"{path}: expected files stored or deflated, found {entry.filename!r} by method "
                f"{entry.compress_type}; pack with plain zip"
            )

    counts = Counter(entry.filename.rstrip("/") for entry in entries)
    for name, count in counts.items():
        if count > 1:
            raise InputError(
                f"{path}: expected every name once, found {name!r} {count} times; pack it again"
            )


def _is_inside(name: str) -> bool:
    """Return whether unpacking a name stays below the target folder, on every system."""
    if "\\" in name or "\0" in name or PureWindowsPath(name).drive:
        return False
    return not name.startswith("/") and ".." not in PurePosixPath(name).parts


def _reason(error: Exception) -> str:
    """Return the message of an exception on one line, or its type if it has none."""
    message = getattr(error, "strerror", None) or str(error)
    return " ".join(message.split()) or type(error).__name__
