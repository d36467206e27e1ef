"""Raw labels of single scans: a file next to the scan, or a field of the scan's own file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import MAX_POINTS, reading
from amvnet.data.formats.detect import TEXT, ending_of
from amvnet.data.formats.las import read_dimension
from amvnet.data.formats.numpy_files import member_names, read_array
from amvnet.data.formats.pcd import read_fields
from amvnet.data.formats.ply import read_vertices
from amvnet.data.formats.raw import count_rows
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.formats.text import read_column
from amvnet.data.label_files import LABEL_COLUMNS
from amvnet.errors import InputError

# Types of the ids in files of nothing but ids, by bytes per point.
INTEGERS = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.int64}
KEYS = ("labels", "label", "class", "arr_0")  # arrays of an archive of labels
ADVICE = "write the labels again, one whole number per point"


def read_label_file(path: Path, count: int, field: str | None = None) -> np.ndarray:
    """Read the raw labels of a scan from a file of labels.

    The ending tells the format: `.npy`, `.npz`, text with a number per line, `.pcd`, `.ply`,
    `.las`, `.laz`; any other file holds integers of 8, 16, 32 or 64 bits and nothing else.

    Args:
        path: the file.
        count: the number of points of the scan.
        field: the column or array to read; None means the only one, or one with a usual name.

    Returns:
        (N,) int64.

    Raises:
        InputError: if the file is missing or broken, or has another number of labels.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected the labels of a scan, found no file; check the path")

    ending = path.suffix.lower()
    with reading(path, "labels", ADVICE):
        if ending in TEXT and field is None:
            labels = _read_numbers(path)
        elif ending in (".npy", ".npz") and field is None:
            labels = read_array(path, _usual_member(path) if ending == ".npz" else None)
        elif ending in FIELD_READERS:
            labels = FIELD_READERS[ending](path, field)
        else:
            labels = _read_integers(path, count)
    return _check(labels, path, count)


def read_label_field(path: Path, count: int, field: str, layout: RowLayout = UNKNOWN) -> np.ndarray:
    """Read the raw labels of a scan from a field of the scan's file.

    Args:
        path: the file of the scan.
        count: the number of points of the scan.
        field: name of the column; of `.npz`, also of an array next to the points; of arrays and
            text without names, the number of the column, from 0.
        layout: of rows without names, what they hold.

    Returns:
        (N,) int64.

    Raises:
        InputError: if there is no such field, or it does not hold whole numbers.
    """
    ending = ending_of(path)
    with reading(path, f"the field {field} with labels", ADVICE):
        if ending.endswith(".bin"):
            labels = _read_raw_column(path, field, layout)
        elif ending in FIELD_READERS:
            labels = FIELD_READERS[ending](path, field)
        else:
            raise InputError(
                f"{path}: expected a file with fields of labels ({', '.join(FIELD_READERS)}), "
                f"found {ending or 'a bag'}; write the labels into files next to the scans"
            )
    return _check(labels, path, count)


def _check(labels: np.ndarray, path: Path, count: int) -> np.ndarray:
    """Return whole numbers, one per point, as (N,) int64."""
    labels = np.asarray(labels).reshape(-1)
    if len(labels) != count:
        raise InputError(
            f"{path}: expected {count} labels, one per point, found {len(labels)}; "
            "give the labels of this scan"
        )
    is_number = labels.dtype.kind in "fiu"
    if not is_number or not np.array_equal(labels, np.round(labels)):
        raise InputError(
            f"{path}: expected whole numbers as labels, found {labels.dtype} with others; {ADVICE}"
        )
    return labels.astype(np.int64)


def _read_integers(path: Path, count: int) -> np.ndarray:
    """Read a file of nothing but integers, whose size tells their type."""
    size = path.stat().st_size
    if count and size % count == 0 and size // count in INTEGERS:
        return np.fromfile(path, dtype=INTEGERS[size // count], count=count)
    raise InputError(
        f"{path}: expected {count} labels of 8 to 64 bits, one per point, found {size} bytes; "
        "give the labels of this scan"
    )


def _read_numbers(path: Path) -> np.ndarray:
    """Read a text with a number in each line; a first line may be a title."""
    with path.open(encoding="utf-8-sig") as file:
        first = file.readline()
        is_title = not first.strip().lstrip("+-").replace(".", "", 1).isdigit()
        if not is_title or first.startswith("#"):
            file.seek(0)
        return np.loadtxt(file, delimiter=",", max_rows=MAX_POINTS + 1, ndmin=1)


def _usual_member(path: Path) -> str:
    """Return the name of the array of labels in an archive."""
    names = member_names(path)
    if len(names) == 1:
        return names[0]
    return _choose(names, None, path, KEYS)


def _read_archive(path: Path, field: str | None) -> np.ndarray:
    """Read an array of an archive, or else a column of the points in it."""
    if field in member_names(path):
        return read_array(path, field)
    return _read_array_column(path, field)


def _read_array_column(path: Path, field: str | None) -> np.ndarray:
    """Read a named or numbered column of an array of points."""
    array = read_array(path)
    names = array.dtype.names
    if names is not None:
        return array[_choose(names, field, path)]
    if field is not None and field.isdecimal() and int(field) < array.shape[-1]:
        return array[..., int(field)]
    raise InputError(
        f"{path}: expected the number of a column from 0 to {array.shape[-1] - 1}, "
        f"found {field!a}; correct the field"
    )


def _read_raw_column(path: Path, field: str, layout: RowLayout) -> np.ndarray:
    """Read a column of rows of numbers that the user described."""
    if not layout.is_complete:
        raise InputError(
            f"{path}: expected columns and dtype of rows with labels, found none; "
            "add columns: [x, y, z, intensity, label] and dtype: float32"
        )
    index = _choose(layout.columns, field, path)
    count = count_rows(path, layout.record, 1)
    records = np.fromfile(path, dtype=layout.record, count=min(count, MAX_POINTS))
    return records[str(layout.columns.index(index))]


def _choose(
    names: Sequence[str], field: str | None, path: Path, usual: Sequence[str] = LABEL_COLUMNS
) -> str:
    """Return the column that a user names, or the first one with a usual name."""
    for name in usual if field is None else [field]:
        if name in names:
            return name
    listing = ", ".join(names)[:200] or "none"
    raise InputError(
        f"{path}: expected a column of labels ({field or ', '.join(usual)}), found {listing!a}; "
        "correct the field"
    )


def _find(names: Sequence[str], field: str | None, path: Path) -> dict[str, int]:
    """Return the index of the column with the labels, as the readers of formats want it."""
    return {"labels": list(names).index(_choose(names, field, path))}


def _read_pcd(path: Path, field: str | None) -> np.ndarray:
    return read_fields(path, partial(_find, field=field, path=path))["labels"]


def _read_ply(path: Path, field: str | None) -> np.ndarray:
    return read_vertices(path, partial(_find, field=field, path=path))["labels"]


def _read_las(path: Path, field: str | None) -> np.ndarray:
    return read_dimension(path, lambda names: _choose(names, field, path))


def _read_text(path: Path, field: str | None) -> np.ndarray:
    return read_column(path, lambda names: _choose(names, field, path))


FIELD_READERS: dict[str, Callable[[Path, str | None], np.ndarray]] = {
    ".npy": _read_array_column,
    ".npz": _read_archive,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
    **dict.fromkeys(TEXT, _read_text),
}
