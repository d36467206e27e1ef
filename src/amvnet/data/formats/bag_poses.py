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

from amvnet.data.formats import bags
from amvnet.data.formats.cloud import reading
from amvnet.data.formats.reader_process import call
from amvnet.data.poses import Poses, timed_poses
from amvnet.errors import InputError, readable, shown
from amvnet.progress import Reporter

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TF_TYPES = (bags.TF_TYPE, "tf/msg/tfMessage")  # the second one is an older name
POSE_TYPES = (
    ODOMETRY_TYPE,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    *TF_TYPES,
)
LONGEST_CHAIN = 100  # largest number of frames from the scans' frame to the highest one

# Where a transform comes from, which tells whether it may change.
STATIC = "tf_static"  # from a topic whose name ends so, which holds what never changes
TF = "tf"  # from any other topic of tf
GIVEN = "given"  # from a topic of odometry or of poses


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
        """Return the time stamps of the scans in seconds.

        Raises:
            InputError: if the header of a scan is broken.
        """
        times: list[float] = self._call(read_times, self.scan_topic)["times"].tolist()
        return times

    def odometry(self) -> str | None:
        """Return the first topic with odometry, or None if there is none."""
        types = self._types()
        return min((topic for topic in types if types[topic] == ODOMETRY_TYPE), default=None)

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
        types = self._types()
        if topic not in types:
            listed = sorted(types.items())[: bags.LISTED_TOPICS]
            listing = ", ".join(f"{other} ({msgtype})" for other, msgtype in listed)
            raise InputError(
                f"{self.path}: expected the topic {topic} with poses, or a file of this name, "
                f"found {listing or 'no topic with poses'}; give another topic or file, or leave "
                "--poses out, so that the poses are estimated"
            )

        name = f"{self.path} ({topic})"
        content = self._call(read_transforms, self.scan_topic, topic)
        transforms = _transforms(name, content)
        if types[topic] in TF_TYPES:
            return _by_tf(name, transforms, content["frame"], content["times"])
        return _by_odometry(name, transforms, content["frame"], content["times"], report)

    def _types(self) -> dict[str, str]:
        """Return the types of the topics with poses, by the topics' names."""
        types: dict[str, str] = self._call(pose_topics)["types"]
        return types

    def _call(self, function: Any, *arguments: Any) -> dict[str, Any]:
        with readable(self.path):
            return call(function, self.path, self.ending, *arguments)


@dataclass(frozen=True)
class _Transform:
    """The poses of a frame in its parent.

    Attributes:
        name: what messages call it.
        child: the frame; empty for a topic of poses, which does not name it.
        source: STATIC, TF or GIVEN.
        rows: (M, 8) time x y z qx qy qz qw, seconds and metres, in the order of the bag.
    """

    name: str
    parent: str
    child: str
    source: str
    rows: NDArray[np.float64]

    @property
    def is_fixed(self) -> bool:
        """Whether it never changes: by its topic, or because /tf has it at a single time."""
        return self.source == STATIC or (self.source == TF and not np.ptp(self.rows[:, 0]))

    def fixed_if_constant(self) -> _Transform:
        """Return it as a fixed one if /tf repeats the same values, else unchanged.

        Drivers also send transforms within the robot on /tf, again and again.
        """
        is_constant = self.source == TF and not np.ptp(self.rows[:, 1:], axis=0).any()
        return replace(self, source=STATIC) if is_constant else self

    def at(self, times: NDArray[np.float64]) -> Poses:
        """Return the pose at each time (N, 4, 4), or the only one (1, 4, 4) if it is fixed."""
        if self.is_fixed:
            return timed_poses(self.name, self.rows[-1:]).poses
        # Messages can be late or come twice, but times must ascend.
        _, first = np.unique(self.rows[:, 0], return_index=True)
        return timed_poses(self.name, self.rows[first]).interpolate(times)


def _transforms(name: str, content: Mapping[str, Any]) -> list[_Transform]:
    """Return the transforms that `read_transforms` found; messages begin with `name`."""
    order = np.argsort(content["edge_of_row"], kind="stable")
    ends = np.cumsum(np.bincount(content["edge_of_row"]))
    rows_of_edges = np.split(content["rows"][order], ends)  # and no rows after the last end
    transforms = []
    for (parent, child, source), rows in zip(content["edges"], rows_of_edges[:-1], strict=True):
        label = f"{name}, {shown(child)} in {shown(parent)}"
        transforms.append(_Transform(label, parent, child, source, rows))
    return transforms


def _by_tf(
    name: str, transforms: Sequence[_Transform], frame: str, times: NDArray[np.float64]
) -> Poses:
    """Return the poses (N, 4, 4) of a frame in the highest frame above it."""
    # If all that moves is constant, the robot may have stood still: then its poses are these.
    for candidates in (list(map(_Transform.fixed_if_constant, transforms)), transforms):
        chain = _climb(frame, candidates, times)
        poses = list(chain.values())[-1]
        if len(poses) == len(times):  # a chain of fixed transforms has one pose for all times
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
    fixed = [item for item in map(_Transform.fixed_if_constant, transforms) if item.is_fixed]
    given = [item for item in transforms if item.source == GIVEN]
    if len(given) != 1:
        pairs = ", ".join(f"{shown(item.child)} in {shown(item.parent)}" for item in given[:3])
        raise InputError(
            f"{name}: expected the poses of one frame, found {pairs or 'no message'}; choose "
            "another topic, or leave --poses out, so that the poses are estimated"
        )

    (odometry,) = given
    poses = odometry.at(times)
    of_lidar = _climb(frame, fixed, times)
    of_child = _climb(odometry.child, fixed, times)
    common = next((above for above in of_lidar if above in of_child), None)
    if common is None:
        reason = f"no fixed transform leads from {shown(odometry.child)} to"
        if not odometry.child:
            reason = "they do not name their frame, such as"
        report(
            f"{name}: assumed that its poses are the LiDAR's: {reason} the scans' frame "
            f"{shown(frame)}"
        )
        return poses
    moved: Poses = poses @ np.linalg.inv(of_child[common]) @ of_lidar[common]
    return moved


def _climb(
    frame: str, transforms: Sequence[_Transform], times: NDArray[np.float64]
) -> dict[str, Poses]:
    """Return the poses of a frame in itself and in each frame above it, by their names, upwards.

    Poses are (N, 4, 4), or (1, 4, 4) as long as only fixed transforms lead to a frame.
    """
    # Of several transforms of a frame, the last one counts: one that moves, if there is any.
    above = {item.child: item for item in sorted(transforms, key=lambda item: not item.is_fixed)}
    poses: dict[str, Poses] = {frame: np.eye(4)[None]}
    while frame in above and len(poses) < LONGEST_CHAIN:
        transform = above[frame]
        if transform.parent in poses:  # broken bags have frames in a circle
            break
        poses[transform.parent] = transform.at(times) @ poses[frame]
        frame = transform.parent
    return poses


# --- in the process with limits ---


def read_times(path: Path, ending: str, scan_topic: str | None) -> dict[str, Any]:
    """Return the time stamps (N,) of the scans in seconds."""
    return {"times": bags.Bag(path, ending, scan_topic).headers()[0]}


def pose_topics(path: Path, ending: str) -> dict[str, dict[str, str]]:
    """Return the types of the topics with poses, by the topics' names."""
    with reading(path, bags.EXPECTED, bags.ADVICE), closing(bags.open_reader(path, ending)) as bag:
        return {"types": {each.topic: each.msgtype for each in _with_poses(bag.connections)}}


def read_transforms(path: Path, ending: str, scan_topic: str | None, topic: str) -> dict[str, Any]:
    """Return the poses of a topic, and transforms that may lead from it to the scans' frame.

    A topic of tf comes with the static transforms, a topic of poses with all transforms.

    Returns:
        `times`: (N,) the time stamps of the scans, seconds.
        `frame`: the frame of the scans.
        `edges`: the parent, the child and the source (STATIC, TF or GIVEN) of each transform.
        `rows`: (M, 8) time x y z qx qy qz qw of all messages, seconds and metres.
        `edge_of_row`: (M,) the index of the transform that a row belongs to.
    """
    times, frame = bags.Bag(path, ending, scan_topic).headers()
    deserialise = bags.deserialiser(ending == ".bag")
    edges: dict[tuple[str, str, str], int] = {}
    edge_of_row = array("q")
    rows = array("d")
    with (
        reading(f"{path} ({topic})", bags.EXPECTED, bags.ADVICE),
        closing(bags.open_reader(path, ending)) as bag,
    ):
        connections = _with_poses(bag.connections)
        sources = {each.topic: _source_of(each) for each in connections}
        wanted = (STATIC, TF) if sources[topic] == GIVEN else (STATIC,)
        chosen = [each for each in connections if each.topic == topic or _source_of(each) in wanted]
        for connection, _, data in bag.messages(connections=chosen):
            msgtype = bags.TF_TYPE if connection.msgtype in TF_TYPES else connection.msgtype
            for parent, child, *row in _poses_of(deserialise(data, msgtype)):
                edge = (parent.strip("/"), child.strip("/"), sources[connection.topic])
                edge_of_row.append(edges.setdefault(edge, len(edges)))
                rows.extend(row)
    return {
        "times": times,
        "frame": frame.strip("/"),
        "edges": list(edges),
        "edge_of_row": np.array(edge_of_row),
        "rows": np.array(rows).reshape(-1, 8),
    }


def _with_poses(connections: Iterable[Any]) -> list[Any]:
    return [connection for connection in connections if connection.msgtype in POSE_TYPES]


def _source_of(connection: Any) -> str:
    if connection.msgtype not in TF_TYPES:
        return GIVEN
    return STATIC if connection.topic.endswith(STATIC) else TF


def _poses_of(message: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the poses of a message: parent, child, time x y z qx qy qz qw."""
    for stamped in getattr(message, "transforms", [message]):
        if hasattr(stamped, "transform"):
            place, turn = stamped.transform.translation, stamped.transform.rotation
        else:
            pose = getattr(stamped.pose, "pose", stamped.pose)  # the outer one has a covariance
            place, turn = pose.position, pose.orientation
        stamp = stamped.header.stamp
        time = stamp.sec + stamp.nanosec * 1e-9
        child = getattr(stamped, "child_frame_id", "")
        yield stamped.header.frame_id, child, time, *_values(place, "xyz"), *_values(turn, "xyzw")


def _values(vector: Any, names: str) -> list[float]:
    return [getattr(vector, name) for name in names]
