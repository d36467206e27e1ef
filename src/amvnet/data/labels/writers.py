"""Write the labels of a single scan, alone or with its coloured points."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import get_args

import numpy as np

from amvnet.data.formats.registry import check_packages
from amvnet.data.labels.clouds import PCD_HEADER, Columns, write_cloud
from amvnet.data.labels.ids import check_count, write_array, write_ids
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import FormatName, Signature, atomic_write

KINDS = get_args(FormatName)

# The largest rounding error of coordinates in float32, metres; if it is larger, they are float64.
MAX_ERROR = 0.0005
# The first bytes of a file of ids: they are no first bytes of a scan file.
_IDS = rb"(?!ply|PK|\x93NUMPY|# \.PCD|VERSION|LASF|#ROSBAG|\x89MCAP|SQLite|\x1f\x8b)"
_ARRAY = rb"\x93NUMPY.{1,20}'descr': '%s'.{1,40}'shape': \(\d+,\)"
_PLY = (
    rb"ply\nformat binary_little_endian 1\.0\nelement vertex \d+\nproperty (float|double) x\n.*"
    rb"property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int class\n"
)
_LAS = rb"LASF.{54}amvnet\0"  # the name of the program
_CLOUD = "points with labels as predict writes them"
# The files that are written for a scan, by their ending; nuScenes' label files end in `.bin`.
SIGNATURES = {
    ".label": Signature("a file of labels", _IDS, unit=4),
    ".bin": Signature("a file of labels", _IDS),
    ".npy": Signature("an array of labels", _ARRAY % b"[<>|][iu]\\d"),
    ".csv": Signature(_CLOUD, rb"x,y,z,class,name[,\n]"),
    ".ply": Signature(_CLOUD, _PLY),
    ".pcd": Signature(_CLOUD, re.escape(PCD_HEADER).encode()),
    ".las": Signature(_CLOUD, _LAS),
    ".laz": Signature(_CLOUD, _LAS),
}
UNCERTAIN = Signature("an array of uncertain points", _ARRAY % rb"\|b1")
SCORES = Signature("scores of predict", rb"PK\x03\x04.{26}(rv|bev)\.npy")


def check_kind(kind: str) -> None:
    """Raise InputError if labels cannot be written in a format; call this before the work."""
    if kind not in KINDS:
        raise InputError(
            f"expected a format of {', '.join(KINDS)}, found {kind!r}; give one of them"
        )
    check_packages(f"format {kind}", f".{kind}")


def write_scan_labels(
    stem: Path,
    kind: str,
    xyz: np.ndarray,
    ids: np.ndarray,
    taxonomy: Taxonomy,
    uncertain: np.ndarray | None = None,
) -> Path:
    """Write the labels of a scan in the order of its points; return the path.

    The file appears whole or not at all. Its formats:

    - `label`: only raw ids, uint32, as in SemanticKITTI.
    - `npy`: the same ids as an (N,) array.
    - `csv`: x, y, z, class (raw id), name (of the class), uncertain (0 or 1), in a line for each
      point below the names of these columns.
    - `ply` (binary): x, y, z, red, green, blue, class (raw id), uncertain (0 or 1). Coordinates are
      float32, or float64 if float32 would be off by more than half a millimetre. NaN stays NaN.
    - `pcd` (binary): the same, with the colours packed in rgb.
    - `las`, `laz`: the same, as `write_cloud` describes it.

    Files of points also name the classes, as `legend_of` returns them.

    Args:
        stem: the path without an ending; `.` and the kind are added.
        xyz: (N, 3) the unchanged coordinates of the scan's file, metres. `label` and `npy` use
            only N.
        ids: (N,) train ids in 0..K.
        uncertain: (N,) bool; by default, the column is left out.

    Raises:
        InputError: if there is no such format, there is not one id per point, an id is outside
            0..K, or the file cannot be written.
    """
    check_kind(kind)
    path = stem.with_name(f"{stem.name}.{kind}")
    ids = check_count(ids, path, len(xyz))
    raw = taxonomy.to_raw(ids)
    if kind == "label":
        return write_ids(path, raw)

    with atomic_write(path) as part:
        if kind == "npy":
            write_array(part, raw)
            return path

        points = _coordinates(xyz)
        others: Columns = {}
        if uncertain is not None:
            others["uncertain"] = np.asarray(uncertain).astype(np.uint8)
        if kind == "csv":
            names = np.asarray(taxonomy.names)[ids]
            _write_table(part, points | {"class": raw, "name": names} | others)
        else:
            write_cloud(part, points, ids, taxonomy, others)
    return path


def write_uncertain(path: Path, uncertain: np.ndarray) -> Path:
    """Write which points are uncertain, (N,) bool, as `.npy`."""
    with atomic_write(path) as part:
        write_array(part, np.asarray(uncertain, dtype=bool))
    return path


def _write_table(path: Path, columns: Columns) -> None:
    """Write columns (N,) as a table with commas; numbers have as many digits as tell them apart."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        table.writerows(zip(*(values.astype(str) for values in columns.values()), strict=True))


@np.errstate(invalid="ignore", over="ignore")
def _coordinates(xyz: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns x, y, z as float32, or as float64 if float32 is not exact enough."""
    values = xyz.astype(np.float32)
    if (np.abs(values - xyz) > MAX_ERROR).any():
        values = xyz.astype(np.float64)
    x, y, z = values.T
    return {"x": x, "y": y, "z": z}
