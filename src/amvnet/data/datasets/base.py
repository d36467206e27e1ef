"""What every data set offers: a list of its scans, each read, and predictions written where its tools look."""

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
    """Where one scan of a data set lies.

    Attributes:
        name: unique in its data set: "08/000001", or the sample_data token.
        sequence: "08", or the name of the scene.
        points_path: the file of the points.
        labels_path: the file of the labels, or None where the sequence has none.
        prediction: where its prediction lies, relative to a folder of predictions.
    """

    name: str
    sequence: str
    points_path: Path
    labels_path: Path | None
    prediction: str


@runtime_checkable
class Dataset(Protocol):
    """One data set on disk; instances can be pickled, so that worker processes can read."""

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes of the labels."""

    @property
    def root(self) -> Path:
        """The folder that was opened."""

    def sequences(self, split: str) -> tuple[str, ...]:
        """The sequences of the official split ("train", "val" or "test") that are on disk; of "all", every one.

        Raises:
            InputError: where the split is unknown or none of its sequences is there.
        """

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """The scans of these sequences, sorted by sequence and then by time.

        Raises:
            InputError: where a sequence is not there; the message lists those that are.
        """

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan, with (N,) train ids where it has labels and they are wanted, else None.

        Raises:
            InputError: where a file is missing, truncated, empty or does not fit its scan.
        """

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read the (N,) uint8 train ids (0..K) that `folder` has for this scan.

        Raises:
            InputError: where the file is missing, has another number of points, or an unknown id.
        """

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) train ids as the raw ids of the benchmark; the file appears whole or not at all.

        Raises:
            InputError: where there is not one id per point, or an id is outside 0..K.
        """


def choose_records(
    dataset: Dataset, sequences: Sequence[str] | None, split: str
) -> list[ScanRecord]:
    """Return the scans of the named sequences, or of a split if there are no names."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)
