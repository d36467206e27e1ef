"""Find scan files and bags, and list the scans that they hold."""

from __future__ import annotations

import glob
import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from amvnet.data.formats import detect
from amvnet.data.formats.bag_poses import BagPoses
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.registry import open_bag, read_file
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.formats.text import find_comma_table, find_table, read_head
from amvnet.data.recordings import Recording, ScanFile
from amvnet.errors import InputError

ANY_FOLDERS = "**"  # the part of a pattern that stands for any folders
POSE_COLUMNS = 12  # the numbers in a line of KITTI's files of poses, a 3 x 4 matrix


def find_scans(path: Path | str) -> list[Path]:
    """Return the scan files and bags that a path names, sorted by name.

    Args:
        path: a file, a folder of files, or a pattern such as `drive/*.bin` or `drives/**/*.pcd`.
            Hidden files are left out. Text files are left out if the folder has other scans.

    Raises:
        InputError: if nothing has this name, or there is no scan.
    """
    path = Path(path)
    if path.is_file() or is_bag_folder(path) or detect.is_dead_link(path):
        return [path]

    if path.is_dir():
        paths = _scans_in(path)
    elif glob.has_magic(str(path)):
        paths = _matches(str(path))
    else:
        raise InputError(
            f"{path}: expected a scan file or a folder of scans, found nothing; check the path"
        )

    if not paths:
        raise InputError(
            f"{path}: expected scan files ({', '.join(detect.ENDINGS)}), found none in it; "
            f"{_advice_to_find(path)}"
        )
    return paths


def list_scans(
    path: Path | str,
    topic: str | None = None,
    layout: RowLayout = UNKNOWN,
    is_alone: bool = True,
    folders: dict[str, Recording] | None = None,
) -> Iterator[ScanFile]:
    """Yield the scans of the files that `find_scans` finds. A bag's scans keep their order.

    If one of several files cannot be opened, or is a link that leads nowhere, it is yielded as a
    scan, and reading this scan raises the error.

    Args:
        topic: the topic to read in bags; by default the only one with scans.
        is_alone: whether the user names no other path.
        folders: the recordings of earlier calls; scans of the same folders and endings join them.

    Raises:
        InputError: if there is no scan, or the only file has an unknown format or is a bag that
            cannot be read.
    """
    files = find_scans(path)
    folder = Path(os.path.commonpath([file.parent for file in files]))
    folders = {} if folders is None else folders
    for file in files:
        # Files in different folders can have the same name.
        name = (file.parent.relative_to(folder) / detect.scan_stem(file)).as_posix()

        try:
            scans = _scans_of(file, name, topic, layout, folders)
        except InputError as error:
            if is_alone and len(files) == 1 and not detect.is_dead_link(file):
                raise
            refuse = partial(_refuse, str(error))
            recording = Recording(str(file))
            scans = [ScanFile(name, recording, file, prediction=f"{name}.label", read=refuse)]
        for scan in scans:
            scan.recording.scans.append(scan)
            yield scan


def read_cloud(path: Path | str, layout: RowLayout = UNKNOWN) -> Cloud:
    """Read the only scan that a path names; raise InputError if there are several."""
    scans = list(list_scans(path, layout=layout))
    if len(scans) > 1:
        raise InputError(
            f"{path}: expected one scan, found {len(scans)}; segment it with amvnet predict"
        )
    return scans[0].read()


def _scans_of(
    file: Path,
    name: str,
    topic: str | None,
    layout: RowLayout,
    folders: dict[str, Recording],
) -> list[ScanFile]:
    ending = detect.ending_of(file)
    if ending not in (detect.FOLDER, *detect.BAGS):
        read = partial(read_file, file, ending, layout)
        source = str(file.parent / f"*{ending}")
        if ending == detect.GZIP:
            ending = detect.named_ending(Path(file.name.lower().removesuffix(detect.GZIP))) or ""
            source = str(file.parent / f"*{ending}{detect.GZIP}")
        recording = folders.setdefault(source, Recording(source))
        place = f"{name}.label"
        return [ScanFile(name, recording, file, prediction=place, ending=ending, read=read)]

    recording = Recording(str(file))
    poses = BagPoses(file, ending, topic)
    scans = []
    for index, read_one in enumerate(open_bag(file, ending, topic)):
        title = f"{name}/{index:06d}"
        scan = ScanFile(title, recording, file, ending=ending, read=read_one, bag=poses)
        scans.append(replace(scan, prediction=f"{scan.name}.label"))
    return scans


def _refuse(message: str) -> Cloud:
    raise InputError(message)


def _scans_in(folder: Path) -> list[Path]:
    """Return the scans of a folder. Text files count only if there are no other scans."""
    paths = sorted(filter(is_scan_file, folder.iterdir()))
    return paths or sorted(filter(_is_text_scan, folder.iterdir()))


def _matches(pattern: str) -> list[Path]:
    """Return the scans that match a pattern, and the scans in folders that match it."""
    paths: list[Path] = []
    for path in matching(Path(pattern)):
        if is_scan_file(path) or _is_text_scan(path):
            paths.append(path)
        elif path.is_dir() and "**" not in pattern:
            paths += _scans_in(path)

    return paths


def matching(pattern: Path) -> list[Path]:
    """Return the paths that match a pattern, sorted; `**` also follows links to folders."""
    parts = pattern.parts
    has_several = parts.count(ANY_FOLDERS) > 1
    folders = {Path()}
    while ANY_FOLDERS in parts:
        index = parts.index(ANY_FOLDERS)
        tops = _matching_in(folders, parts[:index])
        folders = {folder for top in tops for folder in _folders_below(top)}
        parts = parts[index + 1 :] or ("*",)
        if has_several:  # many ways may lead to a folder: take the shortest one
            ways = sorted(folders, key=lambda way: (len(way.parts), way), reverse=True)
            folders = set({way.resolve(): way for way in ways}.values())
    return sorted(_matching_in(folders, parts))


def _matching_in(folders: Iterable[Path], parts: Sequence[str]) -> set[Path]:
    """Return the paths in some folders that match the parts of a pattern, without `**`."""
    paths: set[Path] = set()
    for folder in folders:
        # The folder is a name, not a pattern, whatever characters it has.
        pattern = Path(glob.escape(str(folder))).joinpath(*parts)
        paths.update(map(Path, glob.glob(str(pattern))))
    return paths


def _folders_below(top: Path) -> list[Path]:
    """Return a folder and all folders below it, each once, without hidden folders; links come last.

    A link may lead to a folder that contains it, or that is listed already.
    """
    seen: set[Path] = set()
    folders = []
    waiting = deque([top])
    links: deque[Path] = deque()
    while waiting or links:
        folder = waiting.popleft() if waiting else links.popleft()
        if not folder.is_dir() or folder.resolve() in seen:
            continue
        seen.add(folder.resolve())
        folders.append(folder)
        with suppress(OSError):  # a folder that may not be read
            for child in sorted(folder.iterdir()):
                if child.is_dir() and not child.name.startswith("."):
                    (links if child.is_symlink() else waiting).append(child)
    return folders


def _advice_to_find(path: Path) -> str:
    if any(path.glob("*.label")):
        return "it holds labels, give the folder of the points"
    for pattern in ("*/*", "*/*/*"):
        deeper = sorted(filter(is_scan_file, path.glob(pattern)), reverse=True)
        first = {file.parent: file for file in deeper if not file.parent.name.startswith(".")}
        for folder in sorted(first):
            with suppress(InputError):  # arrays of labels have the names of scans
                next(list_scans(first[folder])).read()
                return f"give the folder of scans, such as {folder}"
    return "give the folder of scans"


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    if not (path / detect.METADATA).is_file():
        return False
    return any(path.glob("*.db3*")) or any(path.glob("*.mcap*"))


def is_scan_file(path: Path) -> bool:
    """Return whether a path is a scan or a bag. A file of predictions is neither."""
    if path.suffix == ".npz" and path.with_suffix(".label").exists():
        return False
    if path.is_dir():
        return is_bag_folder(path) and not path.name.startswith(".")
    return is_scan_name(path.name)


def is_scan_name(name: str) -> bool:
    """Return whether a scan or a bag has such a name; false for text files, which hold anything."""
    if name.startswith(".") or name.endswith(".uncertain.npy"):
        return False
    ending = detect.named_ending(Path(name))
    return ending is not None and ending not in detect.TEXT


def _is_text_scan(path: Path) -> bool:
    """Return whether a path is a text file of points; files of poses are not."""
    is_text = path.name.lower().endswith(detect.TEXT) and not path.name.startswith(".")
    if not is_text or not path.is_file():
        return False
    head = read_head(path)
    # Reading a file with decimal commas raises an error that says what to do.
    table = find_table(head) or find_comma_table(head)
    return table is not None and (bool(table.names) or table.count != POSE_COLUMNS)
