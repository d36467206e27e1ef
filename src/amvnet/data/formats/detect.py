"""Detect the format of a scan file by its first bytes, its values or its name."""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

from amvnet.data.formats.packets import PCAPNG
from amvnet.data.formats.raw import NUSCENES_ENDING, columns_of
from amvnet.data.formats.rows import guess_rows
from amvnet.data.formats.text import ADVICE as TEXT_ADVICE
from amvnet.data.formats.text import find_table, is_text
from amvnet.errors import InputError


@dataclass(frozen=True)
class Format:
    """A kind of scan files.

    Attributes:
        endings: of the files' names.
        content: what is read of them, for people.
        extra: the extra of this package that is needed; empty if none is.
    """

    endings: tuple[str, ...]
    content: str
    extra: str = ""


TEXT = (".xyz", ".txt", ".csv", ".asc", ".pts")
PACKED = (".gz", ".zip")
BAGS = (".bag", ".mcap", ".db3")
FOLDER = ""  # instead of an ending: the folder of a ROS 2 bag
METADATA = "metadata.yaml"  # in the folder of a ROS 2 bag
FORMATS = (
    Format(
        (NUSCENES_ENDING, ".bin"),
        "rows of 3 to 6 float32 or float64: x, y, z, intensity (KITTI), ring (nuScenes); others "
        "with `--columns` and `--dtype`",
    ),
    Format(
        (".pcd",),
        "ascii, binary or binary_compressed; organised or not; columns of any type and order, "
        "padding",
    ),
    Format((".ply",), "the vertices; ascii, or binary of either byte order"),
    Format(
        (".npy",),
        "numbers of shape (N, 3 or more) or (H, W, 3 or more), or an array with named columns",
    ),
    Format(
        (".npz",),
        "the same, next to an array `intensity` and `ring` or without; or the columns `x`, `y`, "
        "`z`, ... as arrays",
    ),
    Format(
        TEXT,
        "a line per point, separated by spaces, commas or semicolons; with the names of the "
        "columns or without; UTF-8 or UTF-16",
    ),
    Format(PACKED, "one scan of the formats above, such as `scan.bin.gz`"),
    Format((".las", ".laz"), "coordinates and intensity", "formats"),
    Format(
        BAGS,
        "ROS 1 and ROS 2: the PointCloud2 or Livox CustomMsg messages of one topic; also the "
        "folder of a ROS 2 bag",
        "formats",
    ),
    Format(
        (".feather",),
        "a table with named columns; of Argoverse 2, moved to the LiDARs by the log's calibration",
        "datasets",
    ),
    Format((".e57",), "every scan, in the frame of the instrument", "e57"),
    Format(
        (".pcap",),
        "the packets of a Velodyne, a scan per turn; of other sensors, an error with the command "
        "that converts it",
        "packets",
    ),
)
ENDINGS = tuple(ending for kind in FORMATS for ending in kind.endings)

# Kinds of files that are known, but not read: what they are, and what to do.
UNREADABLE = {
    ".pcapng": ("a capture in the newer format", "run Wireshark's editcap -F pcap OLD NEW.pcap"),
    ".tfrecord": (
        "Waymo's records",
        "they need TensorFlow; convert them to KITTI's .bin, for example with OpenPCDet or "
        "MMDetection3D",
    ),
    ".parquet": (
        "Parquet, as of Waymo's version 2",
        "convert it to KITTI's .bin, for example with OpenPCDet or MMDetection3D",
    ),
    ".lvx": ("a recording of Livox Viewer", "convert it to a bag with Livox's lvx_to_rosbag"),
    ".lvx2": ("a recording of Livox Viewer", "convert it to .pcd or .las in Livox Viewer"),
    ".rcp": ("a project of ReCap", "export it as .e57 or .pts"),
    ".rcs": ("a scan of ReCap", "export it as .e57 or .pts"),
    ".ptx": ("a scan of Leica's Cyclone", "export it as .e57, or as .ply with CloudCompare"),
    ".obj": ("a mesh", "export its points as .ply, for example with CloudCompare"),
    ".stl": ("a mesh", "export its points as .ply, for example with CloudCompare"),
    ".mat": ("variables of MATLAB", "write the cloud with pcwrite as .pcd"),
    ".pkl": ("a pickle, which can run any program", "save the points with numpy.save"),
    ".pickle": ("a pickle, which can run any program", "save the points with numpy.save"),
    ".pt": ("a pickle of PyTorch", "save the points with numpy.save"),
    ".h5": ("HDF5", "save the points of each scan with numpy.save"),
}


# The first bytes of files.
BEGINNINGS = {
    b"\x93NUMPY": ".npy",
    b"\x1f\x8b": ".gz",
    b"PK\x03\x04": ".zip",
    b"VERSION": ".pcd",
    b"FIELDS": ".pcd",
    b"ply\n": ".ply",
    b"ply\r": ".ply",
    b"LASF": ".las",
    b"#ROSBAG": ".bag",
    b"\x89MCAP0\r\n": ".mcap",
    b"SQLite format 3\x00": ".db3",
    b"ARROW1": ".feather",
    b"FEA1": ".feather",
    b"ASTM-E57": ".e57",
    b"\xd4\xc3\xb2\xa1": ".pcap",
    b"\xa1\xb2\xc3\xd4": ".pcap",
    b"\x4d\x3c\xb2\xa1": ".pcap",
    b"\xa1\xb2\x3c\x4d": ".pcap",
    PCAPNG: ".pcap",
}
HEAD = 4096  # bytes in which the beginning must be found
COMMENT_LINES = re.compile(rb"\A(?:#[^\n]*\n|\s*\n)+")  # before the header of a PCD file


def formats_table() -> str:
    """Return the table of docs/own_scans.md, in Markdown: kinds of files, and what happens."""
    lines = ["| Files | What is read | Needs |", "|---|---|---|"]
    for kind in FORMATS:
        extra = f"`[{kind.extra}]`" if kind.extra else ""
        lines.append(f"| {_listing(kind.endings)} | {kind.content} | {extra} |")

    lines += ["", "| Files that are not read | What to do |", "|---|---|"]
    for ending, (content, advice) in UNREADABLE.items():
        lines.append(f"| `{ending}`, {content} | {advice} |")
    return "\n".join(lines) + "\n"


def _listing(endings: tuple[str, ...]) -> str:
    return ", ".join(f"`{ending}`" for ending in endings)


def ending_of(path: Path) -> str:
    """Return the ending that a file should have, by its first bytes, or else by its name.

    Raises:
        InputError: if neither tells, or files of this kind are not read.
    """
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        content = "a link that leads nowhere" if is_dead_link(path) else "none"
        raise InputError(f"{path}: expected a scan file, found {content}; check the path")

    try:
        ending = _begins_as(path)
    except OSError as error:
        raise InputError(
            f"{path}: expected a file that can be read, found {error.strerror}; check it"
        ) from None
    if ending is not None:
        return ending

    named = named_ending(path)
    if find_table(path) is not None:
        return named if named in TEXT else TEXT[0]
    if named in (NUSCENES_ENDING, ".bin"):
        if is_text(path):
            raise InputError(f"{path}: expected rows of numbers, found other text; {TEXT_ADVICE}")
        return named
    if columns_of(path) is not None:
        return ".bin"
    return named or _guess_ending(path)


def _begins_as(path: Path) -> str | None:
    """Return the ending that the first bytes of a file tell; None if they do not."""
    with path.open("rb") as file:
        beginning = file.read(HEAD)
    without_comments = COMMENT_LINES.sub(b"", beginning, 1)
    for text in (beginning, without_comments):
        for known, ending in BEGINNINGS.items():
            if text.startswith(known):
                return ".npz" if ending == ".zip" and _has_arrays(path) else ending
    return None


def _has_arrays(path: Path) -> bool:
    """Return whether a zip file is one of NumPy's; a broken one is, if its name says so."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return not path.name.lower().endswith(".zip")


def _guess_ending(path: Path) -> str:
    """Return the ending that the values in a file tell, if its name does not.

    Raises:
        InputError: if they do not, or files of this kind are not read.
    """
    for ending, (content, advice) in UNREADABLE.items():
        if path.name.lower().endswith(ending):
            raise InputError(f"{path}: expected a scan file, found {content}; {advice}")

    if guess_rows(path) is not None:
        return ".bin"
    raise InputError(
        f"{path}: expected a scan file ({', '.join(ENDINGS)}), found another format; "
        "convert it to one"
    )


def named_ending(path: Path) -> str | None:
    """Return the known ending of a file's name; None if it has none."""
    for ending in ENDINGS:
        if path.name.lower().endswith(ending):
            return ending
    return None


def is_dead_link(path: Path) -> bool:
    """Return whether a path is that of a link to something that does not exist."""
    return path.is_symlink() and not path.exists()
