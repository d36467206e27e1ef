"""Scan files and bags as a dataset: without splits and without labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.data.formats.raw import NUSCENES_ENDING
from amvnet.data.labels.readers import read_scan_labels
from amvnet.data.labels.writers import KINDS, read_legend, write_scan_labels
from amvnet.data.recordings import Normalise, Recording, ScanFile, by_recording
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.scan import Scan


class ScanFiles(Dataset):
    """Scans in files and bags. `Dataset` documents the arguments and errors of its methods.

    Args:
        scans: what `list_scans` finds.
        taxonomy: the classes of their labels.
    """

    def __init__(self, scans: Iterable[ScanFile], taxonomy: Taxonomy = SEMANTICKITTI) -> None:
        super().__init__(Path(), taxonomy)
        self._scans = [replace(scan, dataset=self) for scan in scans]

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return no sequences: files have no splits."""
        return {"all": ()}

    def sequences(self, name: str) -> tuple[str, ...]:
        """Return no sequences."""
        return ()

    def records(self, sequences: Sequence[str] = ()) -> list[ScanFile]:
        """Return all scans, whatever sequences of datasets are chosen."""
        return self._scans

    def recordings(self) -> list[Recording]:
        """Return the bags, and the folders with the files of one ending."""
        return list(by_recording(self._scans))

    def normalised_by(self, normalise: Normalise) -> ScanFiles:
        """Return the same scans, normalised."""
        recordings = {recording: normalise(recording) for recording in self.recordings()}
        scans = (replace(scan, recording=recordings[scan.recording]) for scan in self._scans)
        return ScanFiles(scans, self.taxonomy)

    def with_classes(self, taxonomy: Taxonomy) -> ScanFiles:
        """Return the same scans with other classes."""
        return ScanFiles(self._scans, taxonomy)

    def named_classes(self) -> Taxonomy:
        """Return the classes that the first file names, or those that its name stands for."""
        usual = NUSCENES if self._scans[0].ending == NUSCENES_ENDING else SEMANTICKITTI
        return read_legend(self._scans[0].path) or usual

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan, which keeps the coordinates of its file."""
        return record.recording.scan(record)

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Do not call this: no scan has labels."""
        raise NotImplementedError

    def files_of(self, record: ScanFile) -> list[Path]:
        """Return the file that holds the scan, or all files of a bag that is a folder."""
        return [*record.path.iterdir()] if record.path.is_dir() else [record.path]

    def place_of_prediction(self, record: ScanFile, kind: str) -> Path:
        """Return the name of the scan, with the format as its ending."""
        return Path(f"{record.name}.{kind}")

    def stored_labels(self, record: ScanFile, count: int) -> np.ndarray | None:
        """Return the labels in the file of the points, if it names their classes."""
        classes = read_legend(record.path)
        if classes is None:
            return None
        if classes.classes != self.taxonomy.classes:
            found = describe_difference(self.taxonomy.classes, classes.classes, classes.name)
            raise InputError(
                f"{record.path}: expected labels with the classes of {self.taxonomy.name}, "
                f"found {found}; show this file alone"
            )
        return read_scan_labels(record.path, count, self.taxonomy)

    def read_prediction(
        self,
        record: ScanFile,
        folder: Path,
        count: int | None = None,
        taxonomy: Taxonomy | None = None,
    ) -> np.ndarray:
        """Read labels from a folder of predictions, or from the label file of the only scan."""
        if folder.is_dir():
            paths = [folder / self.place_of_prediction(record, kind) for kind in KINDS]
            folder = next(filter(Path.is_file, paths), paths[0])
        count = count or self.count_points(record)
        return read_scan_labels(folder, count, taxonomy or self.taxonomy)

    def write_labels(
        self,
        record: ScanFile,
        folder: Path,
        scan: Scan,
        ids: np.ndarray,
        *,
        taxonomy: Taxonomy | None = None,
        kind: str = "label",
        uncertain: np.ndarray | None = None,
    ) -> Path:
        """Write the labels in one of the formats `writers.KINDS`."""
        assert scan.file_xyz is not None
        path = inside(folder, record.name)
        taxonomy = taxonomy or self.taxonomy
        return write_scan_labels(path, kind, scan.file_xyz, ids, taxonomy, uncertain=uncertain)
