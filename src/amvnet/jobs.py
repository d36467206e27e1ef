"""The jobs behind the verbs: predict, evaluate, demo. They print nothing; `progress` is told how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.catalog import is_dataset, open_dataset
from amvnet.data.files import find_scans, whole_file
from amvnet.data.formats import READERS, NamedScan, named_scans
from amvnet.data.labels import TAXONOMIES, Taxonomy
from amvnet.data.outputs import check_kind, write_scan_labels, write_uncertain
from amvnet.data.records import Dataset, ScanRecord
from amvnet.errors import InputError
from amvnet.evaluation import Evaluation
from amvnet.fitting import Fitting
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
    """One scan to segment: how it is read, by what it is segmented, and where its labels go."""

    name: str
    read: Callable[[], Scan]
    segmenter: Segmenter
    write: Callable[[Segmentation], Path]
    scores: Path

    @property
    def uncertain(self) -> Path:
        """Where it is written which points are uncertain."""
        return self.scores.with_suffix(".uncertain.npy")


def predict(
    inputs: Sequence[str],
    segmenter: Segmenter,
    out: Path,
    sequences: Sequence[str] | None = None,
    scores: bool = False,
    progress: Progress = lambda done, total: None,
    split: str = "all",
    topic: str | None = None,
    fitting: Fitting | None = None,
    processes: Processes = ALONE,
    kind: str = "label",
    uncertain: bool = False,
) -> list[Path]:
    """Segment data sets, scan files, bags and folders of them; returns the files that this process has written.

    Args:
        inputs: each a data set as `open_dataset` takes it, a scan file, a bag, or a folder of these.
        sequences: of data sets, which to segment; None means those of `split`.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` of an `.npz`.
        split: the official split of data sets.
        topic: of bags; None is the only one with PointCloud2.
        fitting: makes lone scans such as the weights know them; None measures all, and says nothing.
        processes: those that share the scans.
        kind: the format that the labels of lone scans are written in, of `data.outputs.KINDS`.
        uncertain: also write which points are uncertain, (N,) bool, as `.uncertain.npy`.

    Raises:
        InputError: before anything is written where an input is not there or its folder is `out`, or the method has
            no uncertain points; else at the scan that is broken.
    """
    check_kind(kind)
    if uncertain and segmenter.method in ("rv", "bev"):
        raise InputError(f"expected a method of two networks for --uncertain, found {segmenter.method}; use amvnet")
    lone = Lone(segmenter.by_ring(), fitting or Fitting(segmenter.weights), Path(out), topic, kind, scores)
    tasks = [task for text in inputs for task in _tasks(text, segmenter, lone, sequences, split)]
    _check_names(tasks)
    mine, written = processes.share(tasks), []
    for done, task in enumerate(mine):
        progress(done, len(mine))
        result = task.segmenter(task.read())
        if scores:
            write_scores(task.scores, result)
        if uncertain:
            write_uncertain(task.uncertain, result.uncertain)
        written.append(task.write(result))
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


@dataclass(frozen=True)
class Lone:
    """What lone scans have in common."""

    segmenter: Segmenter
    fitting: Fitting
    out: Path
    topic: str | None
    kind: str
    scores: bool

    def task(self, scan: NamedScan) -> Task:
        kept: list[np.ndarray] = []  # the file's own coordinates, from the reading to the writing

        def read() -> Scan:
            cloud = scan.read()
            kept[:] = [cloud.xyz]
            return self.fitting(cloud, scan.source)

        def write(result: Segmentation) -> Path:
            known = None if result.rv is None or result.bev is None else result.uncertain
            taxonomy = self.segmenter.taxonomy
            return write_scan_labels(self.out / scan.name, self.kind, kept.pop(), result.labels, taxonomy, known)

        return Task(scan.name, read, self.segmenter, write, self.out / f"{scan.name}.npz")

    def check(self, path: Path, task: Task) -> Task:
        """Hand back a task of a scan file.

        Raises:
            InputError: where what is written would lie beside the scans, and be taken for one or replace one.
        """
        mistaken = f".{self.kind}" in READERS or (self.scores and path.suffix.lower() == ".npz")
        if mistaken and task.scores.parent.resolve() == path.parent.resolve():
            raise InputError(f"{path}: expected another folder for the labels, found the scan's own; change --out")
        return task


def _tasks(text: str, segmenter: Segmenter, lone: Lone, sequences: Sequence[str] | None, split: str) -> Iterator[Task]:
    if is_dataset(text):
        dataset = open_dataset(text, own_classes(segmenter.taxonomy))
        check_classes(dataset, segmenter.taxonomy)
        for record in choose_records(dataset, sequences, split):
            yield _record_task(dataset, record, segmenter, lone.out)
        return
    for path in find_scans(text):
        yield from (lone.check(path, lone.task(scan)) for scan in named_scans(path, lone.topic))


def _record_task(dataset: Dataset, record: ScanRecord, segmenter: Segmenter, out: Path) -> Task:
    return Task(
        record.name,
        lambda: dataset.read(record, labels=False),
        segmenter,
        lambda result: dataset.write_prediction(record, out, result.labels),
        (out / record.prediction).with_suffix(".npz"),
    )


def _check_names(tasks: Sequence[Task]) -> None:
    seen: dict[Path, str] = {}
    for task in tasks:
        if task.scores in seen:
            raise InputError(
                f"expected scans of different names, found {task.name} twice ({task.scores.stem}); "
                "segment them in two runs with two folders"
            )
        seen[task.scores] = task.name
