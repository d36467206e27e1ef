"""Write the labels of a bag's scans as a bag: PointCloud2 messages with the stamps of the scans.

Each scan is written as a part of its own, so that an interrupted run can go on; the parts become
the bag at the end.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from amvnet.data.formats.bags import types_of
from amvnet.data.formats.cloud import Message
from amvnet.data.formats.pointcloud2 import CLOUD_TYPE
from amvnet.data.labels.messages import encode_labels
from amvnet.data.labels.writers import LabelledPoints
from amvnet.files import atomic_write, inside, make_folder, publish

Kind = Literal["bag", "mcap"]
KINDS: tuple[Kind, ...] = get_args(Kind)
JOINED = "joined"  # folder of a bag that is being written
SUFFIX = "/labels"  # after the topic of the scans


def bag_path(name: str, kind: str) -> Path:
    """Return the path of the bag with the labels of a scan, relative to a folder of predictions.

    Args:
        name: of the scan, such as `drive/000012`.
        kind: one of `KINDS`.
    """
    return Path(f"{Path(name).parent}.{kind}")


def part_path(name: str, kind: str) -> Path:
    """Return the path of the part of the bag with the labels of one scan, as `bag_path` does."""
    return _parts(bag_path(name, kind)) / f"{Path(name).name}.npz"


def write_part(
    folder: Path, name: str, kind: str, message: Message, points: LabelledPoints
) -> Path:
    """Write the labels of one scan as a part of the bag, and return its path.

    Args:
        name: of the scan, such as `drive/000012`.
        kind: the bag, one of `KINDS`.
    """
    store = types_of(is_ros1=kind == "bag")
    values = encode_labels(store.types, message, points)
    serialise = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
    data = np.frombuffer(serialise(values, CLOUD_TYPE), np.uint8)

    path = inside(folder, part_path(name, kind))
    with atomic_write(path) as part:
        np.savez(part, time=message.time, topic=message.topic + SUFFIX, data=data)
    return path


def join_parts(folder: Path, names: Sequence[str], kind: str) -> list[Path]:
    """Join the parts of each bag, in the order of the scans.

    The parts are removed if none is missing, so that a later run can add what is.

    Args:
        kind: one of `KINDS`.

    Returns:
        The paths of the bags, relative to the folder.
    """
    # Only the parts of these scans: a run that was killed may have left those of others.
    parts_by_bag: dict[Path, list[Path]] = {}
    for name in names:
        part = folder / part_path(name, kind)
        parts_by_bag.setdefault(bag_path(name, kind), []).append(part)

    written = []
    for path, all_parts in parts_by_bag.items():
        parts = list(filter(Path.is_file, all_parts))
        if parts:
            _write_bag(inside(folder, path), parts, kind)
            written.append(path)
        if parts == all_parts:
            shutil.rmtree(inside(folder, _parts(path)))
    return written


def _parts(bag: Path) -> Path:
    """Return the folder of the parts of a bag."""
    return bag.with_name(f".{bag.name}.parts")


def _write_bag(path: Path, parts: Sequence[Path], kind: str) -> None:
    """Write a bag of the parts; it appears whole or not at all."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    # Next to the parts, so that the next run replaces what a run that was killed has left.
    folder = parts[0].parent / JOINED
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    try:
        bag = folder / "labels.bag"
        if kind == "bag":
            _write_messages(Writer1(bag), parts, kind)
        else:
            _write_messages(Writer2(bag, version=9, storage_plugin=StoragePlugin.MCAP), parts, kind)
            (bag,) = bag.glob("*.mcap")
        publish(bag, path)
    finally:
        shutil.rmtree(folder)


def _write_messages(writer: Any, parts: Sequence[Path], kind: str) -> None:
    connections: dict[str, Any] = {}
    with writer:
        for part in parts:
            with np.load(part, allow_pickle=False) as arrays:
                topic = str(arrays["topic"])
                time = int(arrays["time"])
                data = arrays["data"].tobytes()
            if topic not in connections:
                types = types_of(is_ros1=kind == "bag")
                connections[topic] = writer.add_connection(topic, CLOUD_TYPE, typestore=types)
            writer.write(connections[topic], time, data)
