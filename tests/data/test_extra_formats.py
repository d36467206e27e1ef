"""Formats that other packages write: messages of sensors, and what is not read."""

from __future__ import annotations

import gzip
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amvnet.data.formats.detect import BAGS, GZIP, named_ending, scan_stem
from amvnet.data.formats.find import list_scans, read_cloud
from amvnet.data.formats.rows import parse_layout
from amvnet.errors import InputError

from fixtures.commands import fails, new_file
from fixtures.scan_writers import WRITERS, some_points, write_sweep

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


@pytest.mark.parametrize("name", ["a.parquet", "a.pkl", "a.pcap"])
def test_formats_that_are_not_read_are_refused(tmp_path: Path, name: str) -> None:
    path = new_file(tmp_path / name, bytes(range(256)))
    fails(lambda: read_cloud(path), path, "convert it", "PointCloud2")


# --- tables of Argoverse 2 ---


def test_a_sweep_of_argoverse_is_read(tmp_path: Path) -> None:
    points = some_points(count=100)
    for name in ("a.feather", "a.bin", "a"):
        cloud = read_cloud(write_sweep(tmp_path / name, points))
        np.testing.assert_array_equal(cloud.xyz, points[:, :3].astype("f2"))
        np.testing.assert_array_equal(cloud.intensity, np.round(points[:, 3] * 255))
        assert cloud.xyz.dtype == np.float32


def test_a_broken_sweep_is_one_line(tmp_path: Path) -> None:
    content = write_sweep(tmp_path / "a.feather", some_points(count=100)).read_bytes()
    path = tmp_path / "b.feather"
    for size in (6, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        fails(lambda: read_cloud(path), path)
    rng = np.random.default_rng(0)
    for _ in range(40):
        changed = bytearray(content)
        for place in rng.integers(6, len(content), 4):
            changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        with suppress(InputError):
            read_cloud(path)


def test_feather_needs_a_named_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = new_file(tmp_path / "a.feather", b"ARROW1\0\0")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    fails(lambda: read_cloud(path), path, 'pip install "amvnet[feather]"')


# --- packed files ---


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("files")
    contents = {}
    for name, write in WRITERS.items():
        write(folder / name, some_points())
        if named_ending(Path(name)) not in (*BAGS, GZIP):
            contents[name] = (folder / name).read_bytes()
    return contents


def test_every_format_may_be_packed(tmp_path: Path, contents: dict[str, bytes]) -> None:
    for name, content in contents.items():
        path = new_file(tmp_path / f"{name}.gz", gzip.compress(content))
        (scan,) = list_scans(path)
        assert (scan.name, scan.path) == (scan_stem(Path(name)), path)
        assert scan.ending == named_ending(Path(name))
        np.testing.assert_allclose(scan.read().to_scan().points, some_points(), atol=1e-3)

    names = {scan.name for scan in list_scans(tmp_path)}
    assert names == {scan_stem(Path(name)) for name in contents if name != "plain.xyz"}


def test_rows_may_be_packed(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.bin.gz", gzip.compress(some_points()[:, :3].tobytes()))
    cloud = read_cloud(path, parse_layout("z,y,x", None))
    np.testing.assert_array_equal(cloud.xyz, some_points()[:, 2::-1])


def test_a_broken_packed_file_is_one_line(tmp_path: Path, contents: dict[str, bytes]) -> None:
    packed = gzip.compress(contents["kitti.bin"])
    cases = {
        "empty": b"\x1f\x8b",
        "cut": packed[: len(packed) // 2],
        "without its sum": packed[:-8],
        "changed": packed[:40] + bytes([packed[40] ^ 255]) + packed[41:],
        "packed twice": gzip.compress(packed),
        "followed by others": packed + b"more",
        "nothing": gzip.compress(b""),
        "an archive": gzip.compress(contents["archive.npz"][:40]),
    }
    for name, content in cases.items():
        path = new_file(tmp_path / f"{name}.bin.gz", content)
        fails(lambda path=path: read_cloud(path).to_scan(), path)  # type: ignore[misc]


def test_an_archive_of_scans_is_to_be_unzipped(tmp_path: Path, contents: dict[str, bytes]) -> None:
    path = tmp_path / "drive.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("kitti.bin", contents["kitti.bin"])
    fails(lambda: list(list_scans(path)), path, "unzip it")
    (tmp_path / "kitti.bin").write_bytes(contents["kitti.bin"])
    assert [scan.name for scan in list_scans(tmp_path)] == ["kitti"]
