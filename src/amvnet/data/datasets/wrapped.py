"""A dataset that changes another one; what it does not change is that of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import Taxonomy
from amvnet.scan import Scan


@dataclass(frozen=True)
class WrappedDataset:
    """The base of such datasets. `Dataset` documents the methods and their errors.

    Attributes:
        dataset: the other one.
    """

    dataset: Dataset

    @property
    def taxonomy(self) -> Taxonomy:
        return self.dataset.taxonomy

    @property
    def root(self) -> Path:
        return self.dataset.root

    @property
    def spec(self) -> str:
        return self.dataset.spec

    @property
    def is_adapted(self) -> bool:
        return self.dataset.is_adapted

    def sequences(self, split: str) -> tuple[str, ...]:
        return self.dataset.sequences(split)

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        return self.dataset.records(sequences)

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        return self.dataset.at_epoch(record, epoch)

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        return self.dataset.read(record, labels)

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        return self.dataset.read_prediction(record, folder)

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        return self.dataset.write_prediction(record, folder, ids)
