"""A dataset of which some scans have pseudo-labels, in files, in place of labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.scan import Scan


@dataclass(frozen=True)
class Taught:
    """A dataset with pseudo-labels. `Dataset` documents the methods and their errors.

    The labels of a scan that has pseudo-labels are never read.

    Attributes:
        dataset: reads the scans, and the labels of those without pseudo-labels.
        folder: of the pseudo-labels, one file per scan.
    """

    dataset: Dataset
    folder: Path

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes of the labels."""
        return self.dataset.taxonomy

    @property
    def root(self) -> Path:
        """The folder of the dataset."""
        return self.dataset.root

    @property
    def spec(self) -> str:
        """What `open_dataset` opens the dataset with."""
        return self.dataset.spec

    @property
    def is_adapted(self) -> bool:
        """Whether the rings of the scans are the rows of the range image."""
        return self.dataset.is_adapted

    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the sequences of a split."""
        return self.dataset.sequences(split)

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return the scans of these sequences."""
        return self.dataset.records(sequences)

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        """Return the scan to train on in place of a scan in an epoch."""
        return self.dataset.at_epoch(record, epoch)

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan, with its pseudo-labels if it has any."""
        path = pseudo_labels_path(self.folder, record)
        if not labels or not path.is_file():
            return self.dataset.read(record, labels)

        scan = self.dataset.read(record, labels=False)
        try:
            ids = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            raise InputError(
                f"{path}: expected pseudo-labels, found a broken file; delete its folder"
            ) from None
        return dataclasses.replace(scan, labels=ids)

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read the predicted (N,) uint8 train ids of one scan."""
        return self.dataset.read_prediction(record, folder)

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) train ids."""
        return self.dataset.write_prediction(record, folder, ids)


def pseudo_labels_path(folder: Path, record: ScanRecord) -> Path:
    """Return the file of a scan's pseudo-labels."""
    return folder / f"{record.name}.npy"


def write_pseudo_labels(folder: Path, record: ScanRecord, ids: np.ndarray) -> None:
    """Write the (N,) uint8 train ids of a scan; 0 for points without."""
    with atomic_write(pseudo_labels_path(folder, record)) as part:
        np.save(part, ids)
