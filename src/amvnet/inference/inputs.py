"""The scans of a user's inputs: datasets, scan files, bags, and folders of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord, choose_records
from amvnet.data.datasets.open import open_if_dataset, open_with_classes
from amvnet.data.datasets.own import OwnScans
from amvnet.data.formats.cloud import Cloud, Message
from amvnet.data.formats.detect import NamedScan, ending_of, list_scans, scan_stem
from amvnet.data.formats.raw import NUSCENES_ENDING
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.labels import label_bags
from amvnet.data.labels.readers import read_scan_labels
from amvnet.data.labels.writers import KINDS, label_points, write_scan_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, ScanAdapter
from amvnet.sensors.intensity import trained_intensity
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.own import adapted_by
from amvnet.sensors.plain import PlainAdapter
from amvnet.sensors.record import is_trained_as_is, trained_sensor
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class ScanOptions:
    """Which scans of the inputs to use.

    Attributes:
        sequences: of datasets, these sequences or scenes; None means those of `split`.
        split: of datasets, the official split.
        topic: of bags; None means the only topic with scans.
        layout: of rows of numbers without names, what they hold.
    """

    sequences: Sequence[str] | None = None
    split: str = "all"
    topic: str | None = None
    layout: RowLayout = UNKNOWN


@dataclass(frozen=True)
class LoadedScan:
    """A scan in memory.

    Attributes:
        scan: as the segmenter takes it.
        file_xyz: (N, 3) the coordinates as they are in the scan's file; None for a scan of a
            dataset.
    """

    scan: Scan
    file_xyz: np.ndarray | None = None


@dataclass(frozen=True)
class LabelFormat:
    """How labels of scan files are written.

    Attributes:
        kind: one of `writers.KINDS` or `label_bags.KINDS`.
        taxonomy: turns train ids into the raw ids that are written.
    """

    kind: str
    taxonomy: Taxonomy


class InputScan(Protocol):
    """One scan of the inputs, not read yet."""

    @property
    def name(self) -> str:
        """The name for messages, unique among the scans of one input."""

    @property
    def title(self) -> str:
        """A short name for people who look at the scan."""

    @property
    def scores_path(self) -> Path:
        """The path of the `.npz` of its scores, relative to a folder of predictions."""

    def labels_path(self, kind: str) -> Path:
        """Return the path of the file of its labels, relative to a folder of predictions.

        Args:
            kind: the format for scan files; datasets have their own. Of bags, the file is a part of
                the bag.
        """

    @property
    def path(self) -> Path:
        """The file that the scan is read from."""

    @property
    def is_adapted(self) -> bool:
        """Whether `ring` is the row of each point in the range image, for `Segmenter.by_ring`."""

    def load(self, labels: bool = False) -> LoadedScan:
        """Read the scan.

        Args:
            labels: whether to read the ground truth too, if there is any.

        Raises:
            InputError: if it cannot be read.
        """

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        """Read the (N,) train ids of the scan's points.

        Args:
            path: a folder of predictions; for scan files, also a label file.
            count: N.
            taxonomy: turns the raw ids of scan files into train ids; datasets have their own.

        Raises:
            InputError: if they cannot be read.
        """

    def write_labels(
        self, out: Path, form: LabelFormat, labels: Labels, file_xyz: np.ndarray | None
    ) -> Path:
        """Write the labels into a folder of predictions.

        Args:
            out: the folder.
            form: the format for scan files; datasets have their own.
            labels: of the scan's points.
            file_xyz: as of `LoadedScan`.

        Returns:
            The path of the file.
        """


@dataclass(frozen=True)
class Labels:
    """The labels of a scan with N points.

    Attributes:
        ids: (N,) train ids.
        uncertain: (N,) bool, the uncertain points; None if unknown.
    """

    ids: np.ndarray
    uncertain: np.ndarray | None = None


@dataclass(frozen=True)
class DatasetScan:
    """A scan of a dataset.

    Attributes:
        dataset: has the scan.
        record: its files.
        written: the classes of the labels that are written; None means those of the dataset.
    """

    dataset: Dataset
    record: ScanRecord
    written: Taxonomy | None = None

    @property
    def is_adapted(self) -> bool:
        return self.dataset.is_adapted

    @property
    def name(self) -> str:
        return self.record.name

    @property
    def title(self) -> str:
        if "/" in self.record.name:
            return self.record.name
        # The name is a token of nuScenes. The file's name is easier to read: it ends in the time.
        time = scan_stem(self.record.points_path).split("__")[-1]
        return f"{self.record.sequence}/{time}"

    @property
    def scores_path(self) -> Path:
        return Path(self.record.prediction).with_suffix(".npz")

    def labels_path(self, kind: str) -> Path:
        return Path(self.record.prediction)

    @property
    def path(self) -> Path:
        return self.record.points_path

    def load(self, labels: bool = False) -> LoadedScan:
        return LoadedScan(self.dataset.read(self.record, labels=labels))

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        return self.dataset.read_prediction(self.record, path)

    def write_labels(
        self, out: Path, form: LabelFormat, labels: Labels, file_xyz: np.ndarray | None
    ) -> Path:
        return self.dataset.write_prediction(self.record, out, labels.ids, self.written)


def adapter_for(
    weights: Weights, given: Sensor | None = None, say: Say = say_nothing
) -> ScanAdapter:
    """Return a `ScanAdapter` of scan files for some weights.

    Args:
        given: what is known of the sensor; the rest is measured.
        say: is told what was assumed of the sensor.
    """
    intensity = trained_intensity(weights.training, weights.sensor)
    trained = trained_sensor(weights.training, weights.sensor)
    return ScanAdapter(
        weights.model.range_view,
        trained,
        given,
        say=say,
        intensity=intensity,
        as_is=is_trained_as_is(weights.training),
    )


def open_for_weights(spec: str, weights: Weights, dataset: Dataset | None = None) -> Dataset:
    """Open a dataset whose scans are read as some weights expect them.

    The scans of the benchmarks are as they are; a user's own are adapted as `predict` does.

    Args:
        spec: as `open_dataset` takes it.
        weights: the weights.
        dataset: the dataset, if it is open.

    Raises:
        InputError: as `open_with_classes`.
    """
    dataset = dataset or open_with_classes(spec, weights.taxonomy)
    if isinstance(dataset, OwnScans):
        return adapted_by(dataset, adapter_for(weights))
    return dataset


class FileReader:
    """Reads scan files, adapted to what some weights expect.

    All scans of a source are adapted alike, by measurements of its first scans. These are measured
    even if another scan is read first, as after an interruption or in one of several processes.

    Args:
        adapter: adapts the scans; None reads them as they are.
    """

    def __init__(self, adapter: ScanAdapter | PlainAdapter | None) -> None:
        self.adapter = adapter
        self.messages: dict[str, Message] = {}  # of scans in bags, by name, until they are written
        self._first: dict[str, list[NamedScan]] = {}

    def add(self, scan: NamedScan) -> None:
        """Make a scan known; call this for the scans of a source in their order."""
        first = self._first.setdefault(scan.source, [])
        if len(first) < MEASURED:
            first.append(scan)

    def read(self, scan: NamedScan) -> LoadedScan:
        """Read a scan.

        Raises:
            InputError: if it cannot be read, or no point is usable.
        """
        if self.adapter is None:
            cloud = self._read(scan)
            return LoadedScan(cloud.to_scan(), _file_xyz(cloud))

        to_measure = self._first.pop(scan.source, [])
        self.adapter.learn(scan.source, [first.read for first in to_measure])
        cloud = self._read(scan)
        return LoadedScan(self.adapter(cloud, scan.source), _file_xyz(cloud))

    def _read(self, scan: NamedScan) -> Cloud:
        cloud = scan.read()
        if cloud.message is not None:
            self.messages[scan.name] = cloud.message
        return cloud


def _file_xyz(cloud: Cloud) -> np.ndarray:
    """Return the (N, 3) coordinates as they are in the file."""
    return cloud.xyz if cloud.file_xyz is None else cloud.file_xyz


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

    def labels_path(self, kind: str) -> Path:
        if kind in label_bags.KINDS:
            return label_bags.part_path(self.scan.name, kind)
        return Path(f"{self.scan.name}.{kind}")

    @property
    def path(self) -> Path:
        return self.scan.path

    @property
    def is_adapted(self) -> bool:
        return isinstance(self.reader.adapter, ScanAdapter)

    def load(self, labels: bool = False) -> LoadedScan:
        return self.reader.read(self.scan)

    def read_labels(self, path: Path, count: int, taxonomy: Taxonomy) -> np.ndarray:
        if path.is_dir():
            stem = path / self.scan.name
            paths = [stem.with_name(f"{stem.name}.{kind}") for kind in KINDS]
            path = next(filter(Path.is_file, paths), paths[0])
        return read_scan_labels(path, count, taxonomy)

    def write_labels(
        self, out: Path, form: LabelFormat, labels: Labels, file_xyz: np.ndarray | None
    ) -> Path:
        assert file_xyz is not None
        message = self.reader.messages.pop(self.scan.name, None)
        if form.kind in label_bags.KINDS:
            assert message is not None  # predict checks that the scan is from a bag
            points = label_points(file_xyz, labels.ids, form.taxonomy, labels.uncertain)
            return label_bags.write_part(out, self.scan.name, form.kind, message, points)
        return write_scan_labels(
            inside(out, self.scan.name),
            form.kind,
            file_xyz,
            labels.ids,
            form.taxonomy,
            uncertain=labels.uncertain,
        )


@dataclass(frozen=True)
class Inputs:
    """The scans of all inputs, and the classes of their labels.

    Attributes:
        scans: in the order of the inputs.
        taxonomies: of each input; they have the same classes.
    """

    scans: Sequence[InputScan]
    taxonomies: Sequence[Taxonomy]

    @property
    def taxonomy(self) -> Taxonomy:
        return self.taxonomies[0]


def open_inputs(
    inputs: Sequence[str],
    options: ScanOptions,
    taxonomy: Taxonomy | None = None,
    adapter: ScanAdapter | PlainAdapter | None = None,
) -> Inputs:
    """List the scans of all inputs.

    Args:
        inputs: each a dataset as `open_dataset` takes it, a scan file, a bag, a folder of these, or
            a pattern as `find_scans` takes it.
        options: which scans of the inputs to use.
        taxonomy: the classes, of weights or as the user names them. If None, they are those of the
            datasets; scan files have nuScenes' if they end in `.pcd.bin`, else SemanticKITTI's.
        adapter: adapts scan files to weights; None reads them as they are.

    Raises:
        InputError: if an input is missing or has no scan, or the inputs have different classes.
    """
    reader = FileReader(adapter)
    scans: list[InputScan] = []
    taxonomies: list[Taxonomy] = []
    for text in inputs:
        dataset = open_if_dataset(text, taxonomy)
        if dataset is not None:
            if isinstance(dataset, OwnScans) and adapter is not None:
                dataset = adapted_by(dataset, adapter)
            for record in choose_records(dataset, options.sequences, options.split):
                scans.append(DatasetScan(dataset, record))
            taxonomies.append(dataset.taxonomy)
        else:
            files = list(list_scans(text, options.topic, options.layout))
            for scan in files:
                reader.add(scan)
                scans.append(FileScan(scan, reader))
            taxonomies.append(taxonomy or _usual_taxonomy(files[0]))

    if len({input_taxonomy.classes for input_taxonomy in taxonomies}) > 1:
        raise InputError(
            "expected inputs with the same classes, found different ones; "
            "take them one after the other"
        )
    return Inputs(scans, taxonomies)


def _usual_taxonomy(scan: NamedScan) -> Taxonomy:
    """Return the classes of a scan file's labels if the user names none."""
    return NUSCENES if ending_of(scan.path) == NUSCENES_ENDING else SEMANTICKITTI
