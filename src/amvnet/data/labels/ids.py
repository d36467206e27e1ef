"""Read and write files that hold only the ids of a scan's points, as both benchmarks have them.

Errors name the likely mistake of another tool: another number type, another byte order, or train
ids instead of raw ids.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.data.taxonomy import INSTANCE_MASK, Taxonomy
from amvnet.errors import InputError, errors_of, readable
from amvnet.files import atomic_write

WIDTHS = (1, 2, 4, 8)  # the sizes of number types that labels may have by mistake, bytes


def read_ids(path: Path, dtype: DTypeLike, count: int) -> np.ndarray:
    """Read the (N,) raw ids of one scan, given N as `count`.

    Raises:
        InputError: if the file is missing or has another size.
    """
    with readable(path):
        if not path.is_file():
            raise InputError(
                f"{path}: expected the labels of a scan, found no file; add it, or leave the scan "
                "out"
            )
        check_size(path, path.stat().st_size, count, dtype)
        ids = np.fromfile(path, dtype=dtype, count=count)
    check_size(path, ids.nbytes, count, dtype)  # the file may have become shorter
    return ids


def write_ids(path: Path | str, raw_ids: np.ndarray, dtype: DTypeLike = np.uint32) -> Path:
    """Write (N,) raw ids as `dtype` and return the path; the file appears whole or not at all.

    The official `.label` files hold uint32.
    """
    with atomic_write(path) as part:
        part.write_bytes(np.asarray(raw_ids).astype(dtype).tobytes())
    return Path(path)


def write_array(path: Path, values: np.ndarray) -> None:
    """Write an array as `.npy`, whatever the ending of the path.

    If the disk is full, NumPy leaves out the end of an array without an error: call neither
    `tofile` nor `np.save` for a file.
    """
    content = BytesIO()
    np.save(content, values)
    path.write_bytes(content.getbuffer())


def check_count(ids: np.ndarray, path: Path, count: int) -> np.ndarray:
    """Return the ids of a scan as an array; raise InputError if their shape is not (count,)."""
    ids = np.asarray(ids)
    if ids.shape != (count,):
        raise InputError(
            f"{path}: expected {count} ids, one per point, found shape {ids.shape}; "
            "segment the whole scan"
        )

    return ids


def check_size(name: Path | str, size: int, count: int, dtype: DTypeLike) -> None:
    """Check the size of a file of labels, in bytes; an error names the likely mistake.

    Raises:
        InputError: if the file cannot hold `count` labels of `dtype`.
    """
    dtype = np.dtype(dtype)
    if size == count * dtype.itemsize:
        return

    if count and size % count == 0 and size // count in WIDTHS:
        raise InputError(
            f"{name}: expected {dtype} ids, found ids of {8 * size // count} bits; "
            f"write the ids as {dtype}"
        )

    is_whole = size % dtype.itemsize == 0
    found = f"{size // dtype.itemsize}" if is_whole else f"{size} bytes"
    raise InputError(
        f"{name}: expected {count} labels ({dtype}), one per point, found {found}; "
        "give the file of this scan"
    )


def train_ids(
    name: Path | str,
    raw: np.ndarray,
    taxonomy: Taxonomy,
    advice: str | None = None,
    table: np.ndarray | None = None,
) -> np.ndarray:
    """Return the (N,) uint8 train ids of (N,) raw ids; an error names the likely mistake.

    Messages begin with `name`. `Taxonomy.to_train` takes `advice` and `table`.

    Raises:
        InputError: if an id is no raw id of the taxonomy, or all ids look like float32 or
            big-endian ids.
    """
    with errors_of(name):
        return taxonomy.to_train(check_bits(name, raw), advice, table)


def check_bits(name: Path | str, raw: np.ndarray) -> np.ndarray:
    """Return (N,) raw ids; raise InputError if all look like float32 or big-endian ids."""
    classes = raw.astype(np.uint32) & np.uint32(INSTANCE_MASK)

    # The float 40.0 and a big-endian 40 have all of their bits in the upper half.
    if raw.any() and not classes.any():
        raise InputError(
            f"{name}: expected little-endian {raw.dtype} ids, found the class 0 with other bits, "
            f"as float32 and big-endian ids read; write the ids as little-endian {raw.dtype}"
        )
    return raw
