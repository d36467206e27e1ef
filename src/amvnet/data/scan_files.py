"""Scan and label files, read with every check and written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.data.formats.detect import ENDINGS, is_bag_folder, is_scan_file, read_cloud
from amvnet.data.formats.raw import (
    FULL_INTENSITY,
    KITTI_COLUMNS,
    NUSCENES_COLUMNS,
    read_table,
    ring_column,
)
from amvnet.data.formats.raw import count_rows as count_rows
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.scan import Scan


def read_scan(path: Path | str) -> Scan:
    """Read a lone scan; what is in the file says the format, its name only where that does not.

    Rows of float32 (x, y, z, intensity as KITTI has them, or x, y, z, intensity 0..255, ring as nuScenes), `.npy` and
    `.npz` ((N, 3..), or (H, W, C) row by row), `.pcd`, `.ply`, `.las`, `.laz`, and bags of one scan.

    The intensity is taken as 0..255 where a value is above 1, as 0..65535 where one is above 255, and scaled. A
    point at 0, 0, 0 is a lost return: its place is kept, its coordinates become NaN.

    Returns:
        Scan with points (N, 4), metres and intensity in [0, 1], `ring` where the file has it.

    Raises:
        InputError: where the file is missing, of another format, truncated, empty or all NaN.
    """
    return read_cloud(path).to_scan()


def find_scans(path: Path | str) -> list[Path]:
    """List the scan files and bags of a folder, sorted by name (hidden ones left out); a file is its own list.

    Raises:
        InputError: where the path is not there or the folder has no scan.
    """
    path = Path(path)
    if path.is_file() or is_bag_folder(path):
        return [path]
    if not path.is_dir():
        raise InputError(
            f"{path}: expected a scan file or a folder of scans, found nothing; check the path"
        )
    if found := sorted(entry for entry in path.iterdir() if is_scan_file(entry)):
        return found
    raise InputError(
        f"{path}: expected scan files ({', '.join(ENDINGS)}), found none in it; give the folder of scans"
    )


def check_points(points: np.ndarray, path: Path) -> np.ndarray:
    """Hand back (N, 4) points as float32, where they hold anything to work on.

    Raises:
        InputError: where there is no point, or none with a finite position.
    """
    if not len(points):
        raise InputError(f"{path}: expected a scan with points, found 0 points; leave the file out")
    if not np.isfinite(points[:, :3]).all(axis=1).any():
        raise InputError(
            f"{path}: expected finite coordinates, found NaN or infinity in every point; leave it out"
        )
    return np.ascontiguousarray(points, dtype=np.float32)


def read_kitti(path: Path) -> np.ndarray:
    """Read (N, 4) float32 x, y, z, intensity as they are; raises as `read_table` and `check_points`."""
    return check_points(read_table(path, np.float32, KITTI_COLUMNS), path)


def read_nuscenes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read (N, 4) float32 points, intensity scaled from 0..255 to [0, 1], and the (N,) int64 ring."""
    table = read_table(path, np.float32, NUSCENES_COLUMNS)
    points = check_points(table[:, :4], path)
    points[:, 3] /= FULL_INTENSITY
    return points, ring_column(table[:, 4], path)


def read_labels(
    path: Path, dtype: DTypeLike, count: int, to_train: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Read `count` raw labels of `dtype` and turn them into (N,) uint8 train ids by `to_train`.

    Raises:
        InputError: where the file is missing, has another number of labels, or an unknown id.
    """
    raw = read_table(path, dtype, 1)[:, 0]
    if len(raw) != count:
        raise InputError(
            f"{path}: expected {count} labels, one per point, found {len(raw)}; give the file of this scan"
        )
    try:
        return to_train(raw)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_labels(path: Path | str, raw_ids: np.ndarray, dtype: DTypeLike = np.uint32) -> Path:
    """Write (N,) raw ids as `dtype` (uint32 is the official `.label`), whole or not at all."""
    with atomic_write(path) as part:
        np.asarray(raw_ids).astype(dtype).tofile(part)
    return Path(path)


def check_count(ids: np.ndarray, path: Path, count: int) -> np.ndarray:
    """Hand back the ids that are to be written for the scan in `path`.

    Raises:
        InputError: where they are not (count,).
    """
    ids = np.asarray(ids)
    if ids.shape != (count,):
        raise InputError(
            f"{path}: expected {count} ids, one per point, found shape {ids.shape}; segment the whole scan"
        )
    return ids
