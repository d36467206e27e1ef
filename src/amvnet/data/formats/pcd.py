"""Read point clouds in PCL's format: ascii, binary or binary_compressed, columns in any order.

pypcd4 is not used. Version 1.5 reads truncated files without an error, and refuses ascii files
whose numbers are not separated by single spaces.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import lzf
import numpy as np

from amvnet.data.formats import cloud
from amvnet.data.formats.fields import Fields, read_header_line
from amvnet.errors import InputError

KIND = "a PCD file"
COMMENT = "# "  # begins a line of the header
ADVICE = "write the file again"

# NumPy types by a field's TYPE (a letter) and SIZE (bytes).
TYPES = {
    "F": {4: "<f4", 8: "<f8"},
    "I": {1: "<i1", 2: "<i2", 4: "<i4", 8: "<i8"},
    "U": {1: "<u1", 2: "<u2", 4: "<u4", 8: "<u8"},
}

# LZF packs at most LONGEST_REPETITION bytes into a code of REPETITION_CODE bytes. No data can be
# packed more tightly.
LONGEST_REPETITION = 264
REPETITION_CODE = 3


def read_columns(path: Path, wanted: cloud.Names) -> cloud.Arrays:
    """Read some fields of all points; if a field has several values, read only the first.

    The points of an organised cloud (a grid) come row by row.

    Raises:
        InputError: if the file is not PCD, is truncated or lacks a field.
    """
    with cloud.reading(path, KIND, ADVICE), path.open("rb") as file:
        entries = _read_header(file, path)
        fields = _parse_fields(entries)
        chosen = cloud.require_columns(fields.names, path, wanted)
        points = _count_points(entries)
        encoding = entries["DATA"][0].lower()

        if encoding == "ascii":
            # Each value takes at least one character, and another character separates two values.
            cloud.check_point_count(points, path, 2 * sum(fields.counts) * points - 1)
            return fields.read_text(file, points, chosen, path)

        if encoding == "binary":
            cloud.check_point_count(points, path, file.tell() + points * fields.record.itemsize)
            return fields.read_binary(file, points, chosen)
        if encoding == "binary_compressed":
            return _read_compressed(file, fields, points, chosen, path)
        raise InputError(
            f"{path}: expected DATA ascii, binary, binary_compressed, "
            f"found {encoding[:20]!a}; {ADVICE}"
        )


def read_comments(path: Path) -> dict[str, list[str]]:
    """Return the comments of the header; raise InputError if it has no end."""
    comments = []
    with path.open("rb") as file:
        while not (line := read_header_line(file, path, KIND, "line DATA")).startswith("DATA"):
            if line.startswith(COMMENT):
                comments.append(line.removeprefix(COMMENT))
    return {"comments": comments}


def _read_header(file: BinaryIO, path: Path) -> dict[str, list[str]]:
    """Return the header up to DATA: the first word of each line, and its other words."""
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        words = read_header_line(file, path, KIND, "line DATA").split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    return entries


def _parse_fields(entries: dict[str, list[str]]) -> Fields:
    """Return the fields that the lines FIELDS, SIZE, TYPE and COUNT describe."""
    names = entries.get("FIELDS") or entries["COLUMNS"]
    kinds = zip(entries["TYPE"], entries["SIZE"], strict=True)
    dtypes = [TYPES[kind.upper()][int(size)] for kind, size in kinds]
    counts = list(map(int, entries.get("COUNT", ["1"] * len(names))))
    if not len(names) == len(dtypes) == len(counts) or min(counts) < 0:
        raise ValueError(f"{len(names)} FIELDS, {len(dtypes)} TYPE, COUNT {counts[:20]}")

    return Fields(names, dtypes, counts)


def _count_points(entries: dict[str, list[str]]) -> int:
    if "POINTS" in entries:
        return int(entries["POINTS"][0])
    return int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])


def _read_compressed(
    file: BinaryIO, fields: Fields, points: int, chosen: dict[str, int], path: Path
) -> cloud.Arrays:
    """Read the first value of the chosen fields (indices by key) from packed points."""
    packed_size, size = struct.unpack("<II", file.read(8))
    cloud.check_point_count(points, path, file.tell() + packed_size)
    expected = points * fields.record.itemsize
    if size != expected or size > cloud.MAX_BYTES:
        expected = min(expected, cloud.MAX_BYTES)
        raise InputError(f"{path}: expected {expected} bytes of points, found {size}; {ADVICE}")
    if size * REPETITION_CODE > packed_size * LONGEST_REPETITION:
        raise InputError(
            f"{path}: expected {size} bytes of points, found {packed_size} packed ones, which "
            f"cannot hold them; {ADVICE}"
        )

    # The data hold one field after the other. In each, the values of a point are side by side.
    data = unpack_lzf(file.read(packed_size), size)
    sizes = [fields.record[index].itemsize for index in range(len(fields.names))]
    arrays = {}
    for key, index in chosen.items():
        start = points * sum(sizes[:index])
        count = fields.counts[index]
        arrays[key] = np.frombuffer(data, fields.dtypes[index], points * count, start)[::count]
    return arrays


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpack `size` bytes of LZF; raise ValueError if the data are broken.

    The library stops at `size` bytes and returns None if there are more.
    """
    output = lzf.decompress(data, size) if data else b""
    if output is None:
        raise ValueError(f"more than {size} unpacked bytes")
    if len(output) != size:
        raise ValueError(f"{len(output)} unpacked bytes instead of {size}")
    return output
