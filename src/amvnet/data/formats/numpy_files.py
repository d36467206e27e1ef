"""Scans in NumPy's files: tables of points, range images and arrays with named columns; nothing is ever unpickled."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    refusing,
    require_columns,
    ring_indices,
)
from amvnet.data.formats.raw import ring_column
from amvnet.errors import InputError

COLUMNS = ("x", "y", "z", "intensity")
KEYS = ("points", "xyz", "scan", "arr_0")  # of the array to read, where an archive has several
RANGE_TOLERANCE = 0.05  # metres between a column and the distance, for it to be the distance
ADVICE = "save it again with np.save"


def read_npy(path: Path) -> Cloud:
    """Read one array.

    Raises:
        InputError: where it is no array of numbers, of another shape, or truncated.
    """
    with refusing(path, "a plain NumPy array", ADVICE), path.open("rb") as file:
        return _cloud(_load(file, path.stat().st_size, path), path)


def read_npz(path: Path) -> Cloud:
    """Read the one array of an archive, or the one named `points`, `xyz`, `scan` or `arr_0`; raises as `read_npy`."""
    with (
        refusing(path, "a NumPy archive", "save it again with np.savez"),
        zipfile.ZipFile(path) as archive,
    ):
        names = {
            name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")
        }
        found = list(names) if len(names) == 1 else [key for key in KEYS if key in names]
        if not found:
            shown = ", ".join(list(names)[:10])[:200] or "none"
            raise InputError(
                f"{path}: expected an array named {KEYS[0]}, found {shown!a}; save the scan under that name"
            )
        member = archive.getinfo(names[found[0]])
        with archive.open(member) as file:
            return _cloud(_load(file, member.file_size, path), path)  # type: ignore[arg-type]  # a binary file too


def _load(file: BinaryIO, size: int, path: Path) -> np.ndarray:
    """The array that begins here, if the `size` bytes can hold what its header claims."""
    version = np.lib.format.read_magic(file)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = read(file)
    numbers = dtype.names is not None or dtype.kind in "fiu"
    if dtype.hasobject or not numbers or not shape:
        raise InputError(
            f"{path}: expected an array of numbers, found {dtype} of shape {shape}; {ADVICE} as float32"
        )
    length = math.prod(shape) * dtype.itemsize
    if length > size:
        raise InputError(
            f"{path}: expected {length} bytes for its shape {shape}, found {size}; {ADVICE}"
        )
    check_point_count(math.prod(shape[:1] if len(shape) < 3 else shape[:-1]), path)
    flat = np.frombuffer(file.read(length), dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def _cloud(array: np.ndarray, path: Path) -> Cloud:
    if array.dtype.names is not None:
        flat, names = array.ravel(), array.dtype.names
        return make_cloud(
            {key: flat[names[i]] for key, i in require_columns(names, path).items()}, str(path)
        )
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise InputError(
            f"{path}: expected numbers of shape (N, 3), (N, 4), (N, 5) or (H, W, C), found shape {array.shape}; "
            "save such an array"
        )
    table = array.reshape(-1, array.shape[-1])
    found = {name: table[:, i] for i, name in enumerate(COLUMNS[: table.shape[1]])}
    what, ring = _others(table, array.ndim == 3, path)
    cloud = make_cloud(found, str(path))
    return Cloud(cloud.xyz, cloud.intensity, ring, cloud.name, note=_note(array, what))


def _others(table: np.ndarray, image: bool, path: Path) -> tuple[list[str], np.ndarray | None]:
    """What the columns after the intensity are taken for, and the ring where it is among them."""
    if table.shape[1] <= len(COLUMNS) or not len(table):
        return [], None
    fifth = table[:, 4]
    if _is_distance(table):
        return ["range"], None
    if table.shape[1] == 5 and not image:
        return ["ring"], ring_column(fifth, path)
    found = ring_indices(fifth)
    return (["ring"], found) if found is not None and found.any() else ([], None)


def _is_distance(table: np.ndarray) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(np.linalg.norm(table[:, :3].astype(np.float64), axis=1) - table[:, 4])
    finite = np.isfinite(error)
    return bool(finite.any() and (error[finite] < RANGE_TOLERANCE).all() and table[finite, 4].any())


def _note(array: np.ndarray, others: list[str]) -> str:
    columns = array.shape[-1]
    known = [*COLUMNS[:columns], *others]
    left = f", {columns - len(known)} more left out" if columns > len(known) else ""
    shown = f"columns {' '.join(known)}{left}"
    if array.ndim == 3:
        return f"range image of {array.shape[0]} x {array.shape[1]} row by row, {shown}"
    return shown if columns > 5 or others == ["range"] else ""
