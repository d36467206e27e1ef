"""Read scan files packed by gzip, and archives (.zip) of scan files.

A file is unpacked into a temporary file that only its reader sees, whatever its name in the archive
is. This runs in the process with limits, and does not read files that are packed twice.
"""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from amvnet.data.formats.cloud import MAX_BYTES, Cloud, reading
from amvnet.data.formats.detect import ARCHIVE, BAGS, FOLDER, GZIP, TEXT, ending_of, named_ending
from amvnet.errors import InputError

CHUNK = 1 << 20  # the bytes that are unpacked at a time
MAX_MEMBERS = 100_000  # largest number of files in an archive
GZIPPED = "a scan file packed by gzip"
ZIPPED = "an archive of scan files (.zip)"
ADVICE = "copy it again, or unpack it"

Read = Callable[[Path, str], Cloud]  # a function that reads a file of one scan, given its ending


def read_gzip(path: Path, read: Read) -> Cloud:
    """Read the scan in a file that is packed by gzip.

    Raises:
        InputError: if the file is truncated, unpacks to too many bytes, or holds no file of one
            scan.
    """
    with reading(path, GZIPPED, ADVICE), gzip.open(path) as packed:
        return _read_unpacked(packed, path.name.lower().removesuffix(GZIP), str(path), read)


def member_names(path: Path) -> list[str]:
    """Return the names of the scans in an archive, sorted; raise InputError if there is none."""
    with reading(path, ZIPPED, ADVICE), zipfile.ZipFile(path) as archive:
        names = archive.namelist()

    if len(names) > MAX_MEMBERS:
        raise InputError(
            f"{path}: expected at most {MAX_MEMBERS:,} files, found {len(names):,}; unpack it"
        )
    scans = sorted({name for name in names if _is_scan(name)})
    # As in a folder, text files count only if there are no other scans.
    scans = [name for name in scans if named_ending(Path(name)) not in TEXT] or scans
    if not scans:
        raise InputError(f"{path}: expected {ZIPPED}, found no scan in it; {ADVICE}")
    return scans


def read_member(path: Path, name: str, read: Read) -> Cloud:
    """Read a scan in an archive by the name of its file; raise InputError if it is broken."""
    title = f"{path} ({name})"
    with (
        reading(title, "a scan file", ADVICE),
        zipfile.ZipFile(path) as archive,
        archive.open(name) as packed,
    ):
        return _read_unpacked(packed, name, title, read)


def _is_scan(name: str) -> bool:
    """Return whether a file of an archive is a scan by its name."""
    place = Path(name)
    is_hidden = any(
        part == "__MACOSX" or (part.startswith(".") and part != "..") for part in place.parts
    )
    ending = named_ending(place)
    is_scan = ending is not None and ending not in (*BAGS, GZIP, ARCHIVE)
    return is_scan and not is_hidden


def _read_unpacked(packed: IO[bytes] | gzip.GzipFile, name: str, title: str, read: Read) -> Cloud:
    """Unpack a file into a temporary file, and read it.

    Args:
        packed: the packed file.
        name: the file's own name; only its ending is used.
        title: the name of the file in messages.
        read: reads the temporary file.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"scan{named_ending(Path(name)) or ''}"
        _unpack(packed, path, title)
        try:
            ending = ending_of(path)
            if ending in (FOLDER, *BAGS, GZIP, ARCHIVE):
                raise InputError(f"{path}: expected a file of one scan, found {ending}; {ADVICE}")
            cloud = read(path, ending)
        except InputError as error:
            raise InputError(str(error).replace(str(path), title)) from None
    return Cloud(cloud.xyz, cloud.intensity, cloud.ring, title, cloud.note)


def _unpack(packed: IO[bytes] | gzip.GzipFile, path: Path, title: str) -> None:
    """Unpack a file; raise InputError if it has more bytes than any scan."""
    size = 0
    with path.open("wb") as file:
        while chunk := packed.read(CHUNK):
            size += len(chunk)
            if size > MAX_BYTES:
                limit = MAX_BYTES >> 20
                raise InputError(f"{title}: expected at most {limit} MB, found more; {ADVICE}")
            file.write(chunk)
