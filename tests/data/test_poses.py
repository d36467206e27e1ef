"""Poses from files: KITTI's, TUM's and NumPy's format, and what is wrong with others."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amvnet.data.datasets.open import open_dataset
from amvnet.data.poses import read_poses, times_of

from fixtures.commands import fails, new_file, not_none
from fixtures.drives import TO_CAMERA, drive_poses, write_drive
from fixtures.tiny import GOLDEN

# They rise and are tilted, so that no axis is like another and no two motions commute.
WORLD = np.eye(4)
WORLD[:3, :3] = Rotation.from_euler("xyz", [20, -30, 70], degrees=True).as_matrix()
WORLD[:3, 3] = (3, -2, 5)
POSES = WORLD @ drive_poses()


def write_tum(path: Path, poses: np.ndarray = POSES, first: float = 100.0) -> Path:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    times = first + 0.1 * np.arange(len(poses))
    np.savetxt(path, np.column_stack([times, poses[:, :3, 3], quaternions]), header="time x y z")
    return path


def write_kitti(path: Path, poses: np.ndarray = POSES) -> Path:
    np.savetxt(path, poses[:, :3].reshape(-1, 12))
    return path


def write_numpy(path: Path, poses: np.ndarray = POSES) -> Path:
    np.save(path.with_suffix(".npy"), poses)
    return path.with_suffix(".npy")


def write_rows(path: Path, poses: np.ndarray = POSES) -> Path:
    return write_numpy(path, poses[:, :3])


@pytest.mark.parametrize("write", [write_kitti, write_tum, write_numpy, write_rows])
def test_every_format_gives_the_same_poses(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path / "poses.txt")
    np.testing.assert_allclose(read_poses(path).at(None, len(POSES)), POSES, atol=1e-9)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace(" ", ","),
        lambda text: text.replace(" ", ", "),
        lambda text: "time, x, y, z, qx, qy, qz, qw\n" + text,
    ],
)
def test_a_bom_commas_and_names_change_nothing(tmp_path: Path, spoil: Callable[[str], str]) -> None:
    path = write_tum(tmp_path / "tum.txt")
    path.write_text(spoil("\n".join(path.read_text().splitlines()[1:])), encoding="utf-8")
    np.testing.assert_allclose(read_poses(path).poses, POSES, atol=1e-9)


@pytest.mark.parametrize("name", ["poses.npz", "poses.npy"])
def test_an_archive_of_one_array_is_that_array(tmp_path: Path, name: str) -> None:
    np.savez(tmp_path / "any.npz", poses=POSES)
    path = (tmp_path / "any.npz").rename(tmp_path / name)
    np.testing.assert_array_equal(read_poses(path).poses, POSES)
    np.savez(tmp_path / "any.npz", poses=POSES, times=POSES)
    (tmp_path / "any.npz").rename(path)
    fails(lambda: read_poses(path), name, "times")


def test_a_header_of_more_poses_than_the_file_holds_is_one_line(tmp_path: Path) -> None:
    path = write_numpy(tmp_path / "poses")
    content = path.read_bytes()
    path.write_bytes(content.replace(b"(24, 4, 4), }" + b" " * 9, b"(10000000000, 4, 4), }"))
    assert path.read_bytes() != content
    fails(lambda: read_poses(path), "poses.npy", "10000000000")


@pytest.mark.parametrize("name", ["foo", "-1", "24", "1.5", "+3"])
def test_a_scan_whose_name_is_no_number_of_a_pose_is_one_line(tmp_path: Path, name: str) -> None:
    dataset = open_dataset(str(write_drive(tmp_path)))
    folder = tmp_path / "sequences/00"
    for kind, ending in (("velodyne", "bin"), ("labels", "label")):
        shutil.copy(folder / kind / f"000000.{ending}", folder / kind / f"{name}.{ending}")
    records = dataset.records(["00"])
    fails(lambda: dataset.poses(records), "poses.txt", f"the scan {name}", "24 poses")


def test_a_calibration_turns_no_other_format(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(f"Tr: {' '.join(map(str, TO_CAMERA[:3].ravel()))}\n")
    path = write_numpy(tmp_path / "poses")
    np.testing.assert_allclose(read_poses(path).at(None, len(POSES)), POSES, atol=1e-9)


def test_poses_of_the_camera_become_poses_of_the_lidar(tmp_path: Path) -> None:
    dataset = open_dataset(str(write_drive(tmp_path)))
    records = dataset.records(["00"])
    np.testing.assert_allclose(not_none(dataset.poses(records)), drive_poses(), atol=1e-9)
    file = tmp_path / "sequences/00/poses.txt"
    assert "turned from the camera by calib.txt" in read_poses(file).note
    (tmp_path / "sequences/00/calib.txt").rename(tmp_path / "calib.txt")
    assert "as the LiDAR's, without calib.txt" in read_poses(file).note
    (tmp_path / "calib.txt").rename(tmp_path / "sequences/00/calib.txt")

    # The number of a scan is the line of its pose.
    np.testing.assert_allclose(not_none(dataset.poses(records[3:5])), drive_poses()[3:5], atol=1e-9)


def test_a_dataset_without_poses_has_none(tmp_path: Path) -> None:
    dataset = open_dataset(str(write_drive(tmp_path)))
    (tmp_path / "sequences/00/poses.txt").unlink()
    assert dataset.poses(dataset.records(["00"])) is None


def test_poses_of_nuscenes_are_those_of_the_car_and_of_its_sensor() -> None:
    """The reference turns a point by each quaternion, which the tables round."""
    dataset = open_dataset(str(GOLDEN / "nuscenes"))
    records = dataset.records(dataset.sequences("all"))
    poses = not_none(dataset.poses(records))
    tables = {}
    for name in ("sample_data", "ego_pose", "calibrated_sensor"):
        rows = json.loads((GOLDEN / f"nuscenes/v1.0-mini/{name}.json").read_text())
        tables[name] = {row["token"]: row for row in rows}

    point = np.array([3.0, -2.0, 0.5])
    for record, pose in zip(records, poses, strict=True):
        row = tables["sample_data"][record.name]
        moved = point
        for table in ("calibrated_sensor", "ego_pose"):
            motion = tables[table][row[f"{table}_token"]]
            w, *vector = motion["rotation"]
            axis = np.array(vector)
            turned = moved + 2 * np.cross(axis, np.cross(axis, moved) + w * moved)
            moved = turned + motion["translation"]
        np.testing.assert_allclose(pose[:3, :3] @ point + pose[:3, 3], moved, atol=1e-3)


@pytest.mark.parametrize("table", ["ego_pose", "calibrated_sensor"])
@pytest.mark.parametrize(("key", "value"), [("token", "no such"), ("rotation", ["a"] * 4)])
def test_wrong_pose_tables_are_one_line(tmp_path: Path, table: str, key: str, value: Any) -> None:
    root = shutil.copytree(GOLDEN / "nuscenes", tmp_path / "nuscenes")
    path = root / f"v1.0-mini/{table}.json"
    rows = json.loads(path.read_text())
    dataset = open_dataset(str(root))
    records = dataset.records(dataset.sequences("all"))
    wrong: list[list[Any]] = [[row | {key: value} for row in rows], [{}], []]
    for table_rows in wrong:
        path.write_text(json.dumps(table_rows))
        fails(lambda: dataset.poses(records), root, "expected the tables")


def test_poses_are_interpolated_at_the_times_of_the_scans(tmp_path: Path) -> None:
    halfway = read_poses(write_tum(tmp_path / "tum.txt")).at([100.05, 100.35], 2)
    for pose, before in zip(halfway, (0, 3), strict=True):
        middle = (POSES[before, :3, 3] + POSES[before + 1, :3, 3]) / 2
        np.testing.assert_allclose(pose[:3, 3], middle, atol=1e-9)
        turn = Rotation.from_matrix(POSES[before, :3, :3].T @ pose[:3, :3])
        np.testing.assert_allclose(turn.as_rotvec(), [0, 0, 0.03 / 2], atol=1e-9)


def test_before_the_first_pose_and_after_the_last_the_motion_goes_on(tmp_path: Path) -> None:
    """The drive turns steadily, so that its motion goes on exactly."""
    file = read_poses(write_tum(tmp_path / "tum.txt", POSES[4:-4], first=100.4))
    np.testing.assert_allclose(file.at([100.0, 102.3], 2), POSES[[0, -1]], atol=1e-9)
    fails(lambda: file.at([99.8, 102.3], 2), "99.80 to 102.30", "100.40 to 101.90")


def test_a_single_pose_is_no_drive(tmp_path: Path) -> None:
    file = read_poses(write_tum(tmp_path / "tum.txt", POSES[:1]))
    fails(lambda: file.at([100.0, 100.0], 2), "tum.txt", "100.00 to 100.00")


def test_times_that_do_not_overlap_are_one_line(tmp_path: Path) -> None:
    file = read_poses(write_tum(tmp_path / "tum.txt"))
    words = ("tum.txt", "5.00 to 5.10", "100.00 to 102.30", "by the same clock")
    fails(lambda: file.at([5.0, 5.1], 2), *words)


@pytest.mark.parametrize("scans", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("poses", ["s", "ms", "us", "ns"])
def test_times_in_other_units_are_called_so(tmp_path: Path, scans: str, poses: str) -> None:
    powers = {"s": 0, "ms": 3, "us": 6, "ns": 9}
    first = 1_700_000_000
    file = read_poses(write_tum(tmp_path / "tum.txt", first=first))
    assert file.times is not None
    file = replace(file, times=file.times * 10 ** powers[poses])
    times = times_of([str((first + second) * 10 ** powers[scans]) for second in (1, 2)])
    if (poses, scans) in (("s", "s"), ("s", "ns"), ("ms", "ms")):
        assert len(file.at(times, 2)) == 2
    else:
        fails(lambda: file.at(times, 2), "tum.txt", "unit", "in seconds")


@pytest.mark.parametrize("write", [write_kitti, write_tum])
def test_fewer_poses_than_scans_are_one_line(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    file = read_poses(write(tmp_path / "poses.txt"))
    fails(lambda: file.at(None, 30), "poses.txt", "30 scans", "24 poses")


@pytest.mark.parametrize(
    ("index", "factor", "word"),
    [
        (np.s_[2, 0, 3], np.nan, "no number"),
        (np.s_[2, 1, 3], 1e9, "more than 1e+08 m"),
        (np.s_[:, :3, :3], 1.1, "no rotation"),
        (np.s_[:, :, 1], -1, "no rotation"),  # mirrored
    ],
)
def test_no_rigid_motion_is_one_line(tmp_path: Path, index: Any, factor: float, word: str) -> None:
    poses = POSES.copy()
    poses[index] *= factor
    path = write_kitti(tmp_path / "poses.txt", poses)
    fails(lambda: read_poses(path), "poses.txt", word)


def test_no_poses_are_one_line(tmp_path: Path) -> None:
    path = write_numpy(tmp_path / "poses", POSES[:0])
    fails(lambda: read_poses(path), "poses.npy", "found none")


def test_equal_times_are_one_line(tmp_path: Path) -> None:
    path = new_file(tmp_path / "tum.txt", "1 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    fails(lambda: read_poses(path), "ascending times", "1 s twice", "pose 1", "remove one")
    path.write_text("1 0 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n")
    fails(lambda: read_poses(path), "0 s late", "sort them")


def test_angles_in_place_of_quaternions_are_one_line(tmp_path: Path) -> None:
    path = new_file(tmp_path / "tum.txt", "0 1 2 3 0 0 90 0\n1 1 2 3 0 0 91 0\n")
    fails(lambda: read_poses(path), "quaternions", "0 0 90 0")


@pytest.mark.parametrize(
    "content", [b"", b"1 2 3\n", b"x y z\n", b"\x93NUMPY", bytes(100), b"1 " * 12 + b"\n1\n"]
)
@pytest.mark.parametrize("name", ["poses.txt", "poses.npy"])
def test_another_file_is_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    path = new_file(tmp_path / name, content)
    fails(lambda: read_poses(path), name, "expected")


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    fails(lambda: read_poses(tmp_path / "none.txt"), "none.txt", "No such file")


def test_pickled_poses_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    fails(lambda: read_poses(path), "poses.npy")


@pytest.mark.parametrize("line", ["P0: 1 0 0", "Tr: 1 2", f"Tr: {'0 ' * 12}"])
def test_a_calibration_without_a_motion_is_one_line(tmp_path: Path, line: str) -> None:
    write_kitti(tmp_path / "poses.txt", TO_CAMERA @ POSES @ np.linalg.inv(TO_CAMERA))
    (tmp_path / "calib.txt").write_text(f"{line}\n")
    fails(lambda: read_poses(tmp_path / "poses.txt"), "calib.txt", "Tr")
