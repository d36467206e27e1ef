"""List the scans of a user's inputs: datasets, scan files, bags, and folders of these."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord, choose_records
from amvnet.data.datasets.open import is_dataset, open_dataset, with_classes
from amvnet.data.formats.bag_poses import BagPoses
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.find import NamedScan, list_scans, scan_stem
from amvnet.data.formats.raw import NUSCENES_ENDING
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.labels.legend import read_legend
from amvnet.data.labels.readers import read_scan_labels
from amvnet.data.labels.writers import KINDS, write_scan_labels
from amvnet.data.poses import Poses
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.files import inside
from amvnet.inference.segmentation import Segmentation
from amvnet.scan import Scan
from amvnet.sensors.built_in import lasers_of, weights_for
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.lidars import KNOWN_HEIGHTS, Sensor
from amvnet.sensors.measure import MEASURED_SCANS, Estimate, Recording
from amvnet.sensors.normalise import Normaliser, described_sensor, normalised
from amvnet.sensors.own_body import mark_own

MEASURED_HEIGHT = KNOWN_HEIGHTS["hdl64e"]  # of a sensor whose scans lie on the ground, metres


@dataclass(frozen=True)
class ScanOptions:
    """The choice of scans from the inputs.

    Attributes:
        sequences: the sequences or scenes to use of datasets; by default the sequences of `split`.
        topic: the topic to read in bags; by default the only one with scans.
        layout: the names of the columns in files that do not name them.
    """

    sequences: Sequence[str] | None = None
    split: str = "all"
    topic: str | None = None
    layout: RowLayout = UNKNOWN


@dataclass(frozen=True)
class LoadedScan:
    """A scan in memory.

    Attributes:
        file_xyz: (N, 3) the unchanged coordinates of the scan's file; None for a scan of a dataset.
    """

    scan: Scan
    file_xyz: np.ndarray | None = None


class InputScan(ABC):
    """A scan that is not read yet.

    Attributes:
        name: the name in messages, unique among the scans of one input.
        title: a short name for people who look at the scan.
        source: the recording of the scan: a sequence, a bag or a folder.
        scores_path: the path of the `.npz` of its scores, relative to a folder of predictions.
        bag: the poses of the bag that holds the scan; None if no bag does.
        corrected: the place of the scan's corrected labels, relative to the folder of the dataset.
    """

    bag: BagPoses | None = None
    corrected: str

    def __init__(self, name: str, title: str, source: str, path: Path, scores_path: Path) -> None:
        self.name = name
        self.title = title
        self.source = source
        self.path = path
        self.scores_path = scores_path

    @property
    @abstractmethod
    def files(self) -> list[Path]:
        """The files of the scan's points and labels."""

    @abstractmethod
    def load(self, labels: bool = False) -> LoadedScan:
        """Read the scan; if `labels`, with the ground truth, if there is any.

        Raises:
            InputError: if the scan cannot be read.
        """

    def poses(self, scans: Sequence[InputScan]) -> Poses | None:
        """Return the poses (N, 4, 4) that the dataset gives scans of this recording, or None."""
        return None

    @abstractmethod
    def labels_path(self, kind: str) -> Path:
        """Return the path of the scan's label file, relative to a folder of predictions.

        `kind` is the format, one of `writers.KINDS`; datasets have their own format.
        """

    @abstractmethod
    def read_labels(self, path: Path, count: int) -> np.ndarray:
        """Read the (N,) train ids of N = `count` points; raise InputError if they cannot be read.

        `path` is a folder of predictions, or the label file of a scan that is in no dataset.
        """

    def stored_labels(self, count: int) -> np.ndarray | None:
        """Return the (N,) train ids that `predict` or `map` wrote next to N = `count` points."""
        return None

    @abstractmethod
    def write_labels(
        self, folder: Path, loaded: LoadedScan, result: Segmentation, kind: str
    ) -> Path:
        """Write labels into a folder of predictions; return the path of the file."""


class DatasetScan(InputScan):
    """A scan of a dataset, whose labels have the dataset's format.

    Args:
        written: the classes of the labels that are written; by default the classes of the dataset.
        sensor: marks the points of the car's own body (`mark_own`); without it, none are marked.
    """

    def __init__(
        self,
        dataset: Dataset,
        record: ScanRecord,
        written: Taxonomy | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        scores_path = Path(record.prediction).with_suffix(".npz")
        super().__init__(
            record.name, _title_of(record), record.sequence, record.points_path, scores_path
        )
        self.dataset = dataset
        self.record = record
        self.written = written
        self.sensor = sensor
        place = dataset.place_of_labels(record)
        self.corrected = Path(os.path.relpath(place, dataset.root)).as_posix()

    @property
    def files(self) -> list[Path]:
        """The files of the scan's points and labels."""
        return self.dataset.files_of(self.record)

    def load(self, labels: bool = False) -> LoadedScan:
        """Read the scan."""
        scan = self.dataset.read(self.record, labels=labels)
        return LoadedScan(scan if self.sensor is None else mark_own(scan, self.sensor))

    def poses(self, scans: Sequence[InputScan]) -> Poses | None:
        """Return the poses of the dataset, if it has any."""
        records = [scan.record for scan in scans if isinstance(scan, DatasetScan)]
        return self.dataset.poses(records)

    def labels_path(self, kind: str) -> Path:
        """Return the path that the dataset gives predictions."""
        return Path(self.record.prediction)

    def read_labels(self, path: Path, count: int) -> np.ndarray:
        """Read labels from a folder of predictions."""
        return self.dataset.read_prediction(self.record, path)

    def write_labels(
        self, folder: Path, loaded: LoadedScan, result: Segmentation, kind: str
    ) -> Path:
        """Write the labels as a prediction of the dataset."""
        # The file may have vanished since it was read.
        count = len(loaded.scan)
        return self.dataset.write_prediction(
            self.record, folder, result.labels, self.written, count=count
        )


def _title_of(record: ScanRecord) -> str:
    if "/" in record.name:
        return record.name
    # The name is a token of nuScenes. The file's name is easier to read: it ends in the time.
    time = scan_stem(record.points_path).split("__")[-1]
    return f"{record.sequence}/{time}"


class FileReader:
    """Reads scan files, normalised to what some weights expect.

    Scans that were read to measure their sensor are kept until they are needed, so that no file is
    read twice.
    """

    def __init__(self, normaliser: Normaliser | None) -> None:
        self.normaliser = normaliser
        self.is_normalising = normaliser is not None and normaliser.expected is not None
        self._clouds: dict[tuple[str, str], Cloud] = {}  # by source and name; all of one source

    def scans(self, scans: Iterable[NamedScan], taxonomy: Taxonomy) -> list[FileScan]:
        """Return scans that this reader reads, those of a source in their order."""
        found = []
        for scan in scans:
            if self.normaliser is not None:
                self.normaliser.expect(scan.source, partial(self._read_and_keep, scan))
            found.append(FileScan(scan, self, taxonomy))
        return found

    def read(self, scan: NamedScan) -> LoadedScan:
        """Read a scan; raise InputError if it cannot be read, or no point is usable."""
        if self.normaliser is None:
            unchanged = scan.read()
            return LoadedScan(unchanged.to_scan(), unchanged.xyz)

        if self.is_normalising:
            self.normaliser.measure(scan.source)
        cloud = self._clouds.pop((scan.source, scan.name), None)
        if cloud is None:
            cloud = scan.read()
        return LoadedScan(self.normaliser(cloud, scan.source), cloud.xyz)

    def _read_and_keep(self, scan: NamedScan) -> Cloud:
        """Read one of the first scans of a source, and forget the scans of other sources."""
        if any(source != scan.source for source, _ in self._clouds):
            self._clouds.clear()
        cloud = scan.read()
        self._clouds[scan.source, scan.name] = cloud
        return cloud


class FileScan(InputScan):
    """A scan in a file or a bag."""

    def __init__(self, scan: NamedScan, reader: FileReader, taxonomy: Taxonomy) -> None:
        super().__init__(scan.name, scan.name, scan.source, scan.path, Path(f"{scan.name}.npz"))
        self.bag = scan.bag_poses
        self.corrected = f"{scan.name}.label"
        self.scan = scan
        self.reader = reader
        self.taxonomy = taxonomy

    @property
    def files(self) -> list[Path]:
        """The file that holds the scan, or all files of a bag that is a folder."""
        return [*self.path.iterdir()] if self.path.is_dir() else [self.path]

    def load(self, labels: bool = False) -> LoadedScan:
        """Read the scan; a scan file has no ground truth."""
        return self.reader.read(self.scan)

    def labels_path(self, kind: str) -> Path:
        """Return the name of the scan, with the format as its ending."""
        return Path(f"{self.name}.{kind}")

    def read_labels(self, path: Path, count: int) -> np.ndarray:
        """Read labels from a label file, or from a folder of predictions."""
        if path.is_dir():
            paths = [path / self.labels_path(kind) for kind in KINDS]
            path = next(filter(Path.is_file, paths), paths[0])
        return read_scan_labels(path, count, self.taxonomy)

    def stored_labels(self, count: int) -> np.ndarray | None:
        """Return the labels in the file of the points, if it names their classes."""
        classes = read_legend(self.path)
        if classes is None:
            return None
        if classes.classes != self.taxonomy.classes:
            found = describe_difference(self.taxonomy.classes, classes.classes, classes.name)
            raise InputError(
                f"{self.path}: expected labels with the classes of {self.taxonomy.name}, "
                f"found {found}; show this file alone"
            )
        return read_scan_labels(self.path, count, self.taxonomy)

    def write_labels(
        self, folder: Path, loaded: LoadedScan, result: Segmentation, kind: str
    ) -> Path:
        """Write the labels in one of the formats `writers.KINDS`."""
        assert loaded.file_xyz is not None
        return write_scan_labels(
            inside(folder, self.name),
            kind,
            loaded.file_xyz,
            result.labels,
            self.taxonomy,
            uncertain=result.uncertain if result.has_two_networks else None,
        )


# A scan that was read and segmented, or the error that prevented it.
Outcome = tuple[InputScan, LoadedScan | None, Segmentation | InputError]


class Inputs:
    """The inputs that a user names, in their order: datasets, and the scans of files and bags.

    `find_inputs` returns them, without reading a scan.
    """

    def __init__(
        self, parts: list[Dataset | list[NamedScan]], options: ScanOptions = ScanOptions()
    ) -> None:
        self._parts = parts
        self._options = options
        self._measured: dict[str, Estimate | None] = {}  # by source, in the first part

    def choose_weights(self, sensor: Sensor) -> tuple[str, str]:
        """Return the name of built-in weights for the first recording, and in words why these.

        This reads and measures the first scans; `scans` does not repeat it.

        Args:
            sensor: what is known about the sensor of scan files.
        """
        part = self._parts[0]
        if isinstance(part, Dataset):
            recordings = part.recordings()
            if not recordings:  # nothing of a benchmark is measured
                return weights_for(lasers_of(part.taxonomy), part.taxonomy)
            classes = part.taxonomy
            if part.described_sensor is not None and not sensor.is_known:
                sensor = described_sensor(part)
            source, scans = next(iter(recordings.items()))
            reads = [scan.read for scan in scans]
        else:
            classes = None
            source = part[0].source
            places = [place for place, scan in enumerate(part) if scan.source == source]
            reads = [partial(_read_for_later, part, place) for place in places]

        recording = Recording(sensor, MEASURED_HEIGHT)
        recording.learn(reads[:MEASURED_SCANS])
        usual = recording.usual
        # If the origin lies on the ground, the lasers were measured as if from this height.
        if recording.is_mixed or (usual is not None and not usual.frame.is_on_ground(sensor)):
            self._measured[source] = usual
        lasers = SensorGeometry() if usual is None else usual.lasers
        return weights_for(lasers.override(sensor), classes, recording.is_mixed)

    def scans(
        self,
        taxonomy: Taxonomy | None = None,
        normaliser: Normaliser | None = None,
        written: Taxonomy | None = None,
        official: bool = False,
    ) -> tuple[list[InputScan], Taxonomy]:
        """Return all scans in their order, and the classes of their labels.

        Args:
            taxonomy: the classes of the weights, or the classes that the user names. By default, a
                dataset has its own classes, a scan file has the classes that it names, one whose
                name ends in `.pcd.bin` has the classes of nuScenes, and any other scan file has the
                classes of SemanticKITTI.
            normaliser: normalises scan files to weights; without it, they stay unchanged.
            written: the classes of the labels that are written; by default the classes above.
            official: whether labels are written in the official formats of datasets, in which
                every point has a class, also of the car's own body.

        Raises:
            InputError: if the inputs have different classes, or a dataset lacks the named ones.
        """
        sensor = None
        if normaliser is not None and normaliser.expected is not None and not official:
            sensor = normaliser.sensor
        reader = FileReader(normaliser)
        scans: list[InputScan] = []
        taxonomies: list[Taxonomy] = []
        measured = self._measured
        for part in self._parts:
            if isinstance(part, Dataset):
                dataset = part if taxonomy is None else with_classes(part, taxonomy)
                if normaliser is not None:
                    dataset = normalised(dataset, normaliser, measured)
                options = self._options
                for record in choose_records(dataset, options.sequences, options.split):
                    scans.append(DatasetScan(dataset, record, written, sensor))
                taxonomies.append(dataset.taxonomy)
            else:
                if normaliser is not None:
                    normaliser.recall(measured)
                taxonomies.append(taxonomy or _classes_of(part[0]))
                scans += reader.scans(part, written or taxonomies[-1])
            measured = {}

        if len({input_taxonomy.classes for input_taxonomy in taxonomies}) > 1:
            raise InputError(
                "expected inputs with the same classes, found different ones; "
                "take them one after the other"
            )
        return scans, taxonomies[0]


def _classes_of(scan: NamedScan) -> Taxonomy:
    """Return the classes of a scan file's labels, if the user names none."""
    usual = NUSCENES if scan.ending == NUSCENES_ENDING else SEMANTICKITTI
    return read_legend(scan.path) or usual


class _ReadOnce:
    """Returns a cloud that was read already, and reads it if it is needed again."""

    def __init__(self, cloud: Cloud, read: Callable[[], Cloud]) -> None:
        self._cloud: Cloud | None = cloud
        self._read = read

    def __call__(self) -> Cloud:
        cloud, self._cloud = self._cloud, None
        return self._read() if cloud is None else cloud


def _read_for_later(scans: list[NamedScan], place: int) -> Cloud:
    """Read one of some scans, which will not be read again when it is needed."""
    scan = scans[place]
    cloud = scan.read()
    scans[place] = replace(scan, read=_ReadOnce(cloud, scan.read))
    return cloud


def find_inputs(specs: Sequence[str], options: ScanOptions = ScanOptions()) -> Inputs:
    """Return the inputs that a user names.

    Args:
        specs: each a dataset as `open_dataset` takes it, a scan file, a bag, a folder of these, or
            a pattern as `find_scans` takes it.

    Raises:
        InputError: if an input is missing or has no scan.
    """
    parts: list[Dataset | list[NamedScan]] = []
    for spec in specs:
        if is_dataset(spec):
            parts.append(open_dataset(spec))
        else:
            is_alone = len(specs) == 1
            parts.append(list(list_scans(spec, options.topic, options.layout, is_alone)))
    return Inputs(parts, options)


def list_inputs(
    inputs: Sequence[str],
    options: ScanOptions = ScanOptions(),
    taxonomy: Taxonomy | None = None,
    normaliser: Normaliser | None = None,
) -> tuple[list[InputScan], Taxonomy]:
    """List the scans of all inputs, in their order, as `Inputs.scans` returns them.

    Raises:
        InputError: as `find_inputs` and `Inputs.scans`.
    """
    return find_inputs(inputs, options).scans(taxonomy, normaliser)


class Scans(Sequence[Scan]):
    """The scans of a file, a bag, a folder or a dataset; each is read when it is asked for."""

    def __init__(self, path: Path | str, scans: Sequence[InputScan]) -> None:
        self.path = path
        self._scans = scans

    def __len__(self) -> int:
        return len(self._scans)

    @overload
    def __getitem__(self, index: int) -> Scan: ...

    @overload
    def __getitem__(self, index: slice) -> Scans: ...

    def __getitem__(self, index: int | slice) -> Scan | Scans:
        if isinstance(index, slice):
            return Scans(self.path, self._scans[index])
        return self._scans[index].load(labels=True).scan

    def __repr__(self) -> str:
        return f"<Scans of {self.path}: {len(self)}>"


def read(path: Path | str, topic: str | None = None) -> Scan:
    """Read the only scan of a file.

    The points have the coordinates of the file, and intensities scaled to [0, 1]. To segment the
    scan as `amvnet predict` does, give the path to a `Segmenter`, which also normalises the scan to
    its weights.

    Args:
        path: a scan file of any supported format, or a bag.
        topic: the topic to read in a bag; by default the only one with scans.

    Raises:
        InputError: if the file is missing, broken, of another format, or holds several scans.
    """
    scans = read_all(path, topic)
    if len(scans) > 1:
        raise InputError(
            f"{path}: expected one scan, found {len(scans)}; read them with amvnet.read_all"
        )
    return scans[0]


def read_all(path: Path | str, topic: str | None = None) -> Scans:
    """Return the scans of a file, a bag, a folder of these, or a dataset, with their labels if any.

    Args:
        path: a file, folder or dataset, as `amvnet predict` takes it as INPUT.
        topic: the topic to read in bags; by default the only one with scans.

    Returns:
        A sequence that reads each scan when it is asked for, as `read` does.

    Raises:
        InputError: if there is no scan.
    """
    scans, _ = list_inputs([str(path)], ScanOptions(topic=topic))
    return Scans(path, scans)
