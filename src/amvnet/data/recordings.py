"""Recordings and their scans on disk: what datasets, bags, folders and descriptions hold."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import scan_stem

if TYPE_CHECKING:
    from amvnet.data.datasets.base import Dataset
    from amvnet.data.formats.bag_poses import BagPoses
    from amvnet.scan import Scan

Item = TypeVar("Item")


@dataclass(eq=False)
class Recording:
    """What one sensor recorded in one go: a sequence, a scene, a bag or a folder.

    Attributes:
        name: unique among the inputs of a command (`name_apart`).
        scans: all its scans, in order.
    """

    name: str
    scans: list[ScanFile] = field(default_factory=list, repr=False)
    # What was read to measure the sensor stays here until it is needed, by `ScanFile.read`.
    kept: dict[Callable[[], Cloud], Cloud] = field(default_factory=dict, repr=False)

    def first(self, count: int) -> list[Callable[[], Cloud]]:
        """Return functions that read the first scans, and keep them in memory."""
        return [partial(self.read, scan, keep=True) for scan in self.scans[:count]]

    def read(self, scan: ScanFile, keep: bool = False) -> Cloud:
        """Read the points of a scan, unless they were kept; raise InputError if it is broken."""
        cloud = self.kept.pop(scan.read, None) or scan.read()
        if keep:
            self.kept[scan.read] = cloud
        return cloud

    def scan(self, file: ScanFile) -> Scan:
        """Read a scan, which keeps the coordinates of its file; raise the errors of `read`."""
        cloud = self.read(file)
        return replace(self.to_scan(cloud), file_xyz=cloud.xyz)

    def to_scan(self, cloud: Cloud) -> Scan:
        """Return the scan of points that were read: unchanged, except by `Normalised`."""
        return cloud.to_scan()


@dataclass(frozen=True)
class ScanFile:
    """A scan on disk.

    Attributes:
        name: unique in its dataset or folder: "08/000001", a sample_data token, "000000" for the
            file `000000.bin`, "drive/000000" for the first scan of the bag `drive.bag`.
        path: the file of its points, or the bag that holds it.
        sequence: what a split calls it: "08", or the name of the scene; empty for scan files.
        labels_path: the file of the labels, or None if the sequence has none.
        prediction: path of the scan's prediction, relative to a folder of predictions.
        ending: the ending that belongs to the file's content (`ending_of`); empty if it is broken,
            or the dataset knows the format.
        read: reads the points of a scan file or of a scan in a bag.
        bag: the poses of the bag that holds the scan; None if no bag does.
        dataset: reads the scan; what `list_scans` finds belongs to none yet.
    """

    name: str
    recording: Recording = field(compare=False, repr=False)
    path: Path
    sequence: str = ""
    labels_path: Path | None = None
    prediction: str = ""
    ending: str = ""
    read: Callable[[], Cloud] = field(default=None, compare=False, repr=False)  # type: ignore[assignment]
    bag: BagPoses | None = field(default=None, compare=False, repr=False)
    dataset: Dataset = field(default=None, compare=False, repr=False)  # type: ignore[assignment]

    @property
    def has_labels(self) -> bool:
        """Whether the file of the labels exists."""
        return self.labels_path is not None and self.labels_path.is_file()

    @property
    def title(self) -> str:
        """A short name for people who look at the scan."""
        if "/" in self.name or not self.sequence:
            return self.name
        # A token of nuScenes is no name for people. The file's name ends in the time.
        return f"{self.sequence}/{scan_stem(self.path).split('__')[-1]}"

    @property
    def scores_path(self) -> Path:
        """The path of the `.npz` of its scores, relative to a folder of predictions."""
        return Path(f"{self.prediction.rpartition('.')[0]}.npz")

    @property
    def corrected(self) -> str:
        """The place of its corrected labels, relative to the folder of the dataset."""
        place = self.dataset.place_of_labels(self)
        return Path(os.path.relpath(place, self.dataset.root)).as_posix()

    @property
    def files(self) -> list[Path]:
        """The files of its points and labels, which no output may replace."""
        return self.dataset.files_of(self)

    def load(self, labels: bool = False) -> Scan:
        """Read the scan as its dataset does; if `labels`, with the ground truth, if there is any.

        Raises:
            InputError: if it cannot be read.
        """
        scan = self.dataset.read(self, labels=labels)
        return scan if self.dataset.finish is None else self.dataset.finish(scan)


def by_recording(scans: Iterable[ScanFile]) -> dict[Recording, list[ScanFile]]:
    """Return scans by their recording, those of a recording in their order."""
    recordings: dict[Recording, list[ScanFile]] = {}
    for scan in scans:
        recordings.setdefault(scan.recording, []).append(scan)
    return recordings


def name_apart(recordings: Iterable[Recording]) -> None:
    """Give each recording a name of its own: a number follows a name that another one has."""
    recordings = list(recordings)
    names = distinct(recording.name for recording in recordings)
    for recording, name in zip(recordings, names, strict=True):
        recording.name = name


def distinct(names: Iterable[str]) -> list[str]:
    """Return names that differ: a number in brackets follows a name that was there before."""
    used: set[str] = set()
    apart = []
    for name in names:
        number = 1
        other = name
        while other in used:
            number += 1
            other = f"{name} ({number})"
        used.add(other)
        apart.append(other)
    return apart


def evenly_spaced(items: Sequence[Item], limit: int) -> list[Item]:
    """Return at most `limit` of the items, evenly spaced, including the first and the last.

    If there are fewer items, return all of them. If `limit` is 1, return the first.
    """
    indices = np.linspace(0, len(items) - 1, min(limit, len(items))).astype(int)
    return [items[index] for index in indices]
