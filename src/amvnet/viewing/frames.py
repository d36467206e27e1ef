"""Scans with all that is to be seen of them: truth, labels by method, which points are uncertain."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import is_dataset, open_dataset
from amvnet.data.datasets.select import check_classes, choose_records, custom_taxonomy
from amvnet.data.formats.detect import NamedScan, ending_of, scan_stem, scans_in_file
from amvnet.data.scan_files import find_scans, read_labels
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, TAXONOMIES, Taxonomy, taxonomy_from_yaml
from amvnet.errors import InputError
from amvnet.inference.segmenter import Segmenter, check_scan, expand_labels, expand_to_scan
from amvnet.models.assertions import cosine_similarity
from amvnet.progress import Progress
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter

# Colours on a dark ground, RGB in 0..255. The official one of points without a class is black, as the ground nearly is.
UNLABELLED = (128, 136, 148)
RIGHT, WRONG, UNSCORED = (78, 92, 112), (255, 64, 54), (40, 47, 58)
UNCERTAIN = (238, 128, 0)


@dataclass(frozen=True)
class Frame:
    """One scan and what is known of its N points.

    Attributes:
        name: for people.
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1].
        valid: (N,) bool, the points that have a place.
        truth: (N,) train ids, or None where there is none.
        labels: what the points are taken for, (N,) train ids by method ("labels" where they come from files).
        uncertain: (N,) bool, where the two networks disagree, or None without two networks.
        disagreement: (N,) float32 in [0, 1], 1 - cosine similarity of the networks' scores, or None.
    """

    name: str
    points: np.ndarray
    valid: np.ndarray
    truth: np.ndarray | None = None
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    uncertain: np.ndarray | None = None
    disagreement: np.ndarray | None = None

    def errors(self, method: str) -> np.ndarray | None:
        """(N,) bool: the points that truth names and the method takes for something else; None without truth."""
        return (
            None if self.truth is None else (self.truth > 0) & (self.labels[method] != self.truth)
        )


@dataclass(frozen=True)
class Source:
    """One scan to look at: how it is read, its labels from a folder that the user gave, what segments it."""

    name: str
    read: Callable[[], Scan]
    read_labels: Callable[[Path, int], np.ndarray]
    segmenter: Segmenter | None = None


@dataclass(frozen=True)
class Frames:
    """The frames of some scans, made when they are asked for; `taxonomy` says what the ids in them mean."""

    taxonomy: Taxonomy
    sources: Sequence[Source]
    labels: Path | None = None

    def __len__(self) -> int:
        return len(self.sources)

    def each(self, progress: Progress = lambda done, total: None) -> Iterator[Frame]:
        """Read, and label, one after the other; raises InputError at a file that is broken or missing."""
        for done, source in enumerate(self.sources):
            progress(done, len(self))
            yield self._frame(source)
        progress(len(self), len(self))

    def _frame(self, source: Source) -> Frame:
        scan = check_scan(source.read())
        given = (
            {} if self.labels is None else {"labels": source.read_labels(self.labels, len(scan))}
        )
        frame = Frame(source.name, scan.points, scan.valid, scan.labels, given)
        return frame if source.segmenter is None else _segmented(frame, scan, source.segmenter)


def choose_frames(
    inputs: Sequence[str],
    count: int,
    segmenter: Segmenter | None = None,
    labels: Path | None = None,
    taxonomy: str | None = None,
    sequences: Sequence[str] | None = None,
) -> Frames:
    """Choose what to look at: up to `count` scans of the inputs, evenly spaced.

    Args:
        inputs: each a data set as `open_dataset` takes it, a scan file, or a folder of scan files.
        segmenter: what labels the scans, if anything does.
        labels: instead, a folder of predictions as `predict` writes them, or the label file of one scan.
        taxonomy: name of a benchmark or a YAML file; by default that of the weights or the data set, and without
            these nuScenes' for `.pcd.bin` and SemanticKITTI's for other files.
        sequences: of data sets, which to choose from; None means all.

    Raises:
        InputError: where an input is not there, or the inputs do not have the same classes.
    """
    if count < 1:
        raise InputError(f"expected a number of scans from 1, found {count}; say --scans 5")
    if labels is not None and not labels.exists():
        raise InputError(
            f"{labels}: expected a file or a folder of labels, found none; check the path"
        )
    given = _given_taxonomy(taxonomy, segmenter)
    found = [_sources(text, given, segmenter, sequences) for text in inputs]
    if len({classes.classes for classes, _ in found}) > 1:
        raise InputError(
            "expected inputs with the same classes, found several; look at them one after the other"
        )
    sources = [source for _, some in found for source in some]
    if labels is not None and labels.is_file() and len(sources) > 1:
        raise InputError(
            f"{labels}: expected a folder of labels for {len(sources)} scans, found a file; give a folder"
        )
    places = np.linspace(0, len(sources) - 1, min(count, len(sources))).round().astype(int)
    return Frames(found[0][0], [sources[place] for place in places], labels)


def _segmented(frame: Frame, scan: Scan, segmenter: Segmenter) -> Frame:
    scores, uncertain = segmenter.scores_by_method(scan)
    labels = {name: expand_labels(values, scan.valid) for name, values in scores.items()}
    if uncertain is None:
        return replace(frame, labels=labels)
    disagreement = expand_to_scan(
        (1 - cosine_similarity(scores["rv"], scores["bev"])).clamp(0, 1), scan.valid
    )
    return replace(
        frame,
        labels=labels,
        uncertain=expand_to_scan(uncertain, scan.valid),
        disagreement=disagreement,
    )


def _given_taxonomy(text: str | None, segmenter: Segmenter | None) -> Taxonomy | None:
    """The classes that the user named; None where the input is to say them."""
    if text is None:
        return None if segmenter is None else custom_taxonomy(segmenter.taxonomy)
    if segmenter is not None:
        raise InputError(
            "expected no --taxonomy beside --weights, which say their classes; leave it out"
        )
    return TAXONOMIES[text] if text in TAXONOMIES else taxonomy_from_yaml(text)


def _sources(
    text: str, given: Taxonomy | None, segmenter: Segmenter | None, sequences: Sequence[str] | None
) -> tuple[Taxonomy, list[Source]]:
    if is_dataset(text):
        dataset = open_dataset(text, given)
        if segmenter is not None:
            check_classes(dataset, segmenter.taxonomy)
        records = choose_records(dataset, sequences, "all")
        return dataset.taxonomy, [_record_source(dataset, record, segmenter) for record in records]
    paths = find_scans(text)
    ours = NUSCENES if ending_of(paths[0]) == ".pcd.bin" else SEMANTICKITTI
    taxonomy = given or (ours if segmenter is None else segmenter.taxonomy)
    fit = None if segmenter is None else ScanAdapter(segmenter.weights)
    by_ring = None if segmenter is None else segmenter.by_ring()
    return taxonomy, [
        _lone_source(scan, taxonomy, by_ring, fit) for path in paths for scan in scans_in_file(path)
    ]


def _record_source(dataset: Dataset, record: ScanRecord, segmenter: Segmenter | None) -> Source:
    # A token says nothing to people; the last part of nuScenes' names of files is the time.
    name = (
        record.name
        if "/" in record.name
        else f"{record.sequence}/{scan_stem(record.points_path).split('__')[-1]}"
    )

    def labels(folder: Path, count: int) -> np.ndarray:
        return dataset.read_prediction(record, folder)

    return Source(name, lambda: dataset.read(record), labels, segmenter)


def _lone_source(
    scan: NamedScan, taxonomy: Taxonomy, segmenter: Segmenter | None, fit: ScanAdapter | None
) -> Source:
    def read() -> Scan:
        return scan.read().to_scan() if fit is None else fit(scan.read(), scan.source)

    def labels(place: Path, count: int) -> np.ndarray:
        file = place / f"{scan.name}.label" if place.is_dir() else place
        return read_labels(file, np.uint32, count, taxonomy.to_train)

    return Source(scan.name, read, labels, segmenter)
