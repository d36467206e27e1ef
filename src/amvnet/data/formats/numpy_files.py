"""Read scans from NumPy files: tables of points, range images and arrays with named columns.

Nothing is ever unpickled.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from amvnet.data.formats import cloud
from amvnet.data.formats.rows import UNKNOWN, RowLayout, describe, name_columns, named_cloud
from amvnet.errors import InputError

# The possible names of the array of points in an archive with several arrays.
KEYS = ("points", "positions", "xyz", "scan", "arr_0")
# Largest number of rows of an array that is taken for a transposed one, if it has more columns.
TRANSPOSED_ROWS = 10
MAX_COLUMNS = 200  # largest number of columns of an array without names that are considered
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the compressions of NumPy's archives
ADVICE = "save it again with np.save"
ARCHIVE_ADVICE = "save it again with np.savez"


def read_npy(path: Path, layout: RowLayout = UNKNOWN) -> cloud.Cloud:
    """Read the points of an array file.

    Raises:
        InputError: if the file holds no array of numbers, has an unsuitable shape or is truncated.
    """
    with cloud.reading(path, "a plain NumPy array", ADVICE):
        return _to_cloud(read_array(path), path, layout)


def read_npz(path: Path, layout: RowLayout = UNKNOWN) -> cloud.Cloud:
    """Read the points of an archive.

    The points are the only array, or the array named `points`, `positions` (Open3D), `xyz`, `scan`
    or `arr_0`. Arrays named `intensity` and `ring` may stand next to it. Or every column is a
    separate array, named `x`, `y`, `z` and so on.

    Raises:
        InputError: if the file is no archive of NumPy, is truncated, or holds no points.
    """
    with cloud.reading(path, "a NumPy archive", ARCHIVE_ADVICE):
        names = member_names(path)
        arrays = cloud.find_columns(names)
        columns = {}
        if {"x", "y", "z"} <= set(arrays):
            lengths = {}
            for key, index in arrays.items():
                columns[key] = read_array(path, names[index]).ravel()
                lengths[names[index]] = len(columns[key])

            if len(set(lengths.values())) > 1:
                raise InputError(
                    f"{path}: expected columns of one length, found {lengths}; {ARCHIVE_ADVICE}"
                )
            return cloud.make_cloud(columns, str(path))

        points = read_array(path, _choose_member(names, path))
        found = _to_cloud(points, path, layout)
        for key in {"intensity", "ring"} & set(arrays):
            values = read_array(path, names[arrays[key]]).ravel()
            # An array of another size describes something else, such as the lasers.
            if len(values) == len(found.xyz):
                columns[key] = values

        intensity = columns.get("intensity") if found.intensity is None else found.intensity
        ring = cloud.ring_indices(columns.get("ring")) if found.ring is None else found.ring
        return replace(found, intensity=intensity, ring=ring)


def read_columns(path: Path, wanted: cloud.Names) -> cloud.Arrays:
    """Read some columns of an array of points; columns without names are named "0", "1", ..."""
    return _columns_of(read_array(path), path, wanted)


def _columns_of(array: np.ndarray, path: Path, wanted: cloud.Names) -> cloud.Arrays:
    numbers = range(min(array.shape[-1], MAX_COLUMNS))
    names = array.dtype.names or tuple(map(str, numbers))

    columns = {}
    for key, index in cloud.require_columns(names, path, wanted).items():
        columns[key] = array[..., index] if array.dtype.names is None else array[names[index]]
        if columns[key].dtype.kind not in "fiub" or columns[key].ndim > array.ndim:
            raise InputError(
                f"{path}: expected a number per point in the column {names[index]!a}, found "
                f"{array.dtype[index]}; {ADVICE}"
            )
    return columns


def member_names(path: Path) -> list[str]:
    """Return the names of the arrays in an archive; raise InputError if it is no archive."""
    with cloud.reading(path, "a NumPy archive", ARCHIVE_ADVICE), zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith(".npy")]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(
            f"{path}: expected each array once, found {twice[0]!a} {len(twice)} times; "
            f"{ARCHIVE_ADVICE}"
        )
    return [name.removesuffix(".npy") for name in names]


def read_array(path: Path, key: str | None = None) -> np.ndarray:
    """Read an array of numbers from `.npy` or `.npz`; by default an archive's array of points."""
    with cloud.reading(path, "NumPy arrays", ADVICE):
        if not zipfile.is_zipfile(path):
            with path.open("rb") as file:
                return _load(file, path.stat().st_size, path)

        name = _choose_member(member_names(path), path) if key is None else key
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(f"{name}.npy")
            if member.compress_type not in COMPRESSIONS:
                raise InputError(
                    f"{path}: expected an archive of NumPy, found an archive packed in another "
                    f"way; {ARCHIVE_ADVICE}"
                )
            with archive.open(member) as unpacked:
                return _load(cast(BinaryIO, unpacked), member.file_size, path)


def _choose_member(names: Sequence[str], path: Path) -> str:
    """Return the name of the array of points, given the names of all arrays in an archive."""
    if len(names) == 1:
        return names[0]
    for key in KEYS:
        if key in names:
            return key

    listing = ", ".join(names[:10])[:200] or "none"
    raise InputError(
        f"{path}: expected an array named {KEYS[0]}, found {listing!a}; "
        "save the scan under that name"
    )


def _load(file: BinaryIO, size: int, path: Path) -> np.ndarray:
    """Read the array in a file of `size` bytes, if they can hold what its header claims."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)

    is_numeric = dtype.names is not None or dtype.kind in "fiub"
    if dtype.hasobject or not is_numeric or not shape:
        raise InputError(
            f"{path}: expected an array of numbers, found {dtype} of shape {shape}; "
            f"{ADVICE} as float32"
        )

    length = math.prod(shape) * dtype.itemsize
    if not 0 <= length <= min(size, cloud.MAX_BYTES):
        raise InputError(
            f"{path}: expected at most {min(size, cloud.MAX_BYTES)} bytes, found {length} for the "
            f"shape {shape} of its array; {ADVICE}"
        )
    point_axes = shape[:1] if len(shape) < 3 else shape[:-1]
    cloud.check_point_count(math.prod(point_axes), path)

    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _to_cloud(array: np.ndarray, path: Path, layout: RowLayout) -> cloud.Cloud:
    """Return the points of a table (N, C), a range image (H, W, C) or an array of records."""
    if array.dtype.names is not None:
        return cloud.make_cloud(_columns_of(array.ravel(), path, cloud.COLUMN_NAMES), str(path))
    if array.ndim not in (2, 3) or array.shape[-1] < 3 or array.dtype.kind == "b":
        raise InputError(
            f"{path}: expected numbers of shape (N, 3), (N, 4), (N, 5) or (H, W, C), "
            f"found {array.dtype} of shape {array.shape}; save such an array"
        )

    if array.shape[0] <= TRANSPOSED_ROWS < array.shape[-1]:
        raise InputError(
            f"{path}: expected a row per point, found shape {array.shape}, which is transposed; "
            "save numpy.moveaxis(array, 0, -1)"
        )

    table = array.reshape(-1, array.shape[-1])
    if layout.columns:
        return named_cloud(list(table.T), layout.columns, str(path), describe(layout.columns))

    names = name_columns(table)
    note = describe(names) if "_" in names else ""
    if array.ndim == 3:
        note = f"range image of {array.shape[0]} x {array.shape[1]} row by row, {describe(names)}"
    return named_cloud(list(table.T), names, str(path), note)
