"""Read scans from LAS and LAZ files with laspy, compressed ones in a separate process."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    require,
    split_records,
)
from amvnet.errors import InputError

ADVICE = "write the file again"
RECORD = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8"), ("intensity", "u2")])
CHUNK = 1_000_000  # points read at once

# The header.
HEADER_1_0 = 227  # bytes of the header of LAS 1.0, the shortest
HEADER_1_4 = 375  # bytes of the header of LAS 1.4, the longest
MIN_RECORD = 54  # bytes of the shortest variable-length record
COMPRESSED = 0x80  # flag of the point format

# Limits of the process that reads a compressed file.
MEMORY = 2 << 30  # bytes
BASE_SECONDS = 9.0  # time limit, to which the points add
POINTS_PER_SECOND = 200_000  # the least speed: it gives the time that the points add


def read_las(path: Path) -> Cloud:
    """Read all points: coordinates as float64, intensities as in the file (0 to 65535).

    Raises:
        InputError: if the file is not LAS or LAZ, is truncated, or laspy is missing.
    """
    with reading(path, "a LAS or LAZ file", ADVICE):
        count, is_compressed = check_header(path)
        require_laspy(path)
        records = _read_in_process(path, count) if is_compressed else read_records(path)

    if len(records) < count:
        raise InputError(
            f"{path}: expected {count} points, found {len(records)}; "
            "the file is truncated, copy it again"
        )
    return make_cloud(split_records(records), str(path))


def read_dimension(path: Path, choose: Callable[[Sequence[str]], str]) -> np.ndarray:
    """Read one dimension of all points, such as the classification.

    Args:
        choose: returns the name of the dimension, given the names of all.

    Returns:
        (N,) float64.

    Raises:
        InputError: as `read_las`.
    """
    with reading(path, "a LAS or LAZ file", ADVICE):
        count, is_compressed = check_header(path)
        require_laspy(path)
        import laspy

        with laspy.open(path, read_evlrs=False) as file:
            name = choose(list(file.header.point_format.dimension_names))
        record = np.dtype([(name, "f8")])
        if is_compressed:
            return _read_in_process(path, count, record)[name]
        return read_records(path, record)[name]


def check_header(path: Path) -> tuple[int, bool]:
    """Return the number of points that the header claims, and whether they are compressed.

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
    min_size = 0 if is_compressed else points_start + point_size * count
    return check_point_count(count, path, min_size), is_compressed


def require_laspy(path: Path) -> None:
    """Raise an InputError unless the packages that read LAS and LAZ are installed."""
    require("the packages laspy and lazrs", "formats", path, "laspy", "lazrs")


def read_records(path: Path, record: np.dtype = RECORD) -> np.ndarray:
    """Read some dimensions of all points as (N,) records, coordinates in metres, with laspy."""
    import laspy

    chunks = [np.empty(0, record)]
    with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
        for points in file.chunk_iterator(CHUNK):
            records = np.empty(len(points), record)
            for name in record.names or ():
                records[name] = points[name]
            chunks.append(records)
    return np.concatenate(chunks)


def _read_in_process(path: Path, count: int, record: np.dtype = RECORD) -> np.ndarray:
    """Read all points as `read_records` does, in a process with limited memory and time.

    On broken bytes, lazrs 0.8 can take any amount of memory or abort its process.

    Raises:
        ValueError: if the process fails.
        subprocess.TimeoutExpired: if it takes too long for `count` points.
    """
    code = (
        "import sys; from amvnet.data.formats.las import write_records; "
        "write_records(*sys.argv[1:])"
    )
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    # With one thread, because each would use up some of the memory limit.
    environment["OMP_NUM_THREADS"] = "1"
    environment["OPENBLAS_NUM_THREADS"] = "1"

    process = subprocess.run(
        [sys.executable, "-c", code, str(path.absolute()), json.dumps(record.descr)],
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=BASE_SECONDS + count / POINTS_PER_SECOND,
    )
    if process.returncode:
        raise ValueError("its points cannot be unpacked")
    return np.frombuffer(process.stdout, record)


def write_records(path: str, description: str) -> None:
    """Write the records of a file to standard output, with limited memory.

    `_read_in_process` runs this function in its process.

    Args:
        description: the names and types of the records' fields, as JSON.
    """
    record = np.dtype([(name, kind) for name, kind in json.loads(description)])
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    except (ImportError, ValueError):  # Windows has no such limit, and some systems refuse it
        pass
    sys.stdout.buffer.write(read_records(Path(path), record).tobytes())
