"""A dataset of which some scans have pseudo-labels, in files, in place of labels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.wrapped import WrappedDataset
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.scan import Scan


@dataclass(frozen=True)
class Taught(WrappedDataset):
    """A dataset with pseudo-labels. `Dataset` documents the methods and their errors.

    The labels of a scan that has pseudo-labels are never read.

    Attributes:
        dataset: reads the scans, and the labels of those without pseudo-labels.
        folder: of the pseudo-labels, one file per scan.
    """

    folder: Path

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


def pseudo_labels_path(folder: Path, record: ScanRecord) -> Path:
    """Return the file of a scan's pseudo-labels."""
    return folder / f"{record.name}.npy"


def write_pseudo_labels(folder: Path, record: ScanRecord, ids: np.ndarray) -> None:
    """Write the (N,) uint8 train ids of a scan; 0 for points without."""
    with atomic_write(pseudo_labels_path(folder, record)) as part:
        np.save(part, ids)
