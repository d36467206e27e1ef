"""Write the labels of a single scan, alone or with its coloured points, and read their classes.

A file of points names its classes. Each is a line of JSON, such as
`amvnet class {"id": 10, "name": "car", "color": [...]}`: a comment of PLY and PCD, a record of LAS.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import get_args

import numpy as np

from amvnet.data.formats import las, pcd, ply
from amvnet.data.formats.registry import check_packages, read_comments
from amvnet.data.labels.ids import check_count, write_array, write_ids
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy, class_colors
from amvnet.errors import InputError
from amvnet.files import FormatName, Signature, atomic_write

KINDS = get_args(FormatName)

Columns = dict[str, np.ndarray]

# The largest rounding error of coordinates in float32, metres; if it is larger, they are float64.
MAX_ERROR = 0.0005
COLORS = ("red", "green", "blue")
# Open3D's reader of tensors leaves out columns of any other type.
PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
PCD_HEADER = "# .PCD v0.7 - labels of amvnet\nVERSION 0.7"
LAS_FORMAT = 7  # the point format of LAS 1.4 with colours and classes up to 255
# LAS 1.4 wants a coordinate system, as WKT in this point format. Axes and place are those of the
# scan's file, and known to nobody else.
LOCAL_COORDINATES = (
    'LOCAL_CS["Local coordinates",LOCAL_DATUM["Local datum",32767],UNIT["metre",1],'
    'AXIS["X",OTHER],AXIS["Y",OTHER],AXIS["Z",UP]]'
)
FULL_COLOR = 257  # colours of LAS have 16 bits: 255 * 257 = 65535
MILLIMETRE = 0.001
FARTHEST = 1_000_000.0  # largest coordinate, metres, from which 32 bits of millimetres reach 0
CLASSES = "amvnet classes "  # begins the line with the name of the classes
CLASS = "amvnet class "  # begins the line of a class; the first one is of points without a class
LONGEST_LEGEND = 60_000  # the longest legend that a header holds, bytes
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


def write_cloud(
    path: Path,
    coordinates: Columns,
    ids: np.ndarray,
    taxonomy: Taxonomy,
    others: Columns,
    program: str = "amvnet",
) -> None:
    """Write labelled points as .ply, .pcd, .las or .laz; the file also names the classes.

    The columns are x, y and z; red, green and blue of the class, uint8; class, its raw id, int32;
    and the others. LAS has coordinates in millimetres, lost points (NaN) at 0, 0, 0 (in map
    coordinates, at their lowest corner), and the class as `classification` if all ids are below
    256, else as a dimension of its own.

    Args:
        coordinates: (N,) x, y and z in metres.
        ids: (N,) train ids.
        program: what LAS says of the program that wrote the file.
    """
    colors = np.asarray(class_colors(taxonomy), np.uint8)[ids]
    columns = coordinates | dict(zip(COLORS, colors.T, strict=True))
    columns["class"] = taxonomy.to_raw(ids).astype(np.int32)
    columns |= others
    legend = legend_of(taxonomy)
    if path.suffix == ".ply":
        _write_ply(path, columns, legend)
    elif path.suffix == ".pcd":
        _write_pcd(path, columns, legend)
    else:
        _write_las(path, columns, legend, program, packed=path.suffix == ".laz")


def _write_ply(path: Path, columns: Columns, legend: Sequence[str]) -> None:
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(columns['x'])}"]
    for name, values in columns.items():
        header.append(f"property {PLY_TYPES[values.dtype.str[1:]]} {name}")  # without byte order
    header += [ply.COMMENT + line for line in legend]
    header.append("end_header\n")
    path.write_bytes("\n".join(header).encode("ascii") + _records(columns))


def _write_pcd(path: Path, columns: Columns, legend: Sequence[str]) -> None:
    """Write a binary PCD, with the colours packed as PCL packs them."""
    red, green, blue = (columns[name].astype(np.uint32) for name in COLORS)
    fields = {}
    for name, values in columns.items():
        if name == "red":
            fields["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
        elif name not in COLORS:
            fields[name] = values

    count = len(columns["x"])
    header = [
        PCD_HEADER,
        *(pcd.COMMENT + line for line in legend),
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(str(values.dtype.itemsize) for values in fields.values())}",
        f"TYPE {' '.join(values.dtype.kind.upper() for values in fields.values())}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + _records(fields))


def _records(columns: Columns) -> bytes:
    """Return the bytes of the points, each with the values of all columns side by side."""
    fields = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    return np.rec.fromarrays(list(columns.values()), dtype=fields).tobytes()


def _write_las(
    path: Path, columns: Columns, legend: Sequence[str], program: str, packed: bool
) -> None:
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    others = dict(columns)
    xyz = np.stack([others.pop(axis).astype(np.float64) for axis in "xyz"], axis=1)
    is_placed = np.isfinite(xyz).all(axis=1)
    is_far = np.abs(xyz[is_placed]).max(initial=0) > FARTHEST
    colors = [others.pop(name).astype(np.uint16) * FULL_COLOR for name in COLORS]
    if others["class"].max(initial=0) < 256:
        classification = others.pop("class")
    else:
        classification = np.zeros(len(xyz))

    header = laspy.LasHeader(point_format=LAS_FORMAT, version="1.4")
    header.generating_software = program
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(LOCAL_COORDINATES))
    user, record = las.COMMENTS
    lines = "\n".join(legend).encode("ascii")
    header.vlrs.append(laspy.VLR(user, record, "classes of the labels", lines))
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, values.dtype) for name, values in others.items()]
    )
    header.offsets = xyz[is_placed].min(axis=0).round() if is_placed.any() else np.zeros(3)
    header.scales = np.full(3, MILLIMETRE)
    cloud = laspy.LasData(header)
    xyz[~is_placed] = header.offsets if is_far else 0  # integers of 32 bits do not reach 0 from far
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.return_number[:] = 1
    cloud.number_of_returns[:] = 1
    cloud.red, cloud.green, cloud.blue = colors
    cloud.classification = classification.astype(np.uint8)
    for name, values in others.items():
        cloud[name] = values
    content = BytesIO()  # lazrs hides the system's reason if it cannot write a file
    cloud.write(content, do_compress=packed, laz_backend=laspy.LazBackend.Lazrs)
    path.write_bytes(content.getbuffer())


def legend_of(taxonomy: Taxonomy) -> list[str]:
    """Return the lines of ASCII that name the classes, or none if they are too long."""
    lines = [CLASSES + json.dumps(taxonomy.name)]
    entries = zip(taxonomy.train_to_raw, taxonomy.names, taxonomy.colors, strict=True)
    for raw, name, color in entries:
        lines.append(CLASS + json.dumps({"id": raw, "name": name, "color": color}))
    return lines if sum(map(len, lines)) <= LONGEST_LEGEND else []


def read_legend(path: Path) -> Taxonomy | None:
    """Return the classes that a file of labelled points names; None if it names none.

    A broken file names none: whoever reads its points gets the error.
    """
    with suppress(InputError):
        return _classes_of(read_comments(path))
    return None


def _classes_of(comments: Iterable[str]) -> Taxonomy | None:
    name = ""
    entries = []
    with suppress(ValueError, KeyError, TypeError, RecursionError):  # comments of a stranger
        for comment in comments:
            if comment.startswith(CLASSES):
                name = json.loads(comment.removeprefix(CLASSES))
            elif comment.startswith(CLASS):
                values = json.loads(comment.removeprefix(CLASS))
                entries.append((values["id"], values["name"], values["color"]))
    if not entries:
        return None

    raw_ids, names, colors = zip(*entries, strict=True)
    known = TAXONOMIES.get(str(name))
    if known is not None and (known.names, known.train_to_raw) == (names, raw_ids):
        return known
    return Taxonomy.from_dict(
        {
            "name": name,
            "classes": names[1:],
            "colors": colors,
            "raw_to_train": [(raw, ids) for ids, raw in enumerate(raw_ids)],
            "train_to_raw": raw_ids,
            "splits": {},
            "counts_absent": False,
        }
    )
