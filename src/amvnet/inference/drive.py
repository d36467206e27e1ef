"""Segment drives: the scores of scans are fused with those around them, or become a map."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amvnet.data.poses import Poses, as_pose, check_rigid, read_poses, times_of
from amvnet.data.recordings import Recording, ScanFile, by_recording, evenly_spaced
from amvnet.drives.consensus import Consensus, DriveScan, Fused
from amvnet.drives.odometry import GAP, PAIRS, Odometry, Pair, check_fit, check_steps
from amvnet.drives.world_map import MapBuilder
from amvnet.errors import InputError, counted
from amvnet.files import digest
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Progress, Reporter, no_progress, report_nothing
from amvnet.scan import AnyArray, Scan

STANDING = -1.2  # height above which points of a normalised scan stand on the ground, metres
# Each scan of a drive goes to the networks turned by this angle more than the scan before, radians.
# By the golden angle, no two scans in reach look the same to the networks, so that their errors at
# the same place differ, and the consensus corrects more of them.
TURN = math.pi * (3 - math.sqrt(5))
FAR = 8.0  # distance up to which two scans are compared if they are not consecutive, metres
ESTIMATE = "KISS-ICP"
DATASET = "the dataset"
# What a user can do if the poses do not fit, by where they come from.
ADVICE = {
    ESTIMATE: "give poses, or scans that follow each other more closely",
    DATASET: "correct them, or give other poses",
}
OTHER_POSES = "give the poses of this drive's LiDAR in metres, or let them be estimated"
LEAST_SCANS = 2  # smallest number of scans of a drive
SAVED_SCANS = 50  # number of scans after which an unfinished map is saved again


@dataclass(frozen=True)
class DriveOptions:
    """How the scores of drives are fused over time.

    Attributes:
        poses: the file of the poses, or the topic of a bag; by default, they come from the dataset,
            or are estimated.
        past_only: whether scans after a scan do not count.
    """

    poses: Path | None = None
    past_only: bool = False


@dataclass(frozen=True)
class Labelled:
    """A scan that was read (`loaded`), and the result for it."""

    scan: ScanFile
    loaded: Scan
    result: Segmentation


@dataclass(frozen=True)
class Broken:
    """A scan that could not be read or segmented, and why."""

    scan: ScanFile
    error: InputError


Outcome = Labelled | Broken


@dataclass(frozen=True)
class Drives:
    """The poses of the scans of one or several drives.

    Attributes:
        poses: the pose (4, 4) of each scan; it moves the points of the scan's file, in metres.
        table: maps the labels to other classes; by default, they stay unchanged.
    """

    poses: Mapping[ScanFile, Poses]
    past_only: bool = False
    table: NDArray[np.uint8] | None = None

    @property
    def digest(self) -> str:
        """A digest of all that labels depend on."""
        values = np.array(list(self.poses.values())).tobytes()
        return f"{digest([values])}, past only: {self.past_only}"

    def motion(self, scan: ScanFile, loaded: Scan) -> Poses:
        """Return the motion (4, 4) of a scan, normalised to the weights, into the world."""
        return self.poses[scan] @ to_file(loaded)

    @cached_property
    def yaws(self) -> dict[ScanFile, float]:
        """The angle by which the networks get each scan turned, radians."""
        places: Counter[Recording] = Counter()
        yaws = {}
        for scan in self.poses:
            yaws[scan] = places[scan.recording] * TURN
            places[scan.recording] += 1
        return yaws

    def consensus(self) -> Consensus:
        """Return a new consensus for the scans of one drive."""
        return Consensus(past_only=self.past_only)

    def reach_of(self, index: int) -> slice:
        """Return which scans of a drive the labels of the scan with an index depend on."""
        consensus = self.consensus()
        return slice(max(index - consensus.reach, 0), index + consensus.ahead + 1)

    def in_reach(self, scans: Sequence[ScanFile], chosen: Iterable[ScanFile]) -> list[ScanFile]:
        """Return the chosen scans and all scans on which their labels depend, in order."""
        chosen = set(chosen)
        needed: list[ScanFile] = []
        for members in by_recording(scans).values():
            is_needed = np.zeros(len(members), bool)
            for index, scan in enumerate(members):
                if scan in chosen:
                    is_needed[self.reach_of(index)] = True
            needed += [scan for scan, is_in in zip(members, is_needed, strict=True) if is_in]
        return needed

    def fuse(self, outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
        """Yield outcomes, drive by drive, with the consensus as labels and scores."""
        for outcome, scores in self.consensus_of(outcomes):
            if isinstance(outcome, Labelled):
                result = with_scores(outcome.result, scores, self.table)
                outcome = replace(outcome, result=result)
            yield outcome

    def consensus_of(self, outcomes: Iterable[Outcome]) -> Iterator[Fused[Outcome]]:
        """Yield the consensus on the scans of each drive, which come in order, drive by drive.

        A broken scan has its place in the drive, but no points.
        """
        for _, drive in groupby(outcomes, key=lambda outcome: outcome.scan.recording):
            yield from self.consensus().stream(self._of_drive(drive))

    def _of_drive(self, outcomes: Iterable[Outcome]) -> Iterator[DriveScan[Outcome]]:
        for outcome in outcomes:
            if isinstance(outcome, Broken):
                yield DriveScan(outcome, np.empty((0, 3)), np.empty((0, 0)), np.eye(4))
            else:
                xyz = outcome.loaded.points[:, :3]
                motion = self.motion(outcome.scan, outcome.loaded)
                yield DriveScan(outcome, xyz, outcome.result.scores, motion)


def drive(
    segmenter: Segmenter,
    scans: Iterable[AnyArray | Scan],
    poses: Iterable[Poses] | None = None,
    past_only: bool = False,
) -> Iterator[Segmentation]:
    """Segment the scans of a drive, and fuse their scores over time (`Consensus`).

    Only the scans in reach are in memory: 9 before a scan and 9 after it. A result follows 9 scans
    later, or at once if only past scans count.

    Args:
        scans: consecutive scans of one recording, as `Segmenter.__call__` takes arrays and `Scan`s.
        poses: the pose (4, 4) of each scan, which moves its points into the world, metres. By
            default, KISS-ICP estimates them (`pip install "amvnet[drives]"`). A list or an array is
            checked for jumps; poses that are still to come cannot be.
        past_only: whether only scans before a scan count, as on a robot.

    Yields:
        The result of each scan, in order: the consensus gives `labels` and `scores`, the single
        scan everything else.

    Raises:
        InputError: if a scan cannot be segmented, a pose is no rigid motion, there are fewer poses
            than scans, the poses jump, or kiss-icp is missing.
    """
    if isinstance(poses, Sequence | np.ndarray) and len(poses) > 1:
        poses = [as_pose(pose) for pose in poses]
        check_steps(np.array(poses), list(map(str, range(len(poses)))), "poses", OTHER_POSES)

    def segmented() -> Iterator[DriveScan[Segmentation]]:
        given = None if poses is None else iter(poses if isinstance(poses, Iterable) else [poses])
        odometry = Odometry() if given is None else None
        for index, points in enumerate(scans):
            result = segmenter(points, yaw=index * TURN)
            scan = result.require_origin().scan
            if odometry is not None:
                pose = odometry(scan.points[scan.valid, :3])
            else:
                assert given is not None
                found = next(given, None)
                if found is None:
                    raise InputError(
                        f"poses: expected a pose for each scan, found {index}; give one for each"
                    )
                pose = as_pose(found) @ to_file(scan)
            yield DriveScan(result, scan.points[:, :3], result.scores, pose)

    for result, scores in Consensus(past_only=past_only).stream(segmented()):
        yield with_scores(result, scores)


@dataclass(frozen=True)
class SavedMap:
    """Where an unfinished map is saved; `request` tells it from others, `resume` continues it."""

    path: Path
    request: str
    resume: bool


def map_drive(
    scans: Sequence[ScanFile],
    drives: Drives,
    segmenter: Segmenter,
    builder: MapBuilder,
    saved: SavedMap,
    progress: Progress = no_progress,
) -> None:
    """Segment the scans of a drive, and add them to a map, which `saved` keeps while unfinished.

    Raises:
        InputError: if a scan cannot be read or segmented.
    """

    def segment(scan: ScanFile, loaded: Scan) -> tuple[np.ndarray, Segmentation, Poses]:
        result = segmenter(loaded, yaw=drives.yaws[scan])
        return loaded.points[:, :3], result, drives.motion(scan, loaded)

    done = builder.restore(saved.path, saved.request) if saved.resume else 0
    for points, result, pose in stream_scans(
        scans[done:], lambda scan: scan.load(), segment, segmenter.at_once, progress
    ):
        builder.add(points, result.scores, pose)
        done += 1
        if done % SAVED_SCANS == 0:
            builder.save(saved.path, saved.request, done)


def with_scores(
    result: Segmentation, scores: NDArray[np.float32], table: NDArray[np.uint8] | None = None
) -> Segmentation:
    """Return a result with other scores (N, K), and their labels, mapped by a table if given."""
    labels = np.where(result.labels > 0, scores.argmax(axis=1) + 1, 0).astype(np.uint8)
    return replace(result, scores=scores, labels=labels if table is None else table[labels])


def to_file(scan: Scan) -> Poses:
    """Return the motion (4, 4) of a scan's points into the frame of its file."""
    return np.eye(4) if scan.to_file is None else scan.to_file


def find_poses(
    scans: Sequence[ScanFile],
    path: Path | None = None,
    past_only: bool = False,
    *,
    is_one: bool = False,
    progress: Progress = no_progress,
    report: Reporter = report_nothing,
) -> Drives:
    """Find the poses of the scans of one or several drives, and check that they fit the scans.

    They come from a file, from a topic of the bag, from the dataset, or from KISS-ICP. A line for
    each drive says which.

    Args:
        scans: the scans; those of each recording are in order.
        path: the file of the poses of the only drive (`read_poses`), or a topic of bags, if no file
            has this name (`BagPoses`).
        is_one: whether all scans must be of one drive.

    Raises:
        InputError: if a recording has a single scan; if the file or the topic does not have a pose
            for each scan, or a file is given for several drives; if the poses do not fit the scans;
            or if a scan cannot be read or kiss-icp is missing where poses are estimated.
    """
    drives = by_recording(scans)
    is_file = path is not None and path.is_file()
    if (is_file or is_one) and len(drives) > 1:
        names = [recording.name for recording in drives]
        more = ", ..." if len(names) > 3 else ""
        raise InputError(
            f"expected the scans of one drive, found {len(names)} recordings "
            f"({', '.join(names[:3])}{more}); choose one, with --sequences or as INPUT"
        )
    for recording, members in drives.items():
        if len(members) < LEAST_SCANS:
            raise InputError(
                f"{recording.name}: expected the consecutive scans of a drive, found a single "
                "scan; give all scans of the drive"
            )

    found: dict[ScanFile, Poses] = {}
    for recording, members in drives.items():
        name = str(path) if is_file else recording.name
        poses, where = _recorded(members, path, report)
        if poses is None:
            bag = members[0].bag
            topic = None if bag is None else bag.odometry()
            other = "" if topic is None else f"; --poses {topic} takes those of the bag"
            report(f"{name}: estimating the poses of {counted(len(members), 'scan')}{other}")
            earlier = len(found)  # as many scans have their poses already
            poses = _estimated(members, lambda done: progress(earlier + done, len(scans)))  # noqa: B023
            where = ESTIMATE

        check_rigid(poses, name)
        says = f"{name}, by {where}", ADVICE.get(where, OTHER_POSES)
        check_steps(poses, [scan.name for scan in members], *says)
        fit = check_fit(_pairs(members, poses), *says)
        metres = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        report(f"{name}: a drive of {counted(len(members), 'scan')}, {metres:.0f} m by {where}")
        if fit is not None and fit.is_doubtful:
            report(
                f"warning: {name}: the poses are less exact than the scans: the scans have {fit}, "
                "so that less is gained by fusing them; check the time and the place of the LiDAR"
            )
        found |= dict(zip(members, poses, strict=True))
    return Drives(found, past_only)


def _recorded(
    scans: Sequence[ScanFile], path: Path | None, report: Reporter
) -> tuple[Poses | None, str]:
    """Return the poses (N, 4, 4) of a drive, or None if they are unknown, and what holds them."""
    if path is not None:
        bag = scans[0].bag
        if bag is not None and not path.is_file():
            return bag.at_scans(path.as_posix(), report), path.as_posix()
        track = read_poses(path)
        # All of a bag is read for the times of its scans.
        times = None if len(track.poses) == len(scans) else _times(scans)
        note = f", {track.note}" if track.note else ""
        return track.at(times, len(scans)), f"the file{note}"

    return scans[0].dataset.poses(scans), DATASET


def _estimated(scans: Sequence[ScanFile], count: Callable[[int], None]) -> Poses:
    odometry = Odometry()
    poses = []
    for index, scan in enumerate(scans):
        count(index)
        try:
            loaded = scan.load()
            pose = odometry(loaded.points[loaded.valid, :3])
            poses.append(pose @ np.linalg.inv(to_file(loaded)))
        except InputError:  # the segmentation reports the broken scan
            poses.append(poses[-1] if poses else np.eye(4))
    count(len(scans))
    return np.array(poses)


def _times(scans: Sequence[ScanFile]) -> list[float] | None:
    """Return the times of scans in seconds, if their bag or their names state them."""
    bag = scans[0].bag
    if bag is not None:
        return bag.times()
    return times_of(Path(scan.name).name.removesuffix(scan.path.suffix) for scan in scans)


def _pairs(scans: Sequence[ScanFile], poses: Poses) -> Iterator[Pair]:
    """Yield pairs of scans that show whether the poses fit; unreadable scans show nothing."""
    for first in evenly_spaced(range(len(scans) - 1), PAIRS):
        # The farther apart two scans are, the more a wrong motion shows, if they see the same
        # places.
        ahead = poses[first + 1 : first + 1 + GAP, :3, 3] - poses[first, :3, 3]
        is_near = np.linalg.norm(ahead, axis=1) < FAR
        last = first + max(int(np.cumprod(is_near).sum()), 1)
        with suppress(InputError):
            before, after = scans[first].load(), scans[last].load()
            into_world = poses[first] @ to_file(before)
            motion = np.linalg.inv(into_world) @ poses[last] @ to_file(after)
            yield Pair(_standing(before), _standing(after), motion)


def _standing(scan: Scan) -> np.ndarray:
    """Return the points (M, 3) of a scan that stand above the ground."""
    return scan.points[scan.valid & (scan.points[:, 2] > STANDING), :3]
