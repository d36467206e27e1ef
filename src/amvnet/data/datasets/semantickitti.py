"""SemanticKITTI in its official layout: sequences/XX/velodyne, labels and predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data import scan_files as files
from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.predictions import read_prediction
from amvnet.data.taxonomy import SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.scan import Scan


@dataclass(frozen=True)
class SemanticKitti:
    """The scans below one folder; the interface is `records.Dataset`.

    Attributes:
        root: the folder that holds `sequences/`, or `sequences` itself.
        taxonomy: the classes; another one than the official where the labels were written with it.

    Raises:
        InputError: where `root` has no such layout.
    """

    root: Path
    taxonomy: Taxonomy = SEMANTICKITTI

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", Path(self.root))
        if not self._present():
            raise InputError(
                f"{self.root}: expected sequences/XX/velodyne/*.bin, found no folder XX/velodyne; "
                "give the folder that holds `sequences`"
            )

    @staticmethod
    def matches(root: Path) -> bool:
        """Whether a folder has this layout."""
        return any(root.glob("sequences/*/velodyne")) or any(root.glob("*/velodyne"))

    def sequences(self, split: str) -> tuple[str, ...]:
        """The sequences of "train", "val", "test" or "all" that are on disk; raises as `records.Dataset`."""
        present = self._present()
        splits = {**self.taxonomy.splits, "all": present}
        if split not in splits:
            raise InputError(
                f"{self.root}: expected a split of {', '.join(splits)}, found {split!r}; give one of them"
            )
        if found := tuple(sequence for sequence in splits[split] if sequence in present):
            return found
        raise InputError(
            f"{self.root}: expected a sequence of the {split} split ({', '.join(splits[split])}), "
            f"found {', '.join(present)}; name the sequences to use"
        )

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """The scans of these sequences in order; raises as `records.Dataset`."""
        return [record for sequence in sorted(set(sequences)) for record in self._records(sequence)]

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan; raises as `records.Dataset`."""
        points = files.read_kitti(record.points_path)
        ids = None
        if labels and record.labels_path is not None:
            ids = files.read_labels(
                record.labels_path, np.uint32, len(points), self.taxonomy.to_train
            )
        return Scan(points, labels=ids, name=record.name)

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read (N,) uint8 train ids; raises as `records.Dataset`."""
        return read_prediction(
            Path(folder) / record.prediction, np.uint32, self._count(record), self.taxonomy
        )

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) train ids as raw ids (uint32); raises as `records.Dataset`."""
        ids = files.check_count(ids, record.points_path, self._count(record))
        return files.write_labels(Path(folder) / record.prediction, self.taxonomy.to_raw(ids))

    @property
    def _folder(self) -> Path:
        inner = self.root / "sequences"
        return inner if inner.is_dir() else self.root

    def _present(self) -> tuple[str, ...]:
        return tuple(sorted(path.parent.name for path in self._folder.glob("*/velodyne")))

    def _count(self, record: ScanRecord) -> int:
        return files.count_rows(record.points_path, np.float32, files.KITTI_COLUMNS)

    def _records(self, sequence: str) -> list[ScanRecord]:
        folder = self._folder / sequence
        # What a killed program had begun to write has a name that begins with a dot.
        scans = sorted(
            path for path in (folder / "velodyne").glob("*.bin") if not path.name.startswith(".")
        )
        if not scans:
            raise InputError(
                f"{folder / 'velodyne'}: expected the scans *.bin of sequence {sequence}, found none; "
                f"there is {', '.join(self._present())}"
            )
        labelled = any((folder / "labels").glob("*.label"))
        return [
            ScanRecord(
                name=f"{sequence}/{scan.stem}",
                sequence=sequence,
                points_path=scan,
                labels_path=folder / "labels" / f"{scan.stem}.label" if labelled else None,
                prediction=f"sequences/{sequence}/predictions/{scan.stem}.label",
            )
            for scan in scans
        ]
