"""Every format holds the same scan, whoever wrote it and whatever its name; each point keeps its line."""

from __future__ import annotations

import os
import shutil
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from amvnet.data.formats.cloud import MAX_POINTS
from amvnet.data.formats.detect import read_cloud, scan_stem, scans_in_file
from amvnet.data.formats.pcd import unpack_lzf
from amvnet.data.formats.pointcloud2 import read_message
from amvnet.data.scan_files import find_scans, read_scan

from fixtures.scan_writers import (
    WRITERS,
    cloud_message,
    pcd_bytes,
    some_points,
    write_bag1,
    write_bag2,
    write_las,
)
from fixtures.worlds import fails

REAL = os.environ.get("AMVNET_REAL_DATA")
LAS_STEP = 0.0006  # LAS holds millimetres
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scan in every format."""
    folder = tmp_path_factory.mktemp("formats")
    for name, write in WRITERS.items():
        write(folder / name, some_points())
    for entry in folder.iterdir():
        if entry.is_dir():  # what is left of a bag's folder
            shutil.rmtree(entry)
    return folder


# --- every format


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_holds_the_same_scan(folder: Path, name: str) -> None:
    scan = read_scan(folder / name)
    assert scan.points.dtype == np.float32
    np.testing.assert_allclose(scan.points, some_points(), rtol=0, atol=LAS_STEP)
    assert (scan.ring is None) == (name != "nuscenes.pcd.bin")


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("disguise", ["scan.bin", "scan.ply", "scan", "scan.txt", "scan.pcd"])
def test_the_content_counts_where_the_name_lies(
    folder: Path, tmp_path: Path, name: str, disguise: str
) -> None:
    (tmp_path / disguise).write_bytes((folder / name).read_bytes())
    scan = read_scan(tmp_path / disguise)
    np.testing.assert_allclose(scan.points, some_points(), rtol=0, atol=LAS_STEP)


def test_a_folder_lists_all_of_them(folder: Path) -> None:
    assert [path.name for path in find_scans(folder)] == sorted(WRITERS)
    names = [scan.name for path in find_scans(folder) for scan in scans_in_file(path)]
    assert "nuscenes" in names
    assert "plain/000000" in names
    assert "lone/000000" in names


def test_a_folder_s_hidden_files_and_scores_are_no_scans(tmp_path: Path) -> None:
    for name in ("a.bin", ".b.bin", "c.npz", "a.label", "a.npz", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.bin").mkdir()
    assert [path.name for path in find_scans(tmp_path)] == ["a.bin", "c.npz"]


@pytest.mark.parametrize("name", WRITERS)
def test_a_truncated_file_is_refused(folder: Path, tmp_path: Path, name: str) -> None:
    content = (folder / name).read_bytes()
    path = tmp_path / f"cut.{name}"
    for kept in (
        len(content) - 25,
        len(content) // 2 + 1,
    ):  # no whole number of rows where there are but rows
        path.write_bytes(content[:kept])
        fails(lambda: read_scan(path), path)


# --- variants of PCD


def _padded(points: np.ndarray, real: str) -> np.ndarray:
    kinds = [
        ("_a", "u1", 3),
        ("y", real),
        ("x", real),
        ("_b", "f4"),
        ("z", real),
        ("ring", "u2"),
        ("intensity", "u1"),
    ]
    table = np.zeros(len(points), kinds)
    for i, name in enumerate("xyz"):
        table[name] = points[:, i]
    table["ring"], table["intensity"] = np.arange(len(points)) % 16, np.round(points[:, 3] * 255)
    return table


@pytest.mark.parametrize("size", [4, 8])
def test_columns_of_any_order_type_and_padding_are_read(tmp_path: Path, size: int) -> None:
    points, path = some_points(), tmp_path / "a.pcd"
    real = f"F {size}"
    fields = [
        ("_", "U 1", 3),
        ("y", real, 1),
        ("x", real, 1),
        ("_", "F 4", 1),
        ("z", real, 1),
        ("ring", "U 2", 1),
    ]
    path.write_bytes(pcd_bytes(_padded(points, f"f{size}"), [*fields, ("intensity", "U 1", 1)]))
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.points[:, :3], points[:, :3])
    np.testing.assert_allclose(scan.points[:, 3], np.round(points[:, 3] * 255) / 255, rtol=1e-6)
    assert scan.ring is not None
    assert scan.ring.tolist() == [i % 16 for i in range(60)]


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_columns_of_other_types_are_read_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    points = some_points()
    columns = [*points[:, :3].T, np.arange(60) % 7, np.round(points[:, 3] * 255)]
    types = (np.float64, np.float32, np.float64, np.uint16, np.float32)
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "ring", "intensity"), types)
    cloud.save(str(tmp_path / "a.pcd"), Encoding(encoding))
    scan = read_scan(tmp_path / "a.pcd")
    np.testing.assert_allclose(scan.points[:, :3], points[:, :3], atol=1e-4)
    assert scan.ring is not None
    assert scan.ring.tolist() == [i % 7 for i in range(60)]


def test_lost_points_of_an_organised_cloud_keep_their_place(tmp_path: Path) -> None:
    points, path = some_points(), tmp_path / "a.pcd"
    points[3, :3] = np.nan
    points[7] = 0
    points[9, 0] = np.inf
    table = points.view([(name, "f4") for name in ("x", "y", "z", "intensity")]).ravel()
    path.write_bytes(
        pcd_bytes(table, [(name, "F 4", 1) for name in table.dtype.names or ()], height=4)
    )
    scan = read_scan(path)
    assert np.flatnonzero(~scan.valid).tolist() == [3, 7, 9]
    np.testing.assert_array_equal(scan.points[scan.valid], points[scan.valid])


def test_ascii_is_read_with_any_white_space_and_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    lines = "1 2 3 0.5\r\n\t4   5 6\t1\n\nnan nan nan nan\n-1e0 .5 +2 0"
    header = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 4\nHEIGHT 1\nDATA ascii\n"
    path.write_text(header + lines)
    scan = read_scan(path)
    assert scan.points[[0, 1, 3]].tolist() == [[1, 2, 3, 0.5], [4, 5, 6, 1], [-1, 0.5, 2, 0]]
    assert scan.valid.tolist() == [True, True, False, True]


def test_compressed_columns_of_several_values_are_read_as_pcl_writes_them(tmp_path: Path) -> None:
    import lzf

    points, path = some_points(), tmp_path / "a.pcd"
    normals = np.arange(180, dtype=np.float32)  # three of each point, before x
    data = b"".join(column.tobytes() for column in (normals, *points.T))
    head = "FIELDS normal x y z intensity\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 3 1 1 1 1\nPOINTS 60\n"
    packed = lzf.compress(data, 2 * len(data))
    path.write_bytes(
        f"{head}DATA binary_compressed\n".encode()
        + struct.pack("<II", len(packed), len(data))
        + packed
    )
    np.testing.assert_array_equal(read_scan(path).points, points)


def test_lzf_is_unpacked_as_its_own_library_does() -> None:
    import lzf

    rng = np.random.default_rng(0)
    for data in (
        bytes(1000),
        b"ab" * 500,
        rng.bytes(300),
        b"".join(rng.bytes(5) * k for k in range(2, 60)),
    ):
        packed = lzf.compress(data, 2 * len(data) + 100)
        assert unpack_lzf(packed, len(data)) == data
        with pytest.raises((ValueError, IndexError)):
            unpack_lzf(packed, len(data) - 1)


# --- other variants


def test_vertices_after_other_elements_are_read(tmp_path: Path) -> None:
    path, points = tmp_path / "a.ply", some_points(3)
    head = "element camera 2\nproperty uchar id\nelement vertex 3\nproperty double z\nproperty float32 x\n"
    head = f"comment made by hand\n{head}property float y\nproperty list uchar int no\nend_header\n"
    with_list = f"ply\nformat ascii 1.0\n{head}"
    path.write_text(with_list)
    fails(lambda: read_scan(path), path, "list")
    head = head.replace("property list uchar int no\n", "")
    lines = "\n".join(f"{z} {x} {y}" for x, y, z, _ in points.tolist())
    path.write_text(f"ply\nformat ascii 1.0\n{head}7\n8\n{lines}\n")
    np.testing.assert_allclose(read_scan(path).points[:, :3], points[:, :3], rtol=1e-6)
    rows = b"".join(struct.pack(">dff", z, x, y) for x, y, z, _ in points.tolist())
    path.write_bytes(f"ply\nformat binary_big_endian 1.0\n{head}".encode() + b"\7\10" + rows)
    np.testing.assert_array_equal(read_scan(path).points[:, :3], points[:, :3])


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("big", [False, True])
def test_messages_with_gaps_and_either_byte_order_are_read(padded: bool, big: bool) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    cloud = read_message(cloud_message(store, some_points(), padded, big), "here")
    scan = cloud.to_scan()
    np.testing.assert_array_equal(scan.points, some_points())
    assert (scan.ring is not None) == padded


def test_a_message_that_claims_more_than_it_has_is_refused() -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for changes in (
        {"width": 61},
        {"width": 2**32 - 1, "row_step": 0},
        {"row_step": 10},
        {"fields": []},
    ):
        message = cloud_message(store, some_points(), **changes)
        fails(lambda message=message: read_message(message, "here"), "here")  # type: ignore[misc]


def test_range_images_are_flattened_row_by_row(tmp_path: Path) -> None:
    points = some_points(24).reshape(4, 6, 4)
    distance = np.linalg.norm(points[:, :, :3], axis=2, keepdims=True)
    label = np.arange(24).reshape(4, 6, 1) % 3
    for columns, others in {4: [], 5: [distance], 6: [distance, label]}.items():
        np.save(tmp_path / "a.npy", np.concatenate([points, *others], axis=2).astype(np.float32))
        cloud = read_cloud(tmp_path / "a.npy")
        np.testing.assert_array_equal(cloud.to_scan().points, some_points(24))
        assert cloud.ring is None
        assert "4 x 6" in cloud.note
        assert ("range" in cloud.note.split("columns")[1]) == (columns > 4)
    with_ring = np.concatenate([points, np.arange(24).reshape(4, 6, 1) // 6], axis=2)
    np.save(tmp_path / "a.npy", with_ring.astype(np.float32))
    ring = read_cloud(tmp_path / "a.npy").ring
    assert ring is not None
    assert ring.tolist() == [i // 6 for i in range(24)]


def test_arrays_with_named_columns_and_of_either_order_are_read(tmp_path: Path) -> None:
    points = some_points()
    named = np.zeros(60, [("Intensity", "f8"), ("Z", "f4"), ("X", "f4"), ("Y", "f4")])
    for i, name in enumerate(("X", "Y", "Z", "Intensity")):
        named[name] = points[:, i]
    for array in (named, np.asfortranarray(points), points.astype(">f8")):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_allclose(read_scan(tmp_path / "a.npy").points, points, rtol=1e-6)


def test_an_archive_with_no_clear_array_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", left=some_points(), right=some_points())
    fails(lambda: read_scan(tmp_path / "a.npz"), "left", "points")


@pytest.mark.parametrize(
    ("most", "kind"), [(1, "f4"), (255, "f4"), (65535, "f8"), (255, "u1"), (65535, "u2")]
)
def test_intensities_are_scaled_by_their_range(tmp_path: Path, most: int, kind: str) -> None:
    points = some_points()
    table = np.zeros(60, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", kind)])
    for i, name in enumerate("xyz"):
        table[name] = points[:, i]
    table["intensity"] = np.round(points[:, 3] * most) if most > 1 else points[:, 3]
    np.save(tmp_path / "a.npy", table)
    np.testing.assert_allclose(read_scan(tmp_path / "a.npy").points[:, 3], points[:, 3], atol=0.002)


def test_map_coordinates_are_named(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", some_points() + np.array([500_000, 4_000_000, 0, 0]))
    fails(lambda: read_scan(tmp_path / "a.las"), "--offset")


# --- bags


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    "compressed", [None, CompressionMode.MESSAGE, CompressionMode.FILE, CompressionMode.STORAGE]
)
def test_a_bag_is_its_scans_in_order(
    tmp_path: Path, storage: str, compressed: CompressionMode | None
) -> None:
    if compressed is CompressionMode.STORAGE and storage != "mcap":
        pytest.skip("only mcap compresses inside")
    clouds = [some_points(60, seed) for seed in range(5)]
    write_bag2(tmp_path / "drive", {"/lidar": clouds}, STORAGES[storage], compressed)
    assert find_scans(tmp_path / "drive") == [tmp_path / "drive"]
    assert find_scans(tmp_path) == [tmp_path / "drive"]
    scans = list(scans_in_file(tmp_path / "drive"))
    assert [scan.name for scan in scans] == [f"drive/{i:06d}" for i in range(5)]
    for i in (0, 1, 2, 3, 4, 2, 0, 4):  # in order, and not
        np.testing.assert_array_equal(scans[i].read().to_scan().points, clouds[i])
    fails(lambda: read_scan(tmp_path / "drive"), "5", "amvnet predict")


def test_the_topic_is_found_or_asked_for(tmp_path: Path) -> None:
    front, rear = [some_points(60, 1)], [some_points(60, 2), some_points(60, 3)]
    path = write_bag1(tmp_path / "two.bag", {"/front": front, "/rear": rear})
    fails(lambda: list(scans_in_file(path)), "/front", "/rear", "--topic")
    fails(lambda: list(scans_in_file(path, "/top")), "/front", "/rear", "/top")
    found = list(scans_in_file(path, "/rear"))
    assert len(found) == 2
    np.testing.assert_array_equal(found[1].read().to_scan().points, rear[1])
    fails(lambda: list(scans_in_file(write_bag1(tmp_path / "none.bag", {}))), "none.bag")


def test_a_bag_that_claims_more_than_it_has_is_refused(tmp_path: Path) -> None:
    write_bag2(tmp_path / "drive", {"/lidar": [some_points()] * 3}, StoragePlugin.MCAP)
    metadata = tmp_path / "drive" / "metadata.yaml"
    said = metadata.read_text()
    metadata.write_text(said.replace("message_count: 3", "message_count: 3000000000"))
    fails(lambda: list(scans_in_file(tmp_path / "drive")), "3000000000")
    metadata.write_text(said.replace("message_count: 3", "message_count: 4"))
    scans = list(scans_in_file(tmp_path / "drive"))
    assert len(scans) == 4
    fails(lambda: scans[3].read(), "drive", "3")


def test_a_bag_is_read_in_constant_memory(tmp_path: Path) -> None:
    points = some_points(50_000)  # 0.8 MB
    path = write_bag1(tmp_path / "long.bag", {"/lidar": [points] * 30})
    tracemalloc.start()
    for scan in scans_in_file(path):
        scan.read()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * points.nbytes < path.stat().st_size / 2


# --- what is not there, or too much


@pytest.mark.parametrize(
    ("missing", "name"), [("laspy", "old.las"), ("lazrs", "packed.laz"), ("rosbags", "plain.bag")]
)
def test_a_missing_extra_is_named(
    folder: Path, name: str, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in [m for m in sys.modules if m.split(".")[0] == missing]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, missing, None)
    fails(lambda: read_scan(folder / name), name, 'pip install "amvnet[formats]"')


def _npy(shape: tuple[int, ...]) -> bytes:
    text = str({"descr": "<f4", "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(64)


def _pcd(points: int, data: str, rest: bytes = bytes(64)) -> bytes:
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {points}\nDATA {data}\n"
    return head.encode() + rest


def _ply(points: int, kind: str) -> bytes:
    columns = "property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    return f"ply\nformat {kind} 1.0\nelement vertex {points}\n{columns}".encode()


def _las(path: Path, **at: tuple[str, int, int]) -> bytes:
    content = bytearray(path.read_bytes())
    for kind, place, value in at.values():
        struct.pack_into(kind, content, place, value)
    return bytes(content)


def test_headers_that_claim_billions_are_refused_before_memory_is_taken(
    folder: Path, tmp_path: Path
) -> None:
    many = 3_000_000_000
    lies = {
        "a.pcd": _pcd(many, "binary"),
        "b.pcd": _pcd(many, "ascii"),
        "c.pcd": _pcd(many, "binary_compressed", struct.pack("<II", 40, 2**32 - 1) + bytes(40)),
        "d.pcd": _pcd(
            MAX_POINTS, "binary_compressed", struct.pack("<II", 40, MAX_POINTS * 12) + bytes(40)
        ),
        "e.pcd": _pcd(MAX_POINTS, "ascii"),
        "a.ply": _ply(many, "binary_little_endian"),
        "b.ply": _ply(MAX_POINTS, "ascii"),
        "a.npy": _npy((many, 4)),
        "b.npy": _npy((many, many, many)),
        "a.las": _las(folder / "old.las", points=("<I", 107, many)),
        "b.las": _las(folder / "old.las", records=("<I", 100, many)),
        "c.las": _las(folder / "new.las", points=("<Q", 247, 1 << 60)),
        "a.laz": _las(folder / "packed.laz", points=("<I", 107, many)),
        "b.laz": _las(folder / "packed.laz", points=("<I", 107, MAX_POINTS)),
    }
    for name, content in lies.items():
        path = tmp_path / name
        path.write_bytes(content)
        tracemalloc.start()
        fails(lambda path=path: read_scan(path), path)  # type: ignore[misc]
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 20e6, (name, peak)


def test_broken_compressed_files_end_in_one_line(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    content = (folder / "packed.laz").read_bytes()
    begin = struct.unpack_from("<I", content, 96)[0]
    (table,) = struct.unpack_from("<q", content, begin)
    for place in (begin, table + 4):  # where the table of the chunks is, and how many it has
        path = tmp_path / "a.laz"
        path.write_bytes(content[:place] + b"\xff\xff\xff\x7f" + content[place + 4 :])
        fails(lambda path=path: read_scan(path), path)  # type: ignore[misc]
    assert capfd.readouterr().err == ""


def test_names_without_their_endings() -> None:
    for name, expected in {
        "a.pcd.bin": "a",
        "b.PCD": "b",
        "c.d.las": "c.d",
        "e": "e",
        "f.txt": "f",
    }.items():
        assert scan_stem(Path(name)) == expected


# --- real scans


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(
    ("name", "count", "scale"),
    [
        ("kitti_binary.pcd", 116_007, 1),
        ("solid_binary_compressed.pcd", 65_536, 65535),
        ("rellis_velodyne.bin", 37_334, 255),
        ("squeezeseg_64x512x6.npy", 32_768, 1),
    ],
)
def test_real_files_of_other_formats_are_read(name: str, count: int, scale: float) -> None:
    cloud = read_cloud(Path(REAL or "") / "formats" / name)
    assert cloud.intensity_scale() == scale
    scan = cloud.to_scan()
    assert len(scan) == count
    kept = scan.points[scan.valid]
    assert len(kept) > 0.7 * count
    assert 0 <= kept[:, 3].min() < kept[:, 3].max() <= 1
    assert np.abs(kept[:, :3]).max() < 200


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(("name", "count"), [("semantickitti", 80), ("nuscenes", 10)])
def test_every_real_scan_is_read_by_itself_as_in_its_data_set(name: str, count: int) -> None:
    from amvnet.data.datasets.open import open_dataset

    dataset: Any = open_dataset(str(Path(REAL or "") / name))
    records = dataset.records(dataset.sequences("all"))
    assert len(records) == count
    for record in records:
        lone, member = read_scan(record.points_path), dataset.read(record, labels=False)
        np.testing.assert_array_equal(lone.points, member.points)
        assert (lone.ring is None) == (member.ring is None)
        if lone.ring is not None:
            np.testing.assert_array_equal(lone.ring, member.ring)


def test_the_writers_agree_with_each_other(tmp_path: Path) -> None:
    points = some_points()
    table = points.view([(name, "f4") for name in ("x", "y", "z", "intensity")]).ravel()
    (tmp_path / "a.pcd").write_bytes(
        pcd_bytes(table, [(name, "F 4", 1) for name in table.dtype.names or ()])
    )
    np.testing.assert_array_equal(PointCloud.from_path(tmp_path / "a.pcd").numpy(), points)
