"""From what a user names to scans: datasets, scan files, bags, and folders of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord, choose_records
from amvnet.data.datasets.open import open_if_dataset
from amvnet.data.formats.detect import NamedScan, ending_of, list_scans, scan_stem
from amvnet.data.formats.raw import NUSCENES_ENDING
from amvnet.data.label_files import write_scan_labels
from amvnet.data.scan_files import read_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, ScanAdapter
from amvnet.sensors.lidars import Sensor
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class ScanOptions:
    """Which scans of the inputs to use.

    Attributes:
        sequences: of datasets, these sequences or scenes; None means those of `split`.
        split: of datasets, the official split.
        topic: of bags; None means the only topic with PointCloud2 messages.
    """

    sequences: Sequence[str] | None = None
    split: str = "all"
    topic: str | None = None


@dataclass(frozen=True)
class LoadedScan:
    """A scan in memory.

    Attributes:
        scan: for the segmenter.
        file_xyz: (N, 3) the coordinates in the scan's file; None for a scan of a dataset.
    """

    scan: Scan
    file_xyz: np.ndarray | None = None


@dataclass(frozen=True)
class LabelFormat:
    """How labels of scan files are written.

    Attributes:
        kind: one of `label_files.KINDS`.
        taxonomy: of the raw ids.
    """

    kind: str
    taxonomy: Taxonomy


class InputScan(Protocol):
    """One scan of the inputs, not read yet."""

    @property
    def name(self) -> str:
        """The name in messages, unique among the scans of one input."""

    @property
    def title(self) -> str:
        """A short name for people who look at the scan."""

    @property
    def scores_path(self) -> Path:
        """Where the `.npz` of its scores lies, relative to a folder of predictions."""

    @property
    def path(self) -> Path:
        """The file that the scan is read from."""

    @property
    def is_adapted(self) -> bool:
        """Whether `ring` is the row of the range image of each point, see `Segmenter.by_ring`."""

    def load(self, labels: bool = False) -> LoadedScan:
        """Read the scan, with ground truth if there is any and it is asked for.

        Raises:
            InputError: if it cannot be read.
        """

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        """Read (N,) train ids of its `count` points from a folder of predictions, or a file.

        Raises:
            InputError: if they cannot be read.
        """

    def write_labels(
        self, out: Path, form: LabelFormat, loaded: LoadedScan, labels: Labels
    ) -> Path:
        """Write the labels into a folder of predictions; return the path of the file."""


@dataclass(frozen=True)
class Labels:
    """(N,) train ids of a scan, and (N,) bool, the uncertain points; None if that is not known."""

    ids: np.ndarray
    uncertain: np.ndarray | None = None


@dataclass(frozen=True)
class DatasetScan:
    """A scan of a dataset."""

    dataset: Dataset
    record: ScanRecord
    is_adapted = False

    @property
    def name(self) -> str:
        return self.record.name

    @property
    def title(self) -> str:
        if "/" in self.record.name:
            return self.record.name
        # nuScenes: a token says nothing to people; the last part of the file's name is the time.
        time = scan_stem(self.record.points_path).split("__")[-1]
        return f"{self.record.sequence}/{time}"

    @property
    def scores_path(self) -> Path:
        return Path(self.record.prediction).with_suffix(".npz")

    @property
    def path(self) -> Path:
        return self.record.points_path

    def load(self, labels: bool = False) -> LoadedScan:
        return LoadedScan(self.dataset.read(self.record, labels=labels))

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        return self.dataset.read_prediction(self.record, path)

    def write_labels(
        self, out: Path, form: LabelFormat, loaded: LoadedScan, labels: Labels
    ) -> Path:
        return self.dataset.write_prediction(self.record, out, labels.ids)


def adapter_for(
    weights: Weights, given: Sensor | None = None, say: Say = say_nothing
) -> ScanAdapter:
    """Return what adapts scan files to some weights; see `ScanAdapter`."""
    return ScanAdapter(weights.model.range_view, weights.sensor, given, say)


class FileReader:
    """Reads scan files, adapted to what some weights expect.

    Whichever scan of a source is read first, after an interruption or in another process, the
    first scans of the source are measured: all of its scans are adapted in the same way.

    Args:
        adapter: adapts the scans; None reads them as they are.
    """

    def __init__(self, adapter: ScanAdapter | None) -> None:
        self.adapter = adapter
        self._first: dict[str, list[NamedScan]] = {}

    def add(self, scan: NamedScan) -> None:
        """Take note of a scan, in the order of its source."""
        first = self._first.setdefault(scan.source, [])
        if len(first) < MEASURED:
            first.append(scan)

    def read(self, scan: NamedScan) -> LoadedScan:
        if self.adapter is None:
            cloud = scan.read()
            return LoadedScan(cloud.to_scan(), cloud.xyz)

        to_measure = self._first.pop(scan.source, [])
        self.adapter.learn(scan.source, [first.read for first in to_measure])
        cloud = scan.read()
        return LoadedScan(self.adapter(cloud, scan.source), cloud.xyz)


@dataclass(frozen=True)
class FileScan:
    """A scan in a file or a bag."""

    scan: NamedScan
    reader: FileReader

    @property
    def name(self) -> str:
        return self.scan.name

    @property
    def title(self) -> str:
        return self.scan.name

    @property
    def scores_path(self) -> Path:
        return Path(f"{self.scan.name}.npz")

    @property
    def path(self) -> Path:
        return self.scan.path

    @property
    def is_adapted(self) -> bool:
        return self.reader.adapter is not None

    def load(self, labels: bool = False) -> LoadedScan:
        return self.reader.read(self.scan)

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        file = path / f"{self.scan.name}.label" if path.is_dir() else path
        return read_labels(file, np.uint32, count, taxonomy.to_train)

    def write_labels(
        self, out: Path, form: LabelFormat, loaded: LoadedScan, labels: Labels
    ) -> Path:
        assert loaded.file_xyz is not None
        return write_scan_labels(
            out / self.scan.name,
            form.kind,
            loaded.file_xyz,
            labels.ids,
            form.taxonomy,
            uncertain=labels.uncertain,
        )


class Inputs:
    """The scans that a user named, and the classes of their labels.

    Args:
        options: which scans of the inputs to use.
        taxonomy: the classes, of weights or as the user names them. If None, they are those of the
            datasets; scan files have nuScenes' if they end in `.pcd.bin`, else SemanticKITTI's.
        adapter: adapts scan files to weights; None reads them as they are.

    Attributes:
        scans: in the order of the inputs.
    """

    def __init__(
        self,
        options: ScanOptions,
        taxonomy: Taxonomy | None = None,
        adapter: ScanAdapter | None = None,
    ) -> None:
        self.scans: list[InputScan] = []
        self._options = options
        self._named_taxonomy = taxonomy
        self._taxonomies: list[Taxonomy] = []
        self._reader = FileReader(adapter)

    @property
    def taxonomy(self) -> Taxonomy:
        return self._taxonomies[0]

    def open(self, inputs: Sequence[str]) -> None:
        """List the scans of all inputs.

        Args:
            inputs: each a dataset as `open_dataset` takes it, a scan file, a bag, or a folder of
                these.

        Raises:
            InputError: if an input is missing or has no scan, or the inputs have different classes.
        """
        options = self._options
        for text in inputs:
            dataset = open_if_dataset(text, self._named_taxonomy)
            if dataset is not None:
                for record in choose_records(dataset, options.sequences, options.split):
                    self.scans.append(DatasetScan(dataset, record))
                self._taxonomies.append(dataset.taxonomy)
            else:
                for scan in list_scans(text, options.topic):
                    self._reader.add(scan)
                    self.scans.append(FileScan(scan, self._reader))
                self._taxonomies.append(self._named_taxonomy or _usual_taxonomy(self.scans[-1]))

        if len({taxonomy.classes for taxonomy in self._taxonomies}) > 1:
            raise InputError(
                "expected inputs with the same classes, found several; "
                "take them one after the other"
            )


def _usual_taxonomy(scan: InputScan) -> Taxonomy:
    """Return the classes that labels of a scan file have if nobody names them."""
    return NUSCENES if ending_of(scan.path) == NUSCENES_ENDING else SEMANTICKITTI
