"""The node with ROS itself: runs if rclpy is installed, as in the CI's job with ROS."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.formats.pointcloud2 import read_message
from amvnet.weights.file import save

from fixtures.processes import PATIENCE
from fixtures.tiny import fresh_weights, street

rclpy = pytest.importorskip("rclpy")


@pytest.fixture
def context(tmp_path: Path) -> Iterator[None]:
    """A context of ROS, with the arguments of a node with tiny weights."""
    weights = save(fresh_weights(), tmp_path / "tiny.safetensors")
    reliable = "qos_overrides./amvnet/cloud.publisher.reliability:=reliable"
    arguments = ["-p", f"weights:={weights}", "-p", reliable, "-r", "points:=/lidar/top"]
    rclpy.init(args=["--ros-args", *arguments])
    yield
    rclpy.try_shutdown()


def scan_message(points: np.ndarray) -> Any:
    """Return the message of (N, 4) float32 points."""
    from builtin_interfaces.msg import Time
    from sensor_msgs.msg import PointCloud2, PointField
    from std_msgs.msg import Header

    fields = []
    for column, name in enumerate(("x", "y", "z", "intensity")):
        fields.append(PointField(name=name, offset=4 * column, datatype=7, count=1))
    return PointCloud2(
        header=Header(stamp=Time(sec=1, nanosec=2), frame_id="lidar"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(points),
        data=array("B", points.tobytes()),
        is_dense=True,
    )


def test_a_cloud_in_and_a_cloud_out(context: None) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2

    from amvnet_ros.node import SegmentNode

    points, _ = street(0)
    points[:, 3] = np.clip(points[:, 3], 0, 1)
    message = scan_message(points)

    node = SegmentNode()
    driver = rclpy.create_node("driver")
    publisher = driver.create_publisher(PointCloud2, "/lidar/top", qos_profile_sensor_data)
    clouds: list[Any] = []
    labels: list[Any] = []
    statuses: list[Any] = []
    profile = qos_profile_sensor_data
    driver.create_subscription(PointCloud2, "/amvnet/cloud", clouds.append, 1)  # reliable
    driver.create_subscription(PointCloud2, "/amvnet/labels", labels.append, profile)
    driver.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
    driver.create_timer(0.2, lambda: publisher.publish(message))

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(driver)
    end = time.monotonic() + PATIENCE  # comes only if nothing is published
    while time.monotonic() < end and not (clouds and labels and statuses):
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.close()

    cloud = clouds[0]
    assert cloud.header == message.header
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb", "label", "uncertain"]
    np.testing.assert_array_equal(read_message(cloud, "cloud").xyz, points[:, :3])
    assert [field.name for field in labels[0].fields] == ["label", "uncertain"]
    assert statuses[0].status[0].name == "amvnet: segmentation"
