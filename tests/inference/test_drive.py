"""Drives: labels by the consensus of scans, with the commands and in Python."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.data.poses import Poses
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.drives.consensus import REACH
from amvnet.drives.odometry import Odometry, Pair, check_fit
from amvnet.errors import InputError
from amvnet.inference import drive as drive_module
from amvnet.inference.drive import Drives, find_poses
from amvnet.inference.listing import find_inputs
from amvnet.inference.pipeline import Pipeline
from amvnet.sensors.lidars import AXES
from amvnet.sensors.normalise import Normaliser
from amvnet.weights.file import save

from fixtures.bag_poses import drive_clouds, drive_odometry, odometry, pose_at, write_bag
from fixtures.commands import contents, fails, files, new_file, not_none, refused, run_cli, succeed
from fixtures.drives import HEIGHT, SCANS, drive_poses, drive_scans, write_drive
from fixtures.tiny import fresh_weights

POSES = drive_poses()
JUMPING = POSES.copy()
JUMPING[2:, 0, 3] += 5000


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    write_drive(root / "data")
    save(fresh_weights(), root / "w.safetensors")
    succeed(predict(root, root / "labels"))
    return root


def predict(world: Path, out: Path, options: str = "", data: Path | None = None) -> str:
    data = data or world / "data"
    return f"predict {data} --weights {world}/w.safetensors --drive --out {out} {options}"


def test_predict_writes_the_labels_of_python(world: Path) -> None:
    segmenter = amvnet.load(world / "w.safetensors")
    dataset = open_dataset(str(world / "data"))
    records = dataset.records(["00"])
    scans = (dataset.read(record) for record in records)
    alone = 0
    for record, result in zip(records, amvnet.drive(segmenter, scans, POSES), strict=True):
        written = dataset.read_prediction(record, world / "labels")
        np.testing.assert_array_equal(result.labels, written)
        np.testing.assert_allclose(result.scores.sum(axis=1), 1, atol=1e-5)
        alone += int(np.count_nonzero(segmenter(dataset.read(record)).labels != written))
    assert alone > 0, "the consensus changes labels"


def test_past_scans_alone_give_other_labels_at_once(world: Path) -> None:
    segmenter = amvnet.load(world / "w.safetensors")
    read: list[int] = []

    def scans() -> Iterator[np.ndarray]:
        for index, (points, _) in enumerate(drive_scans()):
            read.append(index)
            yield points

    for index, _ in enumerate(amvnet.drive(segmenter, scans(), POSES, past_only=True)):
        assert len(read) == index + 1


def test_lost_returns_of_a_drive_get_no_label_and_move_no_pose(world: Path) -> None:
    segmenter = amvnet.load(world / "w.safetensors")
    scans = [points for points, _ in drive_scans(3)]
    for points in scans:
        points[::9, :3] = np.nan
        points[1::9, :3] = 0
    for poses in (POSES[:3], None):
        if poses is None:
            pytest.importorskip("kiss_icp")
        for points, result in zip(scans, amvnet.drive(segmenter, scans, poses), strict=True):
            valid = np.isfinite(points[:, 0]) & (points[:, 0] != 0)
            np.testing.assert_array_equal(result.labels > 0, valid)


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (POSES[:2], ["for each scan", "found 2"]),
        (0 * POSES, ["no rotation"]),
        (np.ones(16), ["(4, 4)", "shape ()"]),
        (np.eye(3), ["(4, 4)", "shape (3,)"]),
        ("poses.txt", ["(4, 4)", "'p'"]),
        (Path("poses.txt"), ["(4, 4)", "poses.txt"]),
        (JUMPING, ["m between the scans 1 and 2"]),
    ],
)
def test_too_few_or_absurd_poses_are_one_line(world: Path, poses: Any, words: list[str]) -> None:
    segmenter = amvnet.load(world / "w.safetensors")
    scans = [points for points, _ in drive_scans(3)]
    fails(lambda: list(amvnet.drive(segmenter, scans, poses)), "poses", *words)


def test_networks_see_the_scans_in_reach_from_angles_of_their_own() -> None:
    drives = []
    for recording in (Recording("a"), Recording("b")):
        path = Path(recording.name)
        drives.append([ScanFile(str(index), recording, path) for index in range(2 * REACH + 1)])
    yaws = Drives(dict.fromkeys([*drives[0], *drives[1]], np.eye(4))).yaws
    of_one, of_other = ([yaws[scan] for scan in scans] for scans in drives)
    assert of_one == of_other
    angles = np.sort(np.mod(of_one, 2 * np.pi))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).min() > np.pi / (2 * REACH + 1)


@pytest.mark.parametrize("seconds", [100.05, 1_700_000_000.25])
def test_names_in_nanoseconds_are_times(world: Path, tmp_path: Path, seconds: float) -> None:
    """The poses lie between the scans."""
    track = []
    for index in range(-1, 12):
        pose = POSES[max(index, 0)]
        track.append([seconds + index, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()])
    np.savetxt(tmp_path / "tum.txt", track)
    for factor, digits in ((1, 6), (10**9, 0)):
        folder = tmp_path / f"{factor}"
        folder.mkdir()
        for index, (points, _) in enumerate(drive_scans(5)):
            stamp = f"{seconds + index:.6f}" if digits else str(round((seconds + index) * 10**9))
            points.tofile(folder / f"{stamp}.bin")
        scans, _ = find_inputs([str(folder)]).scans()
        if seconds < 1e6 and not digits:
            continue  # as seconds since 1970
        found = find_poses(scans, tmp_path / "tum.txt")
        np.testing.assert_allclose(list(found.poses.values()), POSES[:5], atol=1e-6)


def test_an_interrupted_run_resumes_to_the_same_labels(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Pipeline.write
    written: list[object] = []

    def write_twelve(self: Pipeline, *arguments: Any) -> Any:
        if len(written) == 12:
            raise RuntimeError("the power is gone")
        written.append(arguments)
        return write(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Pipeline, "write", write_twelve)
        with pytest.raises(RuntimeError, match="power"):
            run_cli(*predict(world, tmp_path).split())
    assert len(files(tmp_path) - {".unfinished.jsonl"}) == 12

    succeed(predict(world, tmp_path, "--resume"))
    assert contents(tmp_path) == contents(world / "labels")


def test_scans_of_two_drives_are_fused_each_with_its_own(world: Path, tmp_path: Path) -> None:
    words = []
    for drive in ("a", "b"):
        (tmp_path / drive).mkdir()
        for index, (points, _) in enumerate(drive_scans(6)):
            points.tofile(tmp_path / f"{drive}/{drive}{index}.bin")
        words.append([f"{tmp_path}/{drive}/{drive}{index}.bin" for index in range(6)])
    options = f"--weights {world}/w.safetensors --drive --height {HEIGHT}"
    one_by_one = [path for pair in zip(*words, strict=True) for path in pair]
    succeed(f"predict {' '.join(one_by_one)} --out {tmp_path}/one_by_one {options}")
    succeed(f"predict {tmp_path}/a {tmp_path}/b --out {tmp_path}/apart {options}")
    assert contents(tmp_path / "one_by_one") == contents(tmp_path / "apart")


def test_a_changed_scan_is_labelled_again_with_its_reach(world: Path, tmp_path: Path) -> None:
    write_drive(tmp_path / "data")
    data = tmp_path / "data"
    succeed(predict(world, tmp_path / "resumed", data=data))
    path = tmp_path / "data/sequences/00/velodyne/000012.bin"  # none of those that are measured
    before = contents(tmp_path / "resumed")
    path.write_bytes(path.read_bytes()[: 16 * 1500])
    succeed(predict(world, tmp_path / "resumed", "--resume", data))
    succeed(predict(world, tmp_path / "new", data=data))
    assert contents(tmp_path / "resumed") == contents(tmp_path / "new")
    changed = dict(contents(tmp_path / "new").items() - before.items())
    assert 1 < len(changed) <= REACH + 1 + REACH


def test_a_drive_with_a_broken_scan_resumes_to_the_same_labels(world: Path, tmp_path: Path) -> None:
    write_drive(tmp_path / "data")
    broken = tmp_path / "data/sequences/00/velodyne/000010.bin"
    broken.write_bytes(broken.read_bytes()[:-3])
    out = tmp_path / "out"
    command = predict(world, out, data=tmp_path / "data")
    assert run_cli(*command.split())[0] == 3
    whole = contents(out)
    (out / "sequences/00/predictions/000014.label").unlink()
    assert run_cli(*command.split(), "--resume")[0] == 3
    assert contents(out) == whole


@pytest.mark.full
def test_other_poses_or_past_scans_alone_resume_no_run(world: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "poses.npy", POSES)
    out = tmp_path / "out"
    succeed(predict(world, out, f"--poses {tmp_path}/poses.npy"))
    refused(predict(world, out, f"--resume --past-only --poses {tmp_path}/poses.npy"), "drive")
    np.save(tmp_path / "poses.npy", np.linalg.inv(POSES[2]) @ POSES)
    refused(predict(world, out, f"--resume --poses {tmp_path}/poses.npy"), "drive")
    refused(f"predict {world}/data --weights {world}/w.safetensors --out {out} --resume", "drive")


def of_camera(poses: Poses) -> Poses:
    turn = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return turn @ poses @ np.linalg.inv(turn)


def changed(part: Any, values: Any) -> Poses:
    poses = POSES.copy()
    poses[part] = values
    return poses


PLACES = np.s_[:, :3, 3]
IN_CENTIMETRES = changed(PLACES, 100 * POSES[PLACES])
DO_NOT_FIT = {
    "of the camera": of_camera(POSES),
    "in centimetres": IN_CENTIMETRES,
    "a quarter longer": changed(PLACES, 1.25 * POSES[PLACES]),
    "backwards": POSES[::-1],
    "fewer": POSES[1:],
    "lost": changed(np.s_[3:], np.nan),
    "first without a fix": changed(np.s_[1:, :2, 3], POSES[1:, :2, 3] + (690_000, 5_335_000)),
    "one off": changed(np.s_[7, 0, 3], POSES[7, 0, 3] + 20),
}


@pytest.mark.parametrize("kind", DO_NOT_FIT)
def test_poses_that_do_not_fit_are_one_line_and_nothing_is_written(
    world: Path, tmp_path: Path, kind: str
) -> None:
    np.save(tmp_path / "poses.npy", DO_NOT_FIT[kind])
    refused(predict(world, tmp_path / "out", f"--poses {tmp_path}/poses.npy"), "poses.npy")
    assert not (tmp_path / "out").exists()


def turned(poses: Poses) -> Poses:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 4, degrees=True).as_matrix()
    return poses @ turn


LESS_EXACT = {
    "turned": turned(POSES),
    "in whole metres": changed(PLACES, np.round(POSES[PLACES])),
    "without rotations": changed(np.s_[:, :3, :3], np.eye(3)),
}


@pytest.mark.parametrize("kind", LESS_EXACT)
def test_poses_that_are_less_exact_than_the_scans_do_not_pass_in_silence(
    world: Path, tmp_path: Path, kind: str
) -> None:
    scans, _ = find_inputs([f"{world}/data"]).scans()
    lines: list[str] = []
    np.save(tmp_path / "poses.npy", POSES)
    find_poses(scans, tmp_path / "poses.npy", report=lines.append)
    assert len(lines) == 1
    np.save(tmp_path / "poses.npy", LESS_EXACT[kind])
    try:
        find_poses(scans, tmp_path / "poses.npy", report=lines.append)
    except InputError as error:
        lines.append(str(error))
    assert "apart" in lines[-1]


def test_poses_that_were_turned_by_a_calibration_say_so(world: Path, tmp_path: Path) -> None:
    """A refusal names the calibration that is missing, or that does not belong to the poses."""
    shutil.copytree(world / "data/sequences/00/velodyne", tmp_path / "scans")
    scans, _ = find_inputs([f"{tmp_path}/scans"]).scans()
    of_lidar = tmp_path / "poses.txt"
    np.savetxt(of_lidar, POSES[:, :3].reshape(-1, 12))
    lines: list[str] = []
    find_poses(scans, of_lidar, report=lines.append)
    assert lines[-1].endswith("by the file, as the LiDAR's, without calib.txt beside it")

    kitti = Path(shutil.copy(world / "data/sequences/00/poses.txt", tmp_path / "00.txt"))
    fails(lambda: find_poses(scans, kitti), "00.txt", "without calib.txt", "apart")
    shutil.copy(world / "data/sequences/00/calib.txt", tmp_path)
    find_poses(scans, kitti, report=lines.append)
    assert lines[-1].endswith("by the file, turned from the camera by calib.txt beside it")
    fails(lambda: find_poses(scans, of_lidar), "poses.txt", "turned from the camera", "apart")


def test_poses_are_not_estimated_twice(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_module, "_estimated", lambda *_: IN_CENTIMETRES)
    scans, _ = find_inputs([f"{world}/data"]).scans()
    monkeypatch.setattr(type(scans[0].dataset), "poses", lambda *_: None)
    fails(lambda: find_poses(scans), "KISS-ICP", "give poses, or scans that follow")
    monkeypatch.setattr(type(scans[0].dataset), "poses", lambda *_: IN_CENTIMETRES)
    fails(lambda: find_poses(scans), "the dataset", "correct them")


def test_poses_of_own_scans_move_the_points_of_files(world: Path, tmp_path: Path) -> None:
    turn = np.array(AXES["y-forward"], float)
    to_file = np.eye(4)
    to_file[:3] = np.column_stack((turn.T, (0.5, -0.3, 0.2)))  # axes and place of the file
    for index, (points, _) in enumerate(drive_scans()):
        (tmp_path / "robot").mkdir(exist_ok=True)
        xyz = points[:, :3] @ turn + to_file[:3, 3]
        np.save(tmp_path / f"robot/{index:04d}.npy", np.column_stack((xyz, points[:, 3])))
    offset = ", ".join(map(str, -turn @ to_file[:3, 3]))
    lines = [
        "classes: {road: 1}",
        "scans: robot/*.npy",
        "poses: ../poses.txt",
        f"sensor: {{axes: y-forward, offset: [{offset}]}}",
    ]
    (tmp_path / "own.yaml").write_text("\n".join(lines))
    command = f"predict {tmp_path}/own.yaml --weights {world}/w.safetensors --drive"
    refused(f"{command} --out {tmp_path}/none", "poses.txt")

    kitti = (POSES @ np.linalg.inv(to_file))[:, :3].reshape(-1, 12)
    np.savetxt(tmp_path / "poses.txt", kitti)
    report: list[str] = []
    normaliser = Normaliser(fresh_weights().expects)
    scans, _ = find_inputs([f"{tmp_path}/own.yaml"]).scans(normaliser=normaliser)
    drives = find_poses(scans, report=report.append)
    assert report == ["robot: a drive of 24 scans, 23 m by the dataset"]
    for scan, pose, (points, _) in zip(scans, POSES, drive_scans(), strict=True):
        loaded = scan.load()
        into_world = drives.motion(scan, loaded)
        found = loaded.points[:, :3] @ into_world[:3, :3].T + into_world[:3, 3]
        np.testing.assert_allclose(found, points[:, :3] @ pose[:3, :3].T + pose[:3, 3], atol=1e-3)

    part = not_none(scans[5].dataset.poses(scans[5:7]))
    np.testing.assert_allclose(part[:, :3].reshape(-1, 12), kitti[5:7], atol=1e-12)


def test_poses_of_a_standing_car_fit() -> None:
    points = drive_scans(2)[0][0][:, :3]
    check_fit([Pair(points, points + 0.01, np.eye(4))], "poses", "advice")
    moved = np.eye(4)
    moved[0, 3] = 3
    pair = Pair(points, points + 0.01, moved)
    fails(lambda: check_fit([pair], "poses", "advice"), "poses", "apart", "advice")


def test_a_drive_needs_scans_of_one_recording_in_a_row(world: Path, tmp_path: Path) -> None:
    scan = world / "data/sequences/00/velodyne/000000.bin"
    command = f"predict {scan} --weights {world}/w.safetensors --out {tmp_path}/out"
    refused(f"{command} --drive", "single scan")
    refused(f"{command} --poses {scan}", "--drive")
    refused(f"{command} --past-only", "--drive")

    write_drive(tmp_path / "data", "01", 3)
    write_drive(tmp_path / "data", "02", 3)
    np.save(tmp_path / "poses.npy", POSES)
    options = f"--poses {tmp_path}/poses.npy"
    refused(predict(world, tmp_path / "out", options, tmp_path / "data"), "2 recordings")


@pytest.mark.full
def test_a_broken_scan_is_left_out_of_its_drive(world: Path, tmp_path: Path) -> None:
    write_drive(tmp_path / "data")
    broken = ("000003.bin", f"{SCANS - 1:06d}.bin")
    for name in broken:
        path = tmp_path / "data/sequences/00/velodyne" / name
        path.write_bytes(path.read_bytes()[:-3])
    code, error = run_cli(*predict(world, tmp_path / "out", data=tmp_path / "data").split())
    assert code == 3
    assert all(name in error for name in broken)
    assert len(files(tmp_path / "out")) == SCANS - len(broken)


def test_evaluate_scores_the_labels_that_predict_writes(world: Path, tmp_path: Path) -> None:
    figures = {}
    data = f"{world}/data --split all"
    for name, source in (
        ("drive", f"--weights {world}/w.safetensors --drive"),
        ("predictions", f"--predictions {world}/labels"),
    ):
        succeed(f"evaluate {data} {source} --json {tmp_path}/{name}.json")
        figures[name] = json.loads((tmp_path / f"{name}.json").read_text())["methods"][name]
    assert figures["drive"] == figures["predictions"]
    refused(f"evaluate {data} --predictions {world}/labels --drive", "--weights")


def test_evaluate_fuses_scans_in_other_axes_as_predict_does(world: Path, tmp_path: Path) -> None:
    for folder in ("scans", "labels"):
        (tmp_path / folder).mkdir()
    for index, (points, raw) in enumerate(drive_scans()):
        right_forward = np.column_stack((-points[:, 1], points[:, 0], points[:, 2:]))
        np.save(tmp_path / f"scans/{index:04d}.npy", right_forward)
        raw.astype(np.uint32).tofile(tmp_path / f"labels/{index:04d}.label")
    turn = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "poses.txt", (POSES @ turn)[:, :3].reshape(-1, 12))
    ids = dict(zip(SEMANTICKITTI.classes, SEMANTICKITTI.train_to_raw[1:], strict=True))
    lines = [
        f"classes: {json.dumps(ids)}",
        "scans: scans/*.npy",
        "labels: ../labels/{name}.label",
        "poses: ../poses.txt",
        "sensor: {axes: y-forward}",
    ]
    data = new_file(tmp_path / "own.yaml", "\n".join(lines))

    succeed(predict(world, tmp_path / "out", data=data))
    figures = {}
    for name, source in (
        ("drive", f"--weights {world}/w.safetensors --drive"),
        ("predictions", f"--predictions {tmp_path}/out"),
    ):
        succeed(f"evaluate {data} --split all {source} --json {tmp_path}/{name}.json")
        figures[name] = json.loads((tmp_path / f"{name}.json").read_text())["methods"][name]
    assert figures["drive"] == figures["predictions"]


# ---- poses of a bag

BAG_SCANS = 12


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    messages = [*drive_odometry(BAG_SCANS), *drive_clouds(BAG_SCANS)]
    return write_bag(tmp_path_factory.mktemp("bag") / "drive", messages)


def command_on(bag: Path, world: Path, out: Path, poses: object) -> str:
    words = f"--weights {world}/w.safetensors --out {out} --height {HEIGHT} --axes x-forward"
    return f"predict {bag} {words} --drive --poses {poses}"


def test_odometry_of_a_bag_equals_a_file_of_poses(world: Path, bag: Path, tmp_path: Path) -> None:
    lines = []
    for sent in drive_odometry(BAG_SCANS):
        pose = pose_at(sent.time)
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append([round(sent.time, 9), *pose[:3, 3], *quaternion])
    np.savetxt(tmp_path / "tum.txt", lines)

    folders = []
    for poses in ("/odom", tmp_path / "tum.txt"):
        folders.append(tmp_path / Path(poses).stem)
        succeed(command_on(bag, world, folders[-1], poses))
    assert contents(folders[0]) == contents(folders[1])
    assert len(files(folders[0])) == BAG_SCANS


def test_a_topic_that_does_not_fit_leaves_one_line(world: Path, bag: Path, tmp_path: Path) -> None:
    refused(command_on(bag, world, tmp_path / "out", "/odometry"), "/odom (nav_msgs/msg/Odometry)")
    standing = [odometry(sent.time, np.eye(4)) for sent in drive_odometry(BAG_SCANS)]
    other = write_bag(tmp_path / "standing", [*standing, *drive_clouds(BAG_SCANS)])
    refused(command_on(other, world, tmp_path / "out", "/odom"), "standing", "apart")
    assert not (tmp_path / "out").exists()


def test_where_poses_of_a_bag_are_estimated_a_line_names_its_odometry(bag: Path) -> None:
    pytest.importorskip("kiss_icp")
    lines: list[str] = []
    scans, _ = find_inputs([str(bag)]).scans()
    find_poses(scans, report=lines.append)
    assert lines[0].endswith("; --poses /odom takes those of the bag")
    assert "by KISS-ICP" in lines[1]
    find_poses(scans, Path("/odom"), report=lines.append)
    assert lines[2:] == [f"{bag}: a drive of {BAG_SCANS} scans, 11 m by /odom"]


# ---- estimated poses


def test_poses_are_estimated(world: Path, tmp_path: Path) -> None:
    pytest.importorskip("kiss_icp")
    odometry = Odometry()
    poses = np.array([odometry(points[:, :3]) for points, _ in drive_scans(count=20_000)])
    np.testing.assert_allclose(poses[:, :3, 3], POSES[:, :3, 3], atol=0.15)


class ByTable:
    """Gives scans in order the poses that they have."""

    def __init__(self) -> None:
        self._poses = iter(POSES)

    def __call__(self, xyz: np.ndarray) -> Poses:
        return next(self._poses)


def test_the_estimation_of_poses_counts_its_scans(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(drive_module, "Odometry", ByTable)
    for sequence in ("00", "01"):
        write_drive(tmp_path / "data", sequence)
        (tmp_path / f"data/sequences/{sequence}/poses.txt").unlink()
    counts: list[tuple[int, int]] = []
    scans, _ = find_inputs([f"{tmp_path}/data"]).scans()
    find_poses(scans, progress=lambda done, total: counts.append((done, total)))
    assert sorted(set(counts)) == [(done, 2 * SCANS) for done in range(2 * SCANS + 1)]
    assert counts == sorted(counts)

    monkeypatch.setattr(amvnet.progress, "QUIET_SECONDS", 0)
    capsys.readouterr()
    options = f"--weights {world}/w.safetensors --sequences 00 --drive"
    succeed(f"predict {tmp_path}/data {options} --out {tmp_path}/out")
    assert f"poses: {SCANS // 2} of {SCANS}" in capsys.readouterr().out
    succeed(f"evaluate {tmp_path}/data {options}")
    assert f"poses: {SCANS // 2} of {SCANS}" in capsys.readouterr().out


def test_without_poses_and_kiss_icp_one_line_says_what_to_do(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    write_drive(tmp_path / "data")
    (tmp_path / "data/sequences/00/poses.txt").unlink()
    command = predict(world, tmp_path / "out", data=tmp_path / "data")
    refused(command, 'pip install "amvnet[drives]"')
    assert not (tmp_path / "out").exists()
