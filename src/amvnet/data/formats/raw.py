"""Scans that are nothing but rows of float32: KITTI's four columns, nuScenes' five."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.data.formats.cloud import MAX_POINTS, MOST_RINGS, Cloud, check_point_count
from amvnet.errors import InputError

KITTI_COLUMNS = 4  # x, y, z, intensity
NUSCENES_COLUMNS = 5  # x, y, z, intensity 0..255, ring
NUSCENES_ENDING = ".pcd.bin"
FULL_INTENSITY = 255.0
NEAR = 500.0  # metres: no coordinate of a usual scan is larger
LOOKED_AT = 100_000  # rows that are enough to tell the columns


def read_raw(path: Path) -> Cloud:
    """Read rows of 4 or 5 float32; which of them, the values say, and else the name.

    Raises:
        InputError: where the file is no whole number of rows, or has five columns and the last is no ring.
    """
    columns = columns_of(path) or (NUSCENES_COLUMNS if _named_nuscenes(path) else KITTI_COLUMNS)
    check_point_count(count_rows(path, np.float32, columns), path)
    table = read_table(path, np.float32, columns)
    ring = None if columns == KITTI_COLUMNS else ring_column(table[:, 4], path)
    full = FULL_INTENSITY if ring is not None and _named_nuscenes(path) else None
    return Cloud(table[:, :3], table[:, 3], ring, str(path), full)


def read_table(path: Path, dtype: DTypeLike, columns: int) -> np.ndarray:
    """Read a file that is nothing but rows of `columns` values; (N, columns) of `dtype`.

    Raises:
        InputError: where the file is missing or its size is not a whole number of rows.
    """
    count = count_rows(path, dtype, columns)
    return np.fromfile(path, dtype=dtype, count=count * columns).reshape(count, columns)


def count_rows(path: Path, dtype: DTypeLike, columns: int) -> int:
    """The number of rows in such a file, by its size alone; raises as `read_table` does."""
    if not path.is_file():
        raise InputError(
            f"{path}: expected a file, found none; check the path or complete the data set"
        )
    size, row = path.stat().st_size, np.dtype(dtype).itemsize * columns
    if size % row:
        raise InputError(
            f"{path}: expected a whole number of rows of {row} bytes, found {size} bytes; "
            "the file is truncated or of another format, copy it again"
        )
    return size // row


@np.errstate(invalid="ignore", over="ignore")
def columns_of(path: Path) -> int | None:
    """How many columns the values of a file can only have, whatever its name says; None where they do not tell."""
    size = path.stat().st_size
    if not size or size % 4 or size > MAX_POINTS * 4 * NUSCENES_COLUMNS:
        return None
    values = np.fromfile(path, dtype=np.float32, count=LOOKED_AT * KITTI_COLUMNS * NUSCENES_COLUMNS)
    if size % (4 * NUSCENES_COLUMNS) == 0 and _is_nuscenes(values.reshape(-1, NUSCENES_COLUMNS)):
        return NUSCENES_COLUMNS
    if size % (4 * KITTI_COLUMNS) == 0 and _is_kitti(values.reshape(-1, KITTI_COLUMNS)):
        return KITTI_COLUMNS
    return None


def _named_nuscenes(path: Path) -> bool:
    return path.name.lower().endswith(NUSCENES_ENDING)


def _is_nuscenes(table: np.ndarray) -> bool:
    ring, xyz = table[:, 4], table[:, :3]
    whole = bool((ring == np.round(ring)).all()) and 0 <= ring.min() < ring.max() < MOST_RINGS
    return whole and bool((table[:, 3] >= 0).all()) and not np.array_equal(xyz, np.round(xyz))


def _is_kitti(table: np.ndarray) -> bool:
    """Only a column of intensities has no negative value, and coordinates have some."""
    near, negative = np.abs(table[:, :3]) < NEAR, (table[:, :3] < 0).any()
    return bool(
        near.all() and negative and (table[:, 3] >= 0).all() and (table[:, 3] <= 65535).all()
    )


@np.errstate(invalid="ignore")
def ring_column(values: np.ndarray, path: Path) -> np.ndarray:
    """(N,) int64 ring indices of a fifth column.

    Raises:
        InputError: where they are none.
    """
    finite = np.isfinite(values).all()
    if (
        not finite
        or (len(values) and values.min() < 0)
        or not np.array_equal(values, np.round(values))
    ):
        raise InputError(
            f"{path}: expected ring indices 0, 1, ... in column 5, found other values; correct the column"
        )
    return values.astype(np.int64)
