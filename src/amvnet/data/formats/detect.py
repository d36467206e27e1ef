"""Find scan files and bags, detect their formats, and list the scans that they hold."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from amvnet.data.formats.arrow import read_feather
from amvnet.data.formats.bags import METADATA, Bag
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.e57 import E57
from amvnet.data.formats.las import read_las
from amvnet.data.formats.numpy_files import read_npy, read_npz
from amvnet.data.formats.packets import Capture
from amvnet.data.formats.pcd import read_pcd
from amvnet.data.formats.ply import read_ply
from amvnet.data.formats.raw import NUSCENES_ENDING, columns_of, read_raw
from amvnet.data.formats.recording import Recording
from amvnet.data.formats.rows import UNKNOWN, RowLayout, guess_rows
from amvnet.data.formats.text import find_table, read_text_cloud
from amvnet.errors import InputError


@dataclass(frozen=True)
class Format:
    """A kind of scan files.

    Attributes:
        endings: of the files' names.
        content: what is read of them, for people.
        read: reads the only scan of a file; None if a file holds several.
        read_rows: reads it as rows of numbers, of which the user may say what they hold; None if
            the file says it.
        open: opens a file of several scans; None if it holds one.
        extra: the extra of the package that is needed; empty if none is.
    """

    endings: tuple[str, ...]
    content: str
    read: Callable[[Path], Cloud] | None = None
    read_rows: Callable[[Path, RowLayout], Cloud] | None = None
    open: Callable[[Path, str, str | None], Recording] | None = None
    extra: str = ""


TEXT = (".xyz", ".txt", ".csv", ".asc", ".pts")
FORMATS = (
    Format(
        (NUSCENES_ENDING, ".bin"),
        "rows of 3 to 6 float32 or float64: x, y, z, intensity (KITTI), ring (nuScenes); others "
        "with `--columns` and `--dtype`",
        read_rows=read_raw,
    ),
    Format(
        (".pcd",),
        "ascii, binary or binary_compressed; organised or not; columns of any type and order, "
        "padding",
        read=read_pcd,
    ),
    Format((".ply",), "the vertices; ascii, or binary of either byte order", read=read_ply),
    Format(
        (".npy",),
        "numbers of shape (N, 3 or more) or (H, W, 3 or more), or an array with named columns",
        read_rows=read_npy,
    ),
    Format((".npz",), "the same", read_rows=read_npz),
    Format(
        TEXT,
        "a line per point, separated by spaces, commas or semicolons; with the names of the "
        "columns or without",
        read_rows=read_text_cloud,
    ),
    Format((".las", ".laz"), "coordinates and intensity", read=read_las, extra="formats"),
    Format(
        (".bag", ".mcap", ".db3"),
        "ROS 1 and ROS 2: the PointCloud2 or Livox CustomMsg messages of one topic; also the "
        "folder of a ROS 2 bag",
        open=Bag,
        extra="formats",
    ),
    Format(
        (".feather",),
        "a table with named columns; of Argoverse 2, moved to the LiDARs by the log's calibration",
        read=read_feather,
        extra="datasets",
    ),
    Format((".e57",), "every scan, in the frame of the instrument", open=E57, extra="e57"),
    Format(
        (".pcap", ".pcapng"),
        "the packets of a Velodyne, a scan per turn; of other sensors, an error with the command "
        "that converts it",
        open=Capture,
        extra="packets",
    ),
)

# Kinds of files that are known, but not read: what they are, and what to do.
UNREADABLE = {
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


def _by_ending() -> dict[str, Format]:
    formats = {}
    for kind in FORMATS:
        for ending in kind.endings:
            formats[ending] = kind
    return formats


BY_ENDING = _by_ending()
ENDINGS = tuple(BY_ENDING)
READERS = frozenset(ending for ending, kind in BY_ENDING.items() if kind.open is None)
FOLDER = ""  # instead of an ending: the folder of a ROS 2 bag
BY_ENDING_OR_FOLDER = {**BY_ENDING, FOLDER: BY_ENDING[".bag"]}

# The first bytes of files.
BEGINNINGS = {
    b"\x93NUMPY": ".npy",
    b"PK\x03\x04": ".npz",
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
    b"\x0a\x0d\x0d\x0a": ".pcapng",
}
HEAD = 4096  # bytes in which the beginning must be found
COMMENT_LINES = re.compile(rb"\A(?:#[^\n]*\n|\s*\n)+")  # before the header of a PCD file
POSE_COLUMNS = 12  # of poses, as of KITTI: a 3 x 4 matrix in each line of a text file
KITTI_RAW = "velodyne_points/data"  # the folder of the scans of a drive of KITTI's raw data
RAW_DRIVES = ("", "*_sync/", "*_extract/", "*/*_sync/", "*/*_extract/")  # where it may lie
ARGOVERSE = "sensors/lidar"  # the folder of the scans of a log of Argoverse 2


@dataclass(frozen=True)
class NamedScan:
    """A scan in a file or a bag, not read yet.

    Attributes:
        name: unique among the scans of one input: `000000` for the file `000000.bin`,
            `drive/000000` for the first scan of the bag `drive.bag`.
        source: the same for all scans of one recording: the bag, or the folder and the ending.
        path: the file or the bag.
        ending: that the file should have, by its content (`ending_of`); empty if it is broken.
        read: reads it.
    """

    name: str
    source: str
    path: Path
    ending: str
    read: Callable[[], Cloud]


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


def find_scans(path: Path | str) -> list[Path]:
    """Return the scan files and bags that a text names, sorted by name.

    Args:
        path: a file, a folder of them, a folder of drives of KITTI's raw data or of logs of
            Argoverse 2, or a pattern such as `drive/*.bin` or `drives/**/*.pcd`. Hidden files are
            left out, and text files too if a folder has other scans.

    Raises:
        InputError: if nothing has this name, or there is no scan.
    """
    path = Path(path)
    if path.is_file() or is_bag_folder(path) or is_dead_link(path):
        return [path]
    if path.is_dir():
        paths = _scans_of_folder(path)
    elif glob.has_magic(str(path)):
        paths = _matches(str(path))
    else:
        raise InputError(
            f"{path}: expected a scan file or a folder of scans, found nothing; check the path"
        )

    if not paths:
        raise InputError(
            f"{path}: expected scan files ({', '.join(ENDINGS)}), found none in it; "
            f"{_advice_to_find(path)}"
        )
    return paths


def list_scans(
    path: Path | str, topic: str | None = None, layout: RowLayout = UNKNOWN
) -> Iterator[NamedScan]:
    """Yield the scans that a text names, as `find_scans` finds them; those of a bag in its order.

    A link that leads nowhere, and one of several files whose format cannot be told, is yielded as
    one scan, which cannot be read.

    Args:
        topic: of bags; None means the only topic with scans.
        layout: what rows of numbers without names hold, as far as the user says it.

    Raises:
        InputError: if there is no scan, or the only file has an unknown format or is a bag that
            cannot be read.
    """
    files = find_scans(path)
    folder = Path(os.path.commonpath([file.parent for file in files]))
    for file in files:
        # Files of several folders can have the same names.
        name = (file.parent.relative_to(folder) / scan_stem(file)).as_posix()
        name = name.replace(f"/{KITTI_RAW}/", "/").replace(f"/{ARGOVERSE}/", "/")
        try:
            scans = _scans_of(file, name, topic, layout)
        except InputError as error:
            if len(files) == 1 and not is_dead_link(file):
                raise
            scans = [NamedScan(name, str(file), file, "", partial(_refuse, str(error)))]
        yield from scans


def _scans_of(file: Path, name: str, topic: str | None, layout: RowLayout) -> list[NamedScan]:
    """Return the scans of a file or a bag."""
    ending = ending_of(file)
    kind = BY_ENDING_OR_FOLDER[ending]
    if kind.open is None:
        source = str(file.parent / f"*{ending}")
        return [NamedScan(name, source, file, ending, partial(_read_file, file, kind, layout))]

    recording = kind.open(file, ending, topic)
    scans = []
    for index in range(len(recording)):
        read = partial(recording.read, index)
        scans.append(NamedScan(f"{name}/{index:06d}", str(file), file, ending, read))
    return scans


def _refuse(message: str) -> Cloud:
    raise InputError(message)


def read_cloud(path: Path | str, layout: RowLayout = UNKNOWN) -> Cloud:
    """Read the only scan of a file.

    Args:
        layout: what rows of numbers without names hold, as far as the user says it.

    Raises:
        InputError: if the file is missing, of another format, broken, or a bag of several scans.
    """
    path = Path(path)
    ending = ending_of(path)
    kind = BY_ENDING_OR_FOLDER[ending]
    if kind.open is None:
        return _read_file(path, kind, layout)
    recording = kind.open(path, ending, None)
    if len(recording) > 1:
        raise InputError(
            f"{path}: expected one scan, found {len(recording)}; segment it with amvnet predict"
        )

    return recording.read(0)


def _read_file(path: Path, kind: Format, layout: RowLayout) -> Cloud:
    if kind.read_rows is not None:
        return kind.read_rows(path, layout)
    assert kind.read is not None
    return kind.read(path)


def _scans_of_folder(folder: Path) -> list[Path]:
    """Return the scans that a folder stands for."""
    # The other files of a log are tables, too.
    if (folder / ARGOVERSE).is_dir():
        return _scans_in(folder / ARGOVERSE)
    return _scans_in(folder) or _drives_in(folder)


def _scans_in(folder: Path) -> list[Path]:
    """Return the scans of a folder; its text files only if there are no others."""
    paths = sorted(filter(is_scan_file, folder.iterdir()))
    if paths:
        return paths
    texts = [path for path in sorted(folder.iterdir()) if path.name.lower().endswith(TEXT)]
    return [path for path in texts if _is_text_scan(path)]


def _drives_in(folder: Path) -> list[Path]:
    """Return the scans of the recordings in a folder: drives of KITTI, logs of Argoverse 2."""
    patterns = [drives + KITTI_RAW for drives in RAW_DRIVES]
    paths: list[Path] = []
    for pattern in (*patterns, f"*/{ARGOVERSE}"):
        for data in sorted(folder.glob(pattern)):
            paths += _scans_in(data)
    return paths


def _matches(pattern: str) -> list[Path]:
    """Return the scans that match a pattern, and those of the folders that match."""
    paths: list[Path] = []
    unnamed: list[Path] = []
    for text in sorted(glob.glob(pattern, recursive=True)):
        path = Path(text)
        if is_scan_file(path) or _is_text_scan(path):
            paths.append(path)
        elif path.is_dir() and "**" not in pattern:
            paths += _scans_of_folder(path)
        elif path.is_file():
            unnamed.append(path)
    return paths or unnamed


def _advice_to_find(path: Path) -> str:
    """Return what to do if there is no scan in a folder."""
    for pattern in ("*/*", "*/*/*"):
        for deeper in sorted(path.glob(pattern)):
            if is_scan_file(deeper) and not deeper.parent.name.startswith("."):
                return f"give the folder of scans, such as {deeper.parent}"
    return "give the folder of scans"


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

    named = _named_ending(path)
    if find_table(path) is not None:
        return named if named in TEXT else TEXT[0]
    if named in (NUSCENES_ENDING, ".bin"):
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
                return ending
    return None


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


def _named_ending(path: Path) -> str | None:
    for ending in ENDINGS:
        if path.name.lower().endswith(ending):
            return ending
    return None


def is_dead_link(path: Path) -> bool:
    """Return whether a path is that of a link to something that does not exist."""
    return path.is_symlink() and not path.exists()


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    if not (path / METADATA).is_file():
        return False
    return any(path.glob("*.db3*")) or any(path.glob("*.mcap*"))


def is_scan_file(path: Path) -> bool:
    """Return whether a name in a folder is that of a scan or a bag, and not of predictions.

    Text files hold anything, so their names do not tell.
    """
    if path.name.startswith(".") or path.name.endswith(".uncertain.npy"):
        return False
    if path.suffix == ".npz" and path.with_suffix(".label").exists():
        return False
    if path.is_dir():
        return is_bag_folder(path)
    name = path.name.lower()
    return name.endswith(ENDINGS) and not name.endswith(TEXT)


def _is_text_scan(path: Path) -> bool:
    """Return whether a path is that of a text file with points, and not with poses."""
    is_text = path.name.lower().endswith(TEXT) and not path.name.startswith(".")
    if not is_text or not path.is_file():
        return False
    table = find_table(path)
    return table is not None and (bool(table.names) or table.count != POSE_COLUMNS)


def scan_stem(path: Path) -> str:
    """Return a scan file's name without its ending, also without `.pcd.bin`."""
    name = path.absolute().name if path.name in ("", "..") else path.name
    if path.is_dir():
        return name
    ending = _named_ending(path.with_name(name)) or path.suffix
    return name.removesuffix(name[len(name) - len(ending) :]) if ending else name
