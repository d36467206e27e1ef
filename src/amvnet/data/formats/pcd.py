"""Point clouds in PCL's format: ascii, binary and binary_compressed, with any columns in any order.

Own code, as pypcd4 (1.5) reads a truncated file without a word, and ascii only with single spaces between the numbers.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    refusing,
    require_columns,
)
from amvnet.errors import InputError

HEADER = 65_536  # bytes that a header has at most
TYPES = {"F": {4: "<f4", 8: "<f8"}, "I": {1: "<i1", 2: "<i2", 4: "<i4", 8: "<i8"},
         "U": {1: "<u1", 2: "<u2", 4: "<u4", 8: "<u8"}}  # fmt: skip
ADVICE = "write the file again"
SHORTEST = 3  # bytes for which a compressed file can stand for LONGEST
LONGEST = 264


@dataclass(frozen=True)
class Column:
    """One field: its name, numpy's type, how many values it has, where it begins in a point, and in which column."""

    name: str
    dtype: str
    count: int
    offset: int
    place: int

    @property
    def size(self) -> int:
        return int(self.dtype[2:]) * self.count


@dataclass(frozen=True)
class Header:
    """What a PCD file says of itself."""

    columns: tuple[Column, ...]
    points: int
    encoding: str

    @property
    def row(self) -> int:
        """Bytes of a point."""
        return sum(column.size for column in self.columns)


def read_pcd(path: Path) -> Cloud:
    """Read one cloud; an organised one row by row.

    Raises:
        InputError: where it is no such file, truncated, or has no x, y, z.
    """
    with refusing(path, "a PCD file", ADVICE), path.open("rb") as file:
        header = _read_header(file, path)
        wanted = require_columns([column.name for column in header.columns], path)
        columns = {key: header.columns[place] for key, place in wanted.items()}
        return make_cloud(READERS[header.encoding](file, header, columns, path), str(path))


def _read_header(file: BinaryIO, path: Path) -> Header:
    words: dict[str, list[str]] = {}
    while "DATA" not in words:
        line = file.readline(HEADER)
        if not line or file.tell() > HEADER:
            raise InputError(
                f"{path}: expected the header of a PCD file, found no line DATA; {ADVICE}"
            )
        parts = line.decode("ascii").split()
        if parts and not parts[0].startswith("#"):
            words[parts[0].upper()] = parts[1:]
    names = words.get("FIELDS") or words["COLUMNS"]
    columns = _columns(names, words["SIZE"], words["TYPE"], words.get("COUNT", ["1"] * len(names)))
    points = (
        int(words["POINTS"][0])
        if "POINTS" in words
        else int(words["WIDTH"][0]) * int(words["HEIGHT"][0])
    )
    encoding = words["DATA"][0].lower()
    if encoding not in READERS:
        raise InputError(
            f"{path}: expected DATA {', '.join(READERS)}, found {encoding[:20]!a}; {ADVICE}"
        )
    return Header(columns, points, encoding)


def _columns(
    names: list[str], sizes: list[str], types: list[str], counts: list[str]
) -> tuple[Column, ...]:
    found, offset, place = [], 0, 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        column = Column(name, TYPES[kind.upper()][int(size)], int(count), offset, place)
        if column.count < 0:
            raise ValueError(f"COUNT {count}")
        found.append(column)
        offset, place = offset + column.size, place + column.count
    return tuple(found)


def _read_ascii(
    file: BinaryIO, header: Header, columns: dict[str, Column], path: Path
) -> dict[str, np.ndarray]:
    values = sum(column.count for column in header.columns)
    count = check_point_count(header.points, path, 2 * values * header.points - 1)
    return read_text(
        file, count, {key: (column.place, column.dtype) for key, column in columns.items()}, path
    )


def read_text(
    file: BinaryIO, count: int, columns: dict[str, tuple[int, str]], path: Path
) -> dict[str, np.ndarray]:
    """Columns of the next `count` lines of numbers; each is given as its place and its type.

    Raises:
        InputError: where there are fewer lines.
    """
    if not count:
        return {key: np.zeros(0, dtype) for key, (_, dtype) in columns.items()}
    places = [place for place, _ in columns.values()]
    table = np.loadtxt(file, usecols=places, max_rows=count, comments=None, ndmin=2)
    if len(table) < count:
        raise InputError(
            f"{path}: expected {count} lines of points, found {len(table)}; copy the file again"
        )
    with np.errstate(invalid="ignore"):
        return {
            key: _typed(table[:, i], dtype) for i, (key, (_, dtype)) in enumerate(columns.items())
        }


def _typed(values: np.ndarray, dtype: str) -> np.ndarray:
    return values.astype(dtype) if np.isfinite(values).all() else values


def _read_binary(
    file: BinaryIO, header: Header, columns: dict[str, Column], path: Path
) -> dict[str, np.ndarray]:
    count = check_point_count(header.points, path, file.tell() + header.points * header.row)
    return read_rows(
        file, count, header.row, {key: (c.dtype, c.offset) for key, c in columns.items()}
    )


def read_rows(
    file: BinaryIO, count: int, row: int, columns: dict[str, tuple[str, int]]
) -> dict[str, np.ndarray]:
    """Columns of the next `count` points of `row` bytes; each is given as its type and where it begins in a point."""
    formats, offsets = (
        [dtype for dtype, _ in columns.values()],
        [offset for _, offset in columns.values()],
    )
    point = np.dtype(
        {"names": list(columns), "formats": formats, "offsets": offsets, "itemsize": row}
    )
    table = np.fromfile(file, dtype=point, count=count)
    return {key: table[key] for key in columns}


def _read_compressed(
    file: BinaryIO, header: Header, columns: dict[str, Column], path: Path
) -> dict[str, np.ndarray]:
    packed, unpacked = struct.unpack("<II", file.read(8))
    count = check_point_count(header.points, path, file.tell() + packed)
    if unpacked != count * header.row or unpacked * SHORTEST > packed * LONGEST:
        raise InputError(
            f"{path}: expected {count * header.row} bytes of points, found {unpacked}; {ADVICE}"
        )
    data = unpack_lzf(file.read(packed), unpacked)
    return {  # one column after the other
        key: np.frombuffer(data, c.dtype, count * c.count, count * c.offset)[:: c.count]
        for key, c in columns.items()
    }


def unpack_lzf(data: bytes, size: int) -> bytes:
    """The `size` bytes that LZF made `data` of.

    Raises:
        ValueError, IndexError: where it did not.
    """
    out, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:  # so many bytes follow, and one more
            out += data[at : at + control + 1]
            at += control + 1
        else:  # repeat what was seen before
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, start, length + 2)
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(f"{len(out)} unpacked bytes in place of {size}")
    return bytes(out)


def _repeat(out: bytearray, start: int, length: int) -> None:
    """Append what begins at `start`, of which the end may be what is being appended."""
    if start < 0:
        raise ValueError("a repetition of what was not there")
    seen = out[start : start + length]
    out += (seen * (length // len(seen) + 1))[:length]


READERS = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}
