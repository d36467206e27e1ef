"""The scans of a command's inputs, each with how it is read, segmented and written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import is_dataset, open_dataset
from amvnet.data.datasets.select import check_classes, choose_records, custom_taxonomy
from amvnet.data.formats.detect import READERS, NamedScan, scans_in_file
from amvnet.data.label_files import write_scan_labels
from amvnet.data.scan_files import find_scans
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.pipeline import Segment, Task
from amvnet.inference.segmenter import Segmentation
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, ScanAdapter

By = Callable[
    [Path, bool], Segment
]  # for the scan whose scores lie at a place, and whether it is a lone one


@dataclass
class Lone:
    """What lone scans have in common."""

    taxonomy: Taxonomy
    by: By
    fitting: ScanAdapter
    out: Path
    topic: str | None
    kind: str = "label"
    scores: bool = False
    first: dict[str, list[NamedScan]] = field(default_factory=dict)

    def tasks(self, path: Path) -> Iterator[Task]:
        for scan in scans_in_file(path, self.topic):
            first = self.first.setdefault(scan.source, [])
            if len(first) < MEASURED:
                first.append(scan)
            yield self._checked(path, self._task(scan))

    def _task(self, scan: NamedScan) -> Task:
        kept: list[np.ndarray] = []  # the file's own coordinates, from the reading to the writing

        def read() -> Scan:
            # Whichever of its scans comes first here, after an interruption or in another process: all have the same.
            self.fitting.learn(scan.source, [one.read for one in self.first.pop(scan.source, [])])
            cloud = scan.read()
            kept[:] = [cloud.xyz]
            return self.fitting(cloud, scan.source)

        def write(result: Segmentation) -> Path:
            known = None if result.rv is None or result.bev is None else result.uncertain
            stem = self.out / scan.name
            return write_scan_labels(
                stem, self.kind, kept.pop(), result.labels, self.taxonomy, known
            )

        scores = self.out / f"{scan.name}.npz"
        return Task(scan.name, read, self.by(scores, True), write, scores)

    def _checked(self, path: Path, task: Task) -> Task:
        """Hand back a task of a scan file.

        Raises:
            InputError: where what is written would lie beside the scans, and be taken for one or replace one.
        """
        mistaken = f".{self.kind}" in READERS or (self.scores and path.suffix.lower() == ".npz")
        if mistaken and task.scores.parent.resolve() == path.parent.resolve():
            raise InputError(
                f"{path}: expected another folder for the labels, found the scan's own; change --out"
            )
        return task


def tasks_in(
    inputs: Sequence[str], lone: Lone, sequences: Sequence[str] | None, split: str
) -> list[Task]:
    """The scans of all inputs, data sets as lone ones; raises InputError where two would have the same files."""
    tasks = [task for text in inputs for task in _tasks(text, lone, sequences, split)]
    _check_names(tasks)
    return tasks


def _tasks(text: str, lone: Lone, sequences: Sequence[str] | None, split: str) -> Iterator[Task]:
    if is_dataset(text):
        dataset = open_dataset(text, custom_taxonomy(lone.taxonomy))
        check_classes(dataset, lone.taxonomy)
        for record in choose_records(dataset, sequences, split):
            yield _record_task(dataset, record, lone.by, lone.out)
        return
    for path in find_scans(text):
        yield from lone.tasks(path)


def _record_task(dataset: Dataset, record: ScanRecord, by: By, out: Path) -> Task:
    scores = (out / record.prediction).with_suffix(".npz")
    return Task(
        record.name,
        lambda: dataset.read(record, labels=False),
        by(scores, False),
        lambda result: dataset.write_prediction(record, out, result.labels),
        scores,
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
