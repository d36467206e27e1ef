"""Score the labels of a dataset's scans by the benchmark's official formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from amvnet.data.class_maps import ClassMap
from amvnet.data.datasets.base import Dataset
from amvnet.data.recordings import ScanFile, evenly_spaced
from amvnet.data.taxonomy import Taxonomy, check_classes
from amvnet.drives.consensus import DriveScan
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.top_view import PICTURE, TopView, draw_scan
from amvnet.files import Signature, inside
from amvnet.inference.drive import Drives
from amvnet.inference.journal import read_journals
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import expand_labels, expand_to_scan, scores_by_method
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import METHODS, PAPER_METHODS
from amvnet.models.voting import vote
from amvnet.progress import Progress, Reporter, no_progress, report_nothing
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.scan import Scan, check_scan

Result = TypeVar("Result")
DRIVE = "drive"  # the method whose labels are the consensus of a drive

MAX_PICTURES = 4  # largest number of scans that are drawn; they are evenly spaced


class MethodLabels(NamedTuple):
    """The labels of the N points of a scan.

    Attributes:
        ids: the train ids (N,) by method.
        uncertain: (N,) bool, the uncertain points, or None if there are not two networks.
        turned: (N, K) the scores for the scan as `Drives.yaws` turns it, or None without drives.
    """

    ids: dict[str, np.ndarray]
    uncertain: np.ndarray | None = None
    turned: np.ndarray | None = None


ByMethods = tuple[ScanFile, Scan, MethodLabels]  # a scan with its labels by several methods


@dataclass(frozen=True)
class Labeller:
    """Labels scans.

    Attributes:
        classes: a map from the classes of the labels, and from the classes of the data, to the
            classes that are scored; None if all three are the same.
        at_once: number of scans that `label` may take at the same time, each in a thread.
        segmenter: what computes the labels, or None if they come from files.
    """

    label: Callable[[ScanFile, Scan], MethodLabels]
    taxonomy: Taxonomy
    classes: ClassMap | None = None
    at_once: int = 1
    segmenter: Segmenter | None = None

    def table(self, taxonomy: Taxonomy) -> np.ndarray:
        """Return the (K + 1,) uint8 train ids that are scored, by the K + 1 ids of a taxonomy."""
        if self.classes is None or taxonomy is self.classes.target:
            return np.arange(taxonomy.size + 1, dtype=np.uint8)
        return self.classes.table(taxonomy)


def evaluate(
    dataset: Dataset,
    records: Sequence[ScanFile],
    labeller: Labeller,
    pictures: Path | None = None,
    progress: Progress = no_progress,
    processes: Processes = ALONE,
    drives: Drives | None = None,
    report: Reporter = report_nothing,
) -> Evaluation:
    """Score the labels of some scans.

    Args:
        pictures: folder for pictures of a few scans from above. By default, none are drawn.
        processes: the processes that share the scans. Each returns the evaluation of all scans.
        drives: the poses of the scans, if the method `DRIVE` is to be scored as well. The networks
            then get each scan twice: as it is, and turned.
        report: gets a line if points have a class that is not scored.

    Raises:
        InputError: if the labels do not have the dataset's classes, or a scan has no true labels.
    """
    taxonomy = dataset.taxonomy if labeller.classes is None else labeller.classes.target
    if labeller.classes is None:
        check_classes(dataset.spec, dataset.taxonomy, labeller.taxonomy)
    true_table = labeller.table(dataset.taxonomy)
    table = labeller.table(labeller.taxonomy)
    evaluation = Evaluation(taxonomy)
    counts = np.zeros(dataset.taxonomy.size + 1, dtype=np.int64)  # true points by class
    pictured = {record.name for record in evenly_spaced(records, MAX_PICTURES)}

    def label(record: ScanFile, scan: Scan) -> tuple[ScanFile, Scan, MethodLabels]:
        labels = labeller.label(record, scan)
        if drives is not None:
            assert labeller.segmenter is not None
            yaw = drives.yaws[record]
            labels = labels._replace(turned=labeller.segmenter(scan, yaw=yaw).scores)
        return record, scan, labels

    share = processes.share(records)
    labelled: Iterator[ByMethods] = stream_labelled(
        dataset, share, label, labeller.at_once, progress
    )
    if drives is not None:
        labelled = _with_consensus(labelled, drives)
    for record, scan, labels in labelled:
        assert scan.labels is not None
        truth = true_table[scan.labels]
        counts += np.bincount(scan.labels, minlength=len(counts))
        ids = {name: table[values] for name, values in labels.ids.items()}

        uncertain = labels.uncertain
        evaluation.add(scan.points, truth, ids, uncertain=uncertain)
        if pictures is not None and record.name in pictured:
            view = TopView(
                scan.points, taxonomy, ids, truth, title=record.name, uncertain=uncertain
            )
            draw_scan(_picture_of(record, pictures), view)

    total = sum(processes.gather(counts), np.zeros_like(counts))
    total[0] = 0
    lost = total * (true_table == 0)
    if lost.any():
        names = ", ".join(dataset.taxonomy.names[index] for index in np.flatnonzero(lost))
        part = f"{lost.sum() / total.sum():.0%} of the labelled points"
        report(f"not scored: {names} ({part}), which {taxonomy.name} does not name")
    return sum(processes.gather(evaluation), Evaluation(taxonomy))


def _with_consensus(labelled: Iterator[ByMethods], drives: Drives) -> Iterator[ByMethods]:
    """Add the labels by `DRIVE` to the labels of scans, which are in the order of their drives."""
    for _, drive in groupby(labelled, key=lambda item: item[0].recording):
        for (record, scan, labels), scores in drives.consensus().stream(
            _drive_scan(item, drives) for item in drive
        ):
            ids = np.where(scores.any(axis=1), scores.argmax(axis=1) + 1, 0)
            yield record, scan, labels._replace(ids={**labels.ids, DRIVE: ids})


def _drive_scan(item: ByMethods, drives: Drives) -> DriveScan[ByMethods]:
    record, scan, labels = item
    assert labels.turned is not None
    return DriveScan(item, scan.points[:, :3], labels.turned, drives.motion(record, scan))


def pictures_of(records: Sequence[ScanFile], folder: Path) -> dict[Path, Signature]:
    """Return the pictures that `evaluate` draws of some scans into a folder, by their paths."""
    pictured = evenly_spaced(records, MAX_PICTURES)
    return {_picture_of(record, folder): PICTURE for record in pictured}


def _picture_of(record: ScanFile, folder: Path) -> Path:
    return inside(folder, f"{record.name.replace('/', '_')}.png")


def stream_labelled(
    dataset: Dataset,
    records: Sequence[ScanFile],
    compute: Callable[[ScanFile, Scan], Result],
    at_once: int,
    progress: Progress,
) -> Iterator[Result]:
    """Yield results as `stream_scans` does; raise InputError if a scan has no true labels."""

    def read(record: ScanFile) -> Scan:
        scan = dataset.read(record)
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to compare with, found none; name labelled sequences"
            )
        return scan

    return stream_scans(records, read, compute, at_once, progress)


def label_by_weights(
    segmenter: Segmenter,
    methods: Sequence[str] = PAPER_METHODS,
    classes: ClassMap | None = None,
) -> Labeller:
    """Return a labeller that labels scans with some weights, by several methods."""

    def label(record: ScanFile, scan: Scan) -> MethodLabels:
        return labels_by_method(segmenter, check_scan(scan), methods)

    return Labeller(label, segmenter.taxonomy, classes, segmenter.at_once, segmenter)


@torch.inference_mode()
def labels_by_method(
    segmenter: Segmenter, scan: Scan, methods: Sequence[str] = PAPER_METHODS
) -> MethodLabels:
    """Label the N points of a scan by a segmenter's method and by the methods that it includes.

    Other `methods` are left out (`scores_by_method`). The networks run only once.
    """
    batch = segmenter.batch([scan])
    scores = segmenter.engine.score(batch)

    def vote_by_neighbours(f: Tensor) -> Tensor:
        return vote(f, batch, segmenter.model.range_view.project(batch))

    by_method = scores_by_method(scores, segmenter.method, methods, vote_by_neighbours)
    labels = {name: expand_labels(values, scan.valid) for name, values in by_method.items()}
    uncertain = None
    if METHODS[segmenter.method].has_two_networks:
        uncertain = expand_to_scan(scores.uncertain, scan.valid)
    return MethodLabels(labels, uncertain)


def label_from_files(dataset: Dataset, folder: Path, classes: ClassMap | None = None) -> Labeller:
    """Return a labeller that reads predictions from a folder.

    They have the classes of the dataset, or those of the map with which `predict` wrote them.

    Raises:
        InputError: if there is no such folder, or `predict` wrote other classes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    taxonomy = dataset.taxonomy
    for settings in read_journals(folder).settings:
        written = settings.get("classes")
        if classes is not None and written == repr(classes):
            taxonomy = classes.target
        elif written is not None:
            raise InputError(
                f"{folder}: expected labels with the classes of the data or of --classes, found "
                "classes that another map made; give the --classes of predict"
            )

    def label(record: ScanFile, scan: Scan) -> MethodLabels:
        ids = dataset.read_prediction(record, folder, len(scan), taxonomy)
        return MethodLabels({"predictions": ids})

    return Labeller(label, taxonomy, classes)
