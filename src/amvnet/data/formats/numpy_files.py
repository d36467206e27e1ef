"""Scans in NumPy files: tables of points, range images and arrays with named columns.

Nothing is ever unpickled.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    require_columns,
    ring_indices,
)
from amvnet.data.formats.raw import ring_column
from amvnet.data.formats.rows import UNKNOWN, RowLayout, describe, named_cloud
from amvnet.errors import InputError

COLUMNS = ("x", "y", "z", "intensity")
KEYS = ("points", "xyz", "scan", "arr_0")  # names of the array to read, if there are several
RANGE_TOLERANCE = 0.05  # metres by which a column of distances may differ from them
ADVICE = "save it again with np.save"


def read_npy(path: Path, layout: RowLayout = UNKNOWN) -> Cloud:
    """Read one array.

    Args:
        layout: what its columns hold; the types are in the file.

    Raises:
        InputError: if it is not an array of numbers, has an unsuitable shape or is truncated.
    """
    with reading(path, "a plain NumPy array", ADVICE), path.open("rb") as file:
        return _to_cloud(_load(file, path.stat().st_size, path), path, layout)


def read_npz(path: Path, layout: RowLayout = UNKNOWN) -> Cloud:
    """Read the only array of an archive, or the one named `points`, `xyz`, `scan` or `arr_0`.

    Raises:
        InputError: as `read_npy`, or if there is no such array.
    """
    advice = "save it again with np.savez"
    with reading(path, "a NumPy archive", advice), zipfile.ZipFile(path) as archive:
        member = archive.getinfo(_choose_member(archive.namelist(), path))
        with archive.open(member) as file:
            array = _load(cast(BinaryIO, file), member.file_size, path)
            return _to_cloud(array, path, layout)


def member_names(path: Path) -> list[str]:
    """Return the names of the arrays in an archive.

    Raises:
        InputError: if the file is no archive.
    """
    with (
        reading(path, "a NumPy archive", "save it again with np.savez"),
        zipfile.ZipFile(path) as archive,
    ):
        return list(_members(archive.namelist()))


def read_array(path: Path, key: str | None = None) -> np.ndarray:
    """Read an array of numbers of any shape that a scan can have.

    Args:
        path: a `.npy` or `.npz` file.
        key: the name of the array in an archive; None means the one that `read_npz` reads.

    Raises:
        InputError: as `read_npy`.
    """
    with reading(path, "NumPy arrays", ADVICE):
        if not zipfile.is_zipfile(path):
            with path.open("rb") as file:
                return _load(file, path.stat().st_size, path)
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            name = _choose_member(names, path) if key is None else _members(names)[key]
            member = archive.getinfo(name)
            with archive.open(member) as unpacked:
                return _load(cast(BinaryIO, unpacked), member.file_size, path)


def _members(names: list[str]) -> dict[str, str]:
    """Return the members of an archive that are arrays, by the names of the arrays."""
    members = {}
    for name in names:
        if name.endswith(".npy"):
            members[name.removesuffix(".npy")] = name
    return members


def _choose_member(names: list[str], path: Path) -> str:
    """Return the name of the array to read, given those of all members of an archive."""
    members = _members(names)

    if len(members) == 1:
        return next(iter(members.values()))
    for key in KEYS:
        if key in members:
            return members[key]

    listing = ", ".join(list(members)[:10])[:200] or "none"
    raise InputError(
        f"{path}: expected an array named {KEYS[0]}, found {listing!a}; "
        "save the scan under that name"
    )


def _load(file: BinaryIO, size: int, path: Path) -> np.ndarray:
    """Read the array that starts here, if `size` bytes can hold what its header claims."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, fortran_order, dtype = np.lib.format.read_array_header_2_0(file)

    is_numeric = dtype.names is not None or dtype.kind in "fiu"
    if dtype.hasobject or not is_numeric or not shape:
        raise InputError(
            f"{path}: expected an array of numbers, found {dtype} of shape {shape}; "
            f"{ADVICE} as float32"
        )

    length = math.prod(shape) * dtype.itemsize
    if length > size:
        raise InputError(
            f"{path}: expected {length} bytes for its shape {shape}, found {size}; {ADVICE}"
        )

    point_axes = shape[:1] if len(shape) < 3 else shape[:-1]
    check_point_count(math.prod(point_axes), path)
    flat = np.frombuffer(file.read(length), dtype)
    return flat.reshape(shape, order="F" if fortran_order else "C")


def _to_cloud(array: np.ndarray, path: Path, layout: RowLayout) -> Cloud:
    if array.dtype.names is not None:
        return _from_named_columns(array, array.dtype.names, path)
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise InputError(
            f"{path}: expected numbers of shape (N, 3), (N, 4), (N, 5) or (H, W, C), "
            f"found shape {array.shape}; save such an array"
        )

    table = array.reshape(-1, array.shape[-1])
    if layout.columns:
        return named_cloud(list(table.T), layout.columns, str(path), describe(layout.columns))
    columns = dict(zip(COLUMNS, table.T, strict=False))
    cloud = make_cloud(columns, str(path))

    # A column after the intensity can be the distance, the ring or anything else.
    ring = None
    fifth = ""
    if len(table) and table.shape[1] > len(COLUMNS):
        if _is_distance(table):
            fifth = "range"
        else:
            ring = _read_ring(table, array.ndim == 3, path)
            fifth = "" if ring is None else "ring"

    note = _note(array.shape, fifth)
    return Cloud(cloud.xyz, cloud.intensity, ring, cloud.name, note=note)


def _from_named_columns(array: np.ndarray, names: tuple[str, ...], path: Path) -> Cloud:
    records = array.ravel()
    columns = {}
    for key, index in require_columns(names, path).items():
        columns[key] = records[names[index]]
    return make_cloud(columns, str(path))


def _read_ring(table: np.ndarray, is_image: bool, path: Path) -> np.ndarray | None:
    """Return the ring indices in the fifth column of a table, (N,) int64.

    The fifth of five columns must be a ring. In a range image or before more columns it can be
    anything, and None is returned if it does not look like a ring.
    """
    if table.shape[1] == 5 and not is_image:
        return ring_column(table[:, 4], path)
    ring = ring_indices(table[:, 4])
    return ring if ring is not None and ring.any() else None


def _is_distance(table: np.ndarray) -> bool:
    """Return whether the fifth column of a table is the distance of its points."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(table[:, :3].astype(np.float64), axis=1)
        error = np.abs(distance - table[:, 4])

    is_finite = np.isfinite(error)
    if not is_finite.any() or not table[is_finite, 4].any():
        return False
    return bool((error[is_finite] < RANGE_TOLERANCE).all())


def _note(shape: tuple[int, ...], fifth: str) -> str:
    """Return a note on how an array of this shape was read, empty if that is obvious.

    Args:
        fifth: what the fifth column holds; empty if unknown.
    """
    count = shape[-1]
    names = list(COLUMNS[:count])
    if fifth:
        names.append(fifth)

    note = f"columns {' '.join(names)}"
    if count > len(names):
        note += f", {count - len(names)} more left out"
    if len(shape) == 3:
        return f"range image of {shape[0]} x {shape[1]} row by row, {note}"
    return note if count > 5 or fifth == "range" else ""
