"""Read and check scan and label files, and write label files completely or not at all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.data.formats.detect import read_cloud
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
    """Read a single scan.

    The format is recognised by the file's content, or by its name if the content is ambiguous:

    - rows of float32: x, y, z, intensity as in KITTI, or x, y, z, intensity (0..255), ring as in
      nuScenes;
    - `.npy` and `.npz`: arrays (N, 3 or more), or range images (H, W, C), read row by row;
    - `.pcd`, `.ply`, `.las`, `.laz`;
    - bags of one scan.

    Intensities are divided by 255 if any is above 1, and by 65535 if any is above 255
    (`Cloud.intensity_scale` has the whole rule). A point at 0, 0, 0 is a lost return: it keeps its
    index, and its coordinates become NaN.

    Returns:
        A scan with points (N, 4): x, y, z in metres and intensity in [0, 1]; and with `ring` if
        the file has it.

    Raises:
        InputError: if the file is missing, of another format, truncated, empty or all NaN.
    """
    return read_cloud(path).to_scan()


def check_points(points: np.ndarray, path: Path) -> np.ndarray:
    """Check that a scan has usable points, and return them as contiguous (N, 4) float32.

    Raises:
        InputError: if there is no point, or none with finite coordinates.
    """
    if not len(points):
        raise InputError(f"{path}: expected a scan with points, found 0 points; leave the file out")

    is_finite = np.isfinite(points[:, :3]).all(axis=1)
    if not is_finite.any():
        raise InputError(
            f"{path}: expected finite coordinates, found NaN or infinity in every point; "
            "leave the file out"
        )
    return np.ascontiguousarray(points, dtype=np.float32)


def read_kitti(path: Path) -> np.ndarray:
    """Read (N, 4) float32: x, y, z, intensity, as in the file.

    Raises:
        InputError: as `read_table` and `check_points`.
    """
    return check_points(read_table(path, np.float32, KITTI_COLUMNS), path)


def read_nuscenes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read (N, 4) float32 points and the (N,) int64 ring; scale intensities from 0..255 to [0, 1].

    Raises:
        InputError: as `read_table`, `check_points` and `ring_column`.
    """
    table = read_table(path, np.float32, NUSCENES_COLUMNS)
    points = check_points(table[:, :4], path)
    points[:, 3] /= FULL_INTENSITY
    return points, ring_column(table[:, 4], path)


def read_labels(
    path: Path, dtype: DTypeLike, count: int, to_train: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Read `count` raw labels of `dtype` and return them as (N,) uint8 train ids.

    Args:
        to_train: converts (N,) raw labels to train ids.

    Raises:
        InputError: if the file is missing, has another number of labels, or an unknown id.
    """
    raw = read_table(path, dtype, 1)[:, 0]
    if len(raw) != count:
        raise InputError(
            f"{path}: expected {count} labels, one per point, found {len(raw)}; "
            "give the label file of this scan"
        )

    try:
        return to_train(raw)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_labels(path: Path | str, raw_ids: np.ndarray, dtype: DTypeLike = np.uint32) -> Path:
    """Write (N,) raw ids as `dtype` and return the path; the file appears whole or not at all.

    The official `.label` files hold uint32.
    """
    with atomic_write(path) as part:
        np.asarray(raw_ids).astype(dtype).tofile(part)
    return Path(path)


def check_count(ids: np.ndarray, path: Path, count: int) -> np.ndarray:
    """Check that there is one id per point, and return the ids as an array.

    Args:
        path: the file to name in the message.
        count: the number of points.

    Raises:
        InputError: if the shape of the ids is not (count,).
    """
    ids = np.asarray(ids)
    if ids.shape != (count,):
        raise InputError(
            f"{path}: expected {count} ids, one per point, found shape {ids.shape}; "
            "segment the whole scan"
        )

    return ids
