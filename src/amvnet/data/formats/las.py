"""Read scans and single dimensions from LAS and LAZ files with laspy.

On broken bytes, lazrs 0.8 can take any amount of memory or abort its process, so all points are
read in the process with limits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import Cloud, check_point_count, make_cloud, reading
from amvnet.data.formats.reader_process import call
from amvnet.errors import InputError

EXPECTED = "a LAS or LAZ file"
ADVICE = "write the file again"
COLUMNS = {"x": "f8", "y": "f8", "z": "f8", "intensity": "u2"}
CHUNK = 1_000_000  # points read at once

# The header.
HEADER_1_0 = 227  # bytes of the header of LAS 1.0, the shortest
HEADER_1_4 = 375  # bytes of the header of LAS 1.4, the longest
MIN_RECORD = 54  # bytes of the shortest variable-length record
COMPRESSED = 0x80  # flag of the point format


def read_las(path: Path) -> Cloud:
    """Read all points: coordinates as float64, intensities as in the file (0 to 65535).

    Call this in the process with limits.

    Raises:
        InputError: if the file is not LAS or LAZ, or is truncated.
    """
    return make_cloud(_read_columns(path, COLUMNS), str(path))


def read_dimension(path: Path, choose: Callable[[Sequence[str]], str]) -> np.ndarray:
    """Read one dimension of all points, such as the classification.

    Args:
        choose: returns the name of the dimension, given the names of all.

    Returns:
        (N,) float64.

    Raises:
        InputError: as `read_las`.
    """
    names = call(f"{__name__}:list_dimensions", path)["names"]
    values: np.ndarray = call(f"{__name__}:read_values", path, choose(names))["values"]
    return values


def list_dimensions(path: str) -> dict[str, list[str]]:
    """Return the names of all dimensions; called in the process with limits."""
    with reading(path, EXPECTED, ADVICE):
        import laspy

        check_header(Path(path))
        with laspy.open(path, read_evlrs=False) as file:
            return {"names": list(file.header.point_format.dimension_names)}


def read_values(path: str, name: str) -> dict[str, np.ndarray]:
    """Return the (N,) values of one dimension; called in the process with limits."""
    return {"values": _read_columns(Path(path), {name: "f8"})[name]}


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


def _read_columns(path: Path, kinds: dict[str, str]) -> dict[str, np.ndarray]:
    """Read some dimensions of all points, (N,) each; coordinates in metres.

    Args:
        kinds: the NumPy type of each dimension.

    Raises:
        InputError: as `read_las`.
    """
    with reading(path, EXPECTED, ADVICE):
        import laspy

        count = check_header(path)
        columns = {name: np.empty(count, kind) for name, kind in kinds.items()}
        done = 0
        with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
            for points in file.chunk_iterator(CHUNK):
                for name, values in columns.items():
                    values[done : done + len(points)] = points[name]
                done += len(points)

    if done < count:
        raise InputError(
            f"{path}: expected {count} points, found {done}; the file is truncated, copy it again"
        )
    return columns
