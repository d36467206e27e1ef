"""Writes one scan in every format, by other libraries than the package reads it with, or byte by byte."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import plyfile
from pypcd4 import Encoding, PointCloud
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

CLOUD = "sensor_msgs/msg/PointCloud2"
COLUMNS = ("x", "y", "z", "intensity")
PCD_HEADER = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
    "COUNT {counts}\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
)


def some_points(count: int = 60, seed: int = 0) -> np.ndarray:
    """(N, 4) float32 points within tens of metres, to the millimetre, intensities in [0, 1] with two decimals."""
    rng = np.random.default_rng(seed)
    xyz = np.round(rng.normal(0, (20, 20, 2), (count, 3)), 3)
    intensity = np.round(rng.random(count), 2)
    intensity[0] = 1
    return np.column_stack([xyz, intensity]).astype(np.float32)


def write_pcd(path: Path, points: np.ndarray, encoding: str) -> Path:
    PointCloud.from_xyzi_points(points).save(str(path), Encoding(encoding))
    return path


def pcd_bytes(
    table: np.ndarray,
    fields: Sequence[tuple[str, str, int]],
    height: int = 1,
    points: int | None = None,
) -> bytes:
    """A binary PCD of a structured table whose fields have these names, types ("F 4") and counts."""
    kinds = [kind.split() for _, kind, _ in fields]
    header = PCD_HEADER.format(
        fields=" ".join(name for name, _, _ in fields),
        sizes=" ".join(size for _, size in kinds),
        types=" ".join(kind for kind, _ in kinds),
        counts=" ".join(str(count) for _, _, count in fields),
        width=len(table) // height,
        height=height,
        points=len(table) if points is None else points,
        data="binary",
    )
    return header.encode() + table.tobytes()


def write_ply(path: Path, points: np.ndarray, text: bool = False, order: str = "<") -> Path:
    kinds = [(name, "f4") for name in COLUMNS]
    vertices = np.array([tuple(row) for row in points.tolist()], dtype=kinds)
    element = plyfile.PlyElement.describe(vertices, "vertex")
    plyfile.PlyData([element], text=text, byte_order=order).write(str(path))
    return path


def write_las(path: Path, points: np.ndarray, point_format: int = 3, version: str = "1.2") -> Path:
    """Coordinates to the millimetre; intensities times 65535."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points[0, :3])
    las = laspy.LasData(header)
    las.x, las.y, las.z = points[:, :3].T.astype(np.float64)
    las.intensity = np.round(points[:, 3].astype(np.float64) * 65535).astype(np.uint16)
    las.write(str(path))
    return path


def cloud_message(
    store: Any, points: np.ndarray, padded: bool = False, big: bool = False, **changes: Any
) -> Any:
    """A PointCloud2 of (N, 4) points; a padded one is organised in two rows with gaps and has ring and time, too."""
    types, step = store.types, 32 if padded else 16
    kinds = {
        name: (offset, "f4")
        for name, offset in zip(COLUMNS, (0, 4, 8, 16 if padded else 12), strict=True)
    }
    if padded:
        kinds |= {"ring": (20, "u2"), "time": (24, "f8")}
    numbers = {"f4": 7, "u2": 4, "f8": 8}
    order = ">" if big else "<"
    formats, offsets = (
        [order + kind for _, kind in kinds.values()],
        [offset for offset, _ in kinds.values()],
    )
    table = np.zeros(
        len(points),
        np.dtype({"names": list(kinds), "formats": formats, "offsets": offsets, "itemsize": step}),
    )
    for i, name in enumerate(COLUMNS):
        table[name] = points[:, i]
    if padded:
        table["ring"] = np.arange(len(points)) % 16
    height = 2 if padded else 1
    width, gap = len(points) // height, 8 if padded else 0
    rows = [table[i * width : (i + 1) * width].tobytes() + bytes(gap) for i in range(height)]
    field, header = types["sensor_msgs/msg/PointField"], types["std_msgs/msg/Header"]
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    made = {
        "header": header(
            stamp=stamp, frame_id="lidar", **({"seq": 0} if "seq" in header.__annotations__ else {})
        ),
        "height": height,
        "width": width,
        "fields": [field(name, offset, numbers[kind], 1) for name, (offset, kind) in kinds.items()],
        "is_bigendian": big,
        "point_step": step,
        "row_step": width * step + gap,
        "data": np.frombuffer(b"".join(rows), np.uint8),
        "is_dense": True,
    }
    return types[CLOUD](**{**made, **changes})


Scans = dict[str, Sequence[np.ndarray]]  # of each topic


def write_bag1(path: Path, scans: Scans, compression: str | None = None, **message: Any) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(path)
    if compression is not None:
        writer.set_compression(BagWriter.CompressionFormat[compression])
    with writer:
        for topic, clouds in scans.items():
            connection = writer.add_connection(topic, CLOUD, typestore=store)
            for i, points in enumerate(clouds):
                data = store.serialize_ros1(cloud_message(store, points, **message), CLOUD)
                writer.write(connection, 100 * i, data)
    return path


def write_bag2(
    folder: Path,
    scans: Scans,
    storage: StoragePlugin,
    compressed: CompressionMode | None = None,
    **message: Any,
) -> Path:
    """The folder of a ROS 2 bag."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Bag2Writer(folder, version=9, storage_plugin=storage)
    if compressed is not None:
        writer.set_compression(compressed, CompressionFormat.ZSTD)
    with writer:
        for topic, clouds in scans.items():
            connection = writer.add_connection(topic, CLOUD, typestore=store)
            for i, points in enumerate(clouds):
                data = store.serialize_cdr(cloud_message(store, points, **message), CLOUD)
                writer.write(connection, 100 * i, bytes(data))
    return folder


def _storage_file(path: Path, scans: Scans, storage: StoragePlugin) -> Path:
    """The one file of a ROS 2 bag, without its folder's metadata."""
    folder = write_bag2(path.with_name(f"of_{path.name}"), scans, storage)
    (file,) = (entry for entry in folder.iterdir() if entry.name != "metadata.yaml")
    return file.rename(path)


def _bytes(content: Callable[[np.ndarray], bytes]) -> Callable[[Path, np.ndarray], object]:
    return lambda path, points: path.write_bytes(content(points))


def _with_ring(points: np.ndarray) -> np.ndarray:
    raw = points * np.array([1, 1, 1, 255], dtype=np.float32)
    return np.column_stack([raw, np.arange(len(points)) % 32]).astype(np.float32)


WRITERS: dict[str, Callable[[Path, np.ndarray], object]] = {
    "kitti.bin": _bytes(lambda points: points.tobytes()),
    "nuscenes.pcd.bin": _bytes(lambda points: _with_ring(points).tobytes()),
    "array.npy": lambda path, points: np.save(path, points),
    "archive.npz": lambda path, points: np.savez_compressed(path, points=points, other=np.zeros(2)),
    "ascii.pcd": lambda path, points: write_pcd(path, points, "ascii"),
    "binary.pcd": lambda path, points: write_pcd(path, points, "binary"),
    "compressed.pcd": lambda path, points: write_pcd(path, points, "binary_compressed"),
    "ascii.ply": lambda path, points: write_ply(path, points, text=True),
    "little.ply": lambda path, points: write_ply(path, points),
    "big.ply": lambda path, points: write_ply(path, points, order=">"),
    "old.las": write_las,
    "new.las": lambda path, points: write_las(path, points, 6, "1.4"),
    "packed.laz": write_las,
    "plain.bag": lambda path, points: write_bag1(path, {"/lidar": [points]}),
    "lz4.bag": lambda path, points: write_bag1(path, {"/lidar": [points]}, "LZ4"),
    "bz2.bag": lambda path, points: write_bag1(path, {"/lidar": [points]}, "BZ2"),
    "lone.mcap": lambda path, points: _storage_file(path, {"/lidar": [points]}, StoragePlugin.MCAP),
    "lone.db3": lambda path, points: _storage_file(
        path, {"/lidar": [points]}, StoragePlugin.SQLITE3
    ),
}  # by a name for each
