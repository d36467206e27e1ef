"""Formats that other packages write: Livox messages, packets, Feather, E57 and captures."""

from __future__ import annotations

import shutil
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amvnet.data.formats.find import list_scans
from amvnet.data.formats.livox import TYPES as LIVOX
from amvnet.data.formats.packets import open_capture
from amvnet.data.formats.registry import read_cloud
from amvnet.inference.reading import FileReader

from fixtures.extra_writers import vlp16_packet, write_capture, write_e57, write_sweep
from fixtures.scan_writers import some_points
from fixtures.worlds import fails

CUSTOM_POINT = """\
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
CUSTOM_MESSAGE = """\
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
{package}/CustomPoint[] points
"""
PACKETS = "uint8[] data\n"


def store_with(store: Stores, definitions: dict[str, str]) -> Any:
    """Return the types of a version of ROS, and others by their definitions."""
    types = get_typestore(store)
    for name, definition in definitions.items():
        types.register(get_types_from_msg(definition, name))
    return types


def livox_message(store: Any, kind: str, points: np.ndarray, frame: str) -> Any:
    point_type = store.types[kind.replace("CustomMsg", "CustomPoint")]
    header_type = store.types["std_msgs/msg/Header"]
    sequence = {"seq": 0} if "seq" in header_type.__annotations__ else {}
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    items = []
    for index, (x, y, z, intensity) in enumerate(points.tolist()):
        items.append(point_type(index, x, y, z, round(intensity * 255), 16, index % 6))

    header = header_type(stamp=stamp, frame_id=frame, **sequence)
    return store.types[kind](header, 5, len(items), 0, np.zeros(3, np.uint8), items)


# The length of the name decides what comes between it and the next number.
@pytest.mark.parametrize("frame", ["", "a", "livox", "livox_frame", "of eight"])
@pytest.mark.parametrize("kind", LIVOX)
@pytest.mark.parametrize("version", [1, 2])
def test_messages_of_livox_are_read(tmp_path: Path, version: int, kind: str, frame: str) -> None:
    package = kind.split("/")[0]
    definitions = {
        f"{package}/msg/CustomPoint": CUSTOM_POINT,
        kind: CUSTOM_MESSAGE.format(package=package),
    }
    points = some_points()
    if version == 1:
        path = tmp_path / "a.bag"
        store = store_with(Stores.ROS1_NOETIC, definitions)
        with BagWriter(path) as writer:
            connection = writer.add_connection("/livox/lidar", kind, typestore=store)
            for count in (60, 0, 7):
                message = livox_message(store, kind, points[:count], frame)
                writer.write(connection, count, store.serialize_ros1(message, kind))
    else:
        path = tmp_path / "a"
        store = store_with(Stores.ROS2_HUMBLE, definitions)
        with Bag2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            connection = bag.add_connection("/livox/lidar", kind, typestore=store)
            for count in (60, 0, 7):
                message = livox_message(store, kind, points[:count], frame)
                bag.write(connection, count, bytes(store.serialize_cdr(message, kind)))

    clouds = [scan.read() for scan in list_scans(path)]
    assert sorted(len(cloud.xyz) for cloud in clouds) == [0, 7, 60]
    (cloud,) = [cloud for cloud in clouds if len(cloud.xyz) == 60]
    np.testing.assert_array_equal(cloud.xyz, points[:, :3])
    np.testing.assert_array_equal(cloud.intensity, np.round(points[:, 3] * 255))
    assert cloud.intensity_scale() == 255
    assert cloud.ring is None


def test_a_bag_of_packets_says_what_turns_them_into_clouds(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    kind = "velodyne_msgs/msg/VelodyneScan"
    store = store_with(Stores.ROS1_NOETIC, {kind: PACKETS})
    with BagWriter(path) as writer:
        connection = writer.add_connection("/velodyne_packets", kind, typestore=store)
        message = store.types[kind](np.zeros(9, np.uint8))
        writer.write(connection, 0, store.serialize_ros1(message, kind))

    words = ("/velodyne_packets", kind, "velodyne_pointcloud")
    fails(lambda: list(list_scans(path)), *words)
    fails(lambda: list(list_scans(path, "/points")), "/points", *words)


# --- Feather ---


def test_a_sweep_of_argoverse_is_moved_to_its_lidars(tmp_path: Path) -> None:
    points = some_points()
    expected = points[:, :3].astype("f2").astype("f4")

    cloud = read_cloud(write_sweep(tmp_path / "alone", points, {}))
    np.testing.assert_array_equal(cloud.xyz, expected)
    assert cloud.intensity_scale() == 255

    lidars = {"ring_camera": (9.0, 9, 9), "up_lidar": (1.0, 0, 1.5), "down_lidar": (2.0, 0, 1.5)}
    path = write_sweep(tmp_path / "log", points, lidars)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.xyz, expected - np.array([1.5, 0, 1.5], "f4"), atol=1e-5)
    assert "Argoverse" in cloud.note

    # Labels are written with the coordinates of the file.
    (scan,) = list_scans(path)
    np.testing.assert_array_equal(FileReader(None).read(scan).file_xyz, expected)


def test_logs_of_argoverse_are_their_sweeps(tmp_path: Path) -> None:
    lidars = {"up_lidar": (1.0, 0.0, 1.5)}
    for log in ("a", "b"):
        path = write_sweep(tmp_path / log, some_points(), lidars)
        # A log has other tables, too.
        shutil.copy(tmp_path / log / "calibration/egovehicle_SE3_sensor.feather", tmp_path / log)

    assert [scan.name for scan in list_scans(tmp_path / "a")] == [path.stem]
    names = [scan.name for scan in list_scans(tmp_path)]
    assert names == [f"a/{path.stem}", f"b/{path.stem}"]


def test_broken_feather_is_refused(tmp_path: Path) -> None:
    content = write_sweep(tmp_path / "log", some_points(), {}).read_bytes()
    path = tmp_path / "a.feather"
    for size in (7, 100, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:size])
        fails(lambda: read_cloud(path), path)


# --- E57 ---


def test_every_scan_of_e57_is_read(tmp_path: Path) -> None:
    points = some_points().astype(np.float64)
    fields = dict(
        zip(("cartesianX", "cartesianY", "cartesianZ", "intensity"), points.T, strict=True)
    )
    lost = np.arange(60) == 3
    path = write_e57(
        tmp_path / "a.e57", [fields, fields | {"cartesianInvalidState": lost.astype(int)}]
    )

    first, second = [scan.read() for scan in list_scans(path)]
    np.testing.assert_allclose(first.xyz, points[:, :3], atol=1e-5)
    assert first.intensity is not None
    np.testing.assert_allclose(first.intensity, points[:, 3], atol=1e-6)
    np.testing.assert_array_equal(np.isnan(second.xyz).all(axis=1), lost)

    content = path.read_bytes()
    for size in (9, 100, 1500, len(content) // 2):
        path.write_bytes(content[:size])
        fails(lambda: read_cloud(path), path)


# --- captures ---


def test_a_capture_of_velodyne_is_its_turns(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    packets = [vlp16_packet(480 * index % 36000, index * 1327) for index in range(300)]
    path = write_capture(tmp_path / "drive.pcap", packets)

    scans = list(list_scans(path))
    assert [scan.name for scan in scans] == [f"drive/{index:06d}" for index in range(len(scans))]
    assert len(scans) == 4  # 75 packets a turn
    for index in (1, 2, 1):
        cloud = scans[index].read()
        assert abs(len(cloud.xyz) - 75 * 12 * 32) < 1000
        np.testing.assert_allclose(np.linalg.norm(cloud.xyz, axis=1), 10, atol=0.1)
        assert cloud.ring is not None
        assert set(cloud.ring) == set(range(16))
        assert cloud.intensity_scale() == 255


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("name", ["a.pcapng", "a.pcap"])
def test_a_capture_in_the_newer_format_is_refused_with_the_command_that_converts_it(
    tmp_path: Path, name: str, order: str
) -> None:
    path = tmp_path / name
    path.write_bytes(struct.pack(f"{order}IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28))
    fails(lambda: list(list_scans(path)), path, "editcap")


@pytest.mark.parametrize(
    ("maker", "data", "port"),
    [
        ("Ouster", bytes(3392), 7502),
        ("Hesai", b"\xee\xff\x03\x01" + bytes(1000), 2368),
        ("Livox", bytes(1362), 56301),
        ("RoboSense", b"\x55\xaa\x05\x0a" + bytes(1240), 6699),
        ("unknown", bytes(100), 53),
    ],
)
def test_a_capture_of_another_sensor_says_what_converts_it(
    tmp_path: Path, maker: str, data: bytes, port: int
) -> None:
    path = write_capture(tmp_path / "a.pcap", [data] * 3, port)
    fails(lambda: read_cloud(path), path, maker)


@pytest.mark.parametrize(
    ("package", "extra", "content"),
    [("pyarrow", "datasets", b"ARROW1\0\0"), ("pye57", "e57", b"ASTM-E57")],
)
def test_a_missing_extra_is_named(
    tmp_path: Path, package: str, extra: str, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_bytes(content)
    monkeypatch.setitem(sys.modules, package, None)
    fails(lambda: read_cloud(path), path, f'pip install "amvnet[{extra}]"')


def test_the_missing_extra_of_captures_is_named_only_if_it_would_help(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    path = write_capture(tmp_path / "a.pcap", [vlp16_packet(0, 0)])
    fails(lambda: open_capture(path), path, 'pip install "amvnet[packets]"')
    write_capture(path, [bytes(3392)], 7502)
    fails(lambda: open_capture(path), path, "ouster-cli")


@pytest.mark.parametrize(
    ("name", "word"),
    [("a.tfrecord", "Waymo"), ("a.parquet", "Waymo"), ("a.pkl", "numpy.save"), ("a.lvx", "bag")],
)
def test_formats_that_are_not_read_say_what_to_do(tmp_path: Path, name: str, word: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)))
    fails(lambda: read_cloud(path), path, word)
