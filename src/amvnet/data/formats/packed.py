"""Read scan files packed by gzip.

A file is unpacked into a temporary file that only its reader sees. This runs in the process with
limits, and does not read files that are packed twice.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from amvnet.data.formats.cloud import MAX_BYTES, Cloud, reading
from amvnet.data.formats.detect import BAGS, FOLDER, GZIP, ending_of, named_ending
from amvnet.errors import InputError

CHUNK = 1 << 20  # the bytes that are unpacked at a time
ADVICE = "copy it again, or unpack it"

Read = Callable[[Path, str], Cloud]  # a function that reads a file of one scan, given its ending


def read_gzip(path: Path, read: Read) -> Cloud:
    """Read the scan in a file that is packed by gzip.

    Raises:
        InputError: if the file is truncated, unpacks to too many bytes, or holds no file of one
            scan.
    """
    name = Path(path.name.lower().removesuffix(GZIP))
    with (
        reading(path, "a scan file packed by gzip", ADVICE),
        gzip.open(path) as packed,
        TemporaryDirectory() as folder,
    ):
        unpacked = Path(folder) / f"scan{named_ending(name) or ''}"
        _unpack(packed, unpacked, path)
        try:
            ending = ending_of(unpacked)
            if ending in (FOLDER, *BAGS, GZIP):
                raise InputError(
                    f"{unpacked}: expected a file of one scan, found {ending}; {ADVICE}"
                )
            cloud = read(unpacked, ending)
        except InputError as error:
            raise InputError(str(error).replace(str(unpacked), str(path))) from None
    return Cloud(cloud.xyz, cloud.intensity, cloud.ring, str(path), cloud.note)


def _unpack(packed: gzip.GzipFile, path: Path, title: Path) -> None:
    """Unpack a file; raise InputError if it has more bytes than any scan."""
    size = 0
    with path.open("wb") as file:
        while chunk := packed.read(CHUNK):
            size += len(chunk)
            if size > MAX_BYTES:
                limit = MAX_BYTES >> 20
                raise InputError(f"{title}: expected at most {limit} MB, found more; {ADVICE}")
            file.write(chunk)
