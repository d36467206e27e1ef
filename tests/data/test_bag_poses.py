"""Poses of a bag's topics, against plain loops, and what is wrong with others."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amvnet.data.formats.bag_poses import BagPoses
from amvnet.data.formats.detect import ending_of
from amvnet.progress import report_nothing

from fixtures import bag_poses
from fixtures.bag_poses import FIRST, ODOMETRY, Sent, drive_odometry, odometry, transform, write_bag
from fixtures.commands import fails

SCANS = 6
POINTS = np.ones((4, 4), np.float32)
TIMES = [FIRST + bag_poses.PERIOD * index for index in range(SCANS)]
CLOUDS = [bag_poses.cloud(time, POINTS) for time in TIMES]


def place(x: float, y: float, z: float, yaw: float, pitch: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zy", [yaw, pitch]).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


ON_MOUNT = place(0.1, 0.2, 0.3, yaw=0.5, pitch=0.1)  # of the LiDAR
ON_BASE = place(1.5, 0.0, 1.2, yaw=-1.0)  # of the mount
ON_WHEELS = place(0.0, 0.3, -0.4, yaw=2.0)  # of the base
STATICS = [
    transform(FIRST, ON_MOUNT, ("mount", "/lidar")),
    transform(FIRST, ON_BASE, ("base_link", "mount")),
]


def odometry_of(
    times: list[float], poses: list[np.ndarray], child: str, kind: str = ODOMETRY
) -> list[Sent]:
    """Return the motion of a frame in that of the odometry."""
    moving = zip(times, poses, strict=True)
    return [odometry(time, pose, kind, frames=("odom", child)) for time, pose in moving]


def poses_of(bag: Path, topic: str, lines: list[str] | None = None) -> np.ndarray:
    reader = BagPoses(bag, ending_of(bag), None)
    return reader.at_scans(topic, report_nothing if lines is None else lines.append)


def between(times: list[float], poses: list[np.ndarray], time: float) -> np.ndarray:
    """Return the pose at a time by one step of a plain interpolation."""
    after = next(index for index in range(1, len(times)) if times[index] >= time)
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    first, last = poses[after - 1], poses[after]
    turn = Rotation.from_matrix(first[:3, :3].T @ last[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * last[:3, 3]
    return pose


def shaken(seed: int, count: int = 40) -> tuple[list[float], list[np.ndarray]]:
    """Return times around the scans', unevenly spaced, and poses that shake."""
    rng = np.random.default_rng(seed)
    times = np.sort(np.concatenate(([FIRST - 0.1, FIRST + 1], rng.uniform(0, 0.9, count) + FIRST)))
    poses = []
    for time in times:
        x, y, z, yaw, pitch = rng.normal(0, 0.1, 5)
        poses.append(bag_poses.pose_at(time) @ place(x, y, z, yaw, pitch))
    return times.tolist(), poses


@pytest.mark.parametrize("storage", ["bag", "mcap", "sqlite3"])
def test_odometry_is_interpolated_and_moved_to_the_lidar(tmp_path: Path, storage: str) -> None:
    times, poses = shaken(0)
    sent = odometry_of(times, poses, "wheels")
    fixed = transform(FIRST, np.linalg.inv(ON_WHEELS), ("base_link", "wheels"))
    bag = write_bag(tmp_path / "drive", [*STATICS, fixed, *sent, *CLOUDS], storage)
    lines: list[str] = []
    for pose, time in zip(poses_of(bag, "/odom", lines), TIMES, strict=True):
        expected = between(times, poses, time) @ ON_WHEELS @ ON_BASE @ ON_MOUNT
        np.testing.assert_allclose(pose, expected, atol=1e-4)  # times are rounded to nanoseconds
    assert not lines
    assert BagPoses(bag, ending_of(bag), None).times() == pytest.approx(TIMES)
    assert BagPoses(bag, ending_of(bag), None).odometry() == "/odom"


@pytest.mark.parametrize("storage", ["bag", "mcap"])
def test_tf_takes_the_chain_up_to_the_frame_without_a_parent(tmp_path: Path, storage: str) -> None:
    sent = []
    chain = []
    for seed, frames in enumerate([("map", "odom"), ("odom", "base_link"), ("base_link", "wheel")]):
        times, poses = shaken(seed)
        chain.append((times, poses))
        for time, pose in zip(times, poses, strict=True):
            sent.append(transform(time, pose, frames, "/tf"))
    bag = write_bag(tmp_path / "drive", [*STATICS, *sent, *CLOUDS], storage)
    for pose, time in zip(poses_of(bag, "/tf"), TIMES, strict=True):
        expected = between(*chain[0], time) @ between(*chain[1], time) @ ON_BASE @ ON_MOUNT
        np.testing.assert_allclose(pose, expected, atol=1e-4)


@pytest.mark.parametrize("stamps", [[FIRST], [0.0], [FIRST + 0.2, FIRST + 0.3], []])
def test_transforms_within_the_robot_may_come_on_tf(tmp_path: Path, stamps: list[float]) -> None:
    """They may come once, with any stamp, or again and again, also beside odometry."""
    times, poses = shaken(0)
    moving = list(zip(times, poses, strict=True))
    sent = [transform(time, pose, ("odom", "base_link"), "/tf") for time, pose in moving]
    sent += odometry_of(times, poses, "base_link")
    sent += [
        transform(stamp, pose, frames, "/tf")
        for stamp in stamps or times
        for pose, frames in ((ON_MOUNT, ("mount", "lidar")), (ON_BASE, ("base_link", "mount")))
    ]
    bag = write_bag(tmp_path / "drive", [*sent, *CLOUDS])
    lines: list[str] = []
    for topic in ("/odom", "/tf"):
        for pose, time in zip(poses_of(bag, topic, lines), TIMES, strict=True):
            expected = between(times, poses, time) @ ON_BASE @ ON_MOUNT
            np.testing.assert_allclose(pose, expected, atol=1e-4)
    assert not lines


def test_a_robot_that_stands_still_is_where_tf_says(tmp_path: Path) -> None:
    sent = [transform(time, ON_WHEELS, ("odom", "base_link"), "/tf") for time in shaken(0)[0]]
    bag = write_bag(tmp_path / "drive", [*STATICS, *sent, *CLOUDS])
    expected = ON_WHEELS @ ON_BASE @ ON_MOUNT
    np.testing.assert_allclose(poses_of(bag, "/tf"), [expected] * SCANS, atol=1e-9)


@pytest.mark.parametrize("kind", [ODOMETRY, bag_poses.POSE, bag_poses.POSE_WITH_COVARIANCE])
def test_without_a_static_transform_poses_are_the_lidars(tmp_path: Path, kind: str) -> None:
    times, poses = shaken(0)
    bag = write_bag(tmp_path / "drive", [*odometry_of(times, poses, "base", kind), *CLOUDS])
    lines: list[str] = []
    for pose, time in zip(poses_of(bag, "/odom", lines), TIMES, strict=True):
        np.testing.assert_allclose(pose, between(times, poses, time), atol=1e-4)
    (line,) = lines
    reason = "no fixed transform leads from 'base'" if kind == ODOMETRY else "do not name their"
    assert reason in line


def test_late_messages_and_messages_that_come_twice_change_nothing(tmp_path: Path) -> None:
    sent = drive_odometry(SCANS)
    in_order = write_bag(tmp_path / "in_order", [*sent, *CLOUDS])
    late = write_bag(tmp_path / "late", [*CLOUDS, *sent[3:], *sent[:5], *sent[:2]])
    np.testing.assert_array_equal(poses_of(late, "/odom"), poses_of(in_order, "/odom"))


def with_a_hole() -> list[Sent]:
    sent = drive_odometry(SCANS)
    sent[4] = odometry(sent[4].time, np.full((4, 4), np.nan), quaternion=(0, 0, 0, 1))
    return sent


def in_circle() -> list[Sent]:
    forth = [transform(time, np.eye(4), ("base", "odom"), "/tf") for time in TIMES]
    back = [transform(time, np.eye(4), ("odom", "base"), "/tf") for time in TIMES]
    return [*forth, *back, *STATICS]


def of_another_epoch() -> list[Sent]:
    sent = drive_odometry(SCANS)
    return [odometry(one.time + 1.7e9, bag_poses.pose_at(one.time)) for one in sent]


def of_two_frames() -> list[Sent]:
    return [odometry(FIRST, np.eye(4), frames=("odom", "base")), *drive_odometry(SCANS)]


def turned(quaternion: tuple[float, ...]) -> list[Sent]:
    return [odometry(time, np.eye(4), quaternion=quaternion) for time in TIMES]


@pytest.mark.parametrize(
    ("sent", "topic", "words"),
    [
        ([], "/odom", ["/odom", "no topic with poses", "--poses"]),
        (drive_odometry(SCANS), "/odometry", ["/odom (nav_msgs/msg/Odometry)"]),
        (drive_odometry(SCANS), "/points", ["/odom (nav_msgs/msg/Odometry)"]),
        (drive_odometry(SCANS)[4:5], "/odom", ["100.00 to 100.50", "100.14 to 100.14"]),
        (of_another_epoch(), "/odom", ["100.00 to 100.50", "1700000099.98 to"]),
        (of_two_frames(), "/odom", ["'base' in 'odom'", "'lidar' in 'odom'"]),
        (with_a_hole(), "/odom", ["no number", "pose 4"]),
        (turned((0, 0, 0, 0)), "/odom", ["quaternions", "0 0 0 0"]),
        (turned((0, 0, np.nan, 1)), "/odom", ["quaternions", "nan"]),
        (STATICS, "/tf_static", ["'lidar', 'mount', 'base_link'", "none moves"]),
        ([transform(FIRST, np.eye(4), ("a", "b"), "/tf")], "/tf", ["the chain 'lidar'"]),
        (in_circle(), "/tf", ["none moves"]),
    ],
)
def test_poses_that_cannot_be_used_are_one_line(
    tmp_path: Path, sent: list[Sent], topic: str, words: list[str]
) -> None:
    bag = write_bag(tmp_path / "drive", [*sent, *CLOUDS])
    fails(lambda: poses_of(bag, topic), bag, *words)


def test_a_topic_without_messages_is_one_line(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", CLOUDS, empty=["/odom"])
    fails(lambda: poses_of(bag, "/odom"), "/odom", "no message")
    assert BagPoses(bag, ending_of(bag), None).odometry() == "/odom"


def test_a_broken_message_is_one_line(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", [*drive_odometry(SCANS), *CLOUDS], storage="sqlite3")
    (database,) = bag.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE messages SET data = substr(data, 1, 40) WHERE id = 3")
    fails(lambda: poses_of(bag, "/odom"), "/odom", "broken")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE messages SET data = x'00'")
    fails(lambda: poses_of(bag, "/odom"), bag, "broken")
