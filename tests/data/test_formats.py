"""Every format gives the same scan, row by row, whatever wrote it and whatever its name."""

from __future__ import annotations

import os
import struct
import sys
import tracemalloc
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import laspy
import lzf
import numpy as np
import pytest
import torch
from pypcd4 import Encoding, PointCloud
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from amvnet.data.formats.bags import Bag
from amvnet.data.formats.cloud import MAX_POINTS
from amvnet.data.formats.find import find_scans, list_scans, read_cloud
from amvnet.data.formats.pcd import unpack_lzf
from amvnet.data.formats.pointcloud2 import read_message
from amvnet.data.labels.readers import read_raw_labels
from amvnet.scan import Scan
from amvnet.sensors.lidars import Sensor

from fixtures import scan_writers
from fixtures.commands import fails, new_file, not_none
from fixtures.scan_writers import WRITERS, pcd_bytes, some_points, write_bag1, write_bag2

REAL = os.environ.get("AMVNET_REAL_DATA")
LAS_STEP = 0.0006  # metres: the LAS files have millimetres
FLOAT_FIELDS = [("x", "F 4", 1), ("y", "F 4", 1), ("z", "F 4", 1), ("intensity", "F 4", 1)]
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


def read_scan(path: Path) -> Scan:
    return read_cloud(path).to_scan()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("formats")
    for name, write in WRITERS.items():
        write(folder / name, some_points())
    return folder


@pytest.fixture
def npy(tmp_path: Path) -> Path:
    return tmp_path / "a.npy"


@pytest.fixture
def pcd(tmp_path: Path) -> Path:
    return tmp_path / "a.pcd"


# --- every format ---


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_holds_the_same_scan(folder: Path, name: str) -> None:
    scan = read_scan(folder / name)
    assert scan.points.dtype == np.float32
    np.testing.assert_allclose(scan.points, some_points(), rtol=0, atol=LAS_STEP)
    assert (scan.ring is None) == (name != "nuscenes.pcd.bin")


# Rows of numbers have no first bytes of their own: only their names tell.
@pytest.mark.parametrize("name", [name for name in WRITERS if not name.endswith(".bin")])
@pytest.mark.parametrize("disguise", ["scan.bin", "scan.ply", "scan", "scan.txt", "scan.pcd"])
def test_the_content_counts_if_the_name_is_wrong(
    folder: Path, tmp_path: Path, name: str, disguise: str
) -> None:
    path = new_file(tmp_path / disguise, (folder / name).read_bytes())
    np.testing.assert_allclose(read_scan(path).points, some_points(), rtol=0, atol=LAS_STEP)


def test_a_folder_lists_all_of_them(folder: Path) -> None:
    paths = find_scans(folder)
    # Text files are scans of a folder only if there are no others.
    assert paths == [folder / name for name in sorted(WRITERS) if name != "plain.xyz"]

    names = {scan.name for path in paths for scan in list_scans(path)}
    assert {"nuscenes", "plain/000000", "lone/000000"} <= names


def test_hidden_files_and_scores_in_a_folder_are_not_scans(tmp_path: Path) -> None:
    for name in ("a.bin", ".b.bin", "c.npz", "a.label", "a.npz", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.bin").mkdir()
    assert find_scans(tmp_path) == [tmp_path / "a.bin", tmp_path / "c.npz"]


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "plain.xyz"])
def test_a_truncated_file_is_refused(folder: Path, tmp_path: Path, name: str) -> None:
    content = (folder / name).read_bytes()
    path = tmp_path / f"cut.{name}"
    # Neither size is a whole number of rows, for the formats that are only rows.
    for size in (len(content) - 25, len(content) // 2 + 1):
        path.write_bytes(content[:size])
        fails(lambda: read_scan(path), path)


# --- variants of PCD ---


def test_comments_of_a_header_may_hold_any_bytes(pcd: Path) -> None:
    content = pcd_bytes(some_points().view(scan_writers.FLOATS), FLOAT_FIELDS)
    for comment in (b"# M\xfcller \xff\xfe\x80\n", "# 点群\n".encode()):
        pcd.write_bytes(content.replace(b"VERSION", comment + b"VERSION", 1))
        np.testing.assert_array_equal(read_scan(pcd).points, some_points())


def fill_coordinates(table: np.ndarray, points: np.ndarray) -> None:
    for name, values in zip("xyz", points[:, :3].T, strict=True):
        table[name] = values


@pytest.mark.parametrize("size", [4, 8])
def test_columns_of_any_order_type_and_padding_are_read(pcd: Path, size: int) -> None:
    points = some_points()
    ring = np.arange(60) % 16
    intensity = np.round(points[:, 3] * 255)

    real = f"f{size}"
    padding_within = ("_b", "f4")
    axes = [("_a", "u1", 3), ("y", real), ("x", real), padding_within, ("z", real)]
    table = np.zeros(60, [*axes, ("ring", "u2"), ("intensity", "u1")])
    fill_coordinates(table, points)
    table["ring"] = ring
    table["intensity"] = intensity

    fields = [
        ("_", "U 1", 3),
        ("y", f"F {size}", 1),
        ("x", f"F {size}", 1),
        ("_", "F 4", 1),
        ("z", f"F {size}", 1),
        ("ring", "U 2", 1),
        ("intensity", "U 1", 1),
    ]
    pcd.write_bytes(pcd_bytes(table, fields))

    scan = read_scan(pcd)
    np.testing.assert_array_equal(scan.points[:, :3], points[:, :3])
    np.testing.assert_allclose(scan.points[:, 3], intensity / 255, rtol=1e-6)
    np.testing.assert_array_equal(scan.ring, ring)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_columns_of_other_types_are_read_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    points = some_points()
    ring = np.arange(60) % 7
    columns = [*points[:, :3].T, ring, np.round(points[:, 3] * 255)]
    types = (np.float64, np.float32, np.float64, np.uint16, np.float32)
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "ring", "intensity"), types)
    cloud.save(str(tmp_path / "a.pcd"), Encoding(encoding))

    scan = read_scan(tmp_path / "a.pcd")
    np.testing.assert_allclose(scan.points[:, :3], points[:, :3], atol=1e-4)
    np.testing.assert_array_equal(scan.ring, ring)


def test_lost_points_of_an_organised_cloud_keep_their_index(pcd: Path) -> None:
    points = some_points()
    points[3, :3] = np.nan
    points[7] = 0
    points[9, 0] = np.inf
    pcd.write_bytes(pcd_bytes(points.view(scan_writers.FLOATS), FLOAT_FIELDS, height=4))

    scan = read_scan(pcd)
    assert np.flatnonzero(~scan.valid).tolist() == [3, 7, 9]
    np.testing.assert_array_equal(scan.points[scan.valid], points[scan.valid])


def test_ascii_is_read_with_any_white_space_and_nan(pcd: Path) -> None:
    header = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 4\nHEIGHT 1\n"
    lines = "1 2 3 0.5\r\n\t4   5 6\t1\n\nnan nan nan nan\n-1e0 .5 +2 0"
    pcd.write_text(f"{header}DATA ascii\n{lines}")

    scan = read_scan(pcd)
    assert scan.points[[0, 1, 3]].tolist() == [[1, 2, 3, 0.5], [4, 5, 6, 1], [-1, 0.5, 2, 0]]
    assert scan.valid.tolist() == [True, True, False, True]


def test_the_first_value_of_a_column_of_several_is_used(pcd: Path) -> None:
    points = some_points()
    header = "FIELDS normal x y z intensity\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 3 2 1 1 1\n"
    header += "POINTS 60\nDATA {}\n"
    others = np.full((60, 3), 7, np.float32)
    columns = [others, np.column_stack([points[:, 0], others[:, 0]]), *points[:, 1:].T]
    rows = np.column_stack(columns)

    np.savetxt(pcd, rows, "%.4f", header=header.format("ascii").strip(), comments="")
    np.testing.assert_allclose(read_scan(pcd).points, points, atol=1e-4)

    pcd.write_bytes(header.format("binary").encode() + rows.astype(np.float32).tobytes())
    np.testing.assert_array_equal(read_scan(pcd).points, points)

    data = b"".join(column.astype(np.float32).tobytes() for column in columns)
    packed = lzf.compress(data, 2 * len(data))
    sizes = struct.pack("<II", len(packed), len(data))
    pcd.write_bytes(header.format("binary_compressed").encode() + sizes + packed)
    np.testing.assert_array_equal(read_scan(pcd).points, points)


def test_lzf_is_unpacked_if_it_has_the_size_that_is_stated() -> None:
    rng = np.random.default_rng(0)
    repetitions = b"".join(rng.bytes(5) * k for k in range(2, 60))
    for data in (bytes(1000), b"ab" * 500, rng.bytes(300), repetitions):
        packed = lzf.compress(data, 2 * len(data) + 100)
        assert unpack_lzf(packed, len(data)) == data
        for size in (0, len(data) - 1, len(data) + 1):
            with pytest.raises(ValueError, match="unpacked bytes"):
                unpack_lzf(packed, size)
    assert unpack_lzf(b"", 0) == b""


@pytest.mark.parametrize(
    "data",
    [b"\x05ab", b"\x20\x00", b"\x00a\x20\x01", b"\x00a\x20", b"\x00a\xe0\x05"],
    ids=["literal cut off", "nothing to repeat", "before the first", "no distance", "no end"],
)
def test_broken_lzf_is_an_error_of_one_line(data: bytes, pcd: Path) -> None:
    pcd.write_bytes(_pcd(1, "binary_compressed", struct.pack("<II", len(data), 12) + data))
    fails(partial(read_scan, pcd), pcd, "expected a PCD file, found a broken file", "write")


# --- other variants ---


PLY_ELEMENTS = """\
comment made by hand
element camera 2
property uchar id
element vertex 3
property double z
property float32 x
property float y
"""


def test_vertices_after_other_elements_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    xyz = some_points(3)[:, :3]

    lines = "".join(f"{z} {x} {y}\n" for x, y, z in xyz.tolist())
    path.write_text(f"ply\nformat ascii 1.0\n{PLY_ELEMENTS}end_header\n7\n8\n{lines}")
    np.testing.assert_allclose(read_scan(path).points[:, :3], xyz, rtol=1e-6)

    header = f"ply\nformat binary_big_endian 1.0\n{PLY_ELEMENTS}end_header\n"
    rows = b"".join(struct.pack(">dff", z, x, y) for x, y, z in xyz.tolist())
    path.write_bytes(header.encode() + b"\7\10" + rows)
    np.testing.assert_array_equal(read_scan(path).points[:, :3], xyz)


@pytest.mark.parametrize("order", "<>")
def test_faces_may_come_before_the_vertices(tmp_path: Path, order: str) -> None:
    xyz = some_points()[:, :3]
    path = tmp_path / "a.ply"
    elements = (
        "element face 2\nproperty bool flat\nproperty list uchar short corners\n"
        f"element vertex {len(xyz)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property bool seen\nend_header\n"
    )
    lines = "".join(f"{x!r} {y!r} {z!r} 1\n" for x, y, z in xyz.tolist())
    path.write_text(f"ply\nformat ascii 1.0\n{elements}0 3 0 1 2\n1 4 0 1 2 3\n{lines}")
    np.testing.assert_allclose(read_scan(path).points[:, :3], xyz, rtol=1e-6)

    name = {"<": "little", ">": "big"}[order]
    faces = struct.pack(f"{order}BB3hBB4h", 0, 3, 0, 1, 2, 1, 4, 0, 1, 2, 3)
    rows = b"".join(struct.pack(f"{order}fff?", *row, True) for row in xyz.tolist())
    header = f"ply\nformat binary_{name}_endian 1.0\n{elements}".encode()
    path.write_bytes(header + faces + rows)
    np.testing.assert_array_equal(read_scan(path).points[:, :3], xyz)

    path.write_bytes(header + faces[:-5])  # as a copy that was cut off
    fails(lambda: read_scan(path), path)


def test_packed_points_that_cannot_be_unpacked_are_said_to_be_too_few(pcd: Path) -> None:
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 10000\nHEIGHT 1\n"
    data = struct.pack("<II", 100, 120_000) + bytes(100)
    pcd.write_bytes(f"{header}DATA binary_compressed\n".encode() + data)
    fails(lambda: read_scan(pcd), "expected 120000 bytes", "found 100 packed ones")


def test_a_class_that_las_has_no_room_for_is_not_read_as_another_one(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    for point_format, limit in ((0, 31), (6, 255)):
        cloud = laspy.LasData(laspy.LasHeader(point_format=point_format))
        cloud.xyz = some_points()[:10, :3]
        cloud.classification = np.arange(10) + limit - 9
        cloud.write(path)
        read = partial(read_raw_labels, path, 10, "classification", missing=0)
        assert read().tolist() == list(range(limit - 9, limit + 1))
        if point_format == 0:
            cloud.synthetic = np.arange(10) == 3  # a bit of what another program wrote as 32
            cloud.write(path)
            fails(read, path, "classes up to 31", "LAS 1.4")


@pytest.mark.parametrize("name", ["a.npy", "a.txt"])
def test_times_before_the_coordinates_are_not_called_a_map(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    rows = np.column_stack([np.linspace(1.6e9, 1.6e9 + 0.1, 60), some_points()[:, :3]])
    np.save(path, rows) if name.endswith("npy") else np.savetxt(path, rows)
    fails(lambda: read_scan(path), path, "column of times", "--columns")
    rows[:, 1] += 5e6
    np.save(path, rows) if name.endswith("npy") else np.savetxt(path, rows)
    fails(lambda: read_scan(path), path, "map coordinates")


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("a.bin", b"\x89PNG\r\n\x1a\n" + bytes(24), "a PNG picture"),
        ("a.npy", b"\xff\xd8\xff\xe0" + bytes(28), "a JPEG picture"),
        ("a.label", bytes(64), "labels"),
        ("a_lidarseg.bin", bytes(64), "labels"),
    ],
)
def test_files_of_other_kinds_are_named(tmp_path: Path, name: str, data: bytes, kind: str) -> None:
    path = new_file(tmp_path / name, data)
    fails(lambda: read_scan(path), path, f"found {kind};")


def test_a_folder_of_labels_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "a.label").write_bytes(bytes(64))
    fails(lambda: find_scans(tmp_path), tmp_path, "holds labels")


def test_an_array_that_an_archive_has_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, points=some_points())
    with zipfile.ZipFile(path) as archive:
        data = archive.read("points.npy")
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("points.npy", data)
    fails(lambda: read_scan(path), path, "points.npy", "2 times")


def test_vertices_with_lists_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    elements = f"{PLY_ELEMENTS}property list uchar int no\n"
    path.write_text(f"ply\nformat ascii 1.0\n{elements}end_header\n")
    fails(lambda: read_scan(path), path, "list")


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("big", [False, True])
def test_messages_with_gaps_and_either_byte_order_are_read(padded: bool, big: bool) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    cloud = read_message(scan_writers.cloud_message(store, some_points(), padded, big), "here")
    np.testing.assert_array_equal(cloud.to_scan().points, some_points())
    assert (cloud.ring is not None) == padded


@pytest.mark.parametrize(
    "changes",
    [{"width": 61}, {"width": 2**32 - 1, "row_step": 0}, {"row_step": 10}, {"fields": []}],
)
def test_a_message_that_claims_more_than_it_has_is_refused(changes: dict[str, Any]) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    message = scan_writers.cloud_message(store, some_points(), **changes)
    fails(lambda: read_message(message, "here"), "here")


def test_range_images_are_flattened_row_by_row(npy: Path) -> None:
    image = some_points(24).reshape(4, 6, 4)
    distance = np.linalg.norm(image[:, :, :3], axis=2)
    label = np.arange(24).reshape(4, 6) % 3

    for extra in ([], [distance], [distance, label]):
        np.save(npy, np.dstack([image, *extra]).astype(np.float32))
        cloud = read_cloud(npy)
        np.testing.assert_array_equal(cloud.to_scan().points, some_points(24))
        assert cloud.ring is None
        assert "4 x 6" in cloud.note
        assert ("left out" in cloud.note) == bool(extra)


def test_the_fifth_column_of_a_range_image_can_be_the_ring(npy: Path) -> None:
    image = some_points(24).reshape(8, 3, 4)
    ring = np.arange(24).reshape(8, 3) // 3
    np.save(npy, np.dstack([image, ring]).astype(np.float32))
    np.testing.assert_array_equal(read_cloud(npy).ring, ring.ravel())


def test_arrays_with_named_columns_and_of_either_order_are_read(npy: Path) -> None:
    points = some_points()
    named = np.zeros(60, [("Intensity", "f8"), ("Z", "f4"), ("X", "f4"), ("Y", "f4")])
    for name, values in zip(("X", "Y", "Z", "Intensity"), points.T, strict=True):
        named[name] = values

    for array in (named, np.asfortranarray(points), points.astype(">f8")):
        np.save(npy, array)
        np.testing.assert_allclose(read_scan(npy).points, points, rtol=1e-6)


def test_an_archive_with_no_clear_array_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", left=some_points(), right=some_points())
    fails(lambda: read_scan(tmp_path / "a.npz"), "left", "points")


def test_an_archive_that_open3d_writes_is_read(tmp_path: Path) -> None:
    points = some_points()
    np.savez(tmp_path / "a.npz", positions=points[:, :3], intensity=points[:, 3:])
    np.testing.assert_array_equal(read_scan(tmp_path / "a.npz").points, points)


def test_a_ring_that_is_the_same_for_all_points_is_none(tmp_path: Path) -> None:
    """Some drivers fill the column with zeros: it would be one row of the range image."""
    x, y, z, intensity = some_points().T
    for ring in (0, 5):
        columns = {"x": x, "y": y, "z": z, "intensity": intensity, "ring": np.full(60, ring)}
        np.savez(tmp_path / "a.npz", **columns)
        assert read_scan(tmp_path / "a.npz").ring is None


def test_a_packed_file_of_another_program_is_refused(tmp_path: Path) -> None:
    torch.save(torch.from_numpy(some_points()), tmp_path / "a.pt")
    fails(lambda: read_scan(tmp_path / "a.pt"), "a.pt", "array named points")


def test_an_mcap_file_without_messages_of_ros_2_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for profile in (b"", b"ros1"):
        strings = len(profile).to_bytes(4, "little") + profile + bytes(4)
        header = b"\x01" + len(strings).to_bytes(8, "little") + strings
        path.write_bytes(b"\x89MCAP0\r\n" + header + bytes(100))
        fails(lambda: Bag(path, ".mcap"), "Profile is not ros2")


def test_the_offset_that_the_error_for_map_coordinates_names_helps(npy: Path) -> None:
    points = some_points().astype(float)
    points[:, :3] += (500_000, 5_400_000, 100)
    np.save(npy, points)
    fails(lambda: read_scan(npy), "--offset -x,-y,-z")
    moved = Sensor(offset=(-500_000, -5_400_000, -100)).to_level(read_cloud(npy).xyz)
    np.testing.assert_allclose(moved, some_points()[:, :3], atol=1e-3)


def test_intensities_and_rings_in_arrays_of_their_own_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    points = some_points()
    ring = np.arange(60) % 16
    x, y, z, intensity = points.T

    columns = {"x": x, "y": y, "z": z, "intensity": intensity, "ring": ring}
    nested = {"points": points[:, :3], "intensity": intensity, "ring": ring}
    for arrays in (columns, nested, nested | {"points": points}):
        np.savez(path, **arrays)
        scan = read_scan(path)
        np.testing.assert_array_equal(scan.points, points)
        np.testing.assert_array_equal(scan.ring, ring)

    # The elevations of the lasers are no rings of the points.
    np.savez(path, points=points, ring=np.arange(16))
    assert read_scan(path).ring is None

    np.savez(path, **columns | {"y": y[:9]})
    fails(lambda: read_scan(path), path, "'y': 9")


@pytest.mark.parametrize("shape", [(4, 60), (3, 60), (5, 6, 60)])
def test_a_transposed_array_is_refused(npy: Path, shape: tuple[int, ...]) -> None:
    np.save(npy, np.ones(shape, np.float32))
    fails(lambda: read_scan(npy), npy, shape, "transposed", "moveaxis")


def test_columns_of_no_single_number_are_refused(npy: Path) -> None:
    for kind in (("x", "f4", 3), ("x", "U3"), ("x", [("a", "f4")])):
        np.save(npy, np.zeros(60, [kind, ("y", "f4"), ("z", "f4")]))
        fails(lambda: read_scan(npy), npy, "'x'")


@pytest.mark.parametrize("ending", ["npy", "csv"])
def test_a_fifth_column_is_the_ring_only_if_its_values_are(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    points = some_points(1000)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    by_elevation = np.digitize(elevation, np.linspace(-0.5, 0.5, 30))
    rng = np.random.default_rng(0)
    columns = {
        "ring": [np.arange(1000) % 32, by_elevation, rng.integers(0, 16, 1000)],
        "other": [
            np.linspace(0, 0.1, 1000),  # times
            np.linspace(0, 1e5, 1000).round(),  # times in microseconds
            np.linalg.norm(points[:, :3], axis=1),
            rng.choice(20, 1000, p=np.geomspace(1, 0.01, 20) / np.geomspace(1, 0.01, 20).sum()),
            rng.choice([10, 40, 50, 70, 252], 1000),  # SemanticKITTI's ids
        ],
    }
    for kind, all_values in columns.items():
        for values in all_values:
            table = np.column_stack([points, values]).astype(np.float32)
            if ending == "npy":
                np.save(path, table)
            else:
                np.savetxt(path, table, "%.7g", delimiter=",")

            cloud = read_cloud(path)
            np.testing.assert_allclose(cloud.to_scan().points, points, rtol=1e-6)
            assert (cloud.ring is not None) == (kind == "ring"), values
            assert ("left out" in cloud.note) == (kind == "other")


@pytest.mark.parametrize(
    ("largest", "kind"), [(1, "f4"), (255, "f4"), (65535, "f8"), (255, "u1"), (65535, "u2")]
)
def test_intensities_are_scaled_by_their_range(npy: Path, largest: int, kind: str) -> None:
    points = some_points()
    table = np.zeros(60, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", kind)])
    fill_coordinates(table, points)
    table["intensity"] = np.round(points[:, 3] * largest) if largest > 1 else points[:, 3]

    np.save(npy, table)
    np.testing.assert_allclose(read_scan(npy).points[:, 3], points[:, 3], atol=0.002)


def test_a_dimension_of_las_with_rings_is_read(tmp_path: Path) -> None:
    las = laspy.read(scan_writers.write_las(tmp_path / "a.las", some_points()))
    assert read_cloud(tmp_path / "a.las").ring is None
    las.add_extra_dim(laspy.ExtraBytesParams("ring", "u1"))
    las["ring"] = np.arange(60) % 16
    las.write(str(tmp_path / "a.las"))

    assert not_none(read_cloud(tmp_path / "a.las").ring).tolist() == list(np.arange(60) % 16)


# --- bags ---


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    "compressed", [None, CompressionMode.MESSAGE, CompressionMode.FILE, CompressionMode.STORAGE]
)
def test_a_bag_is_its_scans_in_order(
    tmp_path: Path, storage: str, compressed: CompressionMode | None
) -> None:
    if compressed is CompressionMode.STORAGE and storage != "mcap":
        pytest.skip("only mcap compresses within its storage")
    path = tmp_path / "drive"
    clouds = [some_points(60, seed) for seed in range(5)]
    write_bag2(path, {"/lidar": clouds}, STORAGES[storage], compressed)
    assert find_scans(path) == [path]
    assert find_scans(tmp_path) == [path]

    scans = list(list_scans(path))
    assert len(scans) == 5
    for i in (0, 1, 2, 3, 4, 2, 0, 4):  # first in order, then not
        assert scans[i].name == f"drive/{i:06d}"
        np.testing.assert_array_equal(scans[i].read().to_scan().points, clouds[i])
    fails(lambda: read_scan(path), "5", "amvnet predict")


@pytest.mark.parametrize("name", ["a#b", "a?b", "a%41b", "a b"])
def test_bags_of_any_name_are_read(folder: Path, tmp_path: Path, name: str) -> None:
    lone = new_file(tmp_path / f"{name}.db3", (folder / "lone.db3").read_bytes())
    np.testing.assert_array_equal(read_scan(lone).points, some_points())

    # rosbags writes no such names.
    path = write_bag2(tmp_path / "drive", {"/lidar": [some_points()]}, StoragePlugin.SQLITE3)
    (path / "drive.db3").rename(path / f"{name}.db3")
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", f"{name}.db3"))
    path = path.rename(tmp_path / name)
    np.testing.assert_array_equal(read_scan(path).points, some_points())


def test_a_topic_without_messages_is_refused(tmp_path: Path) -> None:
    path = write_bag2(tmp_path / "empty", {"/lidar": []}, StoragePlugin.MCAP)
    fails(lambda: list(list_scans(path)), "/lidar", "0 messages")


def test_the_topic_is_found_or_asked_for(tmp_path: Path) -> None:
    front = [some_points(60, 1)]
    rear = [some_points(60, 2), some_points(60, 3)]
    path = write_bag1(tmp_path / "two.bag", {"/front": front, "/rear": rear})
    fails(lambda: list(list_scans(path)), "/front", "/rear", "--topic")
    fails(lambda: list(list_scans(path, "/top")), "/front", "/rear", "/top")

    scans = list(list_scans(path, "/rear"))
    assert len(scans) == 2
    np.testing.assert_array_equal(scans[1].read().to_scan().points, rear[1])

    empty = write_bag1(tmp_path / "none.bag", {})
    fails(lambda: list(list_scans(empty)), "none.bag")


def test_a_bag_that_claims_more_than_it_has_is_refused(tmp_path: Path) -> None:
    path = write_bag2(tmp_path / "drive", {"/lidar": [some_points()] * 3}, StoragePlugin.MCAP)
    metadata = path / "metadata.yaml"
    text = metadata.read_text()

    metadata.write_text(text.replace("message_count: 3", "message_count: 3000000000"))
    fails(lambda: list(list_scans(path)), "3000000000")

    metadata.write_text(text.replace("message_count: 3", "message_count: 4"))
    scans = list(list_scans(path))
    assert len(scans) == 4
    fails(lambda: scans[3].read(), "drive", "3")


def test_a_bag_is_read_in_constant_memory(tmp_path: Path) -> None:
    points = some_points(50_000)  # 0.8 MB
    path = write_bag1(tmp_path / "long.bag", {"/lidar": [points] * 30})
    assert path.stat().st_size > 2 * 10 * points.nbytes

    # The bag as it is read in the process with limits, but in this one.
    tracemalloc.start()
    bag = Bag(path, ".bag")
    for index in range(30):
        bag.read(index)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * points.nbytes


# --- missing packages, threads and false headers ---


@pytest.mark.parametrize(
    ("missing", "name"), [("laspy", "old.las"), ("lazrs", "packed.laz"), ("rosbags", "plain.bag")]
)
def test_a_missing_extra_is_named(
    folder: Path, name: str, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    fails(lambda: read_scan(folder / name), name, 'pip install "amvnet[formats]"')


MANY = 3_000_000_000  # points, far more than any file here has


def _npy(shape: tuple[int, ...]) -> bytes:
    text = str({"descr": "<f4", "fortran_order": False, "shape": shape})
    header = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)


def _pcd(points: int, encoding: str, data: bytes = bytes(64)) -> bytes:
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    return f"{header}POINTS {points}\nDATA {encoding}\n".encode() + data


def _compressed(size: int) -> bytes:
    """Return 40 packed bytes of a PCD file that claim to unpack to `size`."""
    return struct.pack("<II", 40, size) + bytes(40)


def _ply(points: int, encoding: str) -> bytes:
    columns = "property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    return f"ply\nformat {encoding} 1.0\nelement vertex {points}\n{columns}".encode()


def _las(path: Path, kind: str, offset: int, value: int) -> bytes:
    """Return the bytes of a LAS file with one number of its header replaced."""
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, offset, value)
    return bytes(content)


def test_claimed_billions_are_refused_before_memory_is_taken(folder: Path, tmp_path: Path) -> None:
    contents = {
        "a.pcd": _pcd(MANY, "binary"),
        "b.pcd": _pcd(MANY, "ascii"),
        "c.pcd": _pcd(MANY, "binary_compressed", _compressed(2**32 - 1)),
        "d.pcd": _pcd(MAX_POINTS, "binary_compressed", _compressed(12 * MAX_POINTS)),
        "e.pcd": _pcd(MAX_POINTS, "ascii"),
        "a.ply": _ply(MANY, "binary_little_endian"),
        "b.ply": _ply(MAX_POINTS, "ascii"),
        "a.npy": _npy((MANY, 4)),
        "b.npy": _npy((MANY, MANY, MANY)),
        "points.las": _las(folder / "old.las", "<I", 107, MANY),
        "points_of_1.4.las": _las(folder / "new.las", "<Q", 247, 1 << 60),
        "a.laz": _las(folder / "packed.laz", "<I", 107, MANY),
        "b.laz": _las(folder / "packed.laz", "<I", 107, MAX_POINTS),
    }
    for name, content in contents.items():
        path = new_file(tmp_path / name, content)

        tracemalloc.start()
        fails(partial(read_scan, path), path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 20e6, (name, peak)


def test_broken_compressed_files_give_an_error_of_one_line(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.laz"
    content = (folder / "packed.laz").read_bytes()
    (points_start,) = struct.unpack_from("<I", content, 96)
    (chunk_table,) = struct.unpack_from("<q", content, points_start)

    # The position of the table of chunks, and the number of chunks in it.
    for offset in (points_start, chunk_table + 4):
        path.write_bytes(content[:offset] + b"\xff\xff\xff\x7f" + content[offset + 4 :])
        fails(lambda: read_scan(path), path)
    assert capfd.readouterr().err == ""


# --- real scans ---


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
    points = scan.points[scan.valid]
    assert len(points) > 0.7 * count
    assert 0 <= points[:, 3].min() < points[:, 3].max() <= 1
    assert np.abs(points[:, :3]).max() < 200


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(("name", "count"), [("semantickitti", 80), ("nuscenes", 10)])
def test_every_real_scan_is_read_alone_as_in_its_dataset(name: str, count: int) -> None:
    from amvnet.data.datasets.open import open_dataset

    dataset: Any = open_dataset(str(Path(REAL or "") / name))
    records = dataset.records(dataset.sequences("all"))
    assert len(records) == count

    for record in records:
        scan = read_scan(record.path)
        expected = dataset.read(record, labels=False)
        np.testing.assert_array_equal(scan.points, expected.points)
        assert (scan.ring is None) == (expected.ring is None)
        if scan.ring is not None:
            np.testing.assert_array_equal(scan.ring, expected.ring)
