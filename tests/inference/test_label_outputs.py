"""Other libraries read what predict writes: coordinates, colours and ids, in the scan's order."""

from __future__ import annotations

import csv
import os
import resource
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pypcd4
import pytest

import amvnet
from amvnet.data.formats.find import read_cloud
from amvnet.data.labels.writers import KINDS, check_kind, write_scan_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, class_colors
from amvnet.drives.world_map import check_ending

from fixtures.commands import fails, files, refusal, run_cli
from fixtures.marks import with_quick
from fixtures.scan_writers import some_points, write_bag1, write_pcd

COUNT = 60
LOST = 7  # the index of a point with NaN
WITH_POINTS = ("csv", "ply", "pcd", "las", "laz")  # kinds of files with coordinates


@dataclass(frozen=True)
class LabelFile:
    raw: np.ndarray
    xyz: np.ndarray | None = None
    colors: np.ndarray | None = None
    uncertain: np.ndarray | None = None


def read_ply(path: Path) -> LabelFile:
    file = plyfile.PlyData.read(path)
    assert not file.text
    assert file.byte_order == "<"

    vertex = file["vertex"].data
    assert (vertex.dtype["red"].str, vertex.dtype["class"].str) == ("|u1", "<i4")

    xyz = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1)
    colors = np.stack([vertex["red"], vertex["green"], vertex["blue"]], axis=1)
    uncertain = vertex["uncertain"] if "uncertain" in vertex.dtype.names else None
    return LabelFile(vertex["class"], xyz, colors, uncertain)


def read_pcd(path: Path) -> LabelFile:
    table = pypcd4.PointCloud.from_path(path).pc_data
    xyz = np.stack([table["x"], table["y"], table["z"]], axis=1)
    rgb = np.ascontiguousarray(table["rgb"]).view(np.uint8).reshape(-1, 4)
    uncertain = table["uncertain"] if "uncertain" in (table.dtype.names or ()) else None
    return LabelFile(table["class"], xyz, rgb[:, 2::-1], uncertain)


def read_las(path: Path) -> LabelFile:
    cloud = laspy.read(path)
    names = list(cloud.point_format.dimension_names)
    raw = np.asarray(cloud["class"] if "class" in names else cloud.classification)
    colors = np.stack([cloud.red, cloud.green, cloud.blue], axis=1) // 257
    uncertain = np.asarray(cloud["uncertain"]) if "uncertain" in names else None
    return LabelFile(raw, cloud.xyz, colors, uncertain)


def read_npy(path: Path) -> LabelFile:
    raw = np.load(path, allow_pickle=False)
    assert raw.dtype == np.uint32
    return LabelFile(raw)


def read_csv(path: Path) -> LabelFile:
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    raw = np.array([int(row["class"]) for row in rows], np.uint32)
    for row in rows:
        known = dict(zip(SEMANTICKITTI.train_to_raw, SEMANTICKITTI.names, strict=True))
        assert row["name"] in (*NUSCENES.classes, known.get(int(row["class"])))
    xyz = np.array([[float(row[axis]) for axis in "xyz"] for row in rows]).reshape(-1, 3)
    uncertain = np.array([row.get("uncertain") == "1" for row in rows])
    has_uncertain = bool(rows) and "uncertain" in rows[0]
    return LabelFile(raw, xyz, None, uncertain if has_uncertain else None)


READERS: dict[str, Callable[[Path], LabelFile]] = {
    "label": lambda path: LabelFile(np.fromfile(path, "<u4")),
    "npy": read_npy,
    "csv": read_csv,
    "ply": read_ply,
    "pcd": read_pcd,
    "las": read_las,
    "laz": read_las,
}


def make_scan(
    dtype: type = np.float32, offset: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return coordinates, train ids of every class, and doubts of points, one of which is lost."""
    xyz = some_points(COUNT)[:, :3].astype(dtype) + dtype(offset)
    ids = np.random.default_rng(1).permutation(COUNT) % (SEMANTICKITTI.size + 1)
    xyz[LOST] = np.nan
    ids[LOST] = 0
    uncertain = np.arange(COUNT) % 3 == 0
    return xyz, ids.astype(np.uint8), uncertain


def check_coordinates(kind: str, xyz: np.ndarray | None, expected: np.ndarray) -> None:
    """Check the coordinates: LAS has millimetres, and lost points at the origin."""
    assert xyz is not None
    if kind.startswith("la"):
        np.testing.assert_allclose(np.nan_to_num(xyz), np.nan_to_num(expected), atol=6e-4)
    else:
        np.testing.assert_array_equal(xyz.astype(expected.dtype), expected)


# --- the files ---


@pytest.mark.parametrize("with_uncertain", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_other_libraries_read_the_files(kind: str, with_uncertain: bool, tmp_path: Path) -> None:
    xyz, ids, uncertain = make_scan()

    written_uncertain = uncertain if with_uncertain else None
    path = write_scan_labels(
        tmp_path / "a.b", kind, xyz, ids, taxonomy=SEMANTICKITTI, uncertain=written_uncertain
    )
    assert path == tmp_path / f"a.b.{kind}"
    assert files(tmp_path) == {path.name}

    content = READERS[kind](path)
    assert content.raw.tolist() == np.array(SEMANTICKITTI.train_to_raw)[ids].tolist()
    if kind not in WITH_POINTS:
        return

    check_coordinates(kind, content.xyz, xyz)
    if kind != "csv":
        np.testing.assert_array_equal(content.colors, np.array(class_colors(SEMANTICKITTI))[ids])
    if with_uncertain:
        np.testing.assert_array_equal(content.uncertain, uncertain)
    else:
        assert content.uncertain is None


@pytest.mark.parametrize("kind", WITH_POINTS)
def test_map_coordinates_keep_their_millimetres(kind: str, tmp_path: Path) -> None:
    xyz, ids, _ = make_scan(np.float64, 5_400_000.0)
    written = READERS[kind](write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)).xyz
    assert written is not None

    assert np.delete(np.abs(written - xyz), LOST, axis=0).max() < 0.0005


@pytest.mark.parametrize("kind", WITH_POINTS)
def test_float64_takes_no_space_if_float32_is_exact_enough(kind: str, tmp_path: Path) -> None:
    xyz, ids, _ = make_scan()
    wide = xyz.astype(np.float64)

    path_32 = write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)
    path_64 = write_scan_labels(tmp_path / "b", kind, wide, ids, SEMANTICKITTI)
    assert path_32.read_bytes() == path_64.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("raw", [256, 260, 65535])
def test_raw_ids_of_more_than_a_byte_survive(kind: str, raw: int, tmp_path: Path) -> None:
    taxonomy = replace(NUSCENES, train_to_raw=(0, raw, *range(2, 17)))
    path = write_scan_labels(tmp_path / "a", kind, np.zeros((2, 3)), np.array([1, 2]), taxonomy)
    assert READERS[kind](path).raw.tolist() == [raw, 2]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 3])
def test_scans_without_a_finite_point_are_written(kind: str, count: int, tmp_path: Path) -> None:
    xyz = np.full((count, 3), np.nan, np.float32)
    path = write_scan_labels(tmp_path / "a", kind, xyz, np.zeros(count, np.uint8), SEMANTICKITTI)
    assert len(READERS[kind](path).raw) == count


def test_open3d_keeps_all_columns_of_a_ply(tmp_path: Path) -> None:
    """Its reader of tensors leaves out properties of all types but these."""
    xyz, ids, uncertain = make_scan()
    for offset in (0, 5_400_000.0):
        path = write_scan_labels(tmp_path / "a", "ply", xyz + offset, ids, SEMANTICKITTI, uncertain)
        header = path.read_bytes().split(b"end_header")[0].decode().splitlines()
        types = {line.split()[1] for line in header if line.startswith("property")}
        assert types <= {"uchar", "int", "float", "double"}


@pytest.mark.parametrize("kind", ["las", "laz"])
@pytest.mark.parametrize("count", [0, COUNT])
def test_files_of_las_are_as_version_1_4_wants(kind: str, count: int, tmp_path: Path) -> None:
    """Of its revision 15, what holds for the point formats from 6 on."""
    xyz, ids, uncertain = make_scan()
    path = write_scan_labels(
        tmp_path / "a", kind, xyz[:count], ids[:count], SEMANTICKITTI, uncertain[:count]
    )
    header = path.read_bytes()[:375]
    (encoding,) = struct.unpack_from("<H", header, 6)
    assert encoding & 0b10000  # WKT
    assert not any(struct.unpack_from("<6I", header, 107))  # the counts of earlier versions
    assert struct.unpack_from("<Q", header, 247)[0] == count
    assert struct.unpack_from("<15Q", header, 255) == (count,) + 14 * (0,)

    cloud = laspy.read(path)
    assert (cloud.return_number == 1).all()
    assert (cloud.number_of_returns == 1).all()
    (system,) = cloud.header.vlrs.get("WktCoordinateSystemVlr")
    assert system.string.startswith("LOCAL_CS[")
    assert system.record_data_bytes().endswith(b"]\0")


# --- errors ---


@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_file_survives_a_write_that_fails(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz, ids, _ = make_scan()
    stem = tmp_path / "a"
    path = write_scan_labels(stem, kind, xyz, ids, SEMANTICKITTI)
    before = path.read_bytes()

    fails(lambda: write_scan_labels(stem, kind, xyz, ids + 20, SEMANTICKITTI), "0..19")
    fails(lambda: write_scan_labels(stem, kind, xyz, ids[1:], SEMANTICKITTI), path, COUNT)

    def disk_full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", disk_full)
    with pytest.raises(OSError, match="No space"):
        write_scan_labels(stem, kind, xyz + 1, ids, SEMANTICKITTI)

    assert path.read_bytes() == before
    assert files(tmp_path) == {path.name}


@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_without_space_is_an_error_that_names_the_file(kind: str, tmp_path: Path) -> None:
    """Libraries hide the reason, and NumPy ignores it in the last block of a file."""
    xyz = np.random.default_rng(0).normal(scale=20, size=(5000, 3))
    ids = np.ones(len(xyz), np.uint8)
    whole = write_scan_labels(tmp_path / "b", kind, xyz, ids, SEMANTICKITTI)
    size = whole.stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for space in (0, size // 2, size - 1):
        resource.setrlimit(resource.RLIMIT_FSIZE, (space, limits[1]))
        try:
            with pytest.raises(OSError, match=f"a.{kind}"):
                write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files(tmp_path) == {whole.name}


def test_an_unknown_format_is_named() -> None:
    xyz = np.zeros((1, 3))
    ids = np.zeros(1)
    fails(lambda: write_scan_labels(Path("a"), "xyz", xyz, ids, SEMANTICKITTI), "xyz", "ply")


@pytest.mark.parametrize("missing", ["laspy", "lazrs"])
def test_a_missing_package_is_named_early(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    for check in (lambda: check_kind("laz"), lambda: check_ending(Path("a.laz"))):
        fails(check, "laz", missing, 'pip install "amvnet[formats]"')


# --- predict ---


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded")
    points = some_points(400)
    (root / "scans").mkdir()
    points.tofile(root / "scans/a.bin")
    points[LOST] = np.nan
    points[LOST + 1, :3] = 0

    write_pcd(root / "scans/b.pcd", points, "binary")
    write_bag1(root / "drive.bag", {"/lidar": [points, points[::-1].copy()]})
    return root


def predict(world: Path, out: Path, *words: object) -> tuple[int, str]:
    return run_cli("predict", *words, "--weights", world / "w.safetensors", "--out", out)


def failure(world: Path, out: Path, *words: object) -> str:
    return refusal("predict", *words, "--weights", world / "w.safetensors", "--out", out)


@pytest.mark.parametrize("kind", with_quick(KINDS, ["ply"]))
def test_predict_writes_the_points_of_the_file_though_the_network_gets_others(
    kind: str, world: Path, recorded: Path, tmp_path: Path
) -> None:
    inputs = (recorded / "scans", recorded / "drive.bag", "--axes", "y-forward", "--height", "0.5")
    assert predict(world, tmp_path / "label", *inputs)[0] == 0
    assert predict(world, tmp_path / "out", *inputs, "--format", kind)[0] == 0

    first = read_cloud(recorded / "scans/a.bin").xyz
    second = read_cloud(recorded / "scans/b.pcd").xyz
    scans = {"a": first, "b": second, "drive/000000": second, "drive/000001": second[::-1]}
    assert files(tmp_path / "out") == {f"{name}.{kind}" for name in scans}

    for name, xyz in scans.items():
        raw = np.fromfile(tmp_path / "label" / f"{name}.label", np.uint32)
        content = READERS[kind](tmp_path / "out" / f"{name}.{kind}")
        np.testing.assert_array_equal(content.raw, raw)
        if kind in WITH_POINTS:
            assert content.uncertain is not None
            check_coordinates(kind, content.xyz, xyz)


def test_uncertain_points_are_the_segmenters(world: Path, recorded: Path, tmp_path: Path) -> None:
    options = ("--uncertain", "--sequences", "08", "--format", "ply")
    assert predict(world, tmp_path, world / "data", recorded / "scans", *options)[0] == 0

    # A dataset keeps its layout and its format.
    folder = "sequences/08/predictions"
    names = {f"{folder}/000000": "label", f"{folder}/000001": "label", "a": "ply", "b": "ply"}
    written = {f"{name}.{kind}" for name, kind in names.items()}
    assert files(tmp_path) == written | {f"{name}.uncertain.npy" for name in names}

    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32).reshape(-1, 4)
    expected = amvnet.load(str(world / "w.safetensors"))(points).uncertain
    uncertain = np.load(tmp_path / folder / "000000.uncertain.npy", allow_pickle=False)
    assert uncertain.dtype == bool
    np.testing.assert_array_equal(uncertain, expected)

    uncertain = np.load(tmp_path / "b.uncertain.npy", allow_pickle=False)
    np.testing.assert_array_equal(uncertain, read_ply(tmp_path / "b.ply").uncertain)
    assert not uncertain[[LOST, LOST + 1]].any()


def test_one_network_alone_reports_no_uncertain_points(world: Path, tmp_path: Path) -> None:
    scan = world / "lone.bin"
    options = ("--method", "rv", "--format", "ply")
    assert predict(world, tmp_path, scan, *options)[0] == 0
    assert read_ply(tmp_path / "lone.ply").uncertain is None

    assert "--uncertain" in failure(world, tmp_path / "other", scan, *options, "--uncertain")
    assert not (tmp_path / "other").exists()


def test_uncertain_points_next_to_scans_are_not_scans(world: Path, tmp_path: Path) -> None:
    some_points(400).tofile(tmp_path / "a.bin")
    for _ in range(2):
        assert predict(world, tmp_path, tmp_path, "--uncertain", "--overwrite")[0] == 0
    assert files(tmp_path) == {"a.bin", "a.label", "a.uncertain.npy"}
