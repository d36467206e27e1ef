"""Jobs behind the verbs: which scans there are, and scoring them; they print nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.top_view import draw_scan
from amvnet.inference.segmenter import COMPARED, Segmenter, checked_scan
from amvnet.scan import Scan

Progress = Callable[[int, int], None]  # done, in all
PICTURES = 4  # scans that are drawn, evenly spaced

DEMO_SEED = 20_201_209  # far from the seeds of the streets that the shipped weights were trained on
DEMO_SCANS = 6
DEMO_SEQUENCES = 3


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
    for record, scan in labelled(dataset, processes.share(records), progress):
        assert scan.labels is not None
        found, uncertain = label(record, scan)
        mine.add(scan.points, scan.labels, found, uncertain)
        if pictures is not None and record.name in drawn:
            path = pictures / f"{record.name.replace('/', '_')}.png"
            draw_scan(path, scan.points, dataset.taxonomy, found, scan.labels, uncertain, record.name)
    return sum(processes.gather(mine), Evaluation(dataset.taxonomy))


def labelled(dataset: Dataset, records: Sequence[ScanRecord], progress: Progress) -> Iterator[tuple[ScanRecord, Scan]]:
    """Read scans that must have labels.

    Raises:
        InputError: at the first that has none.
    """
    for done, record in enumerate(records):
        progress(done, len(records))
        scan = dataset.read(record)
        if scan.labels is None:
            raise InputError(f"{scan.name}: expected labels to compare with, found none; name labelled sequences")
        yield record, scan
    progress(len(records), len(records))


def by_weights(
    dataset: Dataset, segmenter: Segmenter, methods: Sequence[str] = COMPARED
) -> Callable[[ScanRecord, Scan], tuple[dict[str, np.ndarray], np.ndarray | None]]:
    """Labels by every one of some methods that the weights have the parts for.

    Raises:
        InputError: where the weights know other classes than the data set.
    """
    check_classes(dataset, segmenter.taxonomy)
    return lambda record, scan: segmenter.by_method(checked_scan(scan), methods)


def by_files(
    dataset: Dataset, folder: Path
) -> Callable[[ScanRecord, Scan], tuple[dict[str, np.ndarray], np.ndarray | None]]:
    """Labels from a folder of predictions.

    Raises:
        InputError: where the folder is not there.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")
    return lambda record, scan: ({"predictions": dataset.read_prediction(record, folder)}, None)


def own_classes(taxonomy: Taxonomy) -> Taxonomy | None:
    """A user's own classes, with which a data set has to be read; None for those of a benchmark."""
    return taxonomy if taxonomy.name not in TAXONOMIES else None


def check_classes(dataset: Dataset, taxonomy: Taxonomy) -> None:
    """Raises InputError where weights know other classes than the data set."""
    if taxonomy.classes != dataset.taxonomy.classes:
        raise InputError(
            f"expected weights for the classes of {dataset.taxonomy.name}, found weights for those of "
            f"{taxonomy.name}; use weights trained on this benchmark"
        )


def choose_records(dataset: Dataset, sequences: Sequence[str] | None, split: str) -> list[ScanRecord]:
    """The scans of the named sequences, or else of a split."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)


def split_records(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> tuple[list[ScanRecord], list[ScanRecord]]:
    """The scans to train on and those to validate with: as named, else by the official split.

    Of a data set that has no scan of one of the two official splits, the last sequence validates.

    Args:
        with_val: train on both, and validate with none.

    Raises:
        InputError: where there is just one sequence.
    """
    present = dataset.sequences("all")
    official = {split: _present(dataset, split) for split in ("train", "val")}
    if not (train or official["train"]) or not (val or official["val"]):
        official = {"train": present[:-1], "val": present[-1:]}
    val = val or [s for s in official["val"] if s not in (train or ())]
    train = train or [s for s in official["train"] if s not in val]
    if with_val:
        return dataset.records([*train, *(s for s in val if s not in train)]), []
    if not train or not val:
        raise InputError(
            f"{dataset.root}: expected two sequences, one to train on and one to validate with, "
            f"found {', '.join(present)}; name them"
        )
    return dataset.records(train), dataset.records(val)


def _present(dataset: Dataset, split: str) -> tuple[str, ...]:
    try:
        return dataset.sequences(split)
    except InputError:
        return ()
