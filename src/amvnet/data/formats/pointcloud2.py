"""Read ROS messages of the type sensor_msgs/PointCloud2 without ROS.

A message is any object with the attributes of PointCloud2, such as a message of rclpy or rosbags.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    record_dtype,
    require_columns,
)
from amvnet.errors import InputError

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"  # the type in ROS 2; rosbags also has it for ROS 1

# NumPy types by their number in a PointField.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read_message(message: Any, name: str) -> Cloud:
    """Return the points of a message of PointCloud2, row by row, without the padding.

    Raises:
        InputError: if x, y or z is missing, or the data are shorter than the message claims.
    """
    count = check_point_count(message.height * message.width, name)
    fields = list(message.fields)
    byte_order = ">" if message.is_bigendian else "<"

    columns = {}
    for key, index in require_columns([field.name for field in fields], name).items():
        field = fields[index]
        columns[key] = (byte_order + TYPES[field.datatype], field.offset)
    dtype = record_dtype(columns, message.point_step)

    # Rows can also have padding. Some drivers do not set row_step.
    row_size = message.width * message.point_step
    row_step = message.row_step or row_size
    size = (message.height - 1) * row_step + row_size
    if count and (row_step < row_size or len(message.data) < size):
        raise InputError(
            f"{name}: expected {count} points of {message.point_step} bytes, "
            f"found {len(message.data)} bytes; check the driver"
        )

    data = np.ascontiguousarray(message.data) if count else b""
    shape = (message.height, message.width)
    strides = (row_step, message.point_step)
    records = np.ndarray(shape, dtype, data, strides=strides).ravel()
    return make_cloud({key: records[key] for key in columns}, name)
