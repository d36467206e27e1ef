"""Check every label of labelled scans before the training, and report what is wrong."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from amvnet.data import plausible
from amvnet.data.datasets.base import Dataset
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import INSTANCE_MASK, TAXONOMIES, UNKNOWN, Taxonomy
from amvnet.errors import InputError, counted, listed
from amvnet.progress import Progress, no_progress
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.scan import Scan

SHOWN_IDS = 5  # largest number of unknown ids that a message lists
SHOWN_SCANS = 3  # largest number of broken scans that a message names


@dataclass(frozen=True)
class Contents:
    """The contents of a labelled scan.

    Attributes:
        points: (K + 1,) the number of points by train id; lost returns (`Scan.valid`) have 0.
        unknown: the number of points by raw id that is neither in a class nor ignored.
        neighbours: (2, K + 1) as `plausible.neighbours` returns them.
        raised: (K + 1,) as `plausible.raised` returns them.
        digest: equal for equal points.
    """

    points: np.ndarray
    unknown: Mapping[int, int]
    neighbours: np.ndarray
    raised: np.ndarray
    digest: bytes


@dataclass
class UnknownId:
    """How often a raw id occurs that is neither in a class nor ignored, and a file with it."""

    points: int = 0
    scans: int = 0
    example: str = ""


@dataclass
class SplitReport:
    """The contents of the scans of a split.

    Attributes:
        points: (K + 1,) the number of points by train id.
        scans_with: (K + 1,) the number of scans with a point of each train id.
        scans: the names of the labelled scans that could be read.
        unlabelled: the names of the scans without a label file, which are skipped, and the path
            of the file that each lacks ("" if the dataset has no place for it).
        neighbours, raised: the sums of those in `Contents`.
        stray: the names of the scans whose labels do not follow the geometry.
    """

    points: np.ndarray
    scans_with: np.ndarray
    neighbours: np.ndarray
    raised: np.ndarray
    scans: list[str] = field(default_factory=list)
    unlabelled: dict[str, str] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    unknown: dict[int, UnknownId] = field(default_factory=dict)
    stray: list[str] = field(default_factory=list)
    names: dict[bytes, str] = field(default_factory=dict)

    @classmethod
    def empty(cls, size: int) -> SplitReport:
        """Return the report of no scans, given K, the number of classes."""
        counts = np.zeros((5, size + 1), dtype=np.int64)
        return cls(counts[0], counts[1], counts[2:4], counts[4])

    def add(self, record: ScanFile, contents: Contents) -> None:
        """Add the contents of a scan."""
        self.scans.append(record.name)
        self.names[contents.digest] = record.name
        self.points += contents.points
        self.scans_with += contents.points > 0
        self.neighbours += contents.neighbours
        self.raised += contents.raised
        if plausible.following(contents.neighbours)[-1] < plausible.MIN_FOLLOWING:
            self.stray.append(record.name)

        for raw_id, count in contents.unknown.items():
            example = os.path.normpath(record.labels_path or record.path)
            entry = self.unknown.setdefault(raw_id, UnknownId(example=example))
            entry.points += count
            entry.scans += 1


@dataclass(frozen=True)
class Report:
    """The contents of the labelled scans of a dataset, by split.

    Attributes:
        contents: what each scan holds, by the name of the scan; broken scans are left out.
    """

    spec: str
    taxonomy: Taxonomy
    splits: Mapping[str, SplitReport]
    contents: Mapping[str, Contents]

    def count_points(self, records: Sequence[ScanFile]) -> np.ndarray:
        """Return the number of points of some of the scans by train id, (K + 1,) int64."""
        counts = np.zeros(self.taxonomy.size + 1, dtype=np.int64)
        for record in records:
            counts += self.contents[record.name].points
        return counts

    @property
    def broken(self) -> dict[str, str]:
        """The messages about scans that cannot be read, by the name of the scan."""
        return {name: text for split in self.splits.values() for name, text in split.broken.items()}

    @property
    def unknown(self) -> dict[int, UnknownId]:
        """The raw ids that are neither in a class nor ignored, over all splits."""
        totals: dict[int, UnknownId] = {}
        for split in self.splits.values():
            for raw_id, entry in split.unknown.items():
                total = totals.setdefault(raw_id, UnknownId(example=entry.example))
                total.points += entry.points
                total.scans += entry.scans
        return dict(sorted(totals.items()))

    def errors(self) -> Iterator[str]:
        """Yield a line for each error that must be corrected before a training.

        Broken scans are not among them; `broken` has their messages.
        """
        if self.taxonomy.size < 2:
            yield (
                f"{self.spec}: expected two or more classes to train, found only "
                f"{self.taxonomy.classes[0]}; add a class, such as one for all other points"
            )
        unknown = self.unknown
        if unknown:
            texts = [describe_unknown(*item) for item in unknown.items()]
            yield (
                f"{self.spec}: expected ids of classes or of ignored points, found "
                f"{listed(texts, SHOWN_IDS)}; {_advice(self.taxonomy)}"
            )
            return

        for name, purpose in (("train", "train on"), ("val", "validate with")):
            split = self.splits.get(name)
            if split is None or not split.scans:
                continue
            present = [self.taxonomy.classes[index] for index in np.flatnonzero(split.points[1:])]
            if not present:
                yield (
                    f"{self.spec}: expected points with a class to {purpose}, found "
                    f"{counted(int(split.points[0]), 'point')} that are all ignored; correct the "
                    "ids of the classes, or name other scans"
                )
            elif name == "train" and len(present) == 1:
                yield (
                    f"{self.spec}: expected points of two or more classes to train on, found only "
                    f"{present[0]}; label other classes, or name other scans"
                )

    def require_trainable(self) -> None:
        """Raise InputError if there is an error, or a scan is broken."""
        for error in self.errors():
            raise InputError(error)

        broken = self.broken
        if broken:
            total = sum(len(split.scans) + len(split.broken) for split in self.splits.values())
            others = list(broken)[1:SHOWN_SCANS]
            more = len(broken) - 1 - len(others)
            rest = f", also {', '.join(others)}" if others else ""
            rest += f" and {more} more" if more > 0 else ""
            raise InputError(
                f"{self.spec}: expected scans that can be read, found {len(broken)} of "
                f"{counted(total, 'scan')} that cannot: {next(iter(broken.values()))}{rest}; "
                "correct them or leave them out (amvnet check lists all)"
            )

    def doubts(self) -> Iterator[str]:
        """Yield those of the `warnings` that say that labels are hardly right."""
        for name, split in self.splits.items():
            yield from (f"{name}: {line}" for line in self._implausible(split))

    def warnings(self) -> Iterator[str]:
        """Yield a line for each thing that may be a mistake."""
        for name, split in self.splits.items():
            if split.unlabelled:
                total = len(split.unlabelled) + len(split.scans) + len(split.broken)
                scan, path = next(iter(split.unlabelled.items()))
                yield (
                    f"{name}: skipped for lack of labels: {len(split.unlabelled)} of "
                    f"{counted(total, 'scan')}, such as {scan}" + (f" (no {path})" if path else "")
                )
            absent = [
                self.taxonomy.classes[index] for index in np.flatnonzero(split.points[1:] == 0)
            ]
            if split.scans and absent and len(absent) < self.taxonomy.size:
                yield f"{name}: no point of {', '.join(absent)}"
            yield from (f"{name}: {line}" for line in self._implausible(split))

        names = self.splits["train"].names if "train" in self.splits else {}
        for name, split in self.splits.items():
            common = [digest for digest in split.names if digest in names]
            if name != "train" and common:
                yield (
                    f"{name}: {counted(len(common), 'scan')} with the same points as in train, "
                    f"such as {split.names[common[0]]} and {names[common[0]]}; leave out one of "
                    "both"
                )

    def _implausible(self, split: SplitReport) -> Iterator[str]:
        """Yield a line for each thing that is implausible in the labels of a split."""
        frequent = ", ".join(plausible.frequent_classes(split.points, self.taxonomy))
        if frequent:
            yield (
                f"more points than on any street are {frequent}; are the labels ids of another "
                "table, such as train ids?"
            )
        high = ", ".join(plausible.raised_classes(split.raised, split.points, self.taxonomy))
        if high:
            yield (
                "expected the ground below everything else, found points more than 1 m above "
                f"others at the same place: {high}; correct the ids or the labels"
            )
        scattered = ", ".join(plausible.scattered_classes(split.neighbours, self.taxonomy))
        if split.stray:
            yield (
                f"labels do not follow the geometry in {len(split.stray)} of "
                f"{counted(len(split.scans), 'scan')}, such as {split.stray[0]}; write the labels "
                "in the order of the points"
            )
        elif scattered:
            yield f"points spread like random ones: {scattered}; correct their labels"


def check_scans(
    dataset: Dataset,
    splits: Mapping[str, Sequence[ScanFile]],
    progress: Progress = no_progress,
    processes: Processes = ALONE,
) -> Report:
    """Read all labelled scans of some splits by several threads, and report what they hold.

    Args:
        splits: the scans by the name of the split; scans without labels are only counted.
        processes: the processes that share the scans; each process returns the report on all scans.
    """
    labelled = {}
    for records in splits.values():
        for record in dataset.having_labels(records):
            labelled[record.name] = record
    share = processes.share(list(labelled.values()))
    found: dict[str, Contents | str] = {}
    read = _read_all(dataset, share, progress)
    for part in processes.gather(read):
        found |= part

    reports = {}
    for split, records in splits.items():
        report = SplitReport.empty(dataset.taxonomy.size)
        for record in records:
            contents = found.get(record.name)
            if contents is None:
                place = dataset.place_of_labels(record)
                has_place = place != dataset.root / record.prediction
                report.unlabelled[record.name] = str(place) if has_place else ""
            elif isinstance(contents, Contents):
                report.add(record, contents)
            else:
                report.broken[record.name] = contents
        reports[split] = report

    whole = {name: item for name, item in found.items() if isinstance(item, Contents)}
    return Report(dataset.spec, dataset.taxonomy, reports, whole)


def describe_unknown(raw_id: int, entry: UnknownId) -> str:
    """Return in words how often an unknown id occurs, and in which file."""
    points = f"{entry.points:,} point{'' if entry.points == 1 else 's'}"
    return f"{raw_id} ({points} in {counted(entry.scans, 'scan')}, such as {entry.example})"


def _advice(taxonomy: Taxonomy) -> str:
    if taxonomy.name in TAXONOMIES:
        return f"write ids of {taxonomy.name}, or describe your own in a YAML file"
    return "add them to a class or to ignored in that file (ignored: rest takes all others)"


def _read_all(
    dataset: Dataset, records: Sequence[ScanFile], progress: Progress
) -> dict[str, Contents | str]:
    """Return the contents of scans, or the message about a broken scan, by the name of the scan."""
    is_ground = np.array(
        [name == plausible.GROUND for name in plausible.coarse_names(dataset.taxonomy)]
    )

    def read(record: ScanFile) -> Contents | str:
        try:
            return _contents_of(dataset, record, is_ground)
        except InputError as error:
            return str(error)
        except OSError as error:  # for example, a network disk has failed
            return f"{error.filename or record.path}: {error.strerror or error}"

    found = {}
    with ThreadPoolExecutor(min(dataset.readers, os.cpu_count() or 1)) as pool:
        for done, (record, result) in enumerate(
            zip(records, pool.map(read, records), strict=True), start=1
        ):
            found[record.name] = result
            progress(done, len(records))
    return found


def _contents_of(dataset: Dataset, record: ScanFile, is_ground: np.ndarray) -> Contents:
    """Read a scan and its labels, given which (K + 1,) train ids are of the ground."""
    scan = dataset.read_unchanged(record)
    raw = dataset.raw_labels(record, len(scan)).astype(np.int64) & INSTANCE_MASK
    labels = dataset.train_ids_by_raw()[raw]
    unknown = dict(zip(*np.unique(raw[labels == UNKNOWN], return_counts=True), strict=True))

    check_trainable(scan)
    is_valid = scan.valid
    labels = np.where(is_valid & (labels != UNKNOWN), labels, 0)
    shown = (scan.points[is_valid, :3].astype(np.float64), labels[is_valid])
    return Contents(
        np.bincount(labels, minlength=len(is_ground)),
        {int(raw_id): int(count) for raw_id, count in unknown.items()},
        plausible.neighbours(*shown, dataset.taxonomy.size),
        plausible.raised(*shown, is_ground),
        hashlib.blake2b(scan.points.tobytes()).digest(),
    )


def check_trainable(scan: Scan) -> None:
    """Raise InputError if no network can be trained on a scan."""
    valid = int(scan.valid.sum())
    if valid < 2:  # batch norm needs two points to compute a variance
        raise InputError(
            f"{scan.name}: expected at least two valid points to train with, found {valid}; "
            "leave the scan out"
        )
