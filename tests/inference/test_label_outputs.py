"""What predict writes is what other libraries read: coordinates, colours, ids, order, lost points in their places."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import laspy
import numpy as np
import plyfile
import pytest
from pypcd4 import PointCloud

from amvnet.cli.commands import predict as verbs
from amvnet.data.formats.detect import read_cloud
from amvnet.data.label_files import KINDS, write_scan_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.weights.file import save

from fixtures.scan_writers import some_points, write_bag1, write_pcd
from fixtures.worlds import fails, files, fresh_weights, make_streets, run_cli, without

COUNT = 60
LOST = 7  # the place of a point with NaN
WITH_POINTS = ("ply", "pcd", "las")


@dataclass(frozen=True)
class Read:
    """What another library finds in a file."""

    raw: np.ndarray
    xyz: np.ndarray | None = None
    colors: np.ndarray | None = None
    uncertain: np.ndarray | None = None


def read_ply(path: Path) -> Read:
    file = plyfile.PlyData.read(path)
    assert (file.text, file.byte_order) == (False, "<")
    vertex = file["vertex"].data
    names, columns = (
        vertex.dtype.names,
        {name: np.asarray(vertex[name]) for name in vertex.dtype.names},
    )
    assert [vertex.dtype[name].str for name in ("red", "class")] == ["|u1", "<i4"]
    xyz, colors = (
        np.stack([columns[n] for n in some], 1)
        for some in (("x", "y", "z"), ("red", "green", "blue"))
    )
    return Read(
        columns["class"], xyz, colors, columns["uncertain"] if "uncertain" in names else None
    )


def read_pcd(path: Path) -> Read:
    cloud = PointCloud.from_path(path)
    columns = {name: cloud.pc_data[name] for name in cloud.fields}
    colors = PointCloud.decode_rgb(columns["rgb"])
    return Read(columns["label"], cloud.numpy(("x", "y", "z")), colors, columns.get("uncertain"))


def read_las(path: Path) -> Read:
    las = laspy.read(path)
    colors = np.stack([las.red, las.green, las.blue], 1) >> 8
    extra = set(las.point_format.extra_dimension_names)
    assert extra <= {"class", "uncertain"}
    uncertain = np.asarray(las["uncertain"]) if "uncertain" in extra else None
    return Read(np.asarray(las["class"]), np.asarray(las.xyz), colors, uncertain)


def read_npy(path: Path) -> Read:
    raw = np.load(path, allow_pickle=False)
    assert raw.dtype == np.uint32
    return Read(raw)


READERS: dict[str, Callable[[Path], Read]] = {
    "label": lambda path: Read(np.fromfile(path, "<u4")),
    "npy": read_npy,
    "ply": read_ply,
    "pcd": read_pcd,
    "las": read_las,
}


def a_scan(
    dtype: type = np.float32, offset: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 3) coordinates, (N,) train ids with every class, (N,) bool; one point is lost."""
    xyz = some_points(COUNT)[:, :3].astype(dtype) + dtype(offset)
    ids = np.random.default_rng(1).permutation(COUNT) % (SEMANTICKITTI.size + 1)
    xyz[LOST], ids[LOST] = np.nan, 0
    return xyz, ids.astype(np.uint8), np.arange(COUNT) % 3 == 0


def where_lost(kind: str, xyz: np.ndarray) -> np.ndarray:
    """The coordinates that a file of this kind should have."""
    return np.where(np.isfinite(xyz), xyz, 0) if kind == "las" else xyz


# --- the files


def test_every_kind_is_read_back_here_and_offered_by_the_command_line() -> None:
    assert set(READERS) == set(KINDS) == set(get_args(verbs.FormatName))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_other_libraries_read_what_was_written(kind: str, known: bool, tmp_path: Path) -> None:
    xyz, ids, uncertain = a_scan()
    path = write_scan_labels(
        tmp_path / "a.b", kind, xyz, ids, SEMANTICKITTI, uncertain if known else None
    )
    assert path == tmp_path / f"a.b.{kind}"
    assert files(tmp_path) == {path.name}
    found = READERS[kind](path)
    assert found.raw.tolist() == [SEMANTICKITTI.train_to_raw[i] for i in ids]
    if kind in WITH_POINTS:
        assert found.xyz is not None
        assert found.colors is not None
        np.testing.assert_allclose(
            found.xyz, where_lost(kind, xyz), rtol=0, atol=1e-4 if kind == "las" else 0
        )
        assert [tuple(color) for color in found.colors.tolist()] == [
            SEMANTICKITTI.colors[i] for i in ids
        ]
        assert (found.uncertain is None) == (not known)
        if found.uncertain is not None:
            assert found.uncertain.tolist() == uncertain.tolist()


@pytest.mark.parametrize("kind", WITH_POINTS)
def test_coordinates_of_a_map_keep_their_millimetres(kind: str, tmp_path: Path) -> None:
    xyz, ids, _ = a_scan(np.float64, 5_400_000.0)
    found = READERS[kind](write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)).xyz
    kept = np.arange(COUNT) != LOST
    assert found is not None
    assert np.abs(found - xyz)[kept].max() < 0.0005


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_float64_takes_no_room_where_float32_is_enough(kind: str, tmp_path: Path) -> None:
    xyz, ids, _ = a_scan()
    narrow, wide = (
        write_scan_labels(tmp_path / name, kind, xyz.astype(dtype), ids, SEMANTICKITTI)
        for name, dtype in (("a", np.float32), ("b", np.float64))
    )
    assert narrow.read_bytes() == wide.read_bytes()


def test_points_that_las_cannot_hold_keep_their_places_and_move_no_others(tmp_path: Path) -> None:
    xyz, ids, _ = a_scan()
    xyz[[3, 4, 5]] = [[1e30, 0, 0], [0, -np.inf, 0], [0, 0, 3e5]]
    found = read_las(write_scan_labels(tmp_path / "a", "las", xyz, ids, SEMANTICKITTI))
    held = ~np.isin(np.arange(COUNT), [3, 4, 5, LOST])
    assert found.xyz is not None
    assert not found.xyz[~held].any()
    assert not found.raw[~held].any()
    np.testing.assert_allclose(found.xyz[held], xyz[held], rtol=0, atol=1e-4)
    assert np.array_equal(found.raw[held], SEMANTICKITTI.to_raw(ids)[held])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("raw", [0, 260, 65535])
def test_raw_ids_of_more_than_a_byte_survive(kind: str, raw: int, tmp_path: Path) -> None:
    taxonomy = replace(NUSCENES, train_to_raw=(0, raw, *range(2, 17)))
    found = READERS[kind](
        write_scan_labels(tmp_path / "a", kind, np.zeros((2, 3)), np.array([1, 2]), taxonomy)
    )
    assert found.raw.tolist() == [raw, 2]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scan_without_a_finite_point_or_any(kind: str, tmp_path: Path) -> None:
    for count in (0, 3):
        xyz, ids = np.full((count, 3), np.nan, np.float32), np.zeros(count, np.uint8)
        assert (
            len(READERS[kind](write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)).raw)
            == count
        )


@pytest.mark.parametrize("kind", WITH_POINTS)
def test_what_was_written_can_be_segmented_again(kind: str, tmp_path: Path) -> None:
    xyz, ids, uncertain = a_scan()
    cloud = read_cloud(write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI, uncertain))
    np.testing.assert_allclose(cloud.xyz, where_lost(kind, xyz), rtol=0, atol=1e-4)


# --- what goes wrong


@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_file_survives_a_write_that_fails(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz, ids, _ = a_scan()
    path = write_scan_labels(tmp_path / "a", kind, xyz, ids, SEMANTICKITTI)
    before = path.read_bytes()
    fails(lambda: write_scan_labels(tmp_path / "a", kind, xyz, ids + 20, SEMANTICKITTI), "0..19")
    fails(lambda: write_scan_labels(tmp_path / "a", kind, xyz, ids[1:], SEMANTICKITTI), path, COUNT)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write_scan_labels(tmp_path / "a", kind, xyz + 1, ids, SEMANTICKITTI)
    assert path.read_bytes() == before
    assert files(tmp_path) == {path.name}


def test_an_unknown_format_is_named() -> None:
    fails(
        lambda: write_scan_labels(Path("a"), "xyz", np.zeros((1, 3)), np.zeros(1), SEMANTICKITTI),
        "xyz",
        "ply",
    )


def test_a_missing_extra_is_named(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    code, message = predict(world, tmp_path, world / "scans/a.bin", "--format", "las")
    assert (code, message.count("\n")) == (2, 1)
    assert 'pip install "amvnet[formats]"' in message
    assert not files(tmp_path)


# --- predict


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, a data set, and lone scans of three formats."""
    root = tmp_path_factory.mktemp("world")
    save(fresh_weights(), root / "w.safetensors")
    save(without(fresh_weights(), "polar_net"), root / "rv.safetensors")
    make_streets(root / "data")
    (root / "scans").mkdir()
    points = some_points(400)
    points.tofile(root / "scans/a.bin")
    points[LOST] = np.nan
    points[LOST + 1, :3] = 0
    write_pcd(root / "scans/b.pcd", points, "binary")
    write_bag1(root / "drive.bag", {"/lidar": [points, points[::-1].copy()]})
    return root


def predict(world: Path, out: Path, *words: object) -> tuple[int, str]:
    return run_cli("predict", *words, "--weights", world / "w.safetensors", "--out", out)


@pytest.mark.parametrize("kind", KINDS)
def test_predict_writes_the_files_own_points_though_the_network_sees_others(
    kind: str, world: Path, tmp_path: Path
) -> None:
    inputs = (world / "scans", world / "drive.bag", "--axes", "y-forward", "--height", "0.5")
    assert predict(world, tmp_path / "label", *inputs)[0] == 0
    assert predict(world, tmp_path / "out", *inputs, "--format", kind)[0] == 0
    sources = {
        "a": read_cloud(world / "scans/a.bin").xyz,
        "b": read_cloud(world / "scans/b.pcd").xyz,
    }
    sources |= {"drive/000000": sources["b"], "drive/000001": sources["b"][::-1]}
    assert files(tmp_path / "out") == {f"{name}.{kind}" for name in sources}
    for name, xyz in sources.items():
        found = READERS[kind](tmp_path / "out" / f"{name}.{kind}")
        assert np.array_equal(
            found.raw, np.fromfile(tmp_path / "label" / f"{name}.label", np.uint32)
        )
        if found.xyz is not None:
            assert found.uncertain is not None
            np.testing.assert_allclose(
                found.xyz, where_lost(kind, xyz), rtol=0, atol=1e-4 if kind == "las" else 0
            )


def test_uncertain_points_are_those_of_the_segmenter(world: Path, tmp_path: Path) -> None:
    options = ("--uncertain", "--sequences", "08", "--format", "ply")
    assert predict(world, tmp_path, world / "data", world / "scans", *options)[0] == 0
    folder = "sequences/08/predictions"
    names = {f"{folder}/{i:06d}" for i in range(2)}
    expected = {f"{name}.label" for name in names} | {
        "a.ply",
        "b.ply",
    }  # a data set keeps its layout
    assert files(tmp_path) == expected | {f"{name}.uncertain.npy" for name in (*names, "a", "b")}
    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32).reshape(-1, 4)
    found = np.load(tmp_path / folder / "000000.uncertain.npy", allow_pickle=False)
    assert found.dtype == bool
    assert np.array_equal(found, Segmenter(str(world / "w.safetensors"))(points).uncertain)
    beside = np.load(tmp_path / "b.uncertain.npy", allow_pickle=False)
    assert np.array_equal(beside, read_ply(tmp_path / "b.ply").uncertain)
    assert not beside[[LOST, LOST + 1]].any()


def test_one_network_alone_is_never_said_to_be_certain(world: Path, tmp_path: Path) -> None:
    scan, options = world / "scans/a.bin", ("--method", "rv", "--format", "ply")
    assert predict(world, tmp_path, scan, *options)[0] == 0
    assert read_ply(tmp_path / "a.ply").uncertain is None
    code, message = predict(world, tmp_path / "other", scan, *options, "--uncertain")
    assert (code, message.count("\n")) == (2, 1)
    assert "--uncertain" in message
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("scan", "options"),
    [("b.pcd", ("--format", "pcd")), ("a.bin", ("--format", "ply")), ("c.npz", ("--scores",))],
)
def test_scans_are_never_written_over(
    scan: str, options: tuple[str, ...], world: Path, tmp_path: Path
) -> None:
    points = some_points(400)
    for name, content in (("a.bin", points.tobytes()), ("a.ply", b"another scan of mine")):
        (tmp_path / name).write_bytes(content)
    write_pcd(tmp_path / "b.pcd", points, "binary")
    np.savez(tmp_path / "c.npz", points=points)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    code, message = predict(world, tmp_path, tmp_path / scan, *options)
    assert (code, message.count("\n")) == (2, 1)
    assert "--out" in message
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_uncertain_points_beside_scans_are_no_scans(world: Path, tmp_path: Path) -> None:
    some_points(400).tofile(tmp_path / "a.bin")
    for _ in range(2):
        assert predict(world, tmp_path, tmp_path, "--uncertain")[0] == 0
    assert files(tmp_path) == {"a.bin", "a.label", "a.uncertain.npy"}


def test_an_unknown_format_is_one_line(world: Path, tmp_path: Path) -> None:
    code, message = predict(world, tmp_path, world / "scans/a.bin", "--format", "xyz")
    assert (code, message.count("\n")) == (2, 1)
    assert "ply" in message
