"""Read scan files packed by gzip.

A reader takes the unpacked points from a temporary file. All this runs in the process with limits
(`reader_process`), because a file may unpack to any size. Files that are packed twice are refused.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from amvnet.data.formats.cloud import MAX_BYTES, Cloud, reading
from amvnet.data.formats.detect import BAGS, GZIP, ending_of, named_ending
from amvnet.errors import InputError

CHUNK = 1 << 20  # number of bytes that are unpacked at a time
ADVICE = "copy it again, or unpack it"

Read = Callable[[Path, str], Cloud]  # a function that reads a file of one scan, given its ending


def read_gzip(path: Path, read: Read) -> Cloud:
    """Read the scan in a file that is packed by gzip.

    Raises:
        InputError: if the file is truncated, unpacks to too many bytes, or holds no file of one
            scan. Messages name the packed file.
    """
    name_inside = Path(path.name.lower().removesuffix(GZIP))
    with (
        reading(path, "a scan file packed by gzip", ADVICE),
        gzip.open(path) as packed,
        TemporaryDirectory() as folder,
    ):
        unpacked = Path(folder) / f"scan{named_ending(name_inside) or ''}"
        _unpack(packed, unpacked, path)
        try:
            ending = ending_of(unpacked)
            if ending in (*BAGS, GZIP):
                raise InputError(f"{path}: expected a file of one scan, found {ending}; {ADVICE}")
            cloud = read(unpacked, ending)
        except InputError as error:  # readers name the file that they read
            raise InputError(str(error).replace(str(unpacked), str(path))) from None
    return replace(cloud, name=str(path))


def _unpack(packed: gzip.GzipFile, target: Path, title: Path) -> None:
    """Unpack a file, which messages call `title`; raise InputError if no scan has so many bytes."""
    size = 0
    with target.open("wb") as file:
        while chunk := packed.read(CHUNK):
            size += len(chunk)
            if size > MAX_BYTES:
                limit = MAX_BYTES >> 20
                raise InputError(f"{title}: expected at most {limit} MB, found more; {ADVICE}")
            file.write(chunk)
