"""ROS messages of the type sensor_msgs/PointCloud2, to points and from labels, without ROS.

A message is any object with the attributes of PointCloud2: of rclpy, of rosbags, or the plain
values below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    record_dtype,
    require_columns,
    split_records,
)
from amvnet.errors import InputError

# Names of messages in ROS 2, which rosbags uses for ROS 1, too.
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
FIELD_TYPE = "sensor_msgs/msg/PointField"
HEADER_TYPE = "std_msgs/msg/Header"
TIME_TYPE = "builtin_interfaces/msg/Time"

NANOSECONDS = 1_000_000_000  # of a second
ALIGNMENT = 4  # bytes: every field of an encoded point starts at a multiple, as in PCL

# NumPy types by their number in a PointField.
TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    8: "f8",
}


def read_message(message: Any, name: str) -> Cloud:
    """Return the points of a deserialised message, row by row, without the padding.

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

    # Rows can have padding, too. Some drivers leave out row_step.
    row_size = message.width * message.point_step
    row_step = message.row_step or row_size
    size = (message.height - 1) * row_step + row_size
    if count and (row_step < row_size or len(message.data) < size):
        raise InputError(
            f"{name}: expected {count} points of {message.point_step} bytes, "
            f"found {len(message.data)} bytes"
        )

    data = np.ascontiguousarray(message.data) if count else b""
    shape = (message.height, message.width)
    strides = (row_step, message.point_step)
    records = np.ndarray(shape, dtype, data, strides=strides).ravel()
    return make_cloud(split_records(records), name)


@dataclass(frozen=True)
class PointField:
    """A column of a message; attributes as in sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True)
class Origin:
    """When and in which frame the points of a message were measured.

    Attributes:
        stamp: nanoseconds since the epoch.
        frame_id: name of the frame of the coordinates.
        height: number of rows of an organised cloud; 1 if it is not organised.
    """

    stamp: int
    frame_id: str
    height: int = 1

    @classmethod
    def of(cls, message: Any) -> Origin:
        """Return the origin of a deserialised message."""
        stamp = message.header.stamp
        nanoseconds = stamp.sec * NANOSECONDS + stamp.nanosec
        return cls(nanoseconds, message.header.frame_id, message.height)


@dataclass(frozen=True)
class PlainCloud:
    """The values of a PointCloud2, without the classes of any ROS library.

    Attributes:
        origin: its header, and its height.
        data: (height * row_step,) uint8, the points row by row.

    The other attributes are those of sensor_msgs/PointCloud2.
    """

    origin: Origin
    width: int
    fields: tuple[PointField, ...]
    point_step: int
    data: np.ndarray
    is_dense: bool
    is_bigendian: bool = False

    @property
    def height(self) -> int:
        return self.origin.height

    @property
    def row_step(self) -> int:
        return self.width * self.point_step

    def to_message(
        self,
        types: Mapping[str, Callable[..., Any]],
        to_bytes: Callable[[np.ndarray], Any] = np.asarray,
    ) -> Any:
        """Return the message in the classes of a ROS library.

        Args:
            types: the classes of PointCloud2, PointField, Header and Time by name, such as `types`
                of a type store of rosbags.
            to_bytes: turns (B,) uint8 into what the library takes as bytes.
        """
        sec, nanosec = divmod(self.origin.stamp, NANOSECONDS)
        stamp = types[TIME_TYPE](sec=sec, nanosec=nanosec)
        header_type = types[HEADER_TYPE]
        sequence = {"seq": 0} if _has_sequence(header_type) else {}

        fields: list[Any] = []
        for field in self.fields:
            fields.append(types[FIELD_TYPE](**vars(field)))

        return types[CLOUD_TYPE](
            header=header_type(stamp=stamp, frame_id=self.origin.frame_id, **sequence),
            height=self.height,
            width=self.width,
            fields=fields,
            is_bigendian=self.is_bigendian,
            point_step=self.point_step,
            row_step=self.row_step,
            data=to_bytes(self.data),
            is_dense=self.is_dense,
        )


def encode_labels(
    origin: Origin,
    labels: np.ndarray,
    uncertain: np.ndarray | None = None,
    xyz: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> PlainCloud:
    """Return the message of N labelled points, in their order.

    Its fields are x, y, z (float32), rgb (float32, packed as in PCL), label (uint32) and uncertain
    (uint8), without those that are not given. PCL and RViz read no other type of coordinates.

    Args:
        origin: where the points come from, such as that of the message with the scan.
        labels: (N,) integers, raw ids or train ids.
        uncertain: (N,) bool.
        xyz: (N, 3) coordinates, metres; NaN stays NaN.
        colors: (N, 3) uint8 RGB.

    Raises:
        InputError: if the lengths differ, or N is not a multiple of the number of rows.
    """
    columns: dict[str, np.ndarray] = {}
    if xyz is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            columns["x"], columns["y"], columns["z"] = np.asarray(xyz).T.astype("<f4")
    if colors is not None:
        columns["rgb"] = pack_rgb(colors)
    columns["label"] = np.asarray(labels).astype("<u4")
    if uncertain is not None:
        columns["uncertain"] = np.asarray(uncertain).astype("u1")

    _check_lengths(columns, origin.height)
    is_dense = xyz is None or bool(np.isfinite(xyz).all())
    return _encode(origin, columns, is_dense)


def pack_rgb(colors: np.ndarray) -> np.ndarray:
    """Return (N,) little-endian float32, whose bits are (N, 3) uint8 RGB as PCL packs them."""
    red, green, blue = np.asarray(colors).astype(np.uint32).T
    return (red << 16 | green << 8 | blue).astype("<u4").view("<f4")


def _encode(origin: Origin, columns: Mapping[str, np.ndarray], is_dense: bool) -> PlainCloud:
    """Return the message of (N,) little-endian columns."""
    numbers = {kind: number for number, kind in TYPES.items()}
    fields: list[PointField] = []
    layout = {}
    for name, values in columns.items():
        offset = ALIGNMENT * len(fields)  # no column is wider
        kind = values.dtype.str[1:]
        fields.append(PointField(name, offset, numbers[kind]))
        layout[name] = (values.dtype.str, offset)

    count = len(columns["label"])
    records = np.zeros(count, record_dtype(layout, ALIGNMENT * len(fields)))
    for name, values in columns.items():
        records[name] = values

    return PlainCloud(
        origin=origin,
        width=count // origin.height,
        fields=tuple(fields),
        point_step=records.itemsize,
        data=records.view(np.uint8),
        is_dense=is_dense,
    )


def _check_lengths(columns: Mapping[str, np.ndarray], height: int) -> None:
    """Raise an InputError unless the columns have one length, a multiple of the height."""
    lengths = {name: len(values) for name, values in columns.items()}
    count = lengths["label"]
    if len(set(lengths.values())) > 1:
        raise InputError(
            f"expected one value per point in every field, found {lengths}; segment the whole scan"
        )

    if height < 1 or count % height:
        raise InputError(
            f"expected {count} points in rows of one length, found {height} rows; "
            "give the height of the scan's own message"
        )


def _has_sequence(header_type: Callable[..., Any]) -> bool:
    """Return whether headers have a sequence number, as in ROS 1."""
    return "seq" in getattr(header_type, "__annotations__", {})
