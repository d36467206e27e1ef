"""The readers of all formats, and where they run: in this process, or in the one with limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from amvnet.data.formats import arrow, las, numpy_files, pcd, ply, text
from amvnet.data.formats.bags import open_bag
from amvnet.data.formats.cloud import Cloud, make_cloud, require, require_columns
from amvnet.data.formats.detect import BAGS, FOLDER, NUSCENES_ENDING, PACKED, TEXT, ending_of
from amvnet.data.formats.e57 import open_e57
from amvnet.data.formats.fields import Arrays, Choose
from amvnet.data.formats.packed import unpacked
from amvnet.data.formats.raw import read_raw
from amvnet.data.formats.reader_process import call
from amvnet.data.formats.rows import RowLayout
from amvnet.data.formats.series import ScanSeries
from amvnet.errors import InputError

OPEN_FILES = 4  # that the process with limits keeps open


# Readers by the endings of files: of rows, which need to know what the rows hold; of named columns;
# and of files of several scans.
ROW_READERS: dict[str, Callable[[Path, RowLayout], Cloud]] = {
    NUSCENES_ENDING: read_raw,
    ".bin": read_raw,
    ".npy": numpy_files.read_npy,
    ".npz": numpy_files.read_npz,
    **dict.fromkeys(TEXT, text.read_text_cloud),
}
COLUMN_READERS: dict[str, Callable[[Path, Choose], Arrays]] = {
    ".npy": numpy_files.read_columns,
    ".npz": numpy_files.read_columns,
    ".pcd": pcd.read_columns,
    ".ply": ply.read_columns,
    ".las": las.read_columns,
    ".laz": las.read_columns,
    ".feather": arrow.read_columns,
    **dict.fromkeys(TEXT, text.read_columns),
}
SERIES_READERS: dict[str, Callable[[Path, str, str | None], ScanSeries]] = {
    **dict.fromkeys((FOLDER, *BAGS), open_bag),
    ".e57": lambda path, *_: open_e57(path),
}

# The extra of this package that reads a file, and the packages that it installs.
PACKAGES = {
    **dict.fromkeys((".las", ".laz"), ("formats", "laspy", "lazrs")),
    **dict.fromkeys((FOLDER, *BAGS), ("formats", "rosbags")),
    ".feather": ("datasets", "pyarrow"),
    ".e57": ("e57", "pye57"),
}
WITH_LIMITS = (*PACKAGES, *PACKED)  # of the files of one scan


def read_file(path: Path, ending: str, layout: RowLayout) -> Cloud:
    """Read a file of one scan.

    Args:
        ending: as `ending_of` returns it.
        layout: what rows of numbers without names hold, as far as the user says it.

    Raises:
        InputError: if the file is broken, or needs a package that is missing.
    """
    if ending not in WITH_LIMITS:
        return _read(path, ending, layout)
    what = (layout.columns, layout.dtypes)
    return Cloud(**_with_limits("read_with_limits", path, ending, *what))


def read_column(path: Path, ending: str, names: Sequence[str]) -> np.ndarray:
    """Read one column of a file of points, such as their labels.

    Args:
        ending: one of `COLUMN_READERS`.
        names: of the column; the first that the file has counts.

    Returns:
        A number for each point, in any shape.

    Raises:
        InputError: if the file is broken or has no such column.
    """
    if ending not in WITH_LIMITS:
        return _read_column(path, ending, names)
    values: np.ndarray = _with_limits("column_with_limits", path, ending, names)["values"]
    return values


def first_of(names: Sequence[str], wanted: Sequence[str], path: Path) -> str:
    """Return the first of the wanted names of a column or array that a file has.

    Args:
        names: those of the file.
        wanted: the possible names.

    Raises:
        InputError: if it has none of them.
    """
    for name in wanted:
        if name in names:
            return name

    listing = ", ".join(names)[:200] or "none"
    raise InputError(
        f"{path}: expected a column of labels ({', '.join(wanted)}), found {listing!a}; "
        "correct the field"
    )


def open_series(path: Path, ending: str, topic: str | None) -> list[Callable[[], Cloud]]:
    """Return what reads each scan of a file of several, in the process with limits.

    In order is fastest.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        ending: as `ending_of` returns it.
        topic: of bags; None means the only topic with scans.

    Raises:
        InputError: if the file is broken, has no scan, or needs a package that is missing.
    """
    key = uuid4().hex
    values = _with_limits("count_with_limits", path, ending, topic, key)
    return [partial(_read_one, path, ending, topic, key, index) for index in range(values["count"])]


def _read_one(path: Path, *what: Any) -> Cloud:
    return Cloud(**_with_limits("series_with_limits", path, *what))


def _with_limits(function: str, path: Path, ending: str, *arguments: Any) -> dict[str, Any]:
    """Call a function of this module in the process with limits, if the packages are there."""
    if ending in PACKAGES:
        require(path, *PACKAGES[ending])
    return call(f"{__name__}:{function}", path, ending, *arguments)


def _read(path: Path, ending: str, layout: RowLayout) -> Cloud:
    """Read a file of one scan in this process."""
    if ending in PACKED:
        with unpacked(path) as inner:
            cloud = _read(inner, _ending_of_one(inner), layout)
            return replace(cloud, name=str(path))

    if ending in ROW_READERS:
        return ROW_READERS[ending](path, layout)
    columns = COLUMN_READERS[ending](path, partial(require_columns, path=path))
    return make_cloud(columns, str(path))


def _read_column(path: Path, ending: str, names: Sequence[str]) -> np.ndarray:
    """Read one column of a file in this process."""

    def choose(all_names: Sequence[str]) -> dict[str, int]:
        return {"values": list(all_names).index(first_of(all_names, names, path))}

    return COLUMN_READERS[ending](path, choose)["values"]


def _ending_of_one(path: Path) -> str:
    ending = ending_of(path)
    if ending in SERIES_READERS or ending in PACKED:
        raise InputError(
            f"{path}: expected one scan, found a packed {ending} file; unpack the file first"
        )
    return ending


# --- within the process with limits ---


def read_with_limits(
    path: str, ending: str, columns: list[str], dtypes: list[str]
) -> dict[str, Any]:
    """Return the attributes of the cloud in a file."""
    return vars(_read(Path(path), ending, RowLayout(tuple(columns), tuple(dtypes))))


def column_with_limits(path: str, ending: str, names: list[str]) -> Arrays:
    """Return one column of a file, for `read_column`."""
    return {"values": _read_column(Path(path), ending, names)}


def count_with_limits(path: str, *what: str) -> dict[str, int]:
    """Return the number of scans in a file."""
    return {"count": len(_open(path, *what))}


def series_with_limits(path: str, *what: Any) -> dict[str, Any]:
    """Return the attributes of a cloud in a file of several."""
    *which, index = what
    return vars(_open(path, *which).read(index))


@lru_cache(OPEN_FILES)
def _open(path: str, ending: str, topic: str | None, _key: str) -> ScanSeries:
    """Open a file; the key is another each time that it is opened, as it may have changed."""
    return SERIES_READERS[ending](Path(path), ending, topic)
