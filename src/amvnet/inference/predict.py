"""Segments any number of scans, and goes on after an interruption."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import is_dataset, open_dataset
from amvnet.data.formats.detect import READERS, NamedScan, named_scans
from amvnet.data.label_files import check_kind, write_scan_labels
from amvnet.data.scan_files import find_scans
from amvnet.data.taxonomy import Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError, SomeBroken
from amvnet.evaluation.scoring import Progress, check_classes, choose_records, own_classes
from amvnet.inference.journal import Journal
from amvnet.inference.pipeline import Segment, Task, stream
from amvnet.inference.segmenter import Segmentation, Segmenter
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, Fitting

By = Callable[[Path, bool], Segment]  # for the scan whose scores lie at a place, and whether it is a lone one


@dataclass
class Lone:
    """What lone scans have in common."""

    taxonomy: Taxonomy
    by: By
    fitting: Fitting
    out: Path
    topic: str | None
    kind: str = "label"
    scores: bool = False
    first: dict[str, list[NamedScan]] = field(default_factory=dict)

    def tasks(self, path: Path) -> Iterator[Task]:
        for scan in named_scans(path, self.topic):
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
            return write_scan_labels(stem, self.kind, kept.pop(), result.labels, self.taxonomy, known)

        scores = self.out / f"{scan.name}.npz"
        return Task(scan.name, read, self.by(scores, True), write, scores)

    def _checked(self, path: Path, task: Task) -> Task:
        """Hand back a task of a scan file.

        Raises:
            InputError: where what is written would lie beside the scans, and be taken for one or replace one.
        """
        mistaken = f".{self.kind}" in READERS or (self.scores and path.suffix.lower() == ".npz")
        if mistaken and task.scores.parent.resolve() == path.parent.resolve():
            raise InputError(f"{path}: expected another folder for the labels, found the scan's own; change --out")
        return task


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
    resume: bool = False,
    processes: Processes = ALONE,
    kind: str = "label",
    uncertain: bool = False,
    batch: int = 1,
    at_once: int | None = None,
) -> int:
    """Segment data sets, scan files, bags and folders of them; returns how many label files there are now.

    Args:
        inputs: each a data set as `open_dataset` takes it, a scan file, a bag, or a folder of these.
        sequences: of data sets, which to segment; None means those of `split`.
        scores: also write both networks' probabilities, float16 (N, K), as `rv` and `bev` of an `.npz`.
        split: the official split of data sets.
        topic: of bags; None is the only one with PointCloud2.
        fitting: makes lone scans such as the weights know them; None measures all, and says nothing.
        resume: leave out what an interrupted run into `out` has done.
        processes: those that share the scans.
        kind: the format that the labels of lone scans are written in, of `data.outputs.KINDS`.
        uncertain: also write which points are uncertain, (N,) bool, as `.uncertain.npy`.
        batch: scans that go through the networks at a time; the labels are the same up to rounding.
        at_once: scans that are segmented side by side on a CPU, each by its share of the threads; None is as many as
            there are threads, 4 at most, and 1 on a GPU or where another engine than torch shares out the threads.

    Raises:
        InputError: before anything is written where an input is not there or its folder is `out`, or the method has
            no uncertain points; later where every scan is broken.
        SomeBroken: at the end, where some of several scans are.
    """
    check_kind(kind)
    if uncertain and segmenter.method in ("rv", "bev"):
        raise InputError(f"expected a method of two networks for --uncertain, found {segmenter.method}; use amvnet")
    for option, count in (("batch", batch), ("at-once", 1 if at_once is None else at_once)):
        if count < 1:
            raise InputError(f"expected one scan or more at a time, found {count}; set --{option}")
    out, fitting, by_ring = Path(out), fitting or Fitting(segmenter.weights), segmenter.by_ring()

    def by(place: Path, lone: bool) -> Segment:
        return by_ring if lone else segmenter

    tasks = tasks_in(inputs, Lone(segmenter.taxonomy, by, fitting, out, topic, kind, scores), sequences, split)
    parts = {part: segmenter.weights.digest(part) for part in segmenter.weights.parts}
    model = {"weights": parts, "method": segmenter.method, "sensor": repr(fitting.given)}
    if segmenter.precision != "float32":
        model["precision"] = segmenter.precision
    settings = {**model, "scores": scores, "uncertain": uncertain, "format": kind}
    return run_tasks(
        tasks, out, settings, scores, uncertain, progress, resume, processes, batch, at_once or segmenter.at_once
    )


def tasks_in(inputs: Sequence[str], lone: Lone, sequences: Sequence[str] | None, split: str) -> list[Task]:
    """The scans of all inputs, data sets as lone ones; raises InputError where two would have the same files."""
    tasks = [task for text in inputs for task in _tasks(text, lone, sequences, split)]
    _check_names(tasks)
    return tasks


def run_tasks(
    tasks: Sequence[Task],
    out: Path,
    settings: Mapping[str, Any],
    scores: bool = False,
    uncertain: bool = False,
    progress: Progress = lambda done, total: None,
    resume: bool = False,
    processes: Processes = ALONE,
    batch: int = 1,
    at_once: int = 1,
) -> int:
    """Segment scans into `out`; `settings` is what their labels depend on. The rest is as of `predict`."""
    journal = Journal(out, settings, resume, processes)
    mine = [task for task in processes.share(tasks) if str(task.scores.relative_to(out)) not in journal.done]
    broken: list[str] = []
    for done, (task, fault) in enumerate(stream(mine, scores, uncertain, batch, at_once)):
        progress(done, len(mine))
        if fault is None:
            journal.add(str(task.scores.relative_to(out)))
        else:
            broken.append(fault)
    progress(len(mine), len(mine))
    journal.close()
    broken = [fault for some in processes.gather(broken) for fault in some]
    if broken and len(broken) == len(tasks):
        more = f" (and {len(broken) - 1} more scans, each broken)" if len(broken) > 1 else ""
        raise InputError(broken[0] + more)
    if broken:
        kept = len(tasks) - len(broken)
        raise SomeBroken(f"{kept} of {len(tasks)} scans are segmented, {len(broken)} are broken", broken)
    return len(tasks)


def _tasks(text: str, lone: Lone, sequences: Sequence[str] | None, split: str) -> Iterator[Task]:
    if is_dataset(text):
        dataset = open_dataset(text, own_classes(lone.taxonomy))
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
