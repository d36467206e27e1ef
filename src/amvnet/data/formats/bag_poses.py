"""Read the poses of the LiDAR from a bag: from its odometry, its poses or its tf."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.data.formats.bags import (
    ADVICE,
    EXPECTED,
    LISTED_TOPICS,
    TF_TYPE,
    Bag,
    deserialiser,
    open_reader,
)
from amvnet.data.formats.cloud import reading
from amvnet.data.formats.reader_process import call
from amvnet.data.poses import Poses, timed_poses
from amvnet.errors import InputError, readable, shown
from amvnet.progress import Reporter

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TF_TYPES = (TF_TYPE, "tf/msg/tfMessage")  # the second one is an older name
POSE_TYPES = (
    *(ODOMETRY_TYPE, "geometry_msgs/msg/PoseStamped"),
    *("geometry_msgs/msg/PoseWithCovarianceStamped", *TF_TYPES),
)
LONGEST_CHAIN = 100  # largest number of frames above each other that count
# The kinds of poses; the first one is the end of the names of topics whose transforms are fixed.
STATIC, TF, GIVEN = "tf_static", "tf", "given"


@dataclass(frozen=True)
class BagPoses:
    """The poses of the LiDAR at the time stamps of the scans in a bag.

    Attributes:
        scan_topic: the topic of the scans; None for the only one.
    """

    path: Path
    ending: str
    scan_topic: str | None

    def times(self) -> list[float]:
        """Return the time stamps of the scans in seconds; raise InputError if one is broken."""
        times: list[float] = self._call(read_times, self.scan_topic)["times"].tolist()
        return times

    def odometry(self) -> str | None:
        """Return the first topic with odometry, or None if there is none."""
        topics = [name for name, kind in self._topics().items() if kind == ODOMETRY_TYPE]
        return min(topics, default=None)

    def at_scans(self, topic: str, report: Reporter) -> Poses:
        """Return the pose (N, 4, 4) of the LiDAR in each scan.

        Args:
            topic: a topic with Odometry, PoseStamped, PoseWithCovarianceStamped or tf. Of tf, the
                chain from the scans' frame up to the frame without a parent counts.
            report: takes a line if no transform tells where the LiDAR is on the robot.

        Raises:
            InputError: if there is no such topic, its poses do not include the times of the scans
                or are no rigid motions, or no chain of frames leads to the scans' frame.
        """
        topics = self._topics()
        if topic not in topics:
            listed = sorted(topics.items())[:LISTED_TOPICS]
            listing = ", ".join(f"{name} ({kind})" for name, kind in listed)
            raise InputError(
                f"{self.path}: expected the topic {topic} with poses, or a file of this name, "
                f"found {listing or 'no topic with poses'}; give another topic or file, or leave "
                "--poses out, so that the poses are estimated"
            )

        name = f"{self.path} ({topic})"
        found = self._call(read_transforms, self.scan_topic, topic)
        transforms = _transforms(name, found)
        if topics[topic] in TF_TYPES:
            return _by_tf(name, transforms, found["frame"], found["times"])
        return _by_odometry(name, transforms, found["frame"], found["times"], report)

    def _topics(self) -> dict[str, str]:
        topics: dict[str, str] = self._call(pose_topics)["topics"]
        return topics

    def _call(self, function: Any, *arguments: Any) -> dict[str, Any]:
        with readable(self.path):
            return call(function, self.path, self.ending, *arguments)


@dataclass(frozen=True)
class _Transform:
    """The poses of a frame in its parent, as rows (M, 8) of time x y z qx qy qz qw.

    `kind` is STATIC or TF for transforms, or GIVEN for the poses of a topic.
    """

    name: str
    parent: str
    child: str
    kind: str
    rows: NDArray[np.float64]

    @property
    def is_fixed(self) -> bool:
        """Whether it does not change: by its topic, or because /tf has it at a single time."""
        return self.kind == STATIC or (self.kind == TF and not np.ptp(self.rows[:, 0]))

    def fixed(self) -> _Transform:
        """Return it as one that does not change if it is a transform that is always the same.

        Drivers also send transforms within the robot on /tf, again and again.
        """
        is_constant = self.kind != GIVEN and not np.ptp(self.rows[:, 1:], axis=0).any()
        return replace(self, kind=STATIC) if is_constant else self

    def at(self, times: NDArray[np.float64]) -> Poses:
        """Return the pose at each time (N, 4, 4), or the only one (1, 4, 4) if it is fixed."""
        if self.is_fixed:
            return timed_poses(self.name, self.rows[-1:]).poses
        # Messages can be late or come twice.
        _, first = np.unique(self.rows[:, 0], return_index=True)
        return timed_poses(self.name, self.rows[first]).interpolate(times)


def _transforms(name: str, found: Mapping[str, Any]) -> list[_Transform]:
    """Return the transforms that `read_transforms` found, with the rows of each."""
    order = np.argsort(found["edges"], kind="stable")
    ends = np.cumsum(np.bincount(found["edges"], minlength=len(found["frames"])))
    transforms = []
    rows_of_each = np.split(found["rows"][order], ends[:-1])
    for (parent, child, kind), rows in zip(found["frames"], rows_of_each, strict=False):
        label = f"{name}, {shown(child)} in {shown(parent)}"
        transforms.append(_Transform(label, parent, child, kind, rows))
    return transforms


def _by_tf(
    name: str, transforms: Sequence[_Transform], frame: str, times: NDArray[np.float64]
) -> Poses:
    """Return the poses (N, 4, 4) of a frame in the highest frame above it."""
    # If none moves, the robot may have stood still.
    for some in (list(map(_Transform.fixed, transforms)), transforms):
        chain = _climb(frame, some, times)
        poses = list(chain.values())[-1]
        if len(poses) == len(times):
            return poses
    raise InputError(
        f"{name}: expected moving frames above the scans' frame {shown(frame)}, found the "
        f"chain {', '.join(map(shown, chain))}, in which none moves; choose a topic with "
        "odometry, or leave --poses out, so that the poses are estimated"
    )


def _by_odometry(
    name: str,
    transforms: Sequence[_Transform],
    frame: str,
    times: NDArray[np.float64],
    report: Reporter,
) -> Poses:
    """Return the poses (N, 4, 4) of a frame that is fixed to the frame with odometry."""
    fixed = [item for item in map(_Transform.fixed, transforms) if item.is_fixed]
    moving = [item for item in transforms if item.kind == GIVEN]
    if len(moving) != 1:
        pairs = ", ".join(f"{shown(item.child)} in {shown(item.parent)}" for item in moving[:3])
        raise InputError(
            f"{name}: expected the poses of one frame, found {pairs or 'no message'}; choose "
            "another topic, or leave --poses out, so that the poses are estimated"
        )

    (odometry,) = moving
    poses = odometry.at(times)
    of_lidar = _climb(frame, fixed, times)
    of_child = _climb(odometry.child, fixed, times)
    common = next((above for above in of_lidar if above in of_child), None)
    if common is None:
        report(
            f"{name}: assumed that its poses are the LiDAR's: no fixed transform leads from "
            f"{shown(odometry.child)} to the scans' frame {shown(frame)}"
        )
        return poses
    moved: Poses = poses @ np.linalg.inv(of_child[common]) @ of_lidar[common]
    return moved


def _climb(
    frame: str, transforms: Sequence[_Transform], times: NDArray[np.float64]
) -> dict[str, Poses]:
    """Return the poses of a frame in itself and in all frames above it, by their names, upwards."""
    above = {item.child: item for item in sorted(transforms, key=lambda item: not item.is_fixed)}
    poses: dict[str, Poses] = {frame: np.eye(4)[None]}
    while frame in above and len(poses) < LONGEST_CHAIN:
        transform = above[frame]
        if transform.parent in poses:  # the frames are a circle
            break
        poses[transform.parent] = transform.at(times) @ poses[frame]
        frame = transform.parent
    return poses


# --- in the process with limits ---


def read_times(path: Path, ending: str, scan_topic: str | None) -> dict[str, Any]:
    """Return the time stamps (N,) of the scans in seconds."""
    return {"times": Bag(path, ending, scan_topic).headers()[0]}


def pose_topics(path: Path, ending: str) -> dict[str, dict[str, str]]:
    """Return the types of the topics with poses, by name."""
    with reading(path, EXPECTED, ADVICE), closing(open_reader(path, ending)) as reader:
        return {"topics": {item.topic: item.msgtype for item in _with_poses(reader.connections)}}


def read_transforms(path: Path, ending: str, scan_topic: str | None, topic: str) -> dict[str, Any]:
    """Return the scans' times (N,) and frame, and all poses of a topic and transforms beside them.

    Beside tf, these are the static ones; beside a topic of poses, all. Each of the `rows` (M, 8) of
    time x y z qx qy qz qw belongs to one of the `edges` (M,), indices into the `frames`: parent,
    child, and its kind.
    """
    times, frame = Bag(path, ending, scan_topic).headers()
    deserialise = deserialiser(ending == ".bag")
    frames: dict[tuple[str, str, str], int] = {}
    edges = array("q")
    rows = array("d")
    with reading(f"{path} ({topic})", EXPECTED, ADVICE), closing(open_reader(path, ending)) as bag:
        connections = _with_poses(bag.connections)
        kinds = {each.topic: _kind_of(each) for each in connections}
        beside = (STATIC, TF) if kinds[topic] == GIVEN else (STATIC,)
        chosen = [each for each in connections if each.topic == topic or _kind_of(each) in beside]
        for connection, _, data in bag.messages(connections=chosen):
            kind = TF_TYPE if connection.msgtype in TF_TYPES else connection.msgtype
            for parent, child, *row in _poses_of(deserialise(data, kind)):
                key = (parent.strip("/"), child.strip("/"), kinds[connection.topic])
                edges.append(frames.setdefault(key, len(frames)))
                rows.extend(row)
    return {
        "times": times,
        "frame": frame.strip("/"),
        "frames": list(frames),
        "edges": np.array(edges),
        "rows": np.array(rows).reshape(-1, 8),
    }


def _with_poses(connections: Iterable[Any]) -> list[Any]:
    return [connection for connection in connections if connection.msgtype in POSE_TYPES]


def _kind_of(connection: Any) -> str:
    if connection.msgtype not in TF_TYPES:
        return GIVEN
    return STATIC if connection.topic.endswith(STATIC) else TF


def _poses_of(message: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the poses of a message: parent, child, time x y z qx qy qz qw."""
    for one in getattr(message, "transforms", [message]):
        if hasattr(one, "transform"):
            place, turn = one.transform.translation, one.transform.rotation
        else:
            pose = getattr(one.pose, "pose", one.pose)  # in another message with a covariance
            place, turn = pose.position, pose.orientation
        stamp = one.header.stamp
        time = stamp.sec + stamp.nanosec * 1e-9
        child = getattr(one, "child_frame_id", "")
        yield one.header.frame_id, child, time, *_values(place, "xyz"), *_values(turn, "xyzw")


def _values(vector: Any, names: str) -> list[float]:
    return [getattr(vector, name) for name in names]
