"""The labels of a lone scan, written alone or as coloured points that other programs open."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from amvnet.data.scan_files import check_count, write_labels
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write

Kind = Literal["label", "npy", "ply", "pcd", "las"]
KINDS: tuple[Kind, ...] = get_args(Kind)
EXACT = 0.0005  # metres: where float32 is farther off than this, coordinates are written as float64
LAS_STEP = 0.0001  # metres: the unit of LAS coordinates
LAS_REACH = 200_000.0  # metres: what 32 bits hold of that, either way
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


def check_kind(kind: str) -> None:
    """Raises InputError where a format is unknown, or laspy is missing for it; to be asked before anything is done."""
    if kind not in KINDS:
        raise InputError(
            f"expected a format of {', '.join(KINDS)}, found {kind!r}; give one of them"
        )
    if kind == "las":
        try:
            import laspy  # noqa: F401
        except ImportError:
            raise InputError(
                'expected laspy to write LAS, found none; do pip install "amvnet[formats]"'
            ) from None


def write_scan_labels(
    stem: Path,
    kind: str,
    xyz: np.ndarray,
    ids: np.ndarray,
    taxonomy: Taxonomy,
    uncertain: np.ndarray | None = None,
) -> Path:
    """Write the labels of a scan, one row for each of its points in their order; whole or not at all.

    - `label`: uint32 raw ids and nothing else, as SemanticKITTI has them.
    - `npy`: the same as an array (N,).
    - `ply` (binary): x, y, z, red, green, blue, class (raw id), uncertain (0 or 1).
    - `pcd` (binary): x, y, z, rgb (packed as PCL does), label (raw id), uncertain. NaN stays NaN, as in `ply`.
    - `las`: coordinates to 0.1 mm, colours, and the dimensions class (raw id) and uncertain. What LAS cannot hold, NaN
      and points 200 km from the others, keeps its place with class 0 and the coordinates 0, 0, 0; of a scan far from
      the origin, as in a map's coordinates, those of the file's offset.

    Coordinates of `ply` and `pcd` are float32, or float64 where that would be off by more than half a millimetre.

    Args:
        stem: the path without an ending; `.` and the kind are added.
        xyz: (N, 3) coordinates, metres, as the scan's file has them; `label` and `npy` do without.
        ids: (N,) train ids in 0..K.
        uncertain: (N,) bool; None where that is not known, and the column is left out.

    Returns:
        The path of the file.

    Raises:
        InputError: as `check_kind`, where there is not one id per point or an id is outside 0..K, or where the file
            cannot be written.
    """
    check_kind(kind)
    path = stem.with_name(f"{stem.name}.{kind}")
    ids = check_count(ids, path, len(xyz))
    raw = taxonomy.to_raw(ids)
    if kind == "label":
        return write_labels(path, raw)
    with atomic_write(path) as part:
        if kind == "npy":
            np.save(part, raw)
        else:
            POINT_WRITERS[kind](
                part, xyz, raw, np.asarray(taxonomy.colors, dtype=np.uint8)[ids], uncertain
            )
    return path


def write_uncertain(path: Path, uncertain: np.ndarray) -> Path:
    """Write which points are uncertain, (N,) bool, as `.npy`; whole or not at all."""
    with atomic_write(path) as part:
        np.save(part, np.asarray(uncertain, dtype=bool))
    return path


Columns = dict[str, np.ndarray]


def _write_ply(
    path: Path, xyz: np.ndarray, raw: np.ndarray, colors: np.ndarray, uncertain: np.ndarray | None
) -> None:
    columns = _coordinates(xyz) | dict(zip(("red", "green", "blue"), colors.T, strict=True))
    table = _table(columns | {"class": raw.astype(np.int32)} | _flags(uncertain))
    properties = [f"property {PLY_TYPES[dtype.str[1:]]} {name}" for name, dtype in _fields(table)]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *properties,
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def _write_pcd(
    path: Path, xyz: np.ndarray, raw: np.ndarray, colors: np.ndarray, uncertain: np.ndarray | None
) -> None:
    red, green, blue = colors.astype(np.uint32).T
    packed = (
        (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    )  # PCL keeps the three bytes as a float's
    table = _table(_coordinates(xyz) | {"rgb": packed, "label": raw} | _flags(uncertain))
    fields = _fields(table)
    header = PCD_HEADER.format(
        names=" ".join(name for name, _ in fields),
        sizes=" ".join(str(dtype.itemsize) for _, dtype in fields),
        types=" ".join(dtype.kind.upper() for _, dtype in fields),
        counts=" ".join("1" for _ in fields),
        points=len(table),
    )
    path.write_bytes(header.encode("ascii") + table.tobytes())


def _write_las(
    path: Path, xyz: np.ndarray, raw: np.ndarray, colors: np.ndarray, uncertain: np.ndarray | None
) -> None:
    """The class is a dimension of its own: LAS's has a byte, and other meanings for its numbers."""
    import laspy

    places, offset, held = _las_places(xyz)
    extra = {"class": np.where(held, raw, 0).astype(np.uint16)} | _flags(uncertain)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, LAS_STEP), offset
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, values.dtype) for name, values in extra.items()]
    )
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header))
    las.X, las.Y, las.Z = places.T
    las.red, las.green, las.blue = (
        colors.T.astype(np.uint16) * 256
    )  # as the specification brings 8 bits to 16
    for name, values in extra.items():
        las[name] = values
    las.write(str(path))


POINT_WRITERS: dict[
    str, Callable[[Path, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], None]
] = {
    "ply": _write_ply,
    "pcd": _write_pcd,
    "las": _write_las,
}


@np.errstate(invalid="ignore", over="ignore")
def _las_places(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 3) int32 steps from the (3,) offset, which is 0 where that is near enough, and the (N,) points that it holds.

    The median is what a few broken points, however far, cannot move.
    """
    finite = np.isfinite(xyz).all(axis=1)
    middle = (
        np.round(np.median(xyz[finite].astype(np.float64), axis=0)) if finite.any() else np.zeros(3)
    )
    offset = middle if (np.abs(middle) > LAS_REACH / 2).any() else np.zeros(3)
    apart = xyz.astype(np.float64) - offset
    held = finite & (np.abs(apart) < LAS_REACH).all(axis=1)
    return np.round(np.where(held[:, None], apart, 0) / LAS_STEP).astype(np.int32), offset, held


@np.errstate(invalid="ignore", over="ignore")
def _coordinates(xyz: np.ndarray) -> Columns:
    narrow = xyz.astype(np.float32)
    exact = not (np.abs(narrow - xyz) > EXACT).any()
    return dict(zip("xyz", (narrow if exact else xyz.astype(np.float64)).T, strict=True))


def _flags(uncertain: np.ndarray | None) -> Columns:
    return {} if uncertain is None else {"uncertain": np.asarray(uncertain).astype(np.uint8)}


def _table(columns: Columns) -> np.ndarray:
    """(N,) records, packed and little endian."""
    (count,) = {len(values) for values in columns.values()}
    table = np.empty(
        count, [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    )
    for name, values in columns.items():
        table[name] = values
    return table


def _fields(table: np.ndarray) -> list[tuple[str, np.dtype]]:
    return [(name, table.dtype[name]) for name in table.dtype.names or ()]
