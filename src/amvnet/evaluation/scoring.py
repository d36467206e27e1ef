"""Score the labels of a dataset's scans by the benchmark's official formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from amvnet.data.class_maps import ClassMap
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import check_classes
from amvnet.data.spacing import evenly_spaced
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.top_view import TopView, draw_scan
from amvnet.files import inside
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import expand_labels, expand_to_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import Scores
from amvnet.models.methods import METHODS, PAPER_METHODS
from amvnet.models.views.points import PointBatch
from amvnet.models.voting import vote
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan, check_scan

Result = TypeVar("Result")
# (N,) train ids by method, and (N,) bool: the uncertain points; None without two networks.
MethodLabels = tuple[dict[str, np.ndarray], np.ndarray | None]

PICTURES = 4  # scans that are drawn, evenly spaced


@dataclass(frozen=True)
class Labeller:
    """Labels scans.

    Attributes:
        label: labels a scan by one or several methods.
        at_once: scans that it labels at the same time, each in a thread.
        classes: maps the classes of the data to those of the labels; None if they are the same.
    """

    label: Callable[[ScanRecord, Scan], MethodLabels]
    at_once: int = 1
    classes: ClassMap | None = None


def evaluate(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    labeller: Labeller,
    pictures: Path | None = None,
    progress: Progress = no_progress,
    processes: Processes = ALONE,
) -> Evaluation:
    """Score the labels of some scans.

    Args:
        labeller: labels the scans, in the classes that are scored.
        pictures: folder for pictures of a few of the scans from above; None draws none.
        progress: called with the number of this process's scans that are done, and their total.
        processes: the processes that share the scans; each returns the evaluation of all scans.

    Raises:
        InputError: if a scan has no ground truth.
    """
    own = dataset.taxonomy
    classes = labeller.classes
    taxonomy = own if classes is None else classes.target
    table = np.arange(own.size + 1, dtype=np.uint8) if classes is None else classes.table(own)
    evaluation = Evaluation(taxonomy)
    pictured = {record.name for record in evenly_spaced(records, PICTURES)}

    def label(record: ScanRecord, scan: Scan) -> tuple[ScanRecord, Scan, MethodLabels]:
        return record, scan, labeller.label(record, scan)

    share = processes.share(records)
    labelled = stream_labelled(dataset, share, label, labeller.at_once, progress)
    for record, scan, labels in labelled:
        assert scan.labels is not None
        truth = table[scan.labels]
        ids, uncertain = labels
        evaluation.add(scan.points, truth, ids, uncertain)
        if pictures is not None and record.name in pictured:
            view = TopView(
                scan.points, taxonomy, ids, truth, title=record.name, uncertain=uncertain
            )
            draw_scan(inside(pictures, f"{record.name.replace('/', '_')}.png"), view)

    return sum(processes.gather(evaluation), Evaluation(taxonomy))


def stream_labelled(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    compute: Callable[[ScanRecord, Scan], Result],
    at_once: int,
    progress: Progress,
) -> Iterator[Result]:
    """Read scans, each of which must have ground truth, and compute on several at the same time.

    Yields:
        The result of each scan, in order.

    Raises:
        InputError: at the first scan that has no ground truth.
    """

    def read(record: ScanRecord) -> Scan:
        scan = dataset.read(record)
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to compare with, found none; name labelled sequences"
            )
        return scan

    progress(0, len(records))
    with closing(stream_scans(records, read, compute, at_once)) as results:
        for done, result in enumerate(results, start=1):
            yield result
            progress(done, len(records))


def label_by_weights(
    dataset: Dataset,
    segmenter: Segmenter,
    methods: Sequence[str] = PAPER_METHODS,
    classes: ClassMap | None = None,
) -> Labeller:
    """Return what labels scans by several methods.

    Args:
        classes: maps the classes of the weights to those that are scored; None if they are the
            same.

    Raises:
        InputError: if the weights do not have the dataset's classes.
    """
    if classes is None:
        check_classes(dataset, segmenter.taxonomy)
        table = np.arange(segmenter.taxonomy.size + 1, dtype=np.uint8)
    else:
        table = classes.table(segmenter.taxonomy)
    segmenter = segmenter.for_dataset(dataset)

    def label(record: ScanRecord, scan: Scan) -> MethodLabels:
        labels, uncertain = labels_by_method(segmenter, check_scan(scan), methods)
        return {name: table[ids] for name, ids in labels.items()}, uncertain

    return Labeller(label, segmenter.at_once, classes)


def labels_by_method(
    segmenter: Segmenter, scan: Scan, methods: Sequence[str] = PAPER_METHODS
) -> MethodLabels:
    """Label the N points of a scan by a segmenter's method and by those that it includes.

    AMVNet includes the ensembles and each network alone; an ensemble includes the other ensembles
    and each network alone; others of `methods` are left out. The networks run once.
    """
    batch = segmenter.batch([scan])
    scores = segmenter.run(batch)

    labels = {}
    for name in methods:
        values: Tensor | None = scores.merged
        if name != segmenter.method:
            values = _scores_by(name, segmenter, scores, batch)
        if values is not None:
            labels[name] = expand_labels(values, scan.valid)

    if not METHODS[segmenter.method].has_two_networks:
        return labels, None
    return labels, expand_to_scan(scores.uncertain, scan.valid)


@torch.inference_mode()
def _scores_by(name: str, segmenter: Segmenter, scores: Scores, batch: PointBatch) -> Tensor | None:
    """Return the scores (P, K) by another method than the segmenter's; None if it lacks one."""
    f = scores.rv
    g = scores.bev
    ensemble = METHODS[name].ensemble

    if name == "rv":
        return f
    if name == "bev":
        return g
    if name == "rv-knn" and f is not None:
        return vote(f, batch, segmenter.model.range_view.project(batch))
    if ensemble is not None and f is not None and g is not None:
        return ensemble(f, g)
    return None


def label_from_files(dataset: Dataset, folder: Path, classes: ClassMap | None = None) -> Labeller:
    """Return what reads the labels of scans from a folder of predictions.

    Args:
        classes: maps the classes of the dataset to those that are scored; None scores these.

    Raises:
        InputError: if there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")
    table = None if classes is None else classes.table(dataset.taxonomy)

    def label(record: ScanRecord, scan: Scan) -> MethodLabels:
        ids = dataset.read_prediction(record, folder)
        return {"predictions": ids if table is None else table[ids]}, None

    return Labeller(label, classes=classes)
