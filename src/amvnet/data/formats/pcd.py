"""Read point clouds in PCL's format: ascii, binary or binary_compressed, columns in any order.

We do not use pypcd4: version 1.5 reads truncated files without an error, and ascii files only if
single spaces separate the numbers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import (
    MAX_BYTES,
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    record_dtype,
    require_columns,
    split_records,
)
from amvnet.errors import InputError

HEADER = 65_536  # bytes of the longest header
ADVICE = "write the file again"

# NumPy types by the letter of TYPE and the bytes of SIZE.
TYPES = {
    "F": {4: "<f4", 8: "<f8"},
    "I": {1: "<i1", 2: "<i2", 4: "<i4", 8: "<i8"},
    "U": {1: "<u1", 2: "<u2", 4: "<u4", 8: "<u8"},
}

# The longest repetition that LZF can encode, and the length of its code. Nothing is packed more
# tightly.
LONGEST_REPETITION = 264  # bytes
REPETITION_CODE = 3  # bytes


@dataclass(frozen=True)
class Column:
    """One field of the points of a file.

    Attributes:
        name: the name in the header.
        dtype: the NumPy type of its values.
        count: values per point in this column.
        offset: bytes per point before this column.
        index: values per point before this column.
    """

    name: str
    dtype: str
    count: int
    offset: int
    index: int

    @property
    def size(self) -> int:
        """Bytes of this column in one point."""
        return int(self.dtype[2:]) * self.count


@dataclass(frozen=True)
class Header:
    """The header of a PCD file.

    Attributes:
        columns: in the file's order.
        points: the number of points.
        encoding: "ascii", "binary" or "binary_compressed".
    """

    columns: tuple[Column, ...]
    points: int
    encoding: str

    @property
    def row(self) -> int:
        """Bytes of one point."""
        return sum(column.size for column in self.columns)


Columns = dict[str, Column]  # with the keys x, y, z and, if present, intensity and ring
Arrays = dict[str, np.ndarray]  # the (N,) values of these columns


def read_pcd(path: Path) -> Cloud:
    """Read one cloud; an organised one (a grid of points) row by row.

    Raises:
        InputError: if the file is not PCD, is truncated, or has no x, y, z.
    """
    return make_cloud(read_fields(path, partial(require_columns, path=path)), str(path))


def read_fields(path: Path, choose: Callable[[Sequence[str]], dict[str, int]]) -> Arrays:
    """Read some fields of the points.

    Args:
        choose: returns the index of each field to read, given the names of all.

    Returns:
        The (N,) values of each field, by the keys of `choose`.

    Raises:
        InputError: as `read_pcd`.
    """
    with reading(path, "a PCD file", ADVICE), path.open("rb") as file:
        header = _read_header(file, path)

        columns = {}
        names = [column.name for column in header.columns]
        for key, index in choose(names).items():
            columns[key] = header.columns[index]

        read_points = READERS[header.encoding]
        return read_points(file, header, columns, path)


def _read_header(file: BinaryIO, path: Path) -> Header:
    """Read the header, up to and including the line DATA.

    Raises:
        InputError: if there is no such line, or its encoding is unknown.
    """
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = file.readline(HEADER)
        if not line or file.tell() > HEADER:
            raise InputError(
                f"{path}: expected the header of a PCD file, found no line DATA; {ADVICE}"
            )

        words = line.decode("latin-1").split()  # comments may be in any encoding
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]

    columns = _parse_columns(entries)
    if "POINTS" in entries:
        points = int(entries["POINTS"][0])
    else:
        points = int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])

    encoding = entries["DATA"][0].lower()
    if encoding not in READERS:
        raise InputError(
            f"{path}: expected DATA {', '.join(READERS)}, found {encoding[:20]!a}; {ADVICE}"
        )
    return Header(columns, points, encoding)


def _parse_columns(entries: dict[str, list[str]]) -> tuple[Column, ...]:
    """Return the columns that the lines FIELDS, SIZE, TYPE and COUNT describe."""
    names = entries.get("FIELDS") or entries["COLUMNS"]
    sizes = entries["SIZE"]
    types = entries["TYPE"]
    counts = entries.get("COUNT", ["1"] * len(names))

    columns = []
    offset = 0
    index = 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        column = Column(name, TYPES[kind.upper()][int(size)], int(count), offset, index)
        if column.count < 0:
            raise ValueError(f"COUNT {count}")
        columns.append(column)
        offset += column.size
        index += column.count
    return tuple(columns)


def _read_ascii(file: BinaryIO, header: Header, columns: Columns, path: Path) -> Arrays:
    # Each value takes at least one digit, and each but the last a separator.
    values_per_point = sum(column.count for column in header.columns)
    count = check_point_count(header.points, path, 2 * values_per_point * header.points - 1)

    positions = {}
    for key, column in columns.items():
        positions[key] = (column.index, column.dtype)
    return read_text(file, count, positions, path)


def read_text(
    file: BinaryIO, count: int, columns: dict[str, tuple[int, str]], path: Path
) -> Arrays:
    """Read some columns of the next `count` lines of numbers.

    Args:
        columns: for each column, its index in a line and its NumPy type.

    Returns:
        The (count,) values of each column.

    Raises:
        InputError: if there are fewer lines.
    """
    indices, dtypes = zip(*columns.values(), strict=True)
    table = np.zeros((0, len(columns)))
    lines = islice(filter(bytes.strip, file), count)
    for first in lines:  # NumPy warns if there is none
        table = np.loadtxt(chain([first], lines), usecols=indices, comments=None, ndmin=2)

    if len(table) < count:
        raise InputError(
            f"{path}: expected {count} lines of points, found {len(table)}; copy the file again"
        )

    arrays = {}
    with np.errstate(invalid="ignore"):
        for key, dtype, values in zip(columns, dtypes, table.T, strict=True):
            # A column with NaN or infinity stays float64, because integers cannot hold these.
            arrays[key] = values.astype(dtype) if np.isfinite(values).all() else values
    return arrays


def _read_binary(file: BinaryIO, header: Header, columns: Columns, path: Path) -> Arrays:
    end = file.tell() + header.points * header.row
    count = check_point_count(header.points, path, end)

    positions = {}
    for key, column in columns.items():
        positions[key] = (column.dtype, column.offset)
    return read_rows(file, count, header.row, positions)


def read_rows(file: BinaryIO, count: int, row: int, columns: dict[str, tuple[str, int]]) -> Arrays:
    """Read some columns of the next `count` points.

    Args:
        row: bytes of a point.
        columns: for each column, its NumPy type and its offset in a point, bytes.

    Returns:
        The (count,) values of each column; fewer if the file ends before.
    """
    return split_records(np.fromfile(file, dtype=record_dtype(columns, row), count=count))


def _read_compressed(file: BinaryIO, header: Header, columns: Columns, path: Path) -> Arrays:
    packed_size, size = struct.unpack("<II", file.read(8))
    count = check_point_count(header.points, path, file.tell() + packed_size)
    can_unpack = size * REPETITION_CODE <= packed_size * LONGEST_REPETITION
    if size != count * header.row or size > MAX_BYTES or not can_unpack:
        expected = min(count * header.row, MAX_BYTES)
        raise InputError(f"{path}: expected {expected} bytes of points, found {size}; {ADVICE}")

    # One column follows the other. Within a column, the values of a point are adjacent, and the
    # first of them is used.
    data = unpack_lzf(file.read(packed_size), size)
    arrays = {}
    for key, column in columns.items():
        values = np.frombuffer(data, column.dtype, count * column.count, count * column.offset)
        arrays[key] = values[:: column.count]
    return arrays


def unpack_lzf(data: bytes, size: int) -> bytearray:
    """Return the `size` bytes that LZF packed into `data`.

    Raises:
        ValueError, IndexError: if `data` does not unpack to exactly `size` bytes.
    """
    output = bytearray()
    position = 0

    while position < len(data) and len(output) <= size:
        control = data[position]
        position += 1

        if control < 32:  # a literal: the next control + 1 bytes as they are
            output += data[position : position + control + 1]
            position += control + 1
            continue

        # A back reference: 3 bits of length, followed by a byte to add if all three are set, and
        # 13 bits of distance.
        length = (control >> 5) + 2
        if length == 9:
            length += data[position]
            position += 1
        distance = ((control & 31) << 8) + data[position] + 1
        position += 1

        start = len(output) - distance
        if start < 0:
            raise ValueError("a repetition of bytes before the first")
        pattern = output[start : start + length]
        if distance < length:  # the repetition repeats itself
            pattern = (pattern * (length // distance + 1))[:length]
        output += pattern

    if len(output) != size:
        raise ValueError(f"{len(output)} unpacked bytes instead of {size}")
    return output


READERS = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
