"""Read the poses of a drive from a file: KITTI's, TUM's or NumPy's format; interpolate poses."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from amvnet.data.formats.numpy_files import member_names, read_array
from amvnet.errors import InputError, readable, shown

KITTI_COLUMNS = 12  # the upper three rows of a 4 x 4 matrix
TUM_COLUMNS = 8  # time x y z qx qy qz qw
UNITS = (1e3, 1e6, 1e9, 1e12, 1e-3, 1e-6, 1e-9)  # ratios of two units of time that are not the same
CALIBRATION = "calib.txt"  # KITTI's file next to its poses; its `Tr` moves points into camera 0
FARTHEST = 1e8  # largest coordinate of a pose, metres: more than the radius of the Earth
EDGE = 0.5  # seconds before the first pose and after the last one in which the motion goes on
TOLERANCE = 0.01  # largest error of a rotation matrix or of the length of a quaternion
EXPECTED = (
    "poses: lines of 12 numbers (KITTI), lines of time x y z qx qy qz qw (TUM), or .npy of shape "
    "(N, 4, 4)"
)

Poses = NDArray[np.float64]  # (N, 4, 4); each moves points of the sensor into the world


@dataclass(frozen=True)
class Trajectory:
    """The poses of a file or of a topic.

    Attributes:
        poses: (N, 4, 4) float64, each moves points of the sensor into the world.
        times: (N,) seconds, ascending, or None if the file has none.
        note: how poses in KITTI's format were taken: as the camera's or as the LiDAR's.
    """

    name: str
    poses: Poses
    times: NDArray[np.float64] | None = None
    note: str = ""

    def numbered(self, names: Sequence[str]) -> Poses:
        """Return the poses (M, 4, 4) of scans whose names are the numbers of their poses, from 0.

        Raises:
            InputError: if there is no pose of this number.
        """
        count = len(self.poses)
        for name in names:
            if not name.isdecimal() or int(name) >= count:
                raise InputError(
                    f"{self.name}: expected a pose for each scan, found {count} poses and the scan "
                    f"{name}; give the poses of this sequence, or name scans by their numbers"
                )
        return self.poses[list(map(int, names))]

    def at(self, times: Sequence[float] | None, count: int) -> Poses:
        """Return the poses (count, 4, 4) of some scans.

        A file with as many poses as scans has them in the order of the scans. Otherwise the times
        decide (`interpolate`).

        Args:
            times: the time of each scan, seconds, or None if the times are unknown.

        Raises:
            InputError: if the file does not have a pose for each scan.
        """
        if count == len(self.poses):
            return self.poses
        if self.times is None or times is None:
            of = "" if self.times is None else ", or scans whose names are their times in seconds"
            raise InputError(
                f"{self.name}: expected a pose for each of {count} scans{of}, found "
                f"{len(self.poses)} poses; give the poses of these scans in their order"
            )
        return self.interpolate(times)

    def interpolate(self, times: Sequence[float] | NDArray[np.float64]) -> Poses:
        """Return the poses (M, 4, 4) at some times in seconds, between the two nearest poses.

        Recordings seldom begin and end with a pose: up to `EDGE` seconds before the first pose and
        after the last one, the sensor moves as it does there.

        Raises:
            InputError: if the poses belong to other times.
        """
        assert self.times is not None
        first, last = self.times[0], self.times[-1]
        scan_times = np.asarray(times, np.float64)
        edge = min(EDGE, last - first)  # 0 for a single pose
        is_inside = first - edge <= scan_times.min() and scan_times.max() <= last + edge
        if not edge or not is_inside:
            start, end = scan_times.min(), scan_times.max()
            advice = "give the poses of this drive, by the same clock"
            for ratio in UNITS:
                if start * ratio <= last and first <= end * ratio:
                    advice = f"in a unit {ratio:g} of the scans'; give both in seconds"
            raise InputError(
                f"{self.name}: expected times that include the scans' ({start:.2f} to {end:.2f} "
                f"s), found {first:.2f} to {last:.2f} s; {advice}"
            )

        # The motion from the end to a time after it is the motion to the end, as long before it.
        end = np.clip(scan_times, first, last)
        poses = self._within((2 * end - scan_times).clip(first, last))
        is_outside = scan_times != end
        at_end = self._within(end[is_outside])
        poses[is_outside] = at_end @ np.linalg.inv(poses[is_outside]) @ at_end
        return poses

    def _within(self, times: NDArray[np.float64]) -> Poses:
        """Return the poses (M, 4, 4) at times from the first pose to the last one."""
        from scipy.spatial.transform import Rotation, Slerp

        assert self.times is not None
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        rotations = Slerp(self.times, Rotation.from_matrix(self.poses[:, :3, :3]))
        poses[:, :3, :3] = rotations(times).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(times, self.times, self.poses[:, axis, 3])
        return poses


def times_of(names: Iterable[str]) -> list[float] | None:
    """Return the times of scans in seconds, if their names are numbers; large ones are nanoseconds.

    Return None if a name is no number.
    """
    try:
        times = [float(name) for name in names]
    except ValueError:
        return None
    return [time * 1e-9 if time > 1e15 else time for time in times]


def read_poses(path: Path) -> Trajectory:
    """Read poses of the sensor.

    KITTI's poses are poses of camera 0. They are turned into poses of the LiDAR if `calib.txt` with
    `Tr` lies next to the file.

    Raises:
        InputError: if the file is missing, has another format, or holds no finite rigid motions.
    """
    with readable(path):
        table = _read_array(path) if path.suffix in (".npy", ".npz") else _read_table(path)
    shape = table.shape
    if table.dtype.kind in "fiu" and table.ndim == 3 and shape[1:] in ((4, 4), (3, 4)):
        poses = table.astype(np.float64)[:, :3]
    elif table.dtype.kind in "fiu" and table.ndim == 2 and shape[1] == KITTI_COLUMNS:
        poses = table.astype(np.float64).reshape(-1, 3, 4)
    elif table.dtype.kind in "fiu" and table.ndim == 2 and shape[1] == TUM_COLUMNS:
        return timed_poses(str(path), table.astype(np.float64))
    else:
        raise InputError(f"{path}: expected {EXPECTED}, found shape {shape}; convert it")

    whole = np.tile(np.eye(4), (len(poses), 1, 1))
    whole[:, :3] = poses
    check_rigid(whole, str(path))
    if shape[1:] != (KITTI_COLUMNS,):
        return Trajectory(str(path), whole)
    calibration = path.with_name(CALIBRATION)
    if not calibration.is_file():
        return Trajectory(str(path), whole, note=f"as the LiDAR's, without {CALIBRATION} beside it")
    note = f"turned from the camera by {CALIBRATION} beside it"
    return Trajectory(str(path), _from_camera(whole, calibration), note=note)


def _read_array(path: Path) -> NDArray[np.generic]:
    """Read an array, also of an archive that holds no other."""
    names = member_names(path) if is_zipfile(path) else []
    if len(names) > 1:
        raise InputError(
            f"{path}: expected {EXPECTED}, found an archive of {shown(', '.join(names))}; save the "
            "poses alone"
        )
    return read_array(path)


def _read_table(path: Path) -> NDArray[np.float64]:
    """Read numbers separated by spaces or commas, after one line of names if there is one."""
    lines = path.read_text("utf-8-sig", errors="replace").replace(",", " ").splitlines()
    if lines and all(times_of([word]) is None for word in lines[0].split()):
        del lines[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about an empty file
            return np.loadtxt(lines, np.float64, ndmin=2)
    except ValueError:
        raise InputError(f"{path}: expected {EXPECTED}, found another file; convert it") from None


def timed_poses(name: str, table: NDArray[np.float64]) -> Trajectory:
    """Return the poses of a table (N, 8) of time x y z qx qy qz qw, in seconds and metres.

    Raises:
        InputError: if there is no pose, a quaternion has not the length 1, a value is no number, or
            the times do not ascend.
    """
    from scipy.spatial.transform import Rotation

    quaternions = table[:, 4:]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    is_unit = np.abs(lengths - 1) < TOLERANCE  # false for NaN
    if not is_unit.all():
        index = int(np.argmin(is_unit))
        raise InputError(
            f"{name}: expected unit quaternions qx qy qz qw, found "
            f"{' '.join(f'{value:g}' for value in quaternions[index])} in pose {index}; correct "
            "it, or convert angles"
        )

    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    check_rigid(poses, name)
    steps = np.diff(table[:, 0])
    if not (steps > 0).all():
        index = int(np.argmin(steps > 0)) + 1
        fault, advice = ("twice", "remove one") if not steps[index - 1] else ("late", "sort them")
        raise InputError(
            f"{name}: expected ascending times, found {table[index, 0]:.9g} s {fault}, in pose "
            f"{index}; {advice}"
        )
    return Trajectory(name, poses, table[:, 0])


def as_pose(value: object) -> Poses:
    """Return the pose (4, 4) that a user gives as an array; raise InputError if it is none."""
    try:
        pose = np.asarray(value, np.float64)
        found = f"shape {pose.shape}"
    except (TypeError, ValueError):
        pose, found = np.empty(0), shown(value)
    if pose.shape != (4, 4):
        raise InputError(
            f"poses: expected an array (4, 4) for each scan, found {found}; give (N, 4, 4) in all"
        )
    check_rigid(pose[None], "poses")
    return pose


def check_rigid(poses: Poses, name: str) -> None:
    """Raise InputError unless all poses (N, 4, 4) are finite rotations and translations."""
    if not len(poses):
        raise InputError(f"{name}: expected poses, found none; give a pose for each scan")
    rotations = poses[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        products = rotations @ rotations.transpose(0, 2, 1)
        is_rigid = np.abs(poses[:, :3, 3]).max(axis=1) < FARTHEST  # false for NaN
        is_rigid &= np.abs(products - np.eye(3)).max(axis=(1, 2)) < TOLERANCE
        is_rigid &= np.linalg.det(np.where(np.isfinite(rotations), rotations, 0)) > 0
    if not is_rigid.all():
        index = int(np.argmin(is_rigid))
        is_finite = np.isfinite(poses[index]).all()
        fault = f"no rotation, or more than {FARTHEST:g} m," if is_finite else "no number"
        raise InputError(
            f"{name}: expected rotations and translations in metres, found {fault} in pose "
            f"{index}; correct it"
        )


def _from_camera(poses: Poses, calibration: Path) -> Poses:
    """Return the poses of the LiDAR, given the poses of KITTI's camera 0."""
    for line in calibration.read_text(errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() != "Tr":
            continue
        try:
            to_camera = np.vstack((np.array(numbers.split(), float).reshape(3, 4), [0, 0, 0, 1]))
        except ValueError:
            break
        check_rigid(to_camera[None], f"{calibration}: Tr")
        moved: Poses = np.linalg.inv(to_camera) @ poses @ to_camera
        return moved
    raise InputError(
        f"{calibration}: expected a line Tr: with 12 numbers, which moves points into camera 0, "
        "found none; take KITTI's file, or remove it if the poses are the LiDAR's"
    )
