"""The map of a drive: its voxels, its files and its figures."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

import amvnet
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.drives.consensus import LEAST
from amvnet.drives.world_map import MapBuilder
from amvnet.errors import InputError
from amvnet.files import alone_in, digest
from amvnet.inference import drive as drive_module
from amvnet.inference.drive import Drives
from amvnet.inference.listing import find_inputs
from amvnet.inference.request import LabellingRequest
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.reading import Reading
from amvnet.weights.file import save

from fixtures.browser_pages import read_page
from fixtures.commands import fails, new_file, refused, run_cli, succeed
from fixtures.drives import SCANS, drive_poses, write_drive
from fixtures.tiny import fresh_weights

ROAD = 9  # train ids of SemanticKITTI
CAR = 1
SIZE = 0.5


def scores_of(labels: np.ndarray, probability: float = 0.9) -> np.ndarray:
    """Return scores (N, 19) with a probability for each label, and equal ones for the others."""
    scores = np.full((len(labels), 19), (1 - probability) / 18)
    scores[np.arange(len(labels)), labels - 1] = probability
    return scores


def test_voxels_equal_a_loop_over_the_points() -> None:
    rng = np.random.default_rng(0)
    builder = MapBuilder(SIZE, SEMANTICKITTI)
    origin = np.array([400_000.3, 5_000_000.7, 100])
    points: defaultdict[tuple[int, ...], list[np.ndarray]] = defaultdict(list)
    votes: defaultdict[tuple[int, ...], list[tuple[float, np.ndarray]]] = defaultdict(list)
    sights: Counter[tuple[int, ...]] = Counter()
    for pose in drive_poses(5):
        pose[:3, 3] += origin
        xyz = rng.uniform(-3, 3, (80, 3))
        scores = rng.dirichlet(np.full(19, 0.2), 80)
        builder.add(xyz, scores, pose)

        seen = set()
        for point, row in zip(xyz @ pose[:3, :3].T + pose[:3, 3], scores, strict=True):
            voxel = tuple(np.floor((point - np.floor(origin)) / SIZE).astype(int))
            points[voxel].append(point)
            weight = max(round(float(row.max() ** 2 * 16)), 1)
            votes[voxel].append((weight, np.round(np.log(np.maximum(row, LEAST)) * 16) / 16))
            seen.add(voxel)
        sights.update(seen)

    world = builder.build(keeps_movable=True)
    assert len(world) == len(points)
    places = np.floor((world.xyz - np.floor(origin)) / SIZE + 1e-9).astype(int)
    for place, xyz, label, confidence, count in zip(
        places, world.xyz, world.labels, world.confidence, world.sights, strict=True
    ):
        voxel = tuple(place)
        np.testing.assert_allclose(xyz, np.mean(points[voxel], axis=0), atol=1e-4)
        total = sum(weight for weight, _ in votes[voxel])
        logs = sum(weight * values for weight, values in votes[voxel]) / total
        shares = np.exp(logs) / np.exp(logs).sum()
        assert label == shares.argmax() + 1
        assert confidence == pytest.approx(shares.max(), abs=1e-4)
        assert count == sights[voxel]


def test_what_may_move_is_left_out_unless_it_is_wanted() -> None:
    builder = MapBuilder(SIZE, SEMANTICKITTI)
    labels = np.arange(1, SEMANTICKITTI.size + 1)
    xyz = np.column_stack([labels + 0.1, 0 * labels, 0 * labels])
    builder.add(xyz, scores_of(labels), np.eye(4))
    assert builder.build().labels.tolist() == list(range(ROAD, SEMANTICKITTI.size + 1))
    assert builder.build(keeps_movable=True).labels.tolist() == labels.tolist()


def test_a_map_far_from_the_origin_is_continued_as_it_was(tmp_path: Path) -> None:
    builder = MapBuilder(SIZE, SEMANTICKITTI)
    pose = np.eye(4)
    pose[:3, 3] = (400_000.3, 5_000_000.7, 100)
    builder.add(np.array([[1.1, 0.1, 0.1]]), scores_of(np.array([ROAD])), pose)
    builder.save(tmp_path / "part.npz", "a request", done=1)
    other = MapBuilder(SIZE, SEMANTICKITTI)
    assert other.restore(tmp_path / "part.npz", "a request") == 1
    np.testing.assert_array_equal(other.build().xyz, builder.build().xyz)


def test_what_the_keys_of_voxels_cannot_reach_is_one_line() -> None:
    builder = MapBuilder(SIZE, SEMANTICKITTI)
    xyz, scores = np.array([[1.1, 0.1, 0.1]]), scores_of(np.array([ROAD]))
    builder.add(xyz, scores, np.eye(4))
    reach = SIZE * (1 << 20)
    pose = np.eye(4)
    pose[0, 3] = reach - 2
    builder.add(xyz, scores, pose)
    assert builder.build().xyz[:, 0].max() == pytest.approx(reach - 0.9)
    for place in (reach, -reach - 2):
        pose[0, 3] = place
        fails(lambda: builder.add(xyz, scores, pose), "within 524 km", "--voxel")


def test_a_car_that_drives_away_leaves_the_road() -> None:
    builder = MapBuilder(SIZE, SEMANTICKITTI)
    xyz = np.array([[1.1, 0.1, 0.1]])
    for label in (CAR, ROAD, ROAD):
        builder.add(xyz, scores_of(np.array([label])), np.eye(4))
    world = builder.build()
    assert (world.labels.tolist(), world.sights.tolist()) == ([ROAD], [3])


def test_a_map_of_nothing_has_no_voxels(tmp_path: Path) -> None:
    world = MapBuilder(SIZE, SEMANTICKITTI).build()
    for ending in ("ply", "las", "laz"):
        world.write(tmp_path / f"map.{ending}")
    assert len(PlyData.read(tmp_path / "map.ply")["vertex"]) == 0
    fails(lambda: world.write(tmp_path / "map.txt"), ".laz")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    write_drive(root / "data")
    save(fresh_weights(), root / "w.safetensors")
    return root


def command(world: Path, out: Path, *options: object) -> str:
    words = " ".join(map(str, options))
    return f"map {world}/data --weights {world}/w.safetensors --out {out} {words}"


def test_both_formats_read_back_equal_and_as_the_figures_say(world: Path, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    succeed(command(world, tmp_path / "map.ply", "--keep-movable", "--json", tmp_path / "map.json"))
    succeed(command(world, tmp_path / "map.laz", "--keep-movable"))
    figures = json.loads((tmp_path / "map.json").read_text())

    vertices = PlyData.read(tmp_path / "map.ply")["vertex"]
    cloud = laspy.read(tmp_path / "map.laz")
    assert len(vertices) == len(cloud) == figures["voxels"] == sum(figures["classes"].values())
    for axis in "xyz":
        np.testing.assert_allclose(vertices[axis], cloud[axis], atol=0.00051)
    np.testing.assert_array_equal(vertices["class"], cloud.classification)
    np.testing.assert_array_equal(vertices["sights"], cloud.sights)
    assert vertices.data.dtype["sights"] == np.int32  # Open3D's reader of tensors drops uint16
    np.testing.assert_allclose(vertices["confidence"], cloud.confidence)
    np.testing.assert_array_equal(vertices["red"], np.asarray(cloud.red) // 257)

    ids, counts = np.unique(SEMANTICKITTI.to_train(vertices["class"]), return_counts=True)
    of_file = {SEMANTICKITTI.names[index]: count for index, count in zip(ids, counts, strict=True)}
    assert of_file == {name: count for name, count in figures["classes"].items() if count}


def test_the_viewer_and_the_readers_take_a_map(world: Path, tmp_path: Path) -> None:
    succeed(command(world, tmp_path / "map.ply"))
    succeed(f"view {tmp_path}/map.ply --html {tmp_path}/map.html")
    assert read_page(tmp_path / "map.html").about["sources"]
    vertices = PlyData.read(tmp_path / "map.ply")["vertex"]
    assert len(amvnet.read(tmp_path / "map.ply")) == len(vertices)


@pytest.mark.full
def test_a_map_replaces_maps_only(world: Path, tmp_path: Path) -> None:
    out = new_file(tmp_path / "map.ply", "ply\nmy own points")
    refused(command(world, out), "--overwrite")
    refused(command(world, out, "--overwrite"), "a map")
    assert out.read_text() == "ply\nmy own points"
    refused(command(world, tmp_path / "map.txt"), ".laz")

    succeed(command(world, tmp_path / "other.ply"))
    assert run_cli(*command(world, tmp_path / "other.ply", "--overwrite").split())[0] == 0


def test_a_map_replaces_no_scan_and_no_other_cloud(world: Path, tmp_path: Path) -> None:
    """Scans and the clouds of other programs have the ending of a map."""
    laspy = pytest.importorskip("laspy")
    out = tmp_path / "other.laz"
    laspy.LasData(laspy.LasHeader(point_format=0)).write(out)
    content = out.read_bytes()
    refused(command(world, out, "--overwrite"), "a map in LAZ")
    assert out.read_bytes() == content

    drive = tmp_path / "drive"
    for name in ("a.laz", "b.laz"):
        succeed(command(world, drive / name))
    scan = (drive / "a.laz").read_bytes()
    words = f"--weights {world}/w.safetensors --out {drive}/a.laz --overwrite"
    refused(f"map {drive} {words}", "an input")
    assert (drive / "a.laz").read_bytes() == scan
    succeed(command(world, tmp_path / "map.laz"))
    succeed(command(world, tmp_path / "map.laz", "--overwrite"))


def test_a_map_that_was_stopped_is_resumed_to_the_same_map(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    succeed(command(world, tmp_path / "whole.ply"))
    monkeypatch.setattr(drive_module, "SAVED_SCANS", 2)
    added = 0
    add = MapBuilder.add

    def stop_at_the_fourth(*args: object) -> None:
        nonlocal added
        added += 1
        if added == 4:
            raise InputError("stopped")
        add(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(MapBuilder, "add", stop_at_the_fourth)
    out = tmp_path / "map.ply"
    assert run_cli(*command(world, out).split())[0] != 0
    assert not out.exists()
    for other in ("--voxel 0.7", "--height 1.5", "--columns x,y,z,intensity", "--keep-own"):
        refused(command(world, out, f"--resume {other}"), "another one")
    succeed(command(world, out, "--resume"))
    assert added == 4 + SCANS - 2
    assert out.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.ply", "whole.ply"]


def test_a_map_is_not_resumed_if_what_it_depends_on_changed(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    request = LabellingRequest(fresh_weights(), precision="float32")
    scans, _ = find_inputs([f"{tmp_path}/data"]).scans()
    drives = Drives(dict.fromkeys(scans, np.eye(4)))
    moved = Drives({**drives.poses, scans[3]: 2 * np.eye(4)})
    digests = [
        request.digest_of(scans, drives),
        request.digest_of(scans, moved),
        request.digest_of(scans, replace(drives, past_only=True)),
        request.digest_of(scans, None),
        request.digest_of(scans[1:], drives),
        replace(request, precision="bfloat16").digest_of(scans, drives),
        replace(request, engine="onnx").digest_of(scans, drives),
        replace(request, engine="int8").digest_of(scans, drives),
        replace(request, reading=Reading(Sensor(keep_own=True))).digest_of(scans, drives),
        replace(request, weights=fresh_weights(seed=1)).digest_of(scans, drives),
    ]
    status = scans[4].path.stat()
    os.utime(scans[4].path, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    digests.append(request.digest_of(scans, drives))
    scans[4].path.write_bytes(scans[4].path.read_bytes()[:-16])
    os.utime(scans[4].path, ns=(status.st_atime_ns, status.st_mtime_ns))
    digests.append(request.digest_of(scans, drives))
    assert len(set(digests)) == len(digests)
    assert request.digest_of(scans, drives) == digests[-1]


def test_a_map_is_refused_before_the_work_if_it_has_no_place_of_its_own(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive_module, "map_drive", lambda *_: pytest.fail("the work has begun"))
    out = tmp_path / "map.ply"
    refused(command(world, out, f"--json {tmp_path}/x/../map.ply"), "--json")
    long = f"{'m' * 252}.ply"
    refused(command(world, tmp_path / long), "255 bytes", "256")
    refused(command(world, out, f"--json {tmp_path}/{long}"), "255 bytes")
    with alone_in(tmp_path, f".{digest('map.ply')}.lock"):
        refused(command(world, out, "--overwrite"), "another run")
    assert not list(tmp_path.iterdir())


def test_a_map_may_have_the_longest_name(world: Path, tmp_path: Path) -> None:
    out = tmp_path / f"{'m' * 251}.ply"
    succeed(command(world, out))
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("content", [b"", b"PK", b"PK\x03\x04", {"done": 2}, {"request": "other"}])
def test_unreadable_maps_begin_anew(tmp_path: Path, content: bytes | dict[str, object]) -> None:
    path = tmp_path / ".map.ply.unfinished.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)  # type: ignore[arg-type]
    assert MapBuilder(SIZE, SEMANTICKITTI).restore(path, "a request") == 0


def test_a_map_is_of_one_drive(world: Path, tmp_path: Path) -> None:
    for sequence in ("01", "02"):
        write_drive(tmp_path / "data", sequence, 3)
    line = f"map {tmp_path}/data --weights {world}/w.safetensors --out {tmp_path}/map.ply"
    refused(line, "2 recordings")
    succeed(f"{line} --sequences 02")
