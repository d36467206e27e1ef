"""Formats that other packages write: messages of sensors, and Feather."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amvnet.data.formats.find import list_scans, read_cloud

from fixtures.extra_writers import write_sweep
from fixtures.scan_writers import some_points
from fixtures.worlds import fails

PACKETS = "uint8[] data\n"


def store_with(store: Stores, definitions: dict[str, str]) -> Any:
    """Return the types of a version of ROS, and others by their definitions."""
    types = get_typestore(store)
    for name, definition in definitions.items():
        types.register(get_types_from_msg(definition, name))
    return types


def test_a_bag_of_other_messages_says_how_they_become_clouds(tmp_path: Path) -> None:
    kind = "velodyne_msgs/msg/VelodyneScan"
    path = tmp_path / "a.bag"
    store = store_with(Stores.ROS1_NOETIC, {kind: PACKETS})
    with BagWriter(path) as writer:
        connection = writer.add_connection("/packets", kind, typestore=store)
        message = store.types[kind](np.zeros(9, np.uint8))
        writer.write(connection, 0, store.serialize_ros1(message, kind))

    words = ("/packets", kind, "driver")
    fails(lambda: list(list_scans(path)), *words)
    fails(lambda: list(list_scans(path, "/points")), "/points", *words)


# --- Feather ---


def test_a_table_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    points = some_points()
    cloud = read_cloud(write_sweep(tmp_path / "a.feather", points))
    np.testing.assert_array_equal(cloud.xyz, points[:, :3].astype("f2").astype("f4"))
    assert cloud.intensity_scale() == 255


def test_broken_feather_is_refused(tmp_path: Path) -> None:
    content = write_sweep(tmp_path / "log.feather", some_points()).read_bytes()
    path = tmp_path / "a.feather"
    for size in (7, 100, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:size])
        fails(lambda: read_cloud(path), path)


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"ARROW1\0\0")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    fails(lambda: read_cloud(path), path, 'pip install "amvnet[datasets]"')


@pytest.mark.parametrize("name", ["a.parquet", "a.pkl", "a.pcap", "a.bin.gz"])
def test_formats_that_are_not_read_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)))
    fails(lambda: read_cloud(path), path, "convert it", "PointCloud2")
