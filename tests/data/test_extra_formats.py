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

from amvnet.data.formats.detect import BAGS, GZIP, named_ending
from amvnet.data.formats.find import list_scans, read_cloud, scan_stem
from amvnet.data.formats.rows import parse_layout
from amvnet.errors import InputError
from amvnet.files import fault_of_name
from amvnet.weights.file import save

from fixtures.commands import fails, files, run_cli
from fixtures.scan_writers import WRITERS, some_points, write_sweep
from fixtures.tiny import fresh_weights, street

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


@pytest.mark.parametrize("name", ["a.parquet", "a.pkl", "a.pcap"])
def test_formats_that_are_not_read_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)))
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


def test_feather_without_its_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.feather"
    path.write_bytes(b"ARROW1\0\0")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    fails(lambda: read_cloud(path), path, 'pip install "amvnet[feather]"')


# --- packed files and archives ---


def zip_of(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of files of one scan, by name."""
    folder = tmp_path_factory.mktemp("files")
    contents = {}
    for name, write in WRITERS.items():
        write(folder / name, some_points())
        if named_ending(Path(name)) not in (*BAGS, GZIP):
            contents[name] = (folder / name).read_bytes()
    return contents


def test_every_format_may_be_packed(tmp_path: Path, contents: dict[str, bytes]) -> None:
    for name, content in contents.items():
        path = tmp_path / f"{name}.gz"
        path.write_bytes(gzip.compress(content))
        (scan,) = list_scans(path)
        assert (scan.name, scan.path) == (scan_stem(Path(name)), path)
        assert scan.ending == named_ending(Path(name))
        np.testing.assert_allclose(scan.read().to_scan().points, some_points(), atol=1e-3)

    names = {scan.name for scan in list_scans(tmp_path)}
    assert names == {scan_stem(Path(name)) for name in contents if name != "plain.xyz"}


def test_rows_may_be_packed(tmp_path: Path) -> None:
    path = tmp_path / "a.bin.gz"
    path.write_bytes(gzip.compress(some_points()[:, :3].tobytes()))
    cloud = read_cloud(path, parse_layout("z,y,x", None))
    np.testing.assert_array_equal(cloud.xyz, some_points()[:, 2::-1])


def test_the_scans_of_an_archive_are_named_by_their_folders(
    tmp_path: Path, contents: dict[str, bytes]
) -> None:
    others = {"a/readme.txt": b"1 2 3\n", "__MACOSX/a/._kitti.bin": b"x", "b/": b"", ".x.bin": b""}
    members = {f"a/{name}": content for name, content in contents.items()}
    path = zip_of(tmp_path / "drive.zip", members | others)
    scans = list(list_scans(path))
    assert "drive/a/kitti" in {scan.name for scan in scans}
    assert len(scans) == len(contents) - 1  # without the texts
    for scan in scans:
        np.testing.assert_allclose(scan.read().to_scan().points, some_points(), atol=1e-3)
    assert {scan.source for scan in scans if scan.ending == ".pcd"} == {f"{path}/a/*.pcd"}
    # One that is no archive of scans, by its name, is one of NumPy.
    assert [scan.ending for scan in list_scans(tmp_path)] == [scan.ending for scan in scans]


def test_a_broken_packed_file_is_one_line(tmp_path: Path, contents: dict[str, bytes]) -> None:
    one = {"kitti.bin": contents["kitti.bin"]}
    packed = gzip.compress(one["kitti.bin"])
    cases = {
        "empty": b"\x1f\x8b",
        "cut": packed[: len(packed) // 2],
        "without its sum": packed[:-8],
        "changed": packed[:40] + bytes([packed[40] ^ 255]) + packed[41:],
        "packed twice": gzip.compress(packed),
        "followed by others": packed + b"more",
        "nothing": gzip.compress(b""),
        "an archive": gzip.compress(zip_of(tmp_path / "x.zip", one).read_bytes()),
    }
    for name, content in cases.items():
        path = tmp_path / f"{name}.bin.gz"
        path.write_bytes(content)
        fails(lambda path=path: read_cloud(path).to_scan(), path)  # type: ignore[misc]


def test_nothing_leaves_an_archive(tmp_path: Path, contents: dict[str, bytes]) -> None:
    """Names that lead elsewhere, and links, are broken scans; archives in archives are none."""
    link = zipfile.ZipInfo("link.bin")
    link.create_system = 3
    link.external_attr = 0o120777 << 16
    path = zip_of(tmp_path / "a.zip", {"good.bin": contents["kitti.bin"]})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc/passwd")
        archive.writestr("../../up.bin", contents["kitti.bin"])
        archive.writestr("inner.zip", zip_of(tmp_path / "i.zip", contents).read_bytes())
        archive.writestr("inner.bin.gz", gzip.compress(contents["kitti.bin"]))
        archive.writestr("/absolute.bin", contents["kitti.bin"])
        archive.writestr("new\nline.bin", contents["kitti.bin"])
        archive.writestr(f"{'long' * 70}.bin", contents["kitti.bin"])
    before = set(tmp_path.rglob("*"))

    scans = {scan.name: scan for scan in list_scans(path)}
    refused = [name for name in scans if name.startswith("a/member-")]
    assert len(refused) == 4
    assert set(scans) == {"a/good", "a/link", *refused}
    fails(scans["a/link"].read, f"{path} (link.bin)")
    for name in refused:
        fails(scans[name].read, str(path), "expected the name of a scan", "rename it")
        assert fault_of_name(Path(name)) is None
    assert len(scans["a/good"].read().xyz) == len(some_points())
    assert set(tmp_path.rglob("*")) == before

    zip_of(tmp_path / "none.zip", {"a.doc": b"1"})
    zip_of(tmp_path / "nothing.zip", {})
    for name in ("none.zip", "nothing.zip"):
        fails(lambda name=name: list(list_scans(tmp_path / name)), name)  # type: ignore[misc]
    whole = zip_of(tmp_path / "whole.zip", {"good.bin": contents["kitti.bin"]})
    (tmp_path / "cut.zip").write_bytes(whole.read_bytes()[:-30])
    fails(lambda: list(list_scans(tmp_path / "cut.zip")), "cut.zip")


def test_an_archive_with_a_bad_name_is_segmented_but_for_this_scan(
    tmp_path: Path, contents: dict[str, bytes]
) -> None:
    points, _ = street(3)
    members = {"good.bin": points.tobytes(), "../up.bin": points.tobytes()}
    path = zip_of(tmp_path / "a.zip", members)
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    code, error = run_cli("predict", path, "--weights", weights, "--out", tmp_path / "out")
    assert code == 3
    assert "up.bin" in error
    assert [file.name for file in (tmp_path / "out").rglob("*.label")] == ["good.label"]
    assert not (tmp_path / "up.label").exists()


def test_an_archive_of_a_user_is_segmented(tmp_path: Path, contents: dict[str, bytes]) -> None:
    points, _ = street(3)
    points[:, 3] = points[:, 3].clip(0, 1)
    zip_of(tmp_path / "drive.zip", {"a/0.bin": points.tobytes(), "a/1.bin": b"broken"})
    save(fresh_weights(), tmp_path / "w.safetensors")
    options = ("--weights", tmp_path / "w.safetensors", "--out", tmp_path / "out")
    code, error = run_cli("predict", tmp_path / "drive.zip", *options)
    assert code == 3
    assert "drive.zip (a/1.bin)" in error
    assert (tmp_path / "out/drive/a/0.label").stat().st_size == 4 * len(points)
    assert files(tmp_path / "out") == {"drive/a/0.label"}
