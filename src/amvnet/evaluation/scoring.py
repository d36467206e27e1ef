"""Jobs behind the verbs: which scans there are, and scoring them; they print nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.select import check_classes
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.top_view import draw_scan
from amvnet.inference.methods import COMPARED
from amvnet.inference.segmenter import Segmenter, check_scan
from amvnet.progress import Progress
from amvnet.scan import Scan

PICTURES = 4  # scans that are drawn, evenly spaced


def evaluate(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    label: Callable[[ScanRecord, Scan], tuple[dict[str, np.ndarray], np.ndarray | None]],
    pictures: Path | None = None,
    progress: Progress = lambda done, total: None,
    processes: Processes = ALONE,
) -> Evaluation:
    """Score the labels of some scans by the benchmark's formulas.

    Args:
        label: what a scan's points are taken for: ids by method, and which points are uncertain.
        pictures: a folder for drawings of some of the scans from above.
        processes: those that share the scans; each gets the evaluation of all.
    """
    mine = Evaluation(dataset.taxonomy)
    places = np.linspace(0, len(records) - 1, min(PICTURES, len(records))).astype(int)
    drawn = {records[place].name for place in places}
    for record, scan in read_labelled(dataset, processes.share(records), progress):
        assert scan.labels is not None
        found, uncertain = label(record, scan)
        mine.add(scan.points, scan.labels, found, uncertain)
        if pictures is not None and record.name in drawn:
            path = pictures / f"{record.name.replace('/', '_')}.png"
            draw_scan(
                path, scan.points, dataset.taxonomy, found, scan.labels, uncertain, record.name
            )
    return sum(processes.gather(mine), Evaluation(dataset.taxonomy))


def read_labelled(
    dataset: Dataset, records: Sequence[ScanRecord], progress: Progress
) -> Iterator[tuple[ScanRecord, Scan]]:
    """Read scans that must have labels.

    Raises:
        InputError: at the first that has none.
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
    dataset: Dataset, segmenter: Segmenter, methods: Sequence[str] = COMPARED
) -> Callable[[ScanRecord, Scan], tuple[dict[str, np.ndarray], np.ndarray | None]]:
    """Labels by every one of some methods that the weights have the parts for.

    Raises:
        InputError: where the weights know other classes than the data set.
    """
    check_classes(dataset, segmenter.taxonomy)
    return lambda record, scan: segmenter.by_method(check_scan(scan), methods)


def label_from_files(
    dataset: Dataset, folder: Path
) -> Callable[[ScanRecord, Scan], tuple[dict[str, np.ndarray], np.ndarray | None]]:
    """Labels from a folder of predictions.

    Raises:
        InputError: where the folder is not there.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")
    return lambda record, scan: ({"predictions": dataset.read_prediction(record, folder)}, None)
