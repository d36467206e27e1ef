"""Detect the format of a scan file from its first bytes or, failing that, from its name."""

from __future__ import annotations

import re
from pathlib import Path

from amvnet.data.formats.raw import NUSCENES_ENDING
from amvnet.data.formats.text import find_table, read_head
from amvnet.errors import InputError

TEXT = (".xyz", ".txt", ".csv", ".asc", ".pts")
BAGS = (".bag", ".mcap", ".db3")
FOLDER = ""  # the ending of a ROS 2 bag that is a folder
GZIP = ".gz"  # follows the ending of a compressed scan file
METADATA = "metadata.yaml"  # a file in the folder of every ROS 2 bag
# The endings of all files that are read. docs/own_scans.md says what is read from each kind.
ENDINGS = (
    *(NUSCENES_ENDING, ".bin", ".pcd", ".ply", ".npy", ".npz"),
    *TEXT,
    *(".las", ".laz", ".feather"),
    *BAGS,
)

# The ending of a file by its first bytes.
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
    b"\x1f\x8b": GZIP,
}
# What a file is that no reader takes, by its first bytes and by the end of its name.
STRANGERS = {
    b"\x89PNG\r\n": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF-": "a PDF document",
}
LABELS = (".label", "_lidarseg.bin", "_panoptic.npz")  # ends of names that the benchmarks write
BEGINNING = 4096  # the bytes at the start of a file that may hold comments and its first bytes
COMMENT_LINES = re.compile(rb"\A(?:#[^\n]*\n|\s*\n)+")  # may precede the header of a PCD file


def ending_of(path: Path) -> str:
    """Return the ending that a file should have, from its first bytes or, failing that, its name.

    Raises:
        InputError: if neither the bytes nor the name tell the format.
    """
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        found = "a link that leads nowhere" if is_dead_link(path) else "none"
        raise InputError(f"{path}: expected a scan file, found {found}; check the path")

    try:
        head = read_head(path)
    except OSError as error:
        raise InputError(
            f"{path}: expected a file that can be read, found {error.strerror}; check it"
        ) from None

    kinds = [kind for beginning, kind in STRANGERS.items() if head.startswith(beginning)]
    if path.name.lower().endswith(LABELS):
        kinds.append("labels")
    for kind in kinds:
        raise InputError(f"{path}: expected a scan file, found {kind}; give the file of the points")

    ending = _begins_as(head[:BEGINNING])
    named = named_ending(path)
    if ending is not None:
        if ending == ".npz" and path.suffix.lower() == ".zip":
            raise InputError(f"{path}: expected a scan file, found an archive; unzip it")
        return ending

    if find_table(head) is not None:
        return named if named in TEXT else TEXT[0]

    if named is None:
        raise InputError(
            f"{path}: expected a scan file ({', '.join(ENDINGS)}), found another format; convert "
            "it to one of these, or play the packets of a sensor with its driver and record "
            "PointCloud2 in a bag"
        )
    return named


def _begins_as(beginning: bytes) -> str | None:
    """Return the ending of files with these first bytes; None if no format has them."""
    without_comments = COMMENT_LINES.sub(b"", beginning, 1)
    for text in (beginning, without_comments):
        for known, ending in BEGINNINGS.items():
            if text.startswith(known):
                return ending
    return None


def named_ending(path: Path) -> str | None:
    """Return the ending of a file's name if it is one of `ENDINGS`, else None.

    Return `.gz` if the name without it belongs to a file of one scan.
    """
    name = path.name.lower()
    if name.endswith(GZIP):
        packed = named_ending(Path(name.removesuffix(GZIP)))
        return None if packed in (None, GZIP, *BAGS, *TEXT) else GZIP
    for ending in ENDINGS:
        if name.endswith(ending):
            return ending
    return None


def is_dead_link(path: Path) -> bool:
    """Return whether a path is a link to something that does not exist."""
    return path.is_symlink() and not path.exists()


def scan_stem(path: Path) -> str:
    """Return a scan file's name without its ending, such as `.pcd.bin`."""
    name = path.absolute().name if path.name in ("", "..") else path.name
    if path.is_dir():
        return name
    ending = named_ending(Path(name)) or path.suffix
    stem = name[: len(name) - len(ending)]
    return scan_stem(path.with_name(stem)) if ending == GZIP else stem
