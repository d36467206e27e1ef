"""A dataset with other classes: those of its own, mapped."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data import scan_files as files
from amvnet.data.class_maps import ClassMap
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.predictions import read_prediction
from amvnet.data.datasets.wrapped import WrappedDataset
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.scan import Scan


@dataclass(frozen=True)
class MappedDataset(WrappedDataset):
    """The scans of a dataset, with mapped labels. `Dataset` documents the methods and their errors.

    Attributes:
        dataset: has the scans, and labels and predictions of its own classes.
        classes: maps these to the classes of this dataset.
        is_prediction_mapped: whether predictions are read in the ids of the map, as
            `write_prediction` writes them; else in those of the dataset.

    Raises:
        InputError: if the map has none of the dataset's classes.
    """

    classes: ClassMap
    is_prediction_mapped: bool = False

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
        """Read a prediction in the classes of the dataset, and map it; or one that is mapped."""
        if self.is_prediction_mapped:
            return self._read_mapped(record, folder)
        try:
            own_ids = self.dataset.read_prediction(record, folder)
        except InputError:
            if self._is_mapped(record, folder):
                raise InputError(
                    f"{Path(folder) / record.prediction}: expected the ids of "
                    f"{self.dataset.taxonomy.name}, found those of {self.taxonomy.name}; "
                    "say --mapped"
                ) from None
            raise
        return self._table[own_ids]

    def _read_mapped(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read a prediction that has the ids of the map."""
        path, dtype = self._prediction_file(record, folder)
        count = len(self.read(record, labels=False))
        return read_prediction(path, dtype, count, self.taxonomy)

    def _is_mapped(self, record: ScanRecord, folder: Path) -> bool:
        """Return whether a prediction can be read with the ids of the map."""
        try:
            self._read_mapped(record, folder)
        except InputError:
            return False
        return True

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) mapped train ids as the raw ids of the map, in the dataset's layout."""
        _, dtype = self._prediction_file(record, folder)
        path = inside(folder, record.prediction)
        return files.write_labels(path, self.taxonomy.to_raw(ids), dtype)

    def _prediction_file(self, record: ScanRecord, folder: Path) -> tuple[Path, type[np.integer]]:
        """Return the file of a prediction in the dataset's layout, and the type of its ids."""
        path = Path(folder) / record.prediction
        return path, np.uint8 if path.suffix == ".bin" else np.uint32

    @property
    def _table(self) -> np.ndarray:
        return self.classes.table(self.dataset.taxonomy)


def map_classes(
    dataset: Dataset, classes: ClassMap | None, is_prediction_mapped: bool = False
) -> Dataset:
    """Return a dataset with mapped classes, as `MappedDataset` has it; without a map, the dataset.

    Raises:
        InputError: if the map has none of the dataset's classes.
    """
    return dataset if classes is None else MappedDataset(dataset, classes, is_prediction_mapped)
