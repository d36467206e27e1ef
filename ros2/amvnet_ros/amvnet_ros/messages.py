"""Encode labels as sensor_msgs/PointCloud2, with the message classes of any ROS library."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.data.formats.cloud import record_dtype
from amvnet.data.formats.pointcloud2 import CLOUD_TYPE, TYPES

FIELD_TYPE = "sensor_msgs/msg/PointField"
HEADER_TYPE = "std_msgs/msg/Header"
TIME_TYPE = "builtin_interfaces/msg/Time"
NANOSECONDS = 1_000_000_000  # the nanoseconds of a second
ALIGNMENT = 4  # the step between the fields of an encoded point, as in PCL, bytes


@dataclass(frozen=True)
class Message:
    """The parts of a cloud's message that its labels keep.

    Attributes:
        stamp: the time at which the points were measured, nanoseconds since the epoch.
        frame_id: the name of the frame of the coordinates.
        height: the number of rows of an organised cloud, else 1.
    """

    stamp: int
    frame_id: str
    height: int = 1

    @classmethod
    def of(cls, message: Any) -> Message:
        """Return these parts of a deserialised PointCloud2."""
        stamp = message.header.stamp
        nanoseconds = stamp.sec * NANOSECONDS + stamp.nanosec
        return cls(nanoseconds, message.header.frame_id, message.height)


@dataclass(frozen=True)
class LabelledPoints:
    """The points of a scan and their labels.

    Attributes:
        xyz: (N, 3) coordinates, metres.
        raw: (N,) uint32 raw ids.
        colors: (N, 3) uint8 RGB.
        uncertain: (N,) bool; None if it is not known which points are uncertain.
    """

    xyz: np.ndarray
    raw: np.ndarray
    colors: np.ndarray
    uncertain: np.ndarray | None

    def packed_colors(self) -> NDArray[np.float32]:
        """Return (N,) little-endian float32 whose bits are the colours as PCL packs them."""
        red, green, blue = self.colors.astype(np.uint32).T
        packed: NDArray[np.float32] = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
        return packed


def encode_labels(
    types: Mapping[str, Callable[..., Any]],
    origin: Message,
    points: LabelledPoints,
    has_points: bool = True,
    to_bytes: Callable[[np.ndarray], Any] = np.asarray,
) -> Any:
    """Return the message of N labelled points, in their order.

    Its fields are x, y, z (float32), rgb (float32, packed as in PCL), label (uint32, raw ids) and,
    if it is known, uncertain (uint8). Coordinates are float32 because PCL and RViz read no other
    type.

    Args:
        types: the classes of PointCloud2, PointField, Header and Time by name, such as `types` of a
            type store of rosbags.
        origin: the parts of the cloud's message, for the header and the rows.
        points: the points and their labels; NaN stays NaN.
        has_points: whether the message has x, y, z and rgb.
        to_bytes: turns (B,) uint8 into the library's type for bytes.
    """
    columns: dict[str, np.ndarray] = {}
    if has_points:
        with np.errstate(over="ignore", invalid="ignore"):
            columns["x"], columns["y"], columns["z"] = points.xyz.T.astype("<f4")
        columns["rgb"] = points.packed_colors()
    columns["label"] = points.raw.astype("<u4")
    if points.uncertain is not None:
        columns["uncertain"] = points.uncertain.astype("u1")

    numbers = {kind: number for number, kind in TYPES.items()}
    fields: list[Any] = []
    layout = {}
    for name, values in columns.items():
        kind = values.dtype.str
        offset = ALIGNMENT * len(fields)  # no column is wider
        number = numbers[kind[1:]]
        fields.append(types[FIELD_TYPE](name=name, offset=offset, datatype=number, count=1))
        layout[name] = (kind, offset)

    records = np.zeros(len(points.raw), record_dtype(layout, ALIGNMENT * len(fields)))
    for name, values in columns.items():
        records[name] = values

    width = len(records) // origin.height
    return types[CLOUD_TYPE](
        header=_header(types, origin),
        height=origin.height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=records.itemsize,
        row_step=width * records.itemsize,
        data=to_bytes(records.view(np.uint8)),
        is_dense=not has_points or bool(np.isfinite(points.xyz).all()),
    )


def _header(types: Mapping[str, Callable[..., Any]], origin: Message) -> Any:
    seconds, nanoseconds = divmod(origin.stamp, NANOSECONDS)
    stamp = types[TIME_TYPE](sec=seconds, nanosec=nanoseconds)
    header_type = types[HEADER_TYPE]
    # In ROS 1, headers have a sequence number.
    is_ros1 = "seq" in getattr(header_type, "__annotations__", {})
    sequence = {"seq": 0} if is_ros1 else {}
    return header_type(stamp=stamp, frame_id=origin.frame_id, **sequence)
