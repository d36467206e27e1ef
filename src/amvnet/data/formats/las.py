"""Dimensions of LAS and LAZ files, by laspy.

On broken bytes, lazrs 0.8 can take any amount of memory or abort its process, so that points are
read in the process with limits.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import check_point_count, reading
from amvnet.data.formats.fields import Arrays, Choose
from amvnet.errors import InputError

EXPECTED = "a LAS or LAZ file"
ADVICE = "write the file again"
CHUNK = 1_000_000  # points read at once

# The header.
HEADER_1_0 = 227  # bytes of the header of LAS 1.0, the shortest
HEADER_1_4 = 375  # bytes of the header of LAS 1.4, the longest
MIN_RECORD = 54  # bytes of the shortest variable-length record
COMPRESSED = 0x80  # flag of the point format


def read_columns(path: Path, choose: Choose) -> Arrays:
    """Read some dimensions of all points: x, y and z in metres, and others as in the file.

    Args:
        choose: returns the dimensions to read, given the names of all.

    Raises:
        InputError: if the file is not LAS or LAZ, or is truncated.
    """
    with reading(path, EXPECTED, ADVICE):
        import laspy

        count = check_header(path)
        done = 0
        with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
            # The names of the integers that stand for coordinates differ only in their case.
            names = ["x", "y", "z"]
            for name in file.header.point_format.dimension_names:
                if name not in ("X", "Y", "Z"):
                    names.append(name)

            chosen = choose(names)
            columns = {}
            for key, index in chosen.items():
                columns[key] = np.empty(count, "u2" if names[index] == "intensity" else "f8")

            for points in file.chunk_iterator(CHUNK):
                for key, values in columns.items():
                    values[done : done + len(points)] = points[names[chosen[key]]]
                done += len(points)

    if done < count:
        raise InputError(
            f"{path}: expected {count} points, found {done}; the file is truncated, copy it again"
        )
    return columns


def check_header(path: Path) -> int:
    """Return the number of points that the header claims.

    Raises:
        InputError: if the file is too short for what its header claims, or claims too many points.
    """
    with path.open("rb") as file:
        header = file.read(HEADER_1_4)

    fields = struct.unpack_from("<HIIBHI", header, 94)
    header_size, points_start, record_count, point_format, point_size, count = fields

    # Version 1.4 counts points in 64 bits, in another place.
    if len(header) == HEADER_1_4 and header[24:26] == b"\x01\x04":
        (count,) = struct.unpack_from("<Q", header, 247)

    # The points follow the header and its variable-length records.
    file_size = path.stat().st_size
    records_end = header_size + MIN_RECORD * record_count
    if header_size < HEADER_1_0 or records_end > points_start or points_start > file_size:
        raise InputError(
            f"{path}: expected a header, {record_count} variable-length records and points, "
            f"found {file_size} bytes in all; {ADVICE}"
        )

    is_compressed = bool(point_format & COMPRESSED)
    return check_point_count(count, path, 0 if is_compressed else points_start + point_size * count)
