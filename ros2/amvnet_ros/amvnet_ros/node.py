"""The node: it subscribes to scans, and publishes labels, a coloured cloud and diagnostics."""

from __future__ import annotations

import sys
import time
import traceback
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time as RosTime
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header, String
from tf2_ros import Buffer, TransformException, TransformListener

from amvnet.data.formats.pointcloud2 import CLOUD_TYPE
from amvnet.data.poses import timed_poses
from amvnet.errors import InputError, reason_of
from amvnet.runtime.threads import wait_passively
from amvnet_ros.health import Health, Labelled
from amvnet_ros.messages import (
    FIELD_TYPE,
    HEADER_TYPE,
    NANOSECONDS,
    TIME_TYPE,
    Message,
    encode_labels,
)
from amvnet_ros.newest import NewestOnly
from amvnet_ros.segmentation import CloudSegmenter, LabelledCloud, Settings

# The exit codes, the same as in the command line.
DONE = 0
FAILED = 1
WRONG_INPUT = 2

TYPES = {CLOUD_TYPE: PointCloud2, FIELD_TYPE: PointField, HEADER_TYPE: Header, TIME_TYPE: Time}
REPORT_PERIOD = 1.0  # the time between two reports, seconds
REFUSAL_PERIOD = 5.0  # the least time between two lines of the log about broken clouds, seconds
ODOMETRY_WAIT = 0.1  # longest time to wait for odometry that comes after its scan, seconds


@dataclass(frozen=True)
class _Arrival:
    """A message, and the time of its arrival by `time.monotonic`, in seconds."""

    message: Any
    time: float


class SegmentNode(Node):
    """Labels the newest scan whenever the previous scan is done.

    Raises:
        InputError: if a parameter is wrong.
    """

    def __init__(self) -> None:
        super().__init__("amvnet")
        self.exit_code = DONE
        settings = self._declare_settings()
        topic = self.resolve_topic_name("points")
        self._odom_frame = settings.odom_frame
        find_pose = None
        if self._odom_frame:
            self._frames = Buffer()
            self._listener = TransformListener(self._frames, self)  # fills the buffer
            find_pose = self._find_pose
        self._segment = CloudSegmenter(settings, topic, self.get_logger().info, find_pose)
        self._health = Health()
        self._report_time = time.monotonic()

        self._label_publisher = self._create_cloud_publisher("~/labels")
        self._cloud_publisher = self._create_cloud_publisher("~/cloud")
        self._class_publisher = self.create_publisher(String, "~/classes", latched_profile())
        self._has_classes = False
        self._publish_classes()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

        self._worker = NewestOnly(self._label, self._fail)
        self.create_subscription(
            PointCloud2,
            "points",
            self._receive,
            newest_cloud_profile(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.create_timer(REPORT_PERIOD, self._report)
        device = self._segment.hardware or settings.device
        self.get_logger().info(f"{settings.weights} on {device} waits for {topic}")

    def close(self) -> None:
        """End the thread that labels."""
        self._worker.close()

    def _declare_settings(self) -> Settings:
        values = {}
        for parameter in fields(Settings):
            descriptor = ParameterDescriptor(
                description=parameter.metadata["description"], read_only=True
            )
            declared = self.declare_parameter(parameter.name, parameter.default, descriptor)
            values[parameter.name] = declared.value
        return Settings(**values)

    def _create_cloud_publisher(self, topic: str) -> Any:
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(
            PointCloud2, topic, newest_cloud_profile(), qos_overriding_options=options
        )

    def _publish_classes(self) -> None:
        """Publish the classes once, as soon as the weights are known."""
        if not self._has_classes and self._segment.taxonomy is not None:
            self._class_publisher.publish(String(data=self._segment.classes()))
            self._has_classes = True

    def _receive(self, message: Any) -> None:
        drops = self._worker.put(_Arrival(message, time.monotonic()))
        self._health.receive(drops)

    def _label(self, arrival: _Arrival) -> None:
        """Label a message and publish the result; called in the worker's thread."""
        try:
            labelled = self._segment(arrival.message)
        except InputError as error:
            self._health.refuse(str(error))
            self.get_logger().error(str(error), throttle_duration_sec=REFUSAL_PERIOD)
            return

        self._publish_classes()
        # Encoding takes time, so only messages with a subscriber are encoded.
        if self._label_publisher.get_subscription_count():
            self._label_publisher.publish(to_ros(labelled, has_points=False))
        if self._cloud_publisher.get_subscription_count():
            self._cloud_publisher.publish(to_ros(labelled, has_points=True))

        age = self.get_clock().now().nanoseconds - labelled.origin.stamp
        self._health.label(
            Labelled(
                seconds=time.monotonic() - arrival.time,
                age=age / NANOSECONDS,
                points=len(labelled.points.raw),
                verdict=labelled.verdict,
            )
        )

    def _find_pose(self, origin: Message, is_back: bool) -> Any:
        """Return the pose (4, 4) of a scan at its stamp, or None if tf does not know it.

        Args:
            origin: the stamp and the frame of the scan.
            is_back: whether the time went backwards; then tf's transforms are of another run.
        """
        if is_back:
            self._frames.clear()  # fixed transforms stay
        try:
            found = self._frames.lookup_transform(
                self._odom_frame,
                origin.frame_id,
                time=RosTime(nanoseconds=origin.stamp),
                timeout=Duration(seconds=ODOMETRY_WAIT),
            )
            place, turn = found.transform.translation, found.transform.rotation
            # A row of TUM's format: time (does not matter here), place and quaternion.
            row = [0.0, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
            return timed_poses(self._odom_frame, np.array([row])).poses[0]
        except (TransformException, InputError) as error:
            self.get_logger().warning(
                f"a scan is labelled alone, without past scans: {reason_of(error)}",
                throttle_duration_sec=REFUSAL_PERIOD,
            )
            return None

    def _fail(self, error: Exception) -> None:
        """End the node: the error is not due to the message, so the next one would cause it too."""
        if not self.context.ok():  # the node was stopped while it labelled
            return
        self.exit_code = FAILED
        self.get_logger().fatal("".join(traceback.format_exception(error)))
        rclpy.try_shutdown()

    def _report(self) -> None:
        now = time.monotonic()
        report = self._health.report(now - self._report_time)
        self._report_time = now

        values = [KeyValue(key=key, value=value) for key, value in report.values.items()]
        status = DiagnosticStatus(
            level=getattr(DiagnosticStatus, report.level.value),
            name=f"{self.get_name()}: segmentation",
            message=report.message,
            hardware_id=self._segment.hardware,
            values=values,
        )
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id="")
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


def newest_cloud_profile() -> QoSProfile:
    """Return the profile for sensor data that keeps only the newest cloud.

    Each topic needs its own profile: rclpy writes the user's overrides for a topic into it.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def latched_profile() -> QoSProfile:
    """Return a profile with which late subscribers also get the last message."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def to_ros(labelled: LabelledCloud, has_points: bool) -> PointCloud2:
    """Return the message of labelled points; it has x, y, z and rgb only if `has_points`."""
    return encode_labels(
        TYPES,
        labelled.origin,
        labelled.points,
        has_points,
        to_bytes=lambda data: array("B", data.tobytes()),
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; return the exit code.

    The exit code is 0 after the shutdown, 2 if a parameter is wrong (with one line on stderr), and
    1 after any other error.
    """
    wait_passively()

    rclpy.init(args=args)
    try:
        node = SegmentNode()
    except (InputError, ParameterException) as error:
        print(f"amvnet_ros: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return WRONG_INPUT

    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()
    return node.exit_code


if __name__ == "__main__":
    sys.exit(main())
