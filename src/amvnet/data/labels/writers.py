"""Write the labels of a single scan: alone, or with its points, in colour, for other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from amvnet.data.formats.cloud import split_records
from amvnet.data.labels.ids import check_count, write_ids
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write

Kind = Literal["label", "npy", "ply", "pcd"]
KINDS: tuple[Kind, ...] = get_args(Kind)

MAX_ERROR = 0.0005  # metres: if float32 is off by more, coordinates are written as float64

PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
PCD_HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {names}
SIZE {sizes}
TYPE {types}
COUNT {counts}
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA binary
"""

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class LabelledPoints:
    """The points of a scan and their labels.

    Attributes:
        xyz: (N, 3) coordinates, metres.
        raw: (N,) uint32 raw ids.
        colors: (N, 3) uint8 RGB.
        uncertain: (N,) bool, or None if unknown.
    """

    xyz: np.ndarray
    raw: np.ndarray
    colors: np.ndarray
    uncertain: np.ndarray | None

    def packed_colors(self) -> np.ndarray:
        """Return (N,) little-endian float32 whose bits are the colours as PCL packs them."""
        red, green, blue = self.colors.astype(np.uint32).T
        return (red << 16 | green << 8 | blue).astype("<u4").view("<f4")


def check_kind(kind: str) -> None:
    """Check that a format can be written; call this before the work starts.

    Raises:
        InputError: if the format is unknown.
    """
    if kind not in KINDS:
        raise InputError(
            f"expected a format of {', '.join(KINDS)}, found {kind!r}; give one of them"
        )


def write_scan_labels(
    stem: Path,
    kind: str,
    xyz: np.ndarray,
    ids: np.ndarray,
    taxonomy: Taxonomy,
    uncertain: np.ndarray | None = None,
) -> Path:
    """Write the labels of a scan, one row per point, in the scan's order.

    The file appears whole or not at all. Its formats:

    - `label`: uint32 raw ids only, as in SemanticKITTI.
    - `npy`: the same ids as an (N,) array.
    - `ply` (binary): x, y, z, red, green, blue, class (raw id), uncertain (0 or 1).
    - `pcd` (binary): x, y, z, rgb (packed as in PCL), label (raw id), uncertain. NaN stays NaN, as
      in `ply`.

    Coordinates of `ply` and `pcd` are float32, or float64 if float32 would be off by more than half
    a millimetre.

    Args:
        stem: the path without an ending; `.` and the kind are added.
        xyz: (N, 3) coordinates, metres, as in the scan's file. `label` and `npy` use only N.
        ids: (N,) train ids in 0..K.
        uncertain: (N,) bool; None if unknown, which leaves the column out.

    Returns:
        The path of the file.

    Raises:
        InputError: as `check_kind`, or if there is not one id per point, an id is outside 0..K, or
            the file cannot be written.
    """
    check_kind(kind)
    path = stem.with_name(f"{stem.name}.{kind}")

    ids = check_count(ids, path, len(xyz))
    raw = taxonomy.to_raw(ids)
    if kind == "label":
        return write_ids(path, raw)

    with atomic_write(path) as part:
        if kind == "npy":
            np.save(part, raw)
        else:
            POINT_WRITERS[kind](part, label_points(xyz, ids, taxonomy, uncertain))
    return path


def label_points(
    xyz: np.ndarray, ids: np.ndarray, taxonomy: Taxonomy, uncertain: np.ndarray | None
) -> LabelledPoints:
    """Return the points with the raw ids and colours of (N,) train ids.

    Raises:
        InputError: if an id is outside 0..K.
    """
    raw = taxonomy.to_raw(ids)
    return LabelledPoints(xyz, raw, np.asarray(taxonomy.colors, dtype=np.uint8)[ids], uncertain)


def write_uncertain(path: Path, uncertain: np.ndarray) -> Path:
    """Write which points are uncertain, (N,) bool, as `.npy`; the file appears whole or not."""
    with atomic_write(path) as part:
        np.save(part, np.asarray(uncertain, dtype=bool))
    return path


def _write_ply(path: Path, points: LabelledPoints) -> None:
    columns = _coordinates(points.xyz)
    columns["red"], columns["green"], columns["blue"] = points.colors.T
    columns["class"] = points.raw.astype(np.int32)
    table = _to_records(columns | _uncertain_column(points.uncertain))

    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    for name in table.dtype.names or ():
        type_code = table.dtype[name].str[1:]  # without the byte order
        header.append(f"property {PLY_TYPES[type_code]} {name}")
    header.append("end_header\n")

    path.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def _write_pcd(path: Path, points: LabelledPoints) -> None:
    columns = _coordinates(points.xyz)

    columns["rgb"] = points.packed_colors()
    columns["label"] = points.raw
    table = _to_records(columns | _uncertain_column(points.uncertain))

    sizes = []
    types = []
    for values in split_records(table).values():
        sizes.append(str(values.dtype.itemsize))
        types.append(values.dtype.kind.upper())

    header = PCD_HEADER.format(
        names=" ".join(table.dtype.names or ()),
        sizes=" ".join(sizes),
        types=" ".join(types),
        counts=" ".join("1" * len(sizes)),
        points=len(table),
    )
    path.write_bytes(header.encode("ascii") + table.tobytes())


POINT_WRITERS: dict[str, Callable[[Path, LabelledPoints], None]] = {
    "ply": _write_ply,
    "pcd": _write_pcd,
}


@np.errstate(invalid="ignore", over="ignore")
def _coordinates(xyz: np.ndarray) -> Columns:
    """Return the columns x, y, z as float32, or as float64 if float32 is not exact enough."""
    values = xyz.astype(np.float32)
    if (np.abs(values - xyz) > MAX_ERROR).any():
        values = xyz.astype(np.float64)
    x, y, z = values.T
    return {"x": x, "y": y, "z": z}


def _uncertain_column(uncertain: np.ndarray | None) -> Columns:
    """Return the column `uncertain`, or no column if the uncertain points are unknown."""
    if uncertain is None:
        return {}
    return {"uncertain": np.asarray(uncertain).astype(np.uint8)}


def _to_records(columns: Columns) -> np.ndarray:
    """Return (N,) records of the columns, packed and little endian."""
    fields = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    return np.rec.fromarrays(list(columns.values()), dtype=fields)
