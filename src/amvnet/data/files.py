"""Scan and label files, read with every check and written whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.errors import InputError
from amvnet.scan import Scan

KITTI_COLUMNS = 4  # x, y, z, intensity
NUSCENES_COLUMNS = 5  # x, y, z, intensity 0..255, ring
FULL_INTENSITY = 255.0


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Let a file appear whole or not at all: write to the path this yields, a rename does the rest.

    The temporary file lies in the same folder (made where it is missing) and keeps the ending of
    `path`. It is removed where the block raises.

    Raises:
        InputError: where the folder cannot be made or the file not be written.
    """
    path = Path(path)
    make_folder(path.parent)
    part = path.with_name(f".{uuid.uuid4().hex}.part{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    except (PermissionError, IsADirectoryError) as error:
        raise InputError(f"{path}: expected a file that can be written, found {error.strerror}; give another") from None
    finally:
        part.unlink(missing_ok=True)


def read_scan(path: Path | str) -> Scan:
    """Read a lone scan; the ending of its name says the format.

    `.pcd.bin`: float32 rows x, y, z, intensity (0..255), ring, as nuScenes has them.
    `.bin`: float32 rows x, y, z, intensity, as KITTI has them.
    `.npy`: (N, 3..5) numbers, in that order; without a fourth column the intensity is 0.

    In `.bin` and `.npy` the intensity is taken as 0..255 where any value is above 1, and scaled.

    Returns:
        Scan with points (N, 4), metres and intensity in [0, 1], `ring` where the file has it.

    Raises:
        InputError: where the file is missing, of another format, truncated, empty or all NaN.
    """
    path = Path(path)
    for ending, read in READERS.items():
        if path.name.lower().endswith(ending):
            return read(path)
    raise InputError(f"{path}: expected a scan file ({', '.join(READERS)}), found another ending; convert it to one")


def find_scans(path: Path | str) -> list[Path]:
    """List the scan files of a folder, sorted by name (hidden ones left out); a file is its own list.

    Raises:
        InputError: where the path is not there or the folder has no scan.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InputError(f"{path}: expected a scan file or a folder of scans, found nothing; check the path")
    endings = tuple(READERS)
    names = [entry for entry in path.iterdir() if entry.is_file() and not entry.name.startswith(".")]
    if found := sorted(entry for entry in names if entry.name.lower().endswith(endings)):
        return found
    raise InputError(f"{path}: expected scan files ({', '.join(endings)}), found none in it; give the folder of scans")


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
        raise InputError(f"{path}: expected a file, found none; check the path or complete the data set")
    size, row = path.stat().st_size, np.dtype(dtype).itemsize * columns
    if size % row:
        raise InputError(
            f"{path}: expected a whole number of rows of {row} bytes, found {size} bytes; "
            "the file is truncated or of another format, copy it again"
        )
    return size // row


def check_points(points: np.ndarray, path: Path) -> np.ndarray:
    """Hand back (N, 4) points as float32, where they hold anything to work on.

    Raises:
        InputError: where there is no point, or none with a finite position.
    """
    if not len(points):
        raise InputError(f"{path}: expected a scan with points, found 0 points; leave the file out")
    if not np.isfinite(points[:, :3]).all(axis=1).any():
        raise InputError(f"{path}: expected finite coordinates, found NaN or infinity in every point; leave it out")
    return np.ascontiguousarray(points, dtype=np.float32)


def read_kitti(path: Path) -> np.ndarray:
    """Read (N, 4) float32 x, y, z, intensity as they are; raises as `read_table` and `check_points`."""
    return check_points(read_table(path, np.float32, KITTI_COLUMNS), path)


def read_nuscenes(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read (N, 4) float32 points, intensity scaled from 0..255 to [0, 1], and the (N,) int64 ring."""
    table = read_table(path, np.float32, NUSCENES_COLUMNS)
    points = check_points(table[:, :4], path)
    points[:, 3] /= FULL_INTENSITY
    return points, _ring(table[:, 4], path)


def read_labels(path: Path, dtype: DTypeLike, count: int, to_train: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
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


def make_folder(path: Path) -> None:
    """Make a folder and those above it.

    Raises:
        InputError: where it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: expected a folder to write to, found {error.strerror}; give another") from None


def write_labels(path: Path | str, raw_ids: np.ndarray, dtype: DTypeLike = np.uint32) -> Path:
    """Write (N,) raw ids as `dtype` (uint32 is the official `.label`), whole or not at all."""
    with whole_file(path) as part:
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


def _ring(values: np.ndarray, path: Path) -> np.ndarray:
    if not np.isfinite(values).all() or values.min() < 0 or not np.array_equal(values, np.round(values)):
        raise InputError(f"{path}: expected ring indices 0, 1, ... in column 5, found other values; correct the column")
    return values.astype(np.int64)


def _scaled(points: np.ndarray) -> np.ndarray:
    """Bring intensities of 0..255 to [0, 1]; one value above 1 says that they are."""
    intensity = points[:, 3]
    if (intensity[np.isfinite(intensity)] > 1).any():
        intensity /= FULL_INTENSITY
    return points


def _read_bin(path: Path) -> Scan:
    return Scan(_scaled(read_kitti(path)), name=str(path))


def _read_pcd_bin(path: Path) -> Scan:
    points, ring = read_nuscenes(path)
    return Scan(points, ring=ring, name=str(path))


def _read_npy(path: Path) -> Scan:
    table = _load_array(path)
    columns = table.shape[1]
    points = np.zeros((len(table), 4), dtype=np.float32)
    points[:, : min(columns, 4)] = table[:, :4]
    ring = _ring(table[:, 4], path) if columns == 5 and len(table) else None
    return Scan(_scaled(check_points(points, path)), ring=ring, name=str(path))


def _load_array(path: Path) -> np.ndarray:
    """Load (N, 3..5) numbers; nothing is ever unpickled."""
    if not path.is_file():
        raise InputError(f"{path}: expected a file, found none; check the path")
    try:
        table = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else "an unreadable one"
        raise InputError(f"{path}: expected a plain NumPy array, found {reason}; save it again with np.save") from None
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "fiu" or table.ndim != 2:
        found = f"{table.dtype} of shape {table.shape}" if isinstance(table, np.ndarray) else "an archive"
        raise InputError(
            f"{path}: expected numbers of shape (N, 3), (N, 4) or (N, 5), found {found}; save such an array"
        )
    if not 3 <= table.shape[1] <= 5:
        raise InputError(
            f"{path}: expected 3 to 5 columns (x, y, z, intensity, ring), found {table.shape[1]}; drop the others"
        )
    return table


READERS: dict[str, Callable[[Path], Scan]] = {".pcd.bin": _read_pcd_bin, ".bin": _read_bin, ".npy": _read_npy}
