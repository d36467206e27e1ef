"""A message of labels, serialised and deserialised by rosbags, holds what was encoded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from amvnet.data.formats.pointcloud2 import CLOUD_TYPE, read_message
from amvnet_ros.messages import LabelledPoints, Message, encode_labels

from fixtures.scan_writers import cloud_message, some_points

NUMBER_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
ORIGIN = Message(stamp=1_700_000_000_123_456_789, frame_id="lidar")
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def labelled(
    labels: np.ndarray, xyz: np.ndarray | None = None, uncertain: np.ndarray | None = None
) -> LabelledPoints:
    count = len(labels)
    xyz = np.zeros((count, 3)) if xyz is None else xyz
    return LabelledPoints(xyz, labels, np.zeros((count, 3), np.uint8), uncertain)


def through_ros2(origin: Message, points: LabelledPoints, has_points: bool = True) -> Any:
    message = encode_labels(ROS2.types, origin, points, has_points)
    return ROS2.deserialize_cdr(ROS2.serialize_cdr(message, CLOUD_TYPE), CLOUD_TYPE)


def through_ros1(origin: Message, points: LabelledPoints) -> Any:
    message = encode_labels(ROS1.types, origin, points)
    return ROS1.deserialize_ros1(ROS1.serialize_ros1(message, CLOUD_TYPE), CLOUD_TYPE)


def column(message: Any, name: str) -> np.ndarray:
    """Return a column as the definition of PointCloud2 says, one point at a time."""
    (field,) = [field for field in message.fields if field.name == name]
    values = []
    for row in range(message.height):
        for place in range(message.width):
            start = row * message.row_step + place * message.point_step + field.offset
            values.append(np.frombuffer(message.data, NUMBER_TYPES[field.datatype], 1, start)[0])
    return np.array(values)


@pytest.mark.parametrize("through", [through_ros1, through_ros2])
@pytest.mark.parametrize("height", [1, 4])
def test_every_value_arrives(through: Callable[..., Any], height: int) -> None:
    rng = np.random.default_rng(0)
    points = some_points(60)
    labels = rng.integers(0, 260, 60)
    uncertain = rng.random(60) < 0.5
    colors = rng.integers(0, 256, (60, 3)).astype(np.uint8)
    origin = Message(ORIGIN.stamp, "lidar", height)

    message = through(origin, LabelledPoints(points[:, :3], labels, colors, uncertain))
    assert [field.name for field in message.fields] == ["x", "y", "z", "rgb", "label", "uncertain"]
    assert (message.height, message.width) == (height, 60 // height)
    assert (message.header.frame_id, message.header.stamp.sec) == ("lidar", 1_700_000_000)
    assert message.header.stamp.nanosec == 123_456_789
    assert message.is_dense
    assert len(message.data) == message.height * message.row_step

    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(column(message, name), points[:, axis])
    np.testing.assert_array_equal(column(message, "label"), labels)
    np.testing.assert_array_equal(column(message, "uncertain"), uncertain)

    # PCL: the bytes blue, green, red in the memory of a little-endian float.
    packed = column(message, "rgb").view(np.uint8).reshape(60, 4)
    np.testing.assert_array_equal(packed[:, 2::-1], colors)


@settings(max_examples=30)
@given(
    seconds=st.integers(0, 2**31 - 1),
    nanoseconds=st.integers(0, 10**9 - 1),
    count=st.integers(0, 20),
)
def test_the_origin_is_kept_to_the_nanosecond(seconds: int, nanoseconds: int, count: int) -> None:
    stamp = seconds * 10**9 + nanoseconds
    message = through_ros2(Message(stamp, "os_lidar"), labelled(np.zeros(count, np.uint8)))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (seconds, nanoseconds)
    assert Message.of(message) == Message(stamp, "os_lidar")
    assert message.width == count


def test_the_reader_of_scans_reads_what_was_encoded() -> None:
    points = some_points(30)
    message = through_ros2(ORIGIN, labelled(np.arange(30), points[:, :3]))
    np.testing.assert_array_equal(read_message(message, "here").xyz, points[:, :3])


def test_labels_alone_take_the_place_of_each_point_of_the_scan() -> None:
    scan = cloud_message(ROS2, some_points(60), padded=True)
    points = labelled(np.arange(60), uncertain=np.ones(60, bool))
    message = through_ros2(Message.of(scan), points, has_points=False)
    assert [field.name for field in message.fields] == ["label", "uncertain"]
    assert (message.height, message.width) == (scan.height, scan.width)
    assert message.header == scan.header


def test_lost_points_stay_and_the_message_says_that_there_are_some() -> None:
    xyz = some_points(5)[:, :3].astype(np.float64)
    xyz[2] = np.nan
    message = through_ros2(ORIGIN, labelled(np.arange(5), xyz))
    assert not message.is_dense
    assert np.isnan(column(message, "x")).tolist() == [False, False, True, False, False]
