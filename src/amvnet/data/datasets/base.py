"""What every dataset offers: scans, labels, and predictions in its official layout."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.formats.cloud import Cloud
from amvnet.data.labels.ids import check_count, read_ids, train_ids, write_ids
from amvnet.data.poses import Poses
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.progress import counted
from amvnet.scan import Scan

Names = tuple[str, ...]  # names of sequences
# Returns a recording whose scans are as some weights expect them.
Normalise = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Split:
    """The sequences of a dataset on disk, and what they are for.

    Attributes:
        parts: the sequences of "all" and of each split that the dataset knows, some of which may
            have none. "rest" has those that the split in a user's file does not name.
        is_given: whether the dataset says itself what trains and what validates. If not, all
            sequences outside "test" do.
        having_labels: returns those of some sequences that have labels.
        note: what a user should know about a split that nobody named.
    """

    parts: Mapping[str, Names]
    is_given: bool
    having_labels: Callable[[Names], Names]
    note: str = ""

    def part(self, name: str) -> Names:
        """Return the sequences of a split of the dataset, which may be none."""
        return self.parts.get(name, ())

    @cached_property
    def trainable(self) -> Names:
        """The sequences that may train, before those that validate are left out."""
        if self.is_given:
            return self.part("train")
        names = without(self.part("all"), self.part("test"))
        return self.having_labels(names) or names

    def choose(
        self, train: Sequence[str] | None = None, val: Sequence[str] | None = None
    ) -> tuple[Names, Names]:
        """Return the sequences to train on and to validate with: the named ones, or the usual ones.

        Without a split of its own, the last sequence of a dataset validates and the others train.
        If only its "val" is on disk, that validates. If too few are on disk, one of both is empty.
        A sequence that is named for one purpose is not used for the other by default.
        """
        usual = self.part("val")
        if not (self.is_given or usual) and len(self.trainable) > 1:
            usual = self.trainable[-1:]
        val = val or without(usual, train or ())
        return tuple(train or without(self.trainable, val)), tuple(val)


def without(names: Names, others: Sequence[str]) -> Names:
    """Return the names that are not among others, in order."""
    return tuple(name for name in names if name not in others)


class Dataset(ABC):
    """One dataset on disk; instances can be pickled, so that worker processes can read.

    Attributes:
        spec: the text by which `open_dataset` opens the same dataset; by default the folder.
        readers: number of threads that may read scans at the same time.
        simulated_sensor: the sensor whose scans are simulated, new ones in each epoch; "" if the
            scans are recorded.
        described_sensor: what a description of the dataset says of the sensor, if anything.
        reading: all that a description says of how scans are read, in a text; labels depend on it.
        benchmark_sensor: the name of the sensor of a benchmark, whose scans are normalised for
            weights that do not know it; "" if all scans stay unchanged: other sensors' scans often
            have the layout of SemanticKITTI, and so have those that weights are trained on.
        ids_advice: what a user can do about an unknown id in labels; None is advice on files.
        normalise: what the recordings are normalised by; None if points stay unchanged.
        finish: takes each scan that `ScanFile.load` reads, and returns it as labels need it.
    """

    readers = 8
    simulated_sensor = ""
    described_sensor: str | Mapping[str, Any] | None = None
    reading = ""
    benchmark_sensor = ""
    ids_advice: str | None = None
    normalise: Normalise | None = None
    finish: Callable[[Scan], Scan] | None = None

    def __init__(self, root: Path | str, taxonomy: Taxonomy, spec: str | None = None) -> None:
        self.root = Path(root)
        self.taxonomy = taxonomy
        self.spec = spec or str(root)

    @abstractmethod
    def parts(self) -> dict[str, Names]:
        """Return the sequences on disk of "all" and of each split that the dataset knows."""

    def split(self) -> Split:
        """Return how the sequences on disk are split.

        The split of a benchmark counts if there are sequences to train on and to validate with.
        """
        parts = self.parts()
        return Split(parts, bool(parts.get("train") and parts.get("val")), self._with_labels)

    def _with_labels(self, names: Names) -> Names:
        labelled = {record.sequence for record in self.having_labels(self.records(names))}
        return tuple(name for name in names if name in labelled)

    def lacks(self, split: str) -> str:
        """Return the message that says what a split without a sequence lacks."""
        return f"{self.spec}: expected sequences of the split {split}, found none; name others"

    def sequences(self, name: str) -> Names:
        """Return the sequences of a split, for "train" and "val" as `Split.choose` returns them.

        Raises:
            InputError: if the split is unknown or has no sequence.
        """
        split = self.split()
        if name not in split.parts:
            raise InputError(
                f"{self.spec}: expected a split of {', '.join(split.parts)}, found {name!r}; give "
                "one of them"
            )
        names = split.part(name)
        if name in ("train", "val"):
            train, val = split.choose()
            names = train if name == "train" else val
        if not names:
            raise InputError(self.lacks(name))
        return names

    @abstractmethod
    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these sequences, sorted by sequence and then by time.

        Raises:
            InputError: if a sequence does not exist; the message lists those that do.
        """

    @abstractmethod
    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan.

        Args:
            labels: whether to read its (N,) train ids, if it has any.

        Raises:
            InputError: if a file is missing, truncated, empty or does not fit its scan.
        """

    def recordings(self) -> list[Recording]:
        """Return the recordings whose sensors are measured; a benchmark has none."""
        return []

    def normalised_by(self, normalise: Normalise) -> Dataset:
        """Return the dataset with its scans normalised, if they can be."""
        return self

    def _normalised(self, scan: Scan) -> Scan:
        """Return a labelled scan as `normalise` makes it, whose sensor is measured on it alone.

        Points of the car itself, which get no label, are not scored either.
        """
        if self.normalise is None:
            return scan
        cloud = Cloud(scan.points[:, :3], scan.points[:, 3], scan.ring, name=scan.name)
        normalised = self.normalise(Recording(scan.name)).to_scan(cloud)
        labels = scan.labels
        if labels is not None and normalised.own is not None:
            labels = np.where(normalised.own, 0, labels).astype(labels.dtype)
        return dataclasses.replace(normalised, labels=labels)

    def at_epoch(self, record: ScanFile, epoch: int) -> ScanFile:
        """Return the scan that takes a scan's place in an epoch: in most datasets, the scan."""
        return record

    def labelled(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans to train on or to score: those that have labels.

        Raises:
            InputError: if none of the scans has labels.
        """
        labelled = self.having_labels(records)
        if not labelled:
            path = records[0].labels_path if records else None
            found = f"no {path}" if path is not None else "no labels"
            raise InputError(
                f"{self.spec}: expected labelled scans, found {found} among "
                f"{counted(len(records), 'scan')}; name labelled sequences, or add the labels"
            )
        return labelled

    def having_labels(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans that have labels, which may be none."""
        return [record for record in records if record.has_labels]

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

    def write_prediction(
        self,
        record: ScanFile,
        folder: Path,
        ids: np.ndarray,
        taxonomy: Taxonomy | None = None,
        count: int | None = None,
    ) -> Path:
        """Write (N,) train ids as raw ids; the file appears whole or not at all.

        Args:
            taxonomy: the classes of the prediction; by default the classes of the dataset.
            count: N, if it is known; else it is read from the scan's file.

        Raises:
            InputError: if there is not one id per point, or an id is outside 0..K.
        """
        if count is None:
            count = self.count_points(record)
        ids = check_count(ids, record.path, count)
        path = inside(folder, record.prediction)
        return write_ids(path, (taxonomy or self.taxonomy).to_raw(ids), _id_type(path))

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
        """Write the (N,) train ids of a scan that was read: `write_prediction`.

        Args:
            kind: as for `place_of_prediction`.
            uncertain: (N,) bool, the uncertain points, which some kinds also hold.
        """
        # The file may have vanished since it was read.
        return self.write_prediction(record, folder, ids, taxonomy, count=len(scan))


def not_trained_on(unseen: Sequence[str]) -> str:
    """Return the end of an advice: which sequences to name that are not of the split "train"."""
    advice = "sequences on which the weights were not trained"
    if not unseen:
        return f"{advice}, with --sequences"
    return f"{advice}, such as --sequences {','.join(unseen[:3])}"


def _id_type(path: Path) -> type[np.unsignedinteger]:
    """Return the type of the ids in a prediction: uint8 of nuScenes, uint32 of all others."""
    return np.uint8 if path.suffix == ".bin" else np.uint32


def choose_records(dataset: Dataset, sequences: Sequence[str] | None, split: str) -> list[ScanFile]:
    """Return the scans of the named sequences, or of a split if there are no names."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)
