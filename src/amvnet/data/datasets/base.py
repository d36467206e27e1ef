"""What every dataset offers: scans, labels, and predictions in its official layout."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.labels.ids import check_count, read_ids, train_ids, write_ids
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.scan import Scan


@dataclass(frozen=True)
class ScanRecord:
    """The files of one scan of a dataset.

    Attributes:
        name: unique in its dataset: "08/000001", or the sample_data token.
        sequence: "08", or the name of the scene.
        points_path: the file of the points.
        labels_path: the file of the labels, or None if the sequence has none.
        prediction: path of the scan's prediction, relative to a folder of predictions.
    """

    name: str
    sequence: str
    points_path: Path
    labels_path: Path | None
    prediction: str


class Dataset(ABC):
    """One dataset on disk; instances can be pickled, so that worker processes can read.

    Attributes:
        root: the folder that was opened.
        taxonomy: the classes of the labels.
        spec: the text by which `open_dataset` opens the same dataset; by default the folder.
    """

    def __init__(self, root: Path | str, taxonomy: Taxonomy, spec: str | None = None) -> None:
        self.root = Path(root)
        self.taxonomy = taxonomy
        self.spec = spec or str(root)

    @abstractmethod
    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the sequences of a split that are on disk.

        Args:
            split: an official split ("train", "val" or "test"), or "all".

        Raises:
            InputError: if the split is unknown or none of its sequences is on disk.
        """

    @abstractmethod
    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return the scans of these sequences, sorted by sequence and then by time.

        Raises:
            InputError: if a sequence does not exist; the message lists those that do.
        """

    @abstractmethod
    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan.

        Args:
            labels: whether to read its (N,) train ids, if it has any.

        Raises:
            InputError: if a file is missing, truncated, empty or does not fit its scan.
        """

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        """Return the scan that takes a scan's place in an epoch: in most datasets, the scan."""
        return record

    def labelled(self, records: Sequence[ScanRecord]) -> list[ScanRecord]:
        """Return the scans to train on or to score: all, unless the dataset may lack labels.

        Raises:
            InputError: if it may, and none of the scans has labels.
        """
        return list(records)

    def count_points(self, record: ScanRecord) -> int:
        """Return the number of points of a scan; raise the errors of `read`."""
        return len(self.read(record, labels=False))

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read the (N,) uint8 train ids (0..K) that were predicted for a scan.

        Raises:
            InputError: if the file is missing, has another number of points or an unknown id.
        """
        path = Path(folder) / record.prediction
        raw = read_ids(path, _id_type(path), self.count_points(record))
        return train_ids(path, raw, self.taxonomy)

    def write_prediction(
        self,
        record: ScanRecord,
        folder: Path,
        ids: np.ndarray,
        taxonomy: Taxonomy | None = None,
    ) -> Path:
        """Write (N,) train ids as raw ids; the file appears whole or not at all.

        Args:
            taxonomy: the classes of the prediction; None means those of the dataset.

        Raises:
            InputError: if there is not one id per point, or an id is outside 0..K.
        """
        ids = check_count(ids, record.points_path, self.count_points(record))
        path = inside(folder, record.prediction)
        return write_ids(path, (taxonomy or self.taxonomy).to_raw(ids), _id_type(path))


def check_split(source: Path | str, split: str, splits: Collection[str]) -> None:
    """Raise an InputError if a dataset does not know a split."""
    if split not in splits:
        raise InputError(
            f"{source}: expected a split of {', '.join(splits)}, found {split!r}; give one of them"
        )


def _id_type(path: Path) -> type[np.unsignedinteger]:
    """Return the type of the ids in a prediction: uint8 of nuScenes, uint32 of all others."""
    return np.uint8 if path.suffix == ".bin" else np.uint32


def choose_records(
    dataset: Dataset, sequences: Sequence[str] | None, split: str
) -> list[ScanRecord]:
    """Return the scans of the named sequences, or of a split if there are no names."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)
