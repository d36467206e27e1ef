"""Segments any number of scans, and goes on after an interruption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from amvnet.data.label_files import check_kind
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError, SomeBroken
from amvnet.inference.journal import Journal
from amvnet.inference.pipeline import Segment, Task, stream
from amvnet.inference.segmenter import Segmenter
from amvnet.inference.tasks import Lone, tasks_in
from amvnet.progress import Progress
from amvnet.sensors.adapt import ScanAdapter


def predict(
    inputs: Sequence[str],
    segmenter: Segmenter,
    out: Path,
    sequences: Sequence[str] | None = None,
    scores: bool = False,
    progress: Progress = lambda done, total: None,
    split: str = "all",
    topic: str | None = None,
    fitting: ScanAdapter | None = None,
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
        raise InputError(
            f"expected a method of two networks for --uncertain, found {segmenter.method}; use amvnet"
        )
    for option, count in (("batch", batch), ("at-once", 1 if at_once is None else at_once)):
        if count < 1:
            raise InputError(f"expected one scan or more at a time, found {count}; set --{option}")
    out, fitting, by_ring = (
        Path(out),
        fitting or ScanAdapter(segmenter.weights),
        segmenter.by_ring(),
    )

    def by(place: Path, lone: bool) -> Segment:
        return by_ring if lone else segmenter

    tasks = tasks_in(
        inputs, Lone(segmenter.taxonomy, by, fitting, out, topic, kind, scores), sequences, split
    )
    parts = {part: segmenter.weights.digest(part) for part in segmenter.weights.parts}
    model = {"weights": parts, "method": segmenter.method, "sensor": repr(fitting.given)}
    if segmenter.precision != "float32":
        model["precision"] = segmenter.precision
    settings = {**model, "scores": scores, "uncertain": uncertain, "format": kind}
    return run_tasks(
        tasks,
        out,
        settings,
        scores,
        uncertain,
        progress,
        resume,
        processes,
        batch,
        at_once or segmenter.at_once,
    )


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
    mine = [
        task
        for task in processes.share(tasks)
        if str(task.scores.relative_to(out)) not in journal.done
    ]
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
        raise SomeBroken(
            f"{kept} of {len(tasks)} scans are segmented, {len(broken)} are broken", broken
        )
    return len(tasks)
