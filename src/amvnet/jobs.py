"""The jobs behind the verbs: predict, evaluate, demo. They print nothing; `progress` is told how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.catalog import is_dataset, open_dataset
from amvnet.data.files import find_scans, read_scan, whole_file, write_labels
from amvnet.data.labels import TAXONOMIES, Taxonomy
from amvnet.data.records import Dataset, ScanRecord
from amvnet.errors import InputError
from amvnet.evaluation import Evaluation
from amvnet.pictures import draw_scan
from amvnet.processes import ALONE, Processes
from amvnet.scan import Scan
from amvnet.segmenter import COMPARED, Segmentation, Segmenter, checked_scan

Progress = Callable[[int, int], None]  # done, in all
PICTURES = 4  # scans that are drawn, evenly spaced

DEMO_SEED = 20_201_209  # far from the seeds of the streets that the shipped weights were trained on
DEMO_SCANS = 6
DEMO_SEQUENCES = 3


@dataclass(frozen=True)
class Task:
    """One scan to segment: how it is read, and where its labels go."""

    name: str
    read: Callable[[], Scan]
    write: Callable[[np.ndarray], Path]
    scores: Path


def predict(
    inputs: Sequence[str],
    segmenter: Segmenter,
    out: Path,
    sequences: Sequence[str] | None = None,
    scores: bool = False,
    progress: Progress = lambda done, total: None,
    split: str = "all",
    processes: Processes = ALONE,
) -> list[Path]:
    """Segment data sets, scan files and folders of them; returns the files of labels that this process has written.

    Args:
        inputs: each a data set as `open_dataset` takes it, a scan file, or a folder of scan files.
        sequences: of data sets, which to segment; None means those of `split`.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` of an `.npz`.
        split: the official split of data sets.
        processes: those that share the scans.

    Raises:
        InputError: before anything is written where an input is not there; else at the scan that is broken.
    """
    mine, written = processes.share(tasks_in(inputs, segmenter.taxonomy, Path(out), sequences, split)), []
    for done, task in enumerate(mine):
        progress(done, len(mine))
        result = segmenter(task.read())
        if scores:
            write_scores(task.scores, result)
        written.append(task.write(result.labels))
    progress(len(mine), len(mine))
    return written


def write_scores(path: Path, result: Segmentation) -> None:
    """Both networks' probabilities, (N, K) float16, as `rv` and `bev` of an `.npz`."""
    found = {name: v.astype(np.float16) for name, v in (("rv", result.rv), ("bev", result.bev)) if v is not None}
    with whole_file(path) as part:
        np.savez_compressed(part, **found)  # type: ignore[arg-type]  # of the arrays, none is an option


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


def tasks_in(
    inputs: Sequence[str], taxonomy: Taxonomy, out: Path, sequences: Sequence[str] | None, split: str
) -> list[Task]:
    """The scans of all inputs; raises InputError where the files of two would have the same name."""
    tasks = [task for text in inputs for task in _tasks_of(text, taxonomy, out, sequences, split)]
    _check_names(tasks)
    return tasks


def _tasks_of(text: str, taxonomy: Taxonomy, out: Path, sequences: Sequence[str] | None, split: str) -> Iterator[Task]:
    if is_dataset(text):
        dataset = open_dataset(text, own_classes(taxonomy))
        check_classes(dataset, taxonomy)
        for record in choose_records(dataset, sequences, split):
            yield _record_task(dataset, record, out)
        return
    for path in find_scans(text):
        yield _file_task(path, taxonomy, out)


def _record_task(dataset: Dataset, record: ScanRecord, out: Path) -> Task:
    return Task(
        record.name,
        lambda: dataset.read(record, labels=False),
        lambda ids: dataset.write_prediction(record, out, ids),
        (out / record.prediction).with_suffix(".npz"),
    )


def _file_task(path: Path, taxonomy: Taxonomy, out: Path) -> Task:
    return Task(
        path.name,
        lambda: read_scan(path),
        lambda ids: write_labels(out / f"{stem(path)}.label", taxonomy.to_raw(ids)),
        out / f"{stem(path)}.npz",
    )


def stem(path: Path) -> str:
    """A scan file's name without its ending, `.pcd.bin` included."""
    return path.name.removesuffix(".pcd.bin") if path.name.endswith(".pcd.bin") else path.stem


def _check_names(tasks: Sequence[Task]) -> None:
    seen: dict[Path, str] = {}
    for task in tasks:
        if task.scores in seen:
            raise InputError(
                f"expected scans of different names, found {task.name} twice ({task.scores.stem}); "
                "segment them in two runs with two folders"
            )
        seen[task.scores] = task.name
