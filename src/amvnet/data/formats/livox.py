"""Clouds from ROS messages of Livox's drivers, of the type CustomMsg."""

from __future__ import annotations

import struct

import numpy as np

from amvnet.data.formats.cloud import (
    NANOSECONDS,
    Cloud,
    check_point_count,
    make_cloud,
    split_records,
)
from amvnet.errors import InputError

TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
FULL_INTENSITY = 255.0

# A point: its time, coordinates in metres, reflectivity, tag and laser, without padding.
POINT = np.dtype(
    [
        ("time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)
ENCAPSULATION = 4  # bytes before a message of ROS 2; alignment counts from behind them


def read_custom_message(data: bytes, is_ros1: bool, name: str) -> Cloud:
    """Return the points of a serialised CustomMsg; the reflectivity is the intensity.

    Args:
        data: the message, as ROS 1 or ROS 2 (CDR, little endian) serialises it.

    Raises:
        InputError: if the data are shorter than the message claims.
        struct.error: if they end before the points.
    """
    start, count = _find_points(data, 0 if is_ros1 else ENCAPSULATION, is_ros1)
    check_point_count(count, name)

    # ROS 2 aligns the time of every point.
    stride = POINT.itemsize if is_ros1 else -(-POINT.itemsize // 4) * 4
    size = (count - 1) * stride + POINT.itemsize if count else 0
    if len(data) < start + size:
        raise InputError(f"{name}: expected {count} points, found {len(data)} bytes")

    records = np.ndarray((count,), POINT, data, start, (stride,)) if count else np.empty(0, POINT)
    cloud = make_cloud(split_records(records), name)
    return Cloud(cloud.xyz, cloud.intensity, None, name, FULL_INTENSITY)


def read_header(data: bytes, is_ros1: bool) -> tuple[int, str]:
    """Return the stamp of a serialised CustomMsg, in nanoseconds, and the name of its frame."""
    position = 4 if is_ros1 else ENCAPSULATION
    seconds, nanoseconds, length = struct.unpack_from("<III", data, position)
    frame = data[position + 12 : position + 12 + length].rstrip(b"\0")
    return seconds * NANOSECONDS + nanoseconds, frame.decode("utf-8", "replace")


def _find_points(data: bytes, origin: int, is_ros1: bool) -> tuple[int, int]:
    """Return the offset of the first point in a message, and the number of points.

    Before them are a header (in ROS 1 a sequence number; seconds, nanoseconds, the frame's name),
    the time of the first point, the number of points, the LiDAR's number and three spare bytes.

    Args:
        origin: the offset of the message.
    """
    position = origin + (12 if is_ros1 else 8)
    (length,) = struct.unpack_from("<I", data, position)
    position += 4 + length
    if not is_ros1:
        position += -(position - origin) % 8

    position += 8 + 4 + 4
    (count,) = struct.unpack_from("<I", data, position)
    return position + 4, count
