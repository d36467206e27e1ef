"""Predicted labels as any tool may have written them: read, and told apart from what is usually written instead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from amvnet.data.taxonomy import INSTANCE_MASK, Taxonomy
from amvnet.errors import InputError

WIDTHS = (1, 2, 4, 8)  # bytes of the number types that labels are written in by mistake
SHOWN = 5  # unknown ids in a message


def read_prediction(path: Path, dtype: DTypeLike, count: int, taxonomy: Taxonomy) -> np.ndarray:
    """Read `count` raw ids of `dtype`; (N,) uint8 train ids in 0..K.

    Raises:
        InputError: where the file is missing, and as `check_size` and `train_ids`.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: expected the prediction of a scan, found no file; predict this scan, too"
        )
    check_size(path, path.stat().st_size, count, dtype)
    return train_ids(path, np.fromfile(path, dtype=dtype, count=count), taxonomy)


def check_size(name: Path | str, size: int, count: int, dtype: DTypeLike) -> None:
    """Tell a file of other labels from one of another number type, by its size alone.

    Args:
        name: what the message begins with.
        size: bytes in the file.
        count: points of the scan.

    Raises:
        InputError: where the size is not `count` labels of `dtype`.
    """
    wanted, width = np.dtype(dtype), np.dtype(dtype).itemsize
    if size == count * width:
        return
    if size in [count * other for other in WIDTHS]:
        raise InputError(
            f"{name}: expected {wanted} ids, found ids of {8 * size // count} bits; write the ids as {wanted}"
        )
    found = f"{size // width}" if size % width == 0 else f"{size} bytes"
    raise InputError(
        f"{name}: expected {count} labels ({wanted}), one per point, found {found}; give the file of this scan"
    )


def train_ids(name: Path | str, raw: np.ndarray, taxonomy: Taxonomy) -> np.ndarray:
    """Turn (N,) raw ids into (N,) uint8 train ids in 0..K; `name` is what the message begins with.

    Raises:
        InputError: where an id is none of the benchmark's raw ids, or all look like another number type.
    """
    classes = raw.astype(np.uint32) & np.uint32(INSTANCE_MASK)
    if (
        raw.any() and not classes.any()
    ):  # 40.0 and a big-endian 40 have all of their bits in the upper half
        raise InputError(
            f"{name}: expected little-endian {raw.dtype} ids, found the class 0 with other bits, as float32 and "
            f"big-endian ids read; write the ids as little-endian {raw.dtype}"
        )
    try:
        return taxonomy.to_train(raw)
    except InputError:
        raise InputError(f"{name}: {_unknown(classes, taxonomy)}") from None


def _unknown(classes: np.ndarray, taxonomy: Taxonomy) -> str:
    """What to say of ids that are not all in the table."""
    table = {
        *taxonomy.train_to_raw,
        *(raw for raw in taxonomy.raw_to_train if isinstance(raw, int)),
    }
    found = sorted(set(np.unique(classes).tolist()) - table)
    shown = ", ".join(map(str, found[:SHOWN])) + (
        f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    )
    train = " (train ids, it seems)" if classes.max() <= taxonomy.size else ""
    wanted = ", ".join(map(str, taxonomy.train_to_raw[1:]))
    return f"expected the raw ids of {taxonomy.name} ({wanted}), found {shown}{train}; write its raw ids"
