"""Scans in LAS and LAZ files, by laspy; compressed ones are read by a process of their own."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import Cloud, check_point_count, make_cloud, refusing
from amvnet.errors import InputError

ADVICE = "write the file again"
OLDEST, NEWEST = 227, 375  # bytes of the header of LAS 1.0 and of LAS 1.4
RECORD = 54  # bytes that a variable-length record has at least
COMPRESSED = 0x80  # of the point format
CHUNK = 1_000_000  # points that are read at once
MEMORY = 2 << 30  # bytes that reading a compressed file may take
PATIENCE, PACE = 9.0, 200_000  # seconds that it may take, and points a second beyond that


def read_las(path: Path) -> Cloud:
    """Read all points: coordinates as float64, intensity as the file has it (0 to 65535).

    Raises:
        InputError: where it is no such file, truncated, or laspy is missing.
    """
    with refusing(path, "a LAS or LAZ file", ADVICE):
        count, compressed = _check_header(path)
        _require_laspy(path)
        columns = _read_apart(path, count) if compressed else read_columns(path)
    if len(columns["x"]) < count:
        raise InputError(
            f"{path}: expected {count} points, found {len(columns['x'])}; the file is truncated, copy it again"
        )
    return make_cloud(columns, str(path))


def _check_header(path: Path) -> tuple[int, bool]:
    """How many points the header claims, and whether they are compressed.

    Raises:
        InputError: where the file is too short for what its header claims.
    """
    with path.open("rb") as file:
        header = file.read(NEWEST)
    size, begin, records, kind, row, count = struct.unpack_from("<HIIBHI", header, 94)
    if len(header) == NEWEST and header[24:26] == b"\x01\x04":
        (count,) = struct.unpack_from("<Q", header, 247)
    end = path.stat().st_size
    if size < OLDEST or size + RECORD * records > begin or begin > end:
        raise InputError(
            f"{path}: expected points after {records} records, found {end} bytes in all; {ADVICE}"
        )
    compressed = bool(kind & COMPRESSED)
    return check_point_count(count, path, 0 if compressed else begin + row * count), compressed


def _require_laspy(path: Path) -> None:
    try:
        import laspy  # noqa: F401
        import lazrs  # noqa: F401
    except ImportError:
        raise InputError(
            f'{path}: expected laspy and lazrs to read it, found none; do pip install "amvnet[formats]"'
        ) from None


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns x, y, z (float64 metres) and intensity (uint16), by laspy."""
    import laspy

    pieces = []
    with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
        for points in file.chunk_iterator(CHUNK):
            pieces.append([np.asarray(points[name]) for name in ("x", "y", "z", "intensity")])
    joined = [np.concatenate(column) for column in zip(*pieces, strict=True)] or [np.zeros(0)] * 4
    return dict(zip(("x", "y", "z", "intensity"), joined, strict=True))


def _read_apart(path: Path, count: int) -> dict[str, np.ndarray]:
    """The same in another process: on broken bytes lazrs (0.8) takes any amount of memory, or ends its process."""
    code = (
        "import sys; from amvnet.data.formats.las import write_columns; write_columns(sys.argv[1])"
    )
    threads = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
    )  # each takes of the memory allowed
    found = subprocess.run(
        [sys.executable, "-c", code, str(path.absolute())],
        env={**os.environ, **threads, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=PATIENCE + count / PACE,
    )
    if found.returncode:
        raise ValueError("its points cannot be unpacked")
    points = np.frombuffer(
        found.stdout, np.dtype([(name, "f8") for name in "xyz"] + [("intensity", "u2")])
    )
    return {name: points[name] for name in ("x", "y", "z", "intensity")}


def write_columns(path: str) -> None:
    """Write the points to standard output, rows of x, y, z (float64) and intensity (uint16); for `_read_apart`."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    except (ImportError, ValueError):  # Windows has no such limit, and some systems refuse it
        pass
    columns = read_columns(Path(path))
    table = np.empty(len(columns["x"]), [(name, "f8") for name in "xyz"] + [("intensity", "u2")])
    for name, values in columns.items():
        table[name] = values
    sys.stdout.buffer.write(table.tobytes())
