"""Find scan files and bags, detect their formats, and list the scans that they hold."""

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
FOLDER = ""  # instead of an ending: the folder of a ROS 2 bag
# The first bytes of files.
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
}


@dataclass(frozen=True)
class NamedScan:
    """A scan in a file or a bag, not read yet.

    Attributes:
        name: unique among the scans of one input: `000000` for the file `000000.bin`,
            `drive/000000` for the first scan of the bag `drive.bag`.
        source: the same for all scans of one recording: the bag, or the folder and the ending.
        path: the file or the bag.
        read: reads it.
    """

    name: str
    source: str
    path: Path
    read: Callable[[], Cloud]


def find_scans(path: Path | str) -> list[Path]:
    """Return the scan files and bags of a folder, sorted by name; only the path if it is a file.

    Hidden files are left out.

    Raises:
        InputError: if the path does not exist, or the folder has no scan.
    """
    path = Path(path)
    if path.is_file() or is_bag_folder(path):
        return [path]
    if not path.is_dir():
        raise InputError(
            f"{path}: expected a scan file or a folder of scans, found nothing; check the path"
        )

    paths = sorted(filter(is_scan_file, path.iterdir()))
    if not paths:
        raise InputError(
            f"{path}: expected scan files ({', '.join(ENDINGS)}), found none in it; "
            "give the folder of scans"
        )
    return paths


def list_scans(path: Path | str, topic: str | None = None) -> Iterator[NamedScan]:
    """Yield the scans of a file, a bag, or a folder of these; those of a bag in order of time.

    Args:
        topic: of bags; None means the only topic with PointCloud2 messages.

    Raises:
        InputError: if there is no scan, a format cannot be told, or a bag cannot be read.
    """
    for file in find_scans(path):
        ending = ending_of(file)
        name = scan_stem(file)
        if ending in READERS:
            source = str(file.parent / f"*{ending}")
            yield NamedScan(name, source, file, partial(READERS[ending], file))
            continue
        bag = Bag(file, ending, topic)
        for index in range(len(bag)):
            yield NamedScan(f"{name}/{index:06d}", str(file), file, partial(bag.read, index))


def read_cloud(path: Path | str) -> Cloud:
    """Read the only scan of a file.

    Raises:
        InputError: if the file is missing, of another format, broken, or a bag of several scans.
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


def ending_of(path: Path) -> str:
    """Return the ending that a file should have, by its first bytes, or else by its name.

    Raises:
        InputError: if neither tells.
    """
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        raise InputError(f"{path}: expected a scan file, found none; check the path")

    with path.open("rb") as file:
        beginning = file.read(max(map(len, BEGINNINGS)))
    for known, ending in BEGINNINGS.items():
        if beginning.startswith(known):
            return ending

    named = _named_ending(path)
    if columns_of(path) is not None:
        return named if named in (NUSCENES_ENDING, ".bin") else ".bin"
    if named is None:
        raise InputError(
            f"{path}: expected a scan file ({', '.join(ENDINGS)}), found another format; "
            "convert it to one"
        )
    return named


def _named_ending(path: Path) -> str | None:
    for ending in ENDINGS:
        if path.name.lower().endswith(ending):
            return ending
    return None


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    if not (path / METADATA).is_file():
        return False
    return any(path.glob("*.db3*")) or any(path.glob("*.mcap*"))


def is_scan_file(path: Path) -> bool:
    """Return whether a name in a folder is that of a scan or a bag, and not of predictions."""
    if path.name.startswith(".") or path.name.endswith(".uncertain.npy"):
        return False
    if path.suffix == ".npz" and path.with_suffix(".label").exists():
        return False
    return is_bag_folder(path) if path.is_dir() else path.name.lower().endswith(ENDINGS)


def scan_stem(path: Path) -> str:
    """Return a scan file's name without its ending, also without `.pcd.bin`."""
    name = path.absolute().name if path.name in ("", "..") else path.name
    if path.is_dir():
        return name
    ending = _named_ending(path.with_name(name)) or path.suffix
    return name.removesuffix(name[len(name) - len(ending) :]) if ending else name
