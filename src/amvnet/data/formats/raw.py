"""Read scan files that hold only rows of numbers, such as KITTI's and nuScenes' files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from amvnet.data.formats.cloud import MAX_RINGS, Cloud, check_point_count
from amvnet.data.formats.rows import NAMES, UNKNOWN, RowLayout, are_rings, named_cloud
from amvnet.errors import InputError, readable

KITTI_COLUMNS = 4  # the number of columns: x, y, z, intensity
NUSCENES_COLUMNS = 5  # the number of columns: x, y, z, intensity in 0..255, ring
NUSCENES_ENDING = ".pcd.bin"
FULL_INTENSITY = 255.0
XYZ_BYTES = 12  # the size of a row that holds only x, y and z as float32, bytes
KITTI_ROWS = RowLayout(NAMES[:KITTI_COLUMNS])
NUSCENES_ROWS = RowLayout(NAMES)

WIDEST_NUMBER = 8  # the largest size of a number, bytes
# The bytes of a file that are examined; they hold whole rows of both layouts.
SAMPLE_BYTES = 400_000 * KITTI_COLUMNS * NUSCENES_COLUMNS
FEWEST_BYTES = 4800  # the least size of a file whose values can show that no layout fits, bytes

# These limits tell coordinates and intensities from other columns, and float32 from other types.
MAX_INTENSITY = 65535  # the largest intensity that any sensor writes
NEAR = 500.0  # the limit of coordinates in usual scans, metres
USUAL_SHARE = 0.999  # the least share of points within these limits; the others are outliers
IN_METRES = np.array([1e-3, 1e-3, 1e-3, 1], dtype=np.float32)  # factors on a row in millimetres
NO_INTENSITY = -1.0  # the intensity that some tools write for a lost return; no other is negative


def read_raw(path: Path, layout: RowLayout = UNKNOWN) -> Cloud:
    """Read rows in the user's layout, or in KITTI's or nuScenes' layout, whichever the values fit.

    If the values of a small file fit neither, its name decides: a file `.pcd.bin` has nuScenes'
    layout, any other file has KITTI's layout.

    Raises:
        InputError: if the file is not a whole number of rows, or the values fit neither layout.
    """
    columns = max(len(layout.columns), NUSCENES_COLUMNS)
    check_point_count(path.stat().st_size // (WIDEST_NUMBER * columns), path)
    data = np.fromfile(path, np.uint8)
    if layout.columns:
        return _to_cloud(data, path, layout)

    is_named = path.name.lower().endswith(NUSCENES_ENDING)
    usual = _usual_layout(data, is_named)
    if usual is None and len(data) >= FEWEST_BYTES:
        found, advice = _explain(data, layout)
        raise InputError(
            f"{path}: expected rows of float32 x, y, z, intensity (KITTI), ring (nuScenes), found "
            f"{found}; {advice}"
        )
    usual = usual or (NUSCENES_ROWS if is_named else KITTI_ROWS)
    usual = replace(usual, in_yaml=layout.in_yaml)

    return replace(_to_cloud(data, path, usual), note="")


def _explain(data: np.ndarray, layout: RowLayout) -> tuple[str, str]:
    """Return what a file holds whose values fit neither layout, and what to do about it."""
    kitti, nuscenes = KITTI_ROWS.record.itemsize, NUSCENES_ROWS.record.itemsize
    found, advice = "values that fit neither", layout.advice
    if len(data) % kitti and len(data) % nuscenes:
        found = f"{len(data)} bytes, which is a multiple of neither {kitti} nor {nuscenes}"
        advice = f"copy the file again if it is truncated, or {advice}"
    elif not np.isfinite(data.view(np.float32)).any():
        return "no finite number", "record the scan again"

    if len(data) % kitti == 0 and _are_millimetres(data):
        names = layout.advise(*KITTI_ROWS.columns)
        return found, f"say {names} if these are millimetres, or {advice}"
    if len(data) % XYZ_BYTES == 0:
        return found, f"say {layout.advise(*'xyz')} if the rows have no more, or {advice}"
    return found, advice


def _to_cloud(data: np.ndarray, path: Path, layout: RowLayout) -> Cloud:
    size = layout.record.itemsize
    if len(data) % size:
        raise InputError(
            f"{path}: expected {layout.describe()}, found {len(data)} bytes, which is no multiple "
            f"of {size}; {layout.advice}, or copy the file again"
        )

    check_point_count(len(data) // size, path)
    records = data.view(layout.record)
    columns = [records[name] for name in layout.record.names or ()]
    return named_cloud(columns, layout.columns, str(path), layout.describe())


def read_table(path: Path, dtype: DTypeLike, columns: int) -> np.ndarray:
    """Read a file that holds only rows of values, as an array (N, columns) of `dtype`.

    Raises:
        InputError: if the file is missing, or its size is not a whole number of rows.
    """
    count = count_rows(path, dtype, columns)
    with readable(path):
        values = np.fromfile(path, dtype=dtype, count=count * columns)
    if len(values) < count * columns:
        raise InputError(
            f"{path}: expected {count} rows, found fewer: the file became shorter while it was "
            "read; wait until it is written"
        )
    return values.reshape(count, columns)


def count_rows(path: Path, dtype: DTypeLike, columns: int) -> int:
    """Return the number of rows that `read_table` would read, from the size of the file.

    Raises:
        InputError: if the file is missing, or its size is not a whole number of rows.
    """
    with readable(path):
        if not path.is_file():
            raise InputError(
                f"{path}: expected a file, found none; check the path or complete the dataset"
            )
        size = path.stat().st_size

    row_size = np.dtype(dtype).itemsize * columns
    if size % row_size:
        raise InputError(
            f"{path}: expected a whole number of rows of {row_size} bytes, found {size} bytes; "
            "the file is truncated or has another format; copy it again"
        )
    return size // row_size


@np.errstate(invalid="ignore", over="ignore")
def _usual_layout(data: np.ndarray, is_named: bool) -> RowLayout | None:
    """Return the layout of KITTI or nuScenes if the bytes (B,) of a file fit it.

    `is_named` says whether the file's name tells that it has nuScenes' columns.
    """
    if not len(data):
        return None

    if len(data) % NUSCENES_ROWS.record.itemsize == 0:
        table = data[:SAMPLE_BYTES].view(np.float32).reshape(-1, NUSCENES_COLUMNS)
        if _is_nuscenes(table, is_named):
            return NUSCENES_ROWS
    is_whole = len(data) % KITTI_ROWS.record.itemsize == 0
    return KITTI_ROWS if is_whole and _is_kitti(_kitti_table(data)) else None


def _kitti_table(data: np.ndarray) -> NDArray[np.float32]:
    """Return the first bytes of a file as rows (N, 4)."""
    return data[:SAMPLE_BYTES].view(np.float32).reshape(-1, KITTI_COLUMNS)


@np.errstate(invalid="ignore", over="ignore")
def _are_millimetres(data: np.ndarray) -> bool:
    """Return whether the values of a file fit KITTI's layout if they are divided by 1000."""
    return _is_kitti(_kitti_table(data) * IN_METRES)


def _is_nuscenes(table: np.ndarray, is_named: bool) -> bool:
    """Return whether values (N, 5) can be x, y, z, intensity and ring.

    Rings are whole numbers, and there are at least two different rings. Some coordinates are not
    whole. Intensities are never negative. Unless the file's name tells the layout (`is_named`), the
    rings must also not look like labels.
    """
    xyz = table[:, :3]
    intensity = table[:, 3]
    ring = table[:, 4]

    if not (ring == np.round(ring)).all() or not 0 <= ring.min() < ring.max() < MAX_RINGS:
        return False
    if not _are_intensities(intensity).all() or np.array_equal(xyz, np.round(xyz)):
        return False
    return is_named or are_rings(xyz, ring)


def _is_kitti(table: np.ndarray) -> bool:
    """Return whether values (N, 4) can be x, y, z and intensity.

    Intensities are never negative, but some coordinates are. Lost points may have values that are
    not finite.
    """
    # Each column is checked alone: a reduction over rows of three takes several times as long.
    x, y, z, intensity = np.ascontiguousarray(table.T)
    is_usual = _are_near(x, y, z) & _are_intensities(intensity)
    is_around = (x < 0).any() or (y < 0).any() or (z < 0).any()
    return bool(is_around and np.mean(is_usual) >= USUAL_SHARE)


def _are_near(
    x: NDArray[np.floating], y: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Return (N,) bool: whether a point is lost, or within the usual reach of a sensor."""
    is_lost = ~(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
    is_near = (np.abs(x) < NEAR) & (np.abs(y) < NEAR) & (np.abs(z) < NEAR)
    is_either: NDArray[np.bool_] = is_lost | is_near
    return is_either


def _are_intensities(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return (N,) bool: whether a value can be an intensity, also of a lost point."""
    is_possible = (values >= 0) & (values <= MAX_INTENSITY)
    is_missing = (values == NO_INTENSITY) | ~np.isfinite(values)
    is_intensity: NDArray[np.bool_] = is_possible | is_missing
    return is_intensity
