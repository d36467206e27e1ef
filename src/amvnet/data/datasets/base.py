"""What every dataset offers: its scans, their labels, and predictions in its official layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from amvnet.data.taxonomy import Taxonomy
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


@runtime_checkable
class Dataset(Protocol):
    """One dataset on disk; instances can be pickled, so that worker processes can read."""

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes of the labels."""

    @property
    def root(self) -> Path:
        """The folder that was opened."""

    @property
    def spec(self) -> str:
        """What `open_dataset` opens the same dataset with."""

    @property
    def is_adapted(self) -> bool:
        """Whether `ring` of each scan is the row of each point in the range image, 0 the lowest."""

    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the sequences of a split that are on disk.

        Args:
            split: an official split ("train", "val" or "test"), or "all".

        Raises:
            InputError: if the split is unknown or none of its sequences is on disk.
        """

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return the scans of these sequences, sorted by sequence and then by time.

        Raises:
            InputError: if a sequence does not exist; the message lists those that do.
        """

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        """Return the scan to train on in place of a scan in an epoch: most datasets, the scan."""

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan.

        Args:
            record: the scan.
            labels: whether to read its (N,) train ids, if it has any.

        Raises:
            InputError: if a file is missing, truncated, empty or does not fit its scan.
        """

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read the (N,) uint8 train ids (0..K) that were predicted for a scan.

        Raises:
            InputError: if the file is missing, has another number of points or an unknown id.
        """

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) train ids as the benchmark's raw ids; the file appears whole or not at all.

        Raises:
            InputError: if there is not one id per point, or an id is outside 0..K.
        """


def choose_records(
    dataset: Dataset, sequences: Sequence[str] | None, split: str
) -> list[ScanRecord]:
    """Return the scans of the named sequences, or of a split if there are no names."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)
