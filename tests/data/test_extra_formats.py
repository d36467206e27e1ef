"""Formats that other packages write: messages of sensors, and what is not read."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amvnet.data.formats.find import list_scans, read_cloud

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


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"LASF\0\0")
    monkeypatch.setitem(sys.modules, "laspy", None)
    fails(lambda: read_cloud(path), path, 'pip install "amvnet[formats]"')


@pytest.mark.parametrize("name", ["a.parquet", "a.feather", "a.pkl", "a.pcap", "a.bin.gz"])
def test_formats_that_are_not_read_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)))
    fails(lambda: read_cloud(path), path, "convert it", "PointCloud2")
