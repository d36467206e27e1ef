"""ROS messages of the type sensor_msgs/PointCloud2 as clouds."""

from __future__ import annotations

from typing import Any

import numpy as np

from amvnet.data.formats.cloud import Cloud, check_point_count, make_cloud, require_columns
from amvnet.errors import InputError

TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    8: "f8",
}  # by the message's numbers


def read_message(message: Any, name: str) -> Cloud:
    """The points of a deserialised message, row by row; padding of points and of rows is left out.

    Raises:
        InputError: where there is no x, y, z, or the data are shorter than the message claims.
    """
    height, width, step = message.height, message.width, message.point_step
    count = check_point_count(height * width, name)
    fields = list(message.fields)
    wanted = {
        key: fields[i] for key, i in require_columns([field.name for field in fields], name).items()
    }
    order = ">" if message.is_bigendian else "<"
    point = np.dtype(
        {
            "names": list(wanted),
            "formats": [order + TYPES[field.datatype] for field in wanted.values()],
            "offsets": [field.offset for field in wanted.values()],
            "itemsize": step,
        }
    )
    row = message.row_step or width * step  # some drivers leave it out
    if count and (row < width * step or len(message.data) < (height - 1) * row + width * step):
        raise InputError(
            f"{name}: expected {count} points of {step} bytes, found {len(message.data)} bytes"
        )
    data = np.ascontiguousarray(message.data) if count else b""
    table = np.ndarray((height, width), point, data, strides=(row, step)).ravel()
    return make_cloud({key: table[key] for key in wanted}, name)
