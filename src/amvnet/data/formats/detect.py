"""Which format a scan file has, by what is in it, and the scans that a file holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from amvnet.data.formats.bags import METADATA, Bag
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.las import read_las
from amvnet.data.formats.numpy_files import read_npy, read_npz
from amvnet.data.formats.pcd import read_pcd
from amvnet.data.formats.ply import read_ply
from amvnet.data.formats.raw import NUSCENES_ENDING, columns_of, read_raw
from amvnet.errors import InputError

READERS: dict[str, Callable[[Path], Cloud]] = {
    NUSCENES_ENDING: read_raw,
    ".bin": read_raw,
    ".npy": read_npy,
    ".npz": read_npz,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
}
BAGS = (".bag", ".mcap", ".db3")
ENDINGS = (*READERS, *BAGS)
FOLDER = ""  # in place of an ending: the folder of a ROS 2 bag
BEGINNINGS = {
    b"\x93NUMPY": ".npy",
    b"PK\x03\x04": ".npz",
    b"# .PCD": ".pcd",
    b"VERSION": ".pcd",
    b"FIELDS": ".pcd",
    b"ply\n": ".ply",
    b"ply\r": ".ply",
    b"LASF": ".las",
    b"#ROSBAG": ".bag",
    b"\x89MCAP0\r\n": ".mcap",
    b"SQLite format 3\x00": ".db3",
}  # of files


@dataclass(frozen=True)
class NamedScan:
    """A scan that is not read yet.

    Attributes:
        name: unique among the scans of one input: `000000` of a file `000000.bin`, `drive/000000` of a bag `drive.bag`.
        source: tells the scans of one recording from others: the bag, or the folder and the ending.
        read: reads it.
    """

    name: str
    source: str
    read: Callable[[], Cloud]


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (path / METADATA).is_file() and any(
        any(path.glob(f"*{ending}*")) for ending in (".db3", ".mcap")
    )


def is_scan_file(path: Path) -> bool:
    """Whether the name of a file in a folder says that it is a scan or a bag, and not what was found of one."""
    if path.name.startswith(".") or path.name.endswith(".uncertain.npy"):
        return False
    if path.suffix == ".npz" and path.with_suffix(".label").exists():
        return False
    return is_bag_folder(path) if path.is_dir() else path.name.lower().endswith(ENDINGS)


def ending_of(path: Path) -> str:
    """The ending that a file should have, by its first bytes, or else by its name.

    Raises:
        InputError: where neither says it.
    """
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        raise InputError(f"{path}: expected a scan file, found none; check the path")
    with path.open("rb") as file:
        begin = file.read(max(map(len, BEGINNINGS)))
    for known, ending in BEGINNINGS.items():
        if begin.startswith(known):
            return ending
    named = next((ending for ending in ENDINGS if path.name.lower().endswith(ending)), None)
    if columns_of(path) is not None:
        return named if named in (NUSCENES_ENDING, ".bin") else ".bin"
    if named is None:
        raise InputError(
            f"{path}: expected a scan file ({', '.join(ENDINGS)}), found another format; convert it to one"
        )
    return named


def read_cloud(path: Path | str) -> Cloud:
    """Read the one scan of a file.

    Raises:
        InputError: where the file is missing, of another format, broken, or a bag of several scans.
    """
    path = Path(path)
    ending = ending_of(path)
    if ending in READERS:
        return READERS[ending](path)
    bag = Bag(path, ending)
    if len(bag) > 1:
        raise InputError(
            f"{path}: expected one scan, found a bag of {len(bag)}; segment it with amvnet predict"
        )
    return bag.read(0)


def scans_in_file(path: Path, topic: str | None = None) -> Iterator[NamedScan]:
    """The scans of a file: itself, or those of a bag, in order of time.

    Args:
        topic: of a bag; by default its only one with PointCloud2.

    Raises:
        InputError: where the format cannot be told, or a bag not be read.
    """
    ending = ending_of(path)
    if ending in READERS:
        yield NamedScan(
            scan_stem(path), str(path.parent / f"*{ending}"), lambda: READERS[ending](path)
        )
        return
    bag = Bag(path, ending, topic)
    for place in range(len(bag)):
        yield NamedScan(f"{scan_stem(path)}/{place:06d}", str(path), partial(bag.read, place))


def scan_stem(path: Path) -> str:
    """A scan file's name without its ending, `.pcd.bin` included."""
    name = path.absolute().name if path.name in ("", "..") else path.name
    found = next((ending for ending in ENDINGS if name.lower().endswith(ending)), path.suffix)
    return name if path.is_dir() or not found else name[: -len(found)]
