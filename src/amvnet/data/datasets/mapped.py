"""A dataset with other classes: those of its own, mapped."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data import scan_files as files
from amvnet.data.class_maps import ClassMap
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.wrapped import WrappedDataset
from amvnet.data.taxonomy import Taxonomy
from amvnet.scan import Scan


@dataclass(frozen=True)
class MappedDataset(WrappedDataset):
    """The scans of a dataset, with mapped labels. `Dataset` documents the methods and their errors.

    Attributes:
        dataset: has the scans, and labels and predictions of its own classes.
        classes: maps these to the classes of this dataset.

    Raises:
        InputError: if the map has none of the dataset's classes.
    """

    classes: ClassMap

    def __post_init__(self) -> None:
        self.classes.table(self.dataset.taxonomy)

    @property
    def taxonomy(self) -> Taxonomy:
        return self.classes.target

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan, with mapped labels."""
        scan = self.dataset.read(record, labels=labels)
        if scan.labels is None:
            return scan
        return dataclasses.replace(scan, labels=self._table[scan.labels])

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read a prediction in the classes of the dataset, and map it."""
        return self._table[self.dataset.read_prediction(record, folder)]

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) mapped train ids as the raw ids of the map, in the dataset's layout."""
        path = Path(folder) / record.prediction
        dtype = np.uint8 if path.suffix == ".bin" else np.uint32
        return files.write_labels(path, self.taxonomy.to_raw(ids), dtype)

    @property
    def _table(self) -> np.ndarray:
        return self.classes.table(self.dataset.taxonomy)


def map_classes(dataset: Dataset, classes: ClassMap | None) -> Dataset:
    """Return a dataset with mapped classes; without a map, the dataset.

    Raises:
        InputError: if the map has none of the dataset's classes.
    """
    return dataset if classes is None else MappedDataset(dataset, classes)
