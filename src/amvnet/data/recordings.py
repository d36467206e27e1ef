"""Recordings and their scans on disk: what datasets, bags, folders and descriptions hold."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from amvnet.data.formats.bag_poses import BagPoses
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import scan_stem
from amvnet.data.labels.ids import check_count, read_ids, train_ids, write_ids
from amvnet.data.poses import Poses
from amvnet.data.taxonomy import Taxonomy
from amvnet.files import inside
from amvnet.scan import Scan

Item = TypeVar("Item")
# Returns a recording whose scans are as some weights expect them.
Normalise = Callable[["Recording"], "Recording"]


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
    dataset: DatasetFiles = field(default=None, compare=False, repr=False)  # type: ignore[assignment]

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


class DatasetFiles(ABC):
    """The files of a dataset's scans: how to read points and labels, and write predictions.

    `Dataset` adds which scans there are.

    Attributes:
        spec: the text by which `open_dataset` opens the same dataset; by default the folder.
        reading: all that a description says of how scans are read, in a text; labels depend on it.
        ids_advice: what a user can do about an unknown id in labels; None is advice on files.
        normalise: what the recordings are normalised by; None if points stay unchanged.
        finish: takes each scan that `ScanFile.load` reads, and returns it as labels need it.
    """

    reading = ""
    ids_advice: str | None = None
    normalise: Normalise | None = None
    finish: Callable[[Scan], Scan] | None = None

    def __init__(self, root: Path | str, taxonomy: Taxonomy, spec: str | None = None) -> None:
        self.root = Path(root)
        self.taxonomy = taxonomy
        self.spec = spec or str(root)

    @abstractmethod
    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan.

        Args:
            labels: whether to read its (N,) train ids, if it has any.

        Raises:
            InputError: if a file is missing, truncated, empty or does not fit its scan.
        """

    def poses(self, records: Sequence[ScanFile]) -> Poses | None:
        """Return the poses (N, 4, 4) of the LiDAR in scans of one sequence, or None if unknown.

        Raises:
            InputError: if the files of the poses are broken, or lack a scan.
        """
        return None

    def files_of(self, record: ScanFile) -> list[Path]:
        """Return the files of a scan: its points and labels, which no output may replace."""
        files = (record.path, record.labels_path)
        return [path for path in files if path is not None]

    def read_unchanged(self, record: ScanFile) -> Scan:
        """Read the points of one scan as in its file; raise the errors of `read`."""
        return self.read(record, labels=False)

    def place_of_labels(self, record: ScanFile) -> Path:
        """Return the file that holds the labels of a scan, or its prediction if none may."""
        return record.labels_path or self.root / record.prediction

    def labels(self, record: ScanFile, count: int) -> np.ndarray | None:
        """Read the (N,) uint8 train ids of a scan of N = `count` points; None if it has no labels.

        Raises:
            InputError: as `raw_labels`, or if an id is unknown.
        """
        path = record.labels_path
        if path is None:
            return None
        raw = self.raw_labels(record, count)
        return train_ids(path, raw, self.taxonomy, self.ids_advice, self.train_ids_by_raw())

    @abstractmethod
    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Read the (N,) raw ids of a scan that has labels and N = `count` points, unchecked.

        Raises:
            InputError: if the file is missing, broken or has another number of labels.
        """

    def train_ids_by_raw(self) -> np.ndarray:
        """Return the int16 train ids by raw id (`raw_labels`), UNKNOWN for ids to refuse."""
        return self.taxonomy.train_ids_by_raw

    def count_points(self, record: ScanFile) -> int:
        """Return the number of points of a scan; raise the errors of `read`."""
        return len(self.read(record, labels=False))

    def place_of_prediction(self, record: ScanFile, kind: str) -> Path:
        """Return the path of a scan's prediction, relative to a folder of predictions.

        `kind` is the format of scan files, one of `writers.KINDS`; datasets have their own format.
        """
        return Path(record.prediction)

    def stored_labels(self, record: ScanFile, count: int) -> np.ndarray | None:
        """Return the (N,) train ids that `predict` or `map` wrote next to N = `count` points."""
        return None

    def read_prediction(
        self,
        record: ScanFile,
        folder: Path,
        count: int | None = None,
        taxonomy: Taxonomy | None = None,
    ) -> np.ndarray:
        """Read the (N,) uint8 train ids (0..K) that were predicted for a scan.

        Args:
            count: N, if it is known; else it is read from the scan's file.
            taxonomy: the classes of the prediction; by default the classes of the dataset.

        Raises:
            InputError: if the file is missing, has another number of points or an unknown id.
        """
        path = Path(folder) / record.prediction
        raw = read_ids(path, _id_type(path), count or self.count_points(record))
        return train_ids(
            path, raw, taxonomy or self.taxonomy, "write the predictions with these ids"
        )

    def write_labels(
        self,
        record: ScanFile,
        folder: Path,
        scan: Scan,
        ids: np.ndarray,
        *,
        taxonomy: Taxonomy | None = None,
        kind: str = "label",
        uncertain: np.ndarray | None = None,
    ) -> Path:
        """Write the (N,) train ids of a scan that was read; the file appears whole or not at all.

        Args:
            taxonomy: the classes of the ids; by default the classes of the dataset.
            kind: as for `place_of_prediction`.
            uncertain: (N,) bool, the uncertain points, which some kinds also hold.

        Raises:
            InputError: if there is not one id per point, or an id is outside 0..K.
        """
        ids = check_count(ids, record.path, len(scan))
        path = inside(folder, record.prediction)
        return write_ids(path, (taxonomy or self.taxonomy).to_raw(ids), _id_type(path))


def normalised_scan(scan: Scan, recording: Recording) -> Scan:
    """Return a labelled scan as its recording, which a `Normaliser` returned, has it.

    Points of the car itself, which get no label, are not scored either.
    """
    normalised = recording.to_scan(Cloud.of(scan))
    labels = scan.labels
    if labels is not None and normalised.own is not None:
        labels = np.where(normalised.own, 0, labels).astype(labels.dtype)
    return replace(normalised, labels=labels)


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


def _id_type(path: Path) -> type[np.unsignedinteger]:
    """Return the type of the ids in a prediction: uint8 of nuScenes, uint32 of all others."""
    return np.uint8 if path.suffix == ".bin" else np.uint32
