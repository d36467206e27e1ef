"""Fuse the scores of each scan with those of the scans before it; this needs no ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amvnet_ros.messages import NANOSECONDS, Message

if TYPE_CHECKING:  # the node sets the environment before torch reads it
    from amvnet.drives.consensus import DriveScan, Fused
    from amvnet.inference.segmentation import Segmentation
    from amvnet.scan import Scan

FASTEST = 70.0  # a larger speed is a jump of the odometry, metres per second

Pose = NDArray[np.float64]  # (4, 4) moves points of a cloud in metres into the world
FindPose = Callable[[Message, bool], Pose | None]


class PastFusion:
    """Fuses each scan with the scans in reach before it; only these are in memory.

    All scans before a scan are forgotten if the time goes backwards, as in a bag that starts again,
    or if the odometry jumps. A scan without a pose is labelled alone.

    Args:
        find_pose: takes the stamp and the frame of a scan, and whether its time is before the time
            of the last scan; returns the pose of the scan, or None if there is no pose.
    """

    def __init__(self, find_pose: FindPose) -> None:
        self._find_pose = find_pose
        self._waiting: deque[DriveScan[None]] = deque()
        self._fused: Iterator[Fused[None]] | None = None
        self._count = 0  # of the scans that are fused
        self._stamp = 0  # of the last scan, nanoseconds
        self._last: tuple[int, Pose] | None = None  # stamp and pose of the last scan with a pose

    def yaw(self, origin: Message) -> float:
        """Return the angle by which the networks get the next scan turned, radians."""
        from amvnet.inference.drive import TURN

        return 0.0 if origin.stamp < self._stamp else self._count * TURN

    def __call__(self, origin: Message, scan: Scan, result: Segmentation) -> Segmentation:
        """Return a result with the consensus as labels and scores.

        Args:
            origin: the stamp and the frame of the scan.
            scan: the points of the message, normalised to the weights, in metres.
            result: the result for the scan alone.
        """
        from amvnet.drives.consensus import Consensus, DriveScan
        from amvnet.inference.drive import to_file, with_scores

        is_back = origin.stamp < self._stamp
        self._stamp = origin.stamp
        pose = self._find_pose(origin, is_back)
        if is_back or (pose is not None and self._jumps(pose)):
            self._fused = self._last = None
            self._count = 0
        if pose is None:
            return result

        self._count += 1
        self._last = (origin.stamp, pose)
        if self._fused is None:  # of past scans alone, each scan comes back at once
            self._fused = Consensus(past_only=True).stream(iter(self._waiting.popleft, None))
        motion = pose @ to_file(scan)
        self._waiting.append(DriveScan(None, scan.points[:, :3], result.scores, motion))
        return with_scores(result, next(self._fused).scores)

    def _jumps(self, pose: Pose) -> bool:
        """Return whether the sensor cannot have moved to a pose since the last one."""
        if self._last is None:
            return False
        stamp, last = self._last
        metres = np.linalg.norm(pose[:3, 3] - last[:3, 3])
        return bool(metres * NANOSECONDS > FASTEST * (self._stamp - stamp))
