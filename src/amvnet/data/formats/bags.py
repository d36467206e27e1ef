"""Read scans from ROS bags (ROS 1, ROS 2, mcap) with rosbags: the messages of one topic."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from amvnet.data.formats.cloud import Cloud, reading
from amvnet.data.formats.detect import FOLDER
from amvnet.data.formats.pointcloud2 import CLOUD_TYPE, read_message
from amvnet.data.formats.reader_process import DISK, DISK_PER_BYTE, size_of
from amvnet.errors import InputError

LISTED_TOPICS = 10  # largest number of topics that an error message lists

TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"

CHUNK = 1 << 20  # the bytes that are unpacked at a time
MIN_MESSAGE = 16  # the smallest size of a message in a bag, even if it is compressed, bytes
EXPECTED = "a ROS bag"
ADVICE = "repair it with ROS's own tools (rosbag reindex, ros2 bag reindex), or copy it again"


class Bag:
    """The scans of one topic of a bag, ordered by time; only one scan at a time is in memory.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        ending: the storage format: `.bag`, `.mcap`, `.db3`, or empty for a folder.
        topic: the topic of the scans; by default the only topic with PointCloud2.

    Raises:
        InputError: if the bag cannot be read, has no such topic, or, without `topic`, has several
            topics with scans.
    """

    def __init__(self, path: Path, ending: str, topic: str | None = None) -> None:
        with reading(path, EXPECTED, ADVICE):
            if ending == FOLDER:
                _check_unpacked(path)
            with closing(open_reader(path, ending)) as reader:
                topic, count = _choose_topic(reader.connections, topic, path)

        if not 0 < count <= size_of(path) // MIN_MESSAGE:
            raise InputError(
                f"{path}: expected scans under {topic}, found {count} messages; {ADVICE}"
            )
        self._path = path
        self._ending = ending
        self._topic = topic
        self._count = count

        # Scans are read in order: `_rest` yields the messages from the index `_next` on.
        self._next = 0
        self._rest: Iterator[bytes] = iter(())

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> Cloud:
        """Read the scan with an index; reading in order is fastest.

        Raises:
            InputError: if the scan is broken.
        """
        if index != self._next or self._next == 0:
            self._next = 0
            self._rest = self._messages()

        name = f"{self._path} ({self._topic}, {index})"
        with reading(name, "a scan", ADVICE):
            for data in self._rest:
                self._next += 1
                if self._next > index:
                    if self._next == self._count:
                        self._rest = iter(())  # closes the file
                    return self._decode(data, name)

        raise InputError(f"{name}: expected {self._count} scans, found {self._next}; {ADVICE}")

    def headers(self) -> tuple[NDArray[np.float64], str]:
        """Return the time stamp of each scan (N,) in seconds, and the frame of the first scan.

        Only headers are decoded, so that scans with broken points have a time, too.

        Raises:
            InputError: if there are more or fewer scans than the bag states, or a header is broken.
        """
        times = []
        frames: list[str] = []
        with reading(self._path, "scans with headers", ADVICE):
            for data in self._messages():
                # In ROS 1, a number comes first, and in ROS 2, two bytes that tell the byte order.
                order = "<" if self._ending == ".bag" or data[1] else ">"
                seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
                times.append(seconds + nanoseconds * 1e-9)
                frames = frames or [bytes(data[16 : 16 + length]).rstrip(b"\0").decode()]
        if len(times) != self._count:
            raise InputError(
                f"{self._path}: expected {self._count} scans, found {len(times)}; {ADVICE}"
            )
        return np.array(times), frames[0]

    def _messages(self) -> Iterator[bytes]:
        with closing(open_reader(self._path, self._ending)) as reader:
            connections = _with_scans(reader.connections)
            chosen = [connection for connection in connections if connection.topic == self._topic]
            for _, _, data in reader.messages(connections=chosen):
                yield data

    def _decode(self, data: bytes, name: str) -> Cloud:
        return read_message(deserialiser(self._ending == ".bag")(data, CLOUD_TYPE), name)


def open_reader(path: Path, ending: str) -> Any:
    """Open a bag with rosbags; `ending` decides the format, not the name of the file."""
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    def open_database(path: Path) -> Sqlite3Reader:
        # rosbags makes a URI from the path, in which #, ? and % have a meaning.
        return Sqlite3Reader(Path(quote(str(path))))

    readers: dict[str, Callable[[Path], Any]] = {
        ".bag": Reader,
        ".mcap": McapReader,
        ".db3": open_database,
        FOLDER: DirectoryReader,
    }

    reader = readers[ending](path)
    if ending == FOLDER:
        reader.STORAGE_PLUGINS = {"mcap": McapReader, "sqlite3": open_database}
    reader.open()
    return reader


def _check_unpacked(folder: Path) -> None:
    """Raise InputError if the compressed files of a bag would fill the disk.

    rosbags unpacks all files when it opens the bag, and the limits of the process apply to each
    file alone.
    """
    from rosbags.rosbag2.reader import zstd

    limit = DISK + DISK_PER_BYTE * size_of(folder)

    unpacked = 0
    for path in sorted(folder.glob("*.zstd")):
        with zstd.open(path, "rb") as file:
            while chunk := file.read(CHUNK):
                unpacked += len(chunk)
                if unpacked > limit:
                    raise InputError(
                        f"{folder}: expected at most {limit >> 20} MB of unpacked files, found "
                        f"more; {ADVICE}"
                    )


@cache
def deserialiser(is_ros1: bool) -> Callable[[bytes, str], Any]:
    """Return rosbags' function that reads a message of ROS 1 or ROS 2, given its bytes and type."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not is_ros1:  # alike in every storage format
        return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    types = get_typestore(Stores.ROS1_NOETIC)  # has no package tf2_msgs
    types.register(get_types_from_msg(TF_DEFINITION, TF_TYPE))
    return types.deserialize_ros1


def _with_scans(connections: Iterable[Any]) -> list[Any]:
    return [connection for connection in connections if connection.msgtype == CLOUD_TYPE]


def _choose_topic(connections: Iterable[Any], topic: str | None, path: Path) -> tuple[str, int]:
    """Return the topic to read and its number of scans; by default the only topic with scans."""
    counts: dict[str, int] = {}
    for connection in _with_scans(connections):
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    if topic is None and len(counts) == 1:
        (topic,) = counts
    if topic in counts:
        return topic, counts[topic]

    expected = topic or "one topic"
    if counts:
        listing = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
        raise InputError(
            f"{path}: expected {expected} with PointCloud2, found {listing}; choose one with "
            "--topic"
        )

    others = [f"{other.topic} ({other.msgtype})" for other in connections]
    raise InputError(
        f"{path}: expected {expected} with PointCloud2, found "
        f"{', '.join(others[:LISTED_TOPICS]) or 'no topic'}; give a bag with scans, or play this "
        "bag with the driver of the sensor running, and record the PointCloud2 topic that the "
        "driver publishes"
    )
