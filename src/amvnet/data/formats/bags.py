"""The scans of ROS bags (ROS 1, ROS 2, mcap), by rosbags: the PointCloud2 messages of one topic, one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from amvnet.data.formats.cloud import Cloud, refusing
from amvnet.data.formats.pointcloud2 import read_message
from amvnet.errors import InputError

TYPE = "sensor_msgs/msg/PointCloud2"
METADATA = "metadata.yaml"  # in the folder of a ROS 2 bag
SMALLEST = 16  # bytes of a bag for each message that it claims, compressed ones too
EXPECTED, ADVICE = (
    "a ROS bag",
    "mend it with ROS's own tools (rosbag reindex, ros2 bag reindex), or copy it again",
)


class Bag:
    """The scans of one topic of a bag, in order of time. One message is held at a time.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        ending: what its storage is: `.bag`, `.mcap`, `.db3`, or nothing for a folder.
        topic: of the scans; None is the only one with PointCloud2.

    Raises:
        InputError: where it cannot be read, or the topic is not clear.
    """

    def __init__(self, path: Path, ending: str, topic: str | None = None) -> None:
        self.path, self._ending = path, ending
        with refusing(path, EXPECTED, ADVICE), _opened(path, ending) as reader:
            self.topic = _choose(_topics(reader), topic, path)
            self._count = sum(c.msgcount for c in _connections(reader, self.topic))
        if not 0 < self._count <= _size(path) // SMALLEST:
            raise InputError(
                f"{path}: expected scans under {self.topic}, found {self._count} messages; {ADVICE}"
            )
        self._next, self._messages = 0, iter(())  # type: tuple[int, Iterator[Any]]

    def __len__(self) -> int:
        return self._count

    def read(self, place: int) -> Cloud:
        """Read the scan at a place, from 0; fastest in order.

        Raises:
            InputError: where the message is broken, or the bag ends before it.
        """
        if place != self._next:
            self._next, self._messages = 0, iter(())
        if not self._next:
            self._messages = self._read_all()
        name = f"{self.path} ({self.topic}, {place})"
        with refusing(name, "a PointCloud2 message", ADVICE):
            for message in self._messages:
                self._next += 1
                if self._next > place:
                    if self._next == self._count:
                        self._messages = iter(())  # nothing stays open
                    return read_message(message(), name)
        raise InputError(f"{name}: expected {self._count} scans, found {self._next}; {ADVICE}")

    def _read_all(self) -> Iterator[Any]:
        """Every message of the topic as a function that deserialises it."""
        with _opened(self.path, self._ending) as reader:
            decode = _decoder(self._ending)
            for _, _, data in reader.messages(connections=_connections(reader, self.topic)):
                yield lambda data=data: decode(data, TYPE)


@contextmanager
def _opened(path: Path, ending: str) -> Iterator[Any]:
    """rosbags' reader; it goes by the ending of the name, so that one that lies needs a link."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise InputError(
            f'{path}: expected rosbags to read it, found none; do pip install "amvnet[formats]"'
        ) from None
    with ExitStack() as stack:
        if ending in (".mcap", ".db3") and path.suffix != ending:
            folder = Path(stack.enter_context(TemporaryDirectory()))
            (folder / f"bag{ending}").symlink_to(path.absolute())
            path = folder / f"bag{ending}"
        yield stack.enter_context((Reader1 if ending == ".bag" else Reader2)(path))


def _decoder(ending: str) -> Any:
    """From bytes and a type's name to a message."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ending == ".bag" else Stores.ROS2_HUMBLE)
    return store.deserialize_ros1 if ending == ".bag" else store.deserialize_cdr


def _connections(reader: Any, topic: str) -> list[Any]:
    return [c for c in reader.connections if c.topic == topic and c.msgtype == TYPE]


def _topics(reader: Any) -> dict[str, int]:
    """The topics with PointCloud2, and how many messages each has."""
    counts: dict[str, int] = {}
    for connection in reader.connections:
        if connection.msgtype == TYPE:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    return counts


def _choose(counts: dict[str, int], topic: str | None, path: Path) -> str:
    shown = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
    if topic is not None:
        if topic in counts:
            return topic
        raise InputError(
            f"{path}: expected PointCloud2 under {topic}, found {shown or 'none'}; give another --topic"
        )
    if not counts:
        raise InputError(
            f"{path}: expected a topic with PointCloud2, found none; convert the driver's packets first"
        )
    if len(counts) > 1:
        raise InputError(
            f"{path}: expected one topic with PointCloud2, found {shown}; give one with --topic"
        )
    return next(iter(counts))


def _size(path: Path) -> int:
    return (
        sum(f.stat().st_size for f in path.iterdir() if f.is_file())
        if path.is_dir()
        else path.stat().st_size
    )
