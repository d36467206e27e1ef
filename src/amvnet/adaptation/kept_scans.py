"""Scans that are kept in a folder as the networks take them: adapted to the weights, and cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from amvnet.data.datasets.base import ScanRecord
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.scan import Scan


@dataclass(frozen=True)
class KeptScans:
    """A folder of scans. `Dataset` documents the methods and their errors.

    Attributes:
        root: the folder.
        taxonomy: the classes.
        count: number of scans.
        labelled: whether the scans have labels.
        is_adapted: whether the rings of the scans are the rows of the range image.
    """

    root: Path
    taxonomy: Taxonomy
    count: int
    labelled: bool
    is_adapted: bool

    @property
    def spec(self) -> str:
        """The folder, for records; `open_dataset` does not open it."""
        return str(self.root)

    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the only sequence."""
        return (self.root.name,)

    def records(self, sequences: Sequence[str] = ()) -> list[ScanRecord]:
        """Return all scans."""
        records = []
        for index in range(self.count):
            path = self.path(index)
            record = ScanRecord(
                name=path.stem,
                sequence=self.root.name,
                points_path=path,
                labels_path=path if self.labelled else None,
                prediction=f"{path.stem}.label",
            )
            records.append(record)
        return records

    def path(self, index: int) -> Path:
        """Return the file of a scan."""
        return self.root / f"{index:06d}.npz"

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        """Return the scan itself."""
        return record

    def keep(self, index: int, scan: Scan) -> None:
        """Write a scan; its labels only if the scans are to have some."""
        arrays = {"points": scan.points}
        if scan.ring is not None:
            arrays["ring"] = scan.ring.astype(np.int16)
        if self.labelled:
            assert scan.labels is not None
            arrays["labels"] = scan.labels
        with atomic_write(self.path(index)) as part:
            np.savez(part, **arrays)  # type: ignore[arg-type]  # NumPy's stub of the keywords

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan."""
        try:
            with np.load(record.points_path, allow_pickle=False) as file:
                return Scan(
                    file["points"],
                    labels=file["labels"] if labels and self.labelled else None,
                    ring=file["ring"].astype(np.int64) if "ring" in file else None,
                    name=record.name,
                )
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            raise InputError(
                f"{record.points_path}: expected a scan that adapt kept, found a broken file; "
                "delete it and resume"
            ) from None

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Refuse: nobody predicts these scans under their names here."""
        raise NotImplementedError

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Refuse: nobody predicts these scans under their names here."""
        raise NotImplementedError
