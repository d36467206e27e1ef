"""Estimate the poses of a drive from its scans, and check that poses fit them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amvnet.data.poses import Poses
from amvnet.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

GAP = 50  # largest number of scans between the two of a pair that shows whether poses fit
PAIRS = 8  # number of pairs that are compared, evenly spaced over the drive
CHECKED_POINTS = 2000  # number of points of a scan that are compared
NEAREST, FARTHEST = 2.0, 30.0  # distances of the points that are compared, metres
CLOSE = 0.15  # median distance up to which poses fit, metres
# The alignment of two scans by ICP moves points by their nearest ones; the others may have moved.
ALIGNING_STEPS = 12
ALIGNED_SHARE = 0.7
# Aligning true poses moves points by up to 0.13 m and divides the distance by up to 1.09; poses in
# whole metres or turned by 3 degrees by 0.18 to 0.69 m and by 1.23 to 3.4 (docs/log.md).
DOUBTFUL_SHIFT, DOUBTFUL_RATIO = 0.1, 1.2
WRONG_SHIFT, WRONG_RATIO = 0.25, 2.0
OTHERS = (0.0, 0.8, 1.25)  # multiples of a motion; if it is true, it brings the scans closer
# With true poses, the median distance is at most 0.62 of the least distance under the other
# motions, and with wrong poses at least 1.1 times that distance (docs/log.md).
LARGEST_RATIO = 0.75
FARTHEST_STEP = 1000.0  # largest distance between two scans in a row, metres
# A pose may lead off the way between its neighbours by so many metres, or typical steps.
LARGEST_DETOUR, DETOUR_STEPS = 2.0, 5.0
VOXEL = 1.0  # edge of the voxels of KISS-ICP's map, metres


class Odometry:
    """Estimates the pose of each scan from the scans before it, by KISS-ICP (Vizzo et al., 2023).

    The first scan is at the origin. One thread computes, so that equal scans have equal poses.

    Raises:
        InputError: if the package kiss-icp is missing.
    """

    def __init__(self) -> None:
        try:
            from kiss_icp.config import KISSConfig
            from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
            from kiss_icp.kiss_icp import KissICP
        except ImportError:
            raise InputError(
                "expected poses, or the package kiss-icp, which estimates them, found neither; run "
                'pip install "amvnet[drives]", or give poses'
            ) from None

        # The points have no times, by which their motion within a scan could be undone.
        config = KISSConfig(
            data=DataConfig(deskew=False),
            mapping=MappingConfig(voxel_size=VOXEL),
            registration=RegistrationConfig(max_num_threads=1),
        )
        self._odometry = KissICP(config)

    def __call__(self, xyz: NDArray[np.floating]) -> Poses:
        """Return the pose (4, 4) of the next scan, given its valid points (M, 3) in metres."""
        self._odometry.register_frame(np.asarray(xyz, np.float64), np.empty(0))
        pose: Poses = self._odometry.last_pose.copy()
        return pose


@dataclass(frozen=True)
class Pair:
    """Two scans of a drive, some scans apart.

    Attributes:
        before, after: (M, 3) their points that stand above the ground, metres.
        motion: (4, 4) moves points of the second scan into the first one.
    """

    before: NDArray[np.floating]
    after: NDArray[np.floating]
    motion: Poses


def check_steps(poses: Poses, names: Sequence[str], name: str, advice: str) -> None:
    """Check that a drive has no jump: the pose of each scan is near those before it and after it.

    The message begins with `name`, has the `names` of the scans whose poses (N, 4, 4) jump, and
    ends with `advice`. The pairs of `check_fit` are too few to show a single pose that is wrong.

    Raises:
        InputError: if two scans in a row are very far apart, or a single pose lies off the way.
    """
    places = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if steps.max() > FARTHEST_STEP:
        index = int(np.argmax(steps))
        raise InputError(
            f"{name}: expected the poses of one drive, found {steps[index]:,.0f} m between the "
            f"scans {names[index]} and {names[index + 1]}; take either part, or {advice}"
        )

    detours = (steps[:-1] + steps[1:] - np.linalg.norm(places[2:] - places[:-2], axis=1)) / 2
    if (detours > max(LARGEST_DETOUR, DETOUR_STEPS * np.median(steps))).any():
        index = int(np.argmax(detours))
        raise InputError(
            f"{name}: expected the poses of one drive, found that of the scan {names[index + 1]} "
            f"{detours[index]:,.0f} m off the way; leave this scan out, or {advice}"
        )


@dataclass(frozen=True)
class Fit:
    """How well poses fit the scans: medians over pairs of scans, metres.

    Attributes:
        distance: of the points of one scan to the nearest ones of the other, moved by the poses.
        least: the same distance, after each pair was aligned.
        shift: by how much this moved the points.
    """

    distance: float
    least: float
    shift: float

    @property
    def is_doubtful(self) -> bool:
        """Whether the poses are less exact than the scans allow."""
        return self.shift > DOUBTFUL_SHIFT and self.distance > DOUBTFUL_RATIO * self.least

    @property
    def is_wrong(self) -> bool:
        """Whether so little is gained by the poses that others are better."""
        return self.shift > WRONG_SHIFT and self.distance > WRONG_RATIO * self.least

    def __str__(self) -> str:
        return f"their points {self.distance:.2f} m apart, {self.least:.2f} m if they are aligned"


def check_fit(pairs: Iterable[Pair], name: str, advice: str) -> Fit | None:
    """Return how well poses fit the scans, whose surfaces should meet in the world.

    With wrong poses, each wall is seen twice, and another motion brings the scans closer together:
    none, a shorter one, a longer one, or that of an alignment. The message begins with `name` and
    ends with `advice`.

    Returns:
        The fit, or None if the scans do not tell.

    Raises:
        InputError: if the poses do not fit.
    """
    from scipy.spatial import KDTree

    distances = []
    for pair in pairs:
        before = _compared(pair.before)
        after = _compared(pair.after)
        after = after[:: max(len(after) // CHECKED_POINTS, 1)]
        if len(before) and len(after):
            tree = KDTree(before)
            moved = [after @ turn.T + step for turn, step in _motions(pair.motion)]
            moved.append(_aligned(tree, moved[0]))
            shift = np.median(np.linalg.norm(moved[-1] - moved[0], axis=1))
            distances.append([shift, *(np.median(tree.query(points)[0]) for points in moved)])
    if not distances:
        return None

    shift, given, *others, aligned = np.median(distances, axis=0).tolist()
    least = min(others)
    if given > max(CLOSE, LARGEST_RATIO * least):
        factor = OTHERS[others.index(least)]
        motion = f"motions {factor:g} times as long" if factor else "no motion"
        raise InputError(
            f"{name}: expected poses under which the scans meet, found their points {given:.2f} m "
            f"apart, and {least:.2f} m with {motion}; {advice}"
        )
    fit = Fit(given, aligned, shift)
    if fit.is_wrong:
        raise InputError(
            f"{name}: expected poses under which the scans meet, found {fit}; {advice}"
        )
    return fit


def _aligned(tree: KDTree, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (M, 3) moved by ICP, so that most of them are near the points of a tree."""
    for _ in range(ALIGNING_STEPS):
        distance, index = map(np.asarray, tree.query(points))
        is_near = distance <= np.quantile(distance, ALIGNED_SHARE)
        source = points[is_near]
        target = tree.data[index[is_near]]
        centre, goal = source.mean(axis=0), target.mean(axis=0)
        left, _, right = np.linalg.svd((source - centre).T @ (target - goal))
        right[2] *= np.linalg.det(left @ right)  # a rotation, no reflection
        points = (points - centre) @ left @ right + goal
    return points


def _motions(motion: Poses) -> Iterator[tuple[Poses, Poses]]:
    """Yield the rotation (3, 3) and translation (3,) of a motion, and of its multiples `OTHERS`."""
    from scipy.spatial.transform import Rotation

    angles = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    for factor in (1.0, *OTHERS):
        yield Rotation.from_rotvec(factor * angles).as_matrix(), factor * motion[:3, 3]


def _compared(xyz: NDArray[np.floating]) -> NDArray[np.float64]:
    distance = np.linalg.norm(xyz, axis=1)
    return np.asarray(xyz[(distance > NEAREST) & (distance < FARTHEST)], np.float64)
