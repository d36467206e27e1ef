"""Read the labels of single scans from label files or scan files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import MAX_POINTS, reading, require_columns
from amvnet.data.formats.detect import TEXT, ending_of
from amvnet.data.formats.numpy_files import member_names, read_array
from amvnet.data.formats.raw import count_rows
from amvnet.data.formats.registry import COLUMN_READERS, read_columns
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.labels.ids import check_bits, train_ids
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError, readable

# The types of the ids in files that hold only ids, by bytes per point.
INTEGERS = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.int64}
# The usual names of a column of labels; CloudCompare writes names that begin with "scalar_", and
# LAS has a classification in any case.
COLUMNS = ("class", "label", "scalar_class", "scalar_label", "classification")
# The usual names of an array of labels in an archive.
ARRAYS = ("labels", "label", "class", "arr_0")
KEY = "labels"  # the key of the labels among the columns that a reader returns
LARGEST_ID = np.iinfo(np.uint32).max
ADVICE = "write the labels again, one whole number per point"


def read_scan_labels(path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
    """Read the (N,) uint8 train ids of a scan from a label file with raw ids.

    Raises:
        InputError: if `read_raw_labels` raises it, or an id is unknown.
    """
    raw = read_raw_labels(path, count, missing=taxonomy.train_to_raw[0])
    return train_ids(path, raw, taxonomy)


def read_raw_labels(
    path: Path, count: int, field: str | None = None, layout: RowLayout = UNKNOWN, *, missing: int
) -> np.ndarray:
    """Read (N,) int64 raw ids from a label file, or from a field of the scan's file.

    Without a field, the ending decides the format: `.npy`, `.npz`, text with a number per line, or
    the usual column of `.pcd`, `.ply`, `.las` or `.laz`. Any other file holds only integers of 8,
    16, 32 or 64 bits.

    Args:
        path: a label file, or with a field, the scan's file.
        field: the name of the column. In `.npz`, it may also name an array next to the points. In
            arrays and text without names, it is the number of the column, from 0.
        missing: the raw id for NaN, which CloudCompare writes for points without a label.

    Raises:
        InputError: if the file is missing or broken, lacks the field, or has another number of
            labels.
    """
    with readable(path):
        is_file = path.is_file()
    if not is_file:
        raise InputError(f"{path}: expected the labels of a scan, found no file; check the path")

    with reading(path, "labels", ADVICE):
        raw = _read_usual(path, count) if field is None else _read_field(path, field, layout)
    raw = np.asarray(raw)
    if raw.dtype.kind == "f":
        raw = np.where(np.isnan(raw), missing, raw)
    return check_bits(path, _check(raw, path, count))


def _read_field(path: Path, field: str, layout: RowLayout) -> np.ndarray:
    ending = ending_of(path)
    if ending.endswith(".bin"):
        return _read_raw_column(path, layout, field)

    if ending == ".npz" and field in member_names(path):
        return read_array(path, field)

    if ending in COLUMN_READERS:
        return read_columns(path, ending, {KEY: [field]})[KEY]
    raise InputError(
        f"{path}: expected a file with fields of labels ({', '.join(COLUMN_READERS)}), "
        f"found {ending or 'a bag'}; write the labels into files next to the scans"
    )


def _read_usual(path: Path, count: int) -> np.ndarray:
    ending = path.suffix.lower()
    if ending in TEXT:
        return _read_numbers(path)

    if ending == ".npy":
        return read_array(path)
    if ending == ".npz":
        names = member_names(path)
        index = 0 if len(names) == 1 else require_columns(names, path, {KEY: ARRAYS})[KEY]
        return read_array(path, names[index])
    if ending in COLUMN_READERS:
        return read_columns(path, ending, {KEY: COLUMNS})[KEY]
    return _read_integers(path, count)


def _check(labels: np.ndarray, path: Path, count: int) -> np.ndarray:
    """Return whole numbers, one per point, as (N,) int64."""
    if labels.ndim == 2 and len(labels) == count and labels.shape[1] > 1:
        raise InputError(
            f"{path}: expected a label per point, found {labels.shape[1]} columns; save the column "
            "of the classes alone, or name it by its number, such as field: 1 in the YAML file"
        )

    labels = labels.reshape(-1)
    if len(labels) != count:
        raise InputError(
            f"{path}: expected {count} labels, one per point, found {len(labels)}; "
            "give the labels of this scan"
        )

    if labels.dtype.kind not in "fiub":
        raise InputError(
            f"{path}: expected whole numbers as labels, found {labels.dtype}; {ADVICE}"
        )
    is_wrong = ~np.isfinite(labels) | (labels != np.round(labels))
    if is_wrong.any():
        raise InputError(
            f"{path}: expected whole numbers as labels, found {labels[is_wrong][0]:g} "
            f"({np.count_nonzero(is_wrong):,} of {count:,} labels are not whole); {ADVICE}"
        )
    if count and not -LARGEST_ID <= labels.min() <= labels.max() <= LARGEST_ID:
        raise InputError(f"{path}: expected labels of 32 bits, found larger ones; {ADVICE}")
    return labels.astype(np.int64)


def _read_integers(path: Path, count: int) -> np.ndarray:
    """Read a file that holds only integers; its size decides their type."""
    size = path.stat().st_size
    if count and size % count == 0 and size // count in INTEGERS:
        return np.fromfile(path, dtype=INTEGERS[size // count], count=count)
    raise InputError(
        f"{path}: expected {count} labels of 8 to 64 bits, one per point, found {size} bytes; "
        "give the labels of this scan"
    )


def _read_numbers(path: Path) -> np.ndarray:
    """Read a text with a number in each line; the first line may be a title.

    A table whose first line names x, y and z has a column of labels.
    """
    with path.open(encoding="utf-8-sig") as file:
        first = file.readline()
        if {"x", "y", "z"} <= set(first.strip().split(",")):
            return read_columns(path, path.suffix.lower(), {KEY: COLUMNS})[KEY]
        with suppress(ValueError):  # a title or a comment is not read again
            float(first)
            file.seek(0)
        return np.loadtxt(file, delimiter=",", max_rows=MAX_POINTS + 1, ndmin=1)


def _read_raw_column(path: Path, layout: RowLayout, field: str) -> np.ndarray:
    """Read a column from rows of numbers, whose layout the user has described."""
    if not layout.columns:
        raise InputError(
            f"{path}: expected the columns of rows with labels, found none; "
            "add columns: [x, y, z, intensity, label]"
        )
    index = require_columns(layout.columns, path, {KEY: [field]})[KEY]
    count = count_rows(path, layout.record, 1)
    records = np.fromfile(path, dtype=layout.record, count=min(count, MAX_POINTS))

    return records[str(index)]
