"""Choose the reader of a format, and run it in this process or in the process with limits."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from amvnet.data.formats import feather, las, numpy_files, pcd, ply, text
from amvnet.data.formats.bags import Bag
from amvnet.data.formats.cloud import (
    COLUMN_NAMES,
    MAX_BYTES,
    Arrays,
    Cloud,
    Names,
    make_cloud,
    reading,
)
from amvnet.data.formats.detect import BAGS, FOLDER, GZIP, TEXT, ending_of, named_ending
from amvnet.data.formats.raw import NUSCENES_ENDING, read_raw
from amvnet.data.formats.reader_process import call
from amvnet.data.formats.rows import RowLayout
from amvnet.errors import InputError, installation, readable

EXTRAS = {"pyarrow": "feather"}  # the extra that installs a package; by default it is `formats`
OPEN_BAGS = 4  # the number of bags that the process with limits keeps open
CHUNK = 1 << 20  # number of bytes that are unpacked at a time
GZIP_ADVICE = "copy it again, or unpack it"

# Readers by the endings of files. ROW_READERS need the layout of rows without names; COLUMN_READERS
# read named columns.
ROW_READERS: dict[str, Callable[[Path, RowLayout], Cloud]] = {
    NUSCENES_ENDING: read_raw,
    ".bin": read_raw,
    ".npy": numpy_files.read_npy,
    ".npz": numpy_files.read_npz,
    **dict.fromkeys(TEXT, text.read_text_cloud),
}
COLUMN_READERS: dict[str, Callable[[Path, Names], Arrays]] = {
    ".npy": numpy_files.read_columns,
    ".npz": numpy_files.read_columns,
    ".pcd": pcd.read_columns,
    ".ply": ply.read_columns,
    ".las": las.read_columns,
    ".laz": las.read_columns,
    ".feather": feather.read_columns,
    **dict.fromkeys(TEXT, text.read_columns),
}
COMMENT_READERS: dict[str, Callable[[Path], dict[str, list[str]]]] = {
    ".pcd": pcd.read_comments,
    ".ply": ply.read_comments,
    ".las": las.read_comments,
    ".laz": las.read_comments,
}

# The files that are read in the process with limits, and the packages that they need.
PACKAGES: dict[str, tuple[str, ...]] = {
    GZIP: (),
    ".feather": ("pyarrow",),
    **dict.fromkeys((".las", ".laz"), ("laspy", "lazrs")),
    **dict.fromkeys((FOLDER, *BAGS), ("rosbags",)),
}


def read_file(path: Path, ending: str, layout: RowLayout) -> Cloud:
    """Read a file of one scan in the format of an ending (`ending_of`).

    Raises:
        InputError: if the file is broken, or needs a package that is missing.
    """
    if ending == GZIP:
        return Cloud(**_call(read_gzip, path, ending, list(layout.columns), list(layout.dtypes)))
    if ending in ROW_READERS:
        cloud: Cloud = _call(ROW_READERS[ending], path, ending, layout)
        return cloud
    return make_cloud(read_columns(path, ending, COLUMN_NAMES), str(path))


def read_columns(path: Path, ending: str, wanted: Names) -> Arrays:
    """Read some columns of a file of points; each has one number per point, in any shape.

    Raises:
        InputError: if the file is broken, lacks a column, or needs a package that is missing.
    """
    columns: Arrays = _call(COLUMN_READERS[ending], path, ending, wanted)
    return columns


def read_comments(path: Path) -> list[str]:
    """Return the comments in a file of points, in the format that its name ends in.

    Raises:
        InputError: if the file is broken, or needs a package that is missing.
    """
    ending = path.suffix.lower()
    if ending not in COMMENT_READERS:
        return []
    comments: list[str] = _call(COMMENT_READERS[ending], path, ending)["comments"]
    return comments


def open_bag(path: Path, ending: str, topic: str | None) -> list[Callable[[], Cloud]]:
    """Return a function for each scan of a bag, which reads the scan; reading in order is fastest.

    `Bag` documents the arguments.

    Raises:
        InputError: if the bag is broken, has no scan, or needs a package that is missing.
    """
    bag = (ending, topic, uuid4().hex)  # the arguments of `_open`
    count = _call(count_scans, path, ending, *bag)["count"]
    return [partial(_read_scan, path, bag, index) for index in range(count)]


def _read_scan(path: Path, bag: tuple[str, str | None, str], index: int) -> Cloud:
    ending = bag[0]
    return Cloud(**_call(read_from_bag, path, ending, index, *bag))


def check_packages(place: object, ending: str) -> None:
    """Raise InputError, which begins with `place`, if a format needs a package that is missing."""
    missing = [package for package in PACKAGES.get(ending, ()) if find_spec(package) is None]
    if missing:
        raise InputError(
            f"{place}: expected the package {' and '.join(missing)}, found none; "
            f"run {installation(EXTRAS.get(missing[0], 'formats'))}"
        )


def _call(function: Callable[..., Any], path: Path, ending: str, *arguments: Any) -> Any:
    """Call a function that reads a file; the process with limits runs it if `PACKAGES` says so."""
    check_packages(path, ending)
    read = partial(call, function) if ending in PACKAGES else function
    with readable(path):
        return read(path, *arguments)


# --- in the process with limits ---


def count_scans(path: Path, *bag: Any) -> dict[str, int]:
    """Return the number of scans in a bag."""
    return {"count": len(_open(path, *bag))}


def read_from_bag(path: Path, index: int, *bag: Any) -> dict[str, Any]:
    """Return the attributes of the cloud with an index in a bag."""
    return vars(_open(path, *bag).read(index))


@lru_cache(OPEN_BAGS)
def _open(path: Path, ending: str, topic: str | None, _opening: str) -> Bag:
    """Open a bag once for each `_opening`.

    Each call of `open_bag` has its own `_opening`, because the file may have changed since the last
    call.
    """
    return Bag(path, ending, topic)


def read_gzip(path: Path, columns: list[str], dtypes: list[str]) -> dict[str, Any]:
    """Return the attributes of the cloud in a file that is packed by gzip.

    Raises:
        InputError: if the file is truncated, unpacks to too many bytes, or holds no file of one
            scan, or one that is packed again. Messages name the packed file.
    """
    name_inside = Path(path.name.lower().removesuffix(GZIP))
    with (
        reading(path, "a scan file packed by gzip", GZIP_ADVICE),
        gzip.open(path) as packed,
        TemporaryDirectory() as folder,
    ):
        unpacked = Path(folder) / f"scan{named_ending(name_inside) or ''}"
        _unpack(packed, unpacked, path)
        try:
            ending = ending_of(unpacked)
            if ending in (*BAGS, GZIP):
                raise InputError(
                    f"{path}: expected a file of one scan, found {ending}; {GZIP_ADVICE}"
                )
            cloud = read_file(unpacked, ending, RowLayout(tuple(columns), tuple(dtypes)))
        except InputError as error:  # readers name the file that they read
            raise InputError(str(error).replace(str(unpacked), str(path))) from None
    return vars(replace(cloud, name=str(path)))


def _unpack(packed: gzip.GzipFile, target: Path, title: Path) -> None:
    """Unpack a file, which messages call `title`; raise InputError if no scan has so many bytes."""
    size = 0
    with target.open("wb") as file:
        while chunk := packed.read(CHUNK):
            size += len(chunk)
            if size > MAX_BYTES:
                limit = MAX_BYTES >> 20
                raise InputError(f"{title}: expected at most {limit} MB, found more; {GZIP_ADVICE}")
            file.write(chunk)
