"""Read the poses of a drive from a file: KITTI's, TUM's or NumPy's format."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from amvnet.errors import InputError

KITTI_COLUMNS = 12  # the upper three rows of a 4 x 4 matrix
TUM_COLUMNS = 8  # time x y z qx qy qz qw
CALIBRATION = "calib.txt"  # KITTI's file next to its poses; its `Tr` moves points into camera 0
TOLERANCE = 0.01  # largest error of a rotation matrix or of the length of a quaternion
EXPECTED = (
    "poses: lines of 12 numbers (KITTI), lines of time x y z qx qy qz qw (TUM), or .npy of shape "
    "(N, 4, 4)"
)

Poses = NDArray[np.float64]  # (N, 4, 4); each moves points of the sensor into the world


@dataclass(frozen=True)
class PoseFile:
    """The poses of a file.

    Attributes:
        path: the file.
        poses: (N, 4, 4) float64, each moves points of the sensor into the world.
        times: (N,) seconds, ascending, or None if the file has none.
    """

    path: Path
    poses: Poses
    times: NDArray[np.float64] | None = None

    def at(self, times: Sequence[float] | None, count: int) -> Poses:
        """Return the poses (count, 4, 4) of some scans.

        A file with as many poses as scans has them in the order of the scans. Otherwise the times
        decide, and poses are interpolated between the two nearest ones.

        Args:
            times: the time of each scan, seconds, or None if the times are unknown.
            count: the number of scans.

        Raises:
            InputError: if the file does not have a pose for each scan.
        """
        if count == len(self.poses):
            return self.poses
        if self.times is None or times is None:
            of = "" if self.times is None else ", or scans whose names are their times in seconds"
            raise InputError(
                f"{self.path}: expected a pose for each of {count} scans{of}, found "
                f"{len(self.poses)} poses; give the poses of these scans in their order"
            )

        first, last = self.times[0], self.times[-1]
        scan_times = np.asarray(times)
        if scan_times.min() < first or scan_times.max() > last:
            raise InputError(
                f"{self.path}: expected times that include the scans' ({scan_times.min():.2f} to "
                f"{scan_times.max():.2f} s), found {first:.2f} to {last:.2f} s; give the poses of "
                "this drive, by the same clock"
            )
        poses = np.tile(np.eye(4), (count, 1, 1))
        rotations = Slerp(self.times, Rotation.from_matrix(self.poses[:, :3, :3]))
        poses[:, :3, :3] = rotations(scan_times).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(scan_times, self.times, self.poses[:, axis, 3])
        return poses


def read_poses(path: Path) -> PoseFile:
    """Read poses of the sensor.

    KITTI's poses are poses of camera 0. They are turned into poses of the LiDAR if `calib.txt` with
    `Tr` lies next to the file.

    Raises:
        InputError: if the file is missing, has another format, or holds no finite rigid motions.
    """
    try:
        if path.suffix == ".npy":
            table = np.load(path, allow_pickle=False)
        else:
            with path.open(errors="replace") as file, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about an empty file
                table = np.loadtxt(file, np.float64, ndmin=2)
    except OSError as error:
        raise InputError(
            f"{path}: expected {EXPECTED}, found {error.strerror}; check the path"
        ) from None
    except (ValueError, EOFError):
        raise InputError(f"{path}: expected {EXPECTED}, found another file; convert it") from None

    shape = table.shape
    times = None
    if table.dtype.kind in "fiu" and table.ndim == 3 and shape[1:] in ((4, 4), (3, 4)):
        poses = table.astype(np.float64)[:, :3]
    elif table.dtype.kind in "fiu" and table.ndim == 2 and shape[1] == KITTI_COLUMNS:
        poses = table.astype(np.float64).reshape(-1, 3, 4)
    elif table.dtype.kind in "fiu" and table.ndim == 2 and shape[1] == TUM_COLUMNS:
        times = table[:, 0].astype(np.float64)
        poses = _from_tum(path, table)
    else:
        raise InputError(f"{path}: expected {EXPECTED}, found shape {shape}; convert it")

    whole = np.tile(np.eye(4), (len(poses), 1, 1))
    whole[:, :3] = poses
    check_rigid(whole, str(path))
    if times is not None and not (np.diff(times) > 0).all():
        raise InputError(f"{path}: expected ascending times in column 1, found others; sort them")
    calibration = path.with_name(CALIBRATION)
    if shape[1:] == (KITTI_COLUMNS,) and calibration.is_file():
        whole = _from_camera(whole, calibration)
    return PoseFile(path, whole, times)


def check_rigid(poses: Poses, name: str) -> None:
    """Raise InputError unless all poses (N, 4, 4) are finite rotations and translations."""
    if not len(poses):
        raise InputError(f"{name}: expected poses, found none; give a pose for each scan")
    rotations = poses[:, :3, :3]
    products = rotations @ rotations.transpose(0, 2, 1)
    with np.errstate(invalid="ignore"):
        is_rigid = np.isfinite(poses).all(axis=(1, 2))
        is_rigid &= np.abs(products - np.eye(3)).max(axis=(1, 2)) < TOLERANCE
        is_rigid &= np.linalg.det(np.where(np.isfinite(rotations), rotations, 0)) > 0
    if not is_rigid.all():
        index = int(np.argmin(is_rigid))
        is_finite = np.isfinite(poses[index]).all()
        fault = "no rotation" if is_finite else "a value that is no number"
        raise InputError(
            f"{name}: expected rotations and translations in metres, found {fault} in pose "
            f"{index}; correct it"
        )


def _from_tum(path: Path, table: np.ndarray) -> NDArray[np.float64]:
    """Return the (N, 3, 4) poses of lines of time x y z qx qy qz qw."""
    quaternions = table[:, 4:].astype(np.float64)
    lengths = np.linalg.norm(quaternions, axis=1)
    is_unit = np.abs(lengths - 1) < TOLERANCE  # false for NaN
    if not is_unit.all():
        index = int(np.argmin(is_unit))
        raise InputError(
            f"{path}: expected unit quaternions qx qy qz qw in the last four columns, found "
            f"{' '.join(f'{value:g}' for value in table[index, 4:])} in pose {index}; angles must "
            "be converted"
        )
    rotations = Rotation.from_quat(quaternions).as_matrix()
    return np.concatenate((rotations, table[:, 1:4, None]), axis=2)


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
