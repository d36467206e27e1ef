"""Score the labels of a dataset's scans by the benchmark's official formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import check_classes
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.top_view import TopView, draw_scan
from amvnet.inference.segmenter import Segmenter, check_scan
from amvnet.models.methods import PAPER_METHODS
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan

PICTURES = 4  # scans that are drawn, evenly spaced


@dataclass(frozen=True)
class MethodLabels:
    """The labels of a scan with N points.

    Attributes:
        ids: (N,) train ids by method.
        uncertain: (N,) bool, true for uncertain points; None if the labels are not those of two
            networks.
    """

    ids: dict[str, np.ndarray]
    uncertain: np.ndarray | None = None


LabelScan = Callable[[ScanRecord, Scan], MethodLabels]


def evaluate(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    label: LabelScan,
    pictures: Path | None = None,
    progress: Progress = no_progress,
    processes: Processes = ALONE,
) -> Evaluation:
    """Score the labels of some scans.

    Args:
        dataset: the dataset that has the scans.
        records: the scans.
        label: the function that labels a scan.
        pictures: folder for pictures of a few of the scans from above; None draws none.
        progress: called with the number of this process's scans that are done, and their total.
        processes: the processes that share the scans; each returns the evaluation of all scans.

    Raises:
        InputError: if a scan has no ground truth.
    """
    evaluation = Evaluation(dataset.taxonomy)
    indices = np.linspace(0, len(records) - 1, min(PICTURES, len(records))).astype(int)
    pictured = {records[index].name for index in indices}

    for record, scan in read_labelled(dataset, processes.share(records), progress):
        assert scan.labels is not None
        labels = label(record, scan)
        evaluation.add(scan.points, scan.labels, labels.ids, labels.uncertain)
        if pictures is not None and record.name in pictured:
            view = TopView(
                scan.points,
                dataset.taxonomy,
                labels.ids,
                scan.labels,
                uncertain=labels.uncertain,
                title=record.name,
            )
            draw_scan(pictures / f"{record.name.replace('/', '_')}.png", view)

    return sum(processes.gather(evaluation), Evaluation(dataset.taxonomy))


def read_labelled(
    dataset: Dataset, records: Sequence[ScanRecord], progress: Progress
) -> Iterator[tuple[ScanRecord, Scan]]:
    """Yield the records and their scans, each of which must have ground truth.

    Raises:
        InputError: at the first scan that has none.
    """
    for done, record in enumerate(records):
        progress(done, len(records))
        scan = dataset.read(record)
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to compare with, found none; name labelled sequences"
            )
        yield record, scan
    progress(len(records), len(records))


def label_by_weights(
    dataset: Dataset, segmenter: Segmenter, methods: Sequence[str] = PAPER_METHODS
) -> LabelScan:
    """Return a function that labels a scan by several methods.

    Args:
        dataset: the dataset that has the scans.
        segmenter: the networks, with the parts that the methods need.
        methods: names of the methods.

    Raises:
        InputError: if the weights do not have the dataset's classes.
    """
    check_classes(dataset, segmenter.taxonomy)

    def label(record: ScanRecord, scan: Scan) -> MethodLabels:
        return MethodLabels(*segmenter.labels_by_method(check_scan(scan), methods))

    return label


def label_from_files(dataset: Dataset, folder: Path) -> LabelScan:
    """Return a function that reads the labels of a scan from a folder of predictions.

    Raises:
        InputError: if there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    def label(record: ScanRecord, scan: Scan) -> MethodLabels:
        return MethodLabels({"predictions": dataset.read_prediction(record, folder)})

    return label
