"""List the scans of a user's inputs: datasets, scan files, bags, and folders of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import overload

from amvnet.data.datasets.base import Dataset, choose_records
from amvnet.data.datasets.files import ScanFiles
from amvnet.data.datasets.open import is_dataset, open_dataset, with_classes
from amvnet.data.formats.find import list_scans
from amvnet.data.recordings import Recording, ScanFile, by_recording, name_apart
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.progress import Reporter, report_nothing
from amvnet.scan import Scan
from amvnet.sensors.built_in import lasers_of, weights_for
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.lidars import KNOWN_HEIGHTS
from amvnet.sensors.measure import MEASURED_SCANS, Estimate, Measured
from amvnet.sensors.normalise import Normaliser, described_sensor, normalised
from amvnet.sensors.own_body import mark_own
from amvnet.sensors.reading import AS_FOUND, Reading
from amvnet.weights.file import Weights

MEASURED_HEIGHT = KNOWN_HEIGHTS["hdl64e"]  # of a sensor whose scans lie on the ground, metres


@dataclass(eq=False)
class Inputs:
    """The inputs that a user names: `find_inputs` returns them, without reading a scan.

    Attributes:
        parts: datasets, and the scans of files and bags, in the user's order.
        reading: how files and bags are read.
        sequences: the sequences or scenes to use of datasets; by default the sequences of `split`.
    """

    parts: Sequence[Dataset]
    reading: Reading = AS_FOUND
    sequences: Sequence[str] | None = None
    split: str = "all"
    # The recording that chose the weights, and what was measured of it.
    _known: tuple[Recording, Estimate | None] | None = field(default=None, init=False)

    @property
    def taxonomies(self) -> list[Taxonomy]:
        """The classes of the datasets among the inputs."""
        return [part.taxonomy for part in self.parts if not isinstance(part, ScanFiles)]

    def choose_weights(self) -> tuple[str, str]:
        """Return the name of built-in weights for the first recording, and in words why these.

        This reads and measures the first scans; `scans` does not repeat it.

        Raises:
            InputError: if the only scan of the inputs cannot be read.
        """
        sensor = self.reading.sensor
        part = self.parts[0]
        classes = None if isinstance(part, ScanFiles) else part.taxonomy
        recordings = part.recordings()
        if not recordings:  # nothing of a benchmark is measured
            return weights_for(lasers_of(part.taxonomy), part.taxonomy)
        if part.described_sensor is not None and not sensor.is_known:
            sensor = described_sensor(part)

        measured = Measured(sensor, MEASURED_HEIGHT)
        measured.learn(recordings[0].first(MEASURED_SCANS))
        usual = measured.usual
        scans = [scan for each in self.parts for one in each.recordings() for scan in one.scans]
        if usual is None and len(scans) == 1:
            recordings[0].read(scans[0], keep=True)
        # If the origin lies on the ground, the lasers were measured as if from this height.
        if measured.is_mixed or (usual is not None and not usual.frame.is_on_ground(sensor)):
            self._known = (recordings[0], usual)
        lasers = SensorGeometry() if usual is None else usual.lasers
        return weights_for(lasers.override(sensor), classes, measured.is_mixed)

    def for_weights(
        self, weights: Weights, report: Reporter = report_nothing, official: bool = False
    ) -> list[ScanFile]:
        """Return all scans, normalised to weights; the arguments and errors are as for `scans`."""
        normaliser = Normaliser(weights.expects, self.reading.sensor, report)
        return self.scans(weights.taxonomy, normaliser, official)[0]

    def scans(
        self,
        taxonomy: Taxonomy | None = None,
        normaliser: Normaliser | None = None,
        official: bool = False,
    ) -> tuple[list[ScanFile], Taxonomy]:
        """Return all scans, recording by recording, and the classes of their labels.

        Args:
            taxonomy: the classes of the weights, or the classes that the user names. By default, a
                dataset has its own classes, a scan file has the classes that it names, one whose
                name ends in `.pcd.bin` has the classes of nuScenes, and any other scan file has the
                classes of SemanticKITTI.
            normaliser: normalises scan files to weights; without it, they stay unchanged.
            official: whether labels are written in the official formats of datasets, in which
                every point has a class, also of the car's own body.

        Raises:
            InputError: if the inputs have different classes, or a dataset lacks the named ones.
        """
        if normaliser is not None:
            normaliser = replace(normaliser, known=self._known)
            once = cache(normaliser)  # files of one recording may be in several parts
        scans: list[ScanFile] = []
        taxonomies: list[Taxonomy] = []
        for part in self.parts:
            dataset = part
            if taxonomy is not None:
                dataset = with_classes(part, taxonomy)
            elif isinstance(part, ScanFiles):
                dataset = part.with_classes(part.named_classes())
            if normaliser is not None and isinstance(part, ScanFiles):
                dataset = dataset.normalised_by(once)
            elif normaliser is not None:
                dataset = normalised(dataset, normaliser)
                if normaliser.expected is not None:
                    mark = partial(mark_own, sensor=normaliser.sensor)
                    dataset.finish = None if official else mark
            scans += choose_records(dataset, self.sequences, self.split)
            taxonomies.append(dataset.taxonomy)

        if len({input_taxonomy.classes for input_taxonomy in taxonomies}) > 1:
            raise InputError(
                "expected inputs with the same classes, found different ones; "
                "take them one after the other"
            )
        recordings = by_recording(scans)
        name_apart(recordings)
        return list(chain.from_iterable(recordings.values())), taxonomies[0]


def find_inputs(
    specs: Sequence[str],
    reading: Reading = AS_FOUND,
    sequences: Sequence[str] | None = None,
    split: str = "all",
) -> Inputs:
    """Return the inputs that a user names.

    Args:
        specs: each a dataset as `open_dataset` takes it, a scan file, a bag, a folder of these, or
            a pattern as `find_scans` takes it.
        reading, sequences, split: as `Inputs` takes them.

    Raises:
        InputError: if an input is missing or has no scan.
    """
    parts: list[Dataset] = []
    folders: dict[str, Recording] = {}
    is_alone = len(specs) == 1
    for spec in specs:
        if is_dataset(spec):
            parts.append(open_dataset(spec))
        else:
            parts.append(
                ScanFiles(list_scans(spec, reading.topic, reading.layout, is_alone, folders))
            )
    return Inputs(parts, reading, sequences, split)


class Scans(Sequence[Scan]):
    """The scans of a file, a bag, a folder or a dataset; each is read when it is asked for."""

    def __init__(self, path: Path | str, scans: Sequence[ScanFile]) -> None:
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
        # Whoever gets the scan may move its points, so that they are no longer those of the file.
        return replace(self._scans[index].load(labels=True), file_xyz=None)

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
    scans, _ = find_inputs([str(path)], Reading(topic=topic)).scans()
    return Scans(path, scans)
