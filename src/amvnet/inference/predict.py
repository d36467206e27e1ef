"""Segment the scans of a user's inputs into label files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from amvnet.data.class_maps import ClassMap
from amvnet.data.recordings import ScanFile
from amvnet.inference.drive import DriveOptions, Drives, find_poses
from amvnet.inference.journal import Entry
from amvnet.inference.listing import Inputs
from amvnet.inference.pipeline import OutputOptions, Pipeline, Segment, check_output
from amvnet.inference.request import LabellingRequest
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Reporter, TitledProgress, report_nothing
from amvnet.scan import Scan
from amvnet.weights.verdict import Verdict

SHOWN_RECORDINGS = 10  # the most doubtful recordings or scans that are named, each in a line
# What a user can try if the labels are doubtful.
ADVICE = (
    "check what was assumed, and try --height, --offset, --axes, --rotate or --intensity-scale, "
    "weights of another sensor, or training for yours (docs/own_sensor.md)"
)


def predict(
    inputs: Inputs,
    request: LabellingRequest,
    make_segmenter: Callable[[], Segmenter],
    output: OutputOptions,
    *,
    progress: TitledProgress,
    drive: DriveOptions | None = None,
    batch: int = 1,
    report: Reporter = report_nothing,
) -> tuple[list[Entry], list[str]]:
    """Segment datasets, scan files, bags and folders of them.

    Args:
        request: how the scans are labelled, and which files are written for each; its precision is
            not "auto", so that the journal says what the labels depend on.
        make_segmenter: returns the segmenter that computes the labels, with the weights, method and
            tau of the request. It is called after the inputs and the output are checked, because it
            may take long.
        drive: how the scores of drives are fused over time; by default, each scan is segmented
            alone.

    Returns:
        The entries of the scans that are labelled, including scans of the run that is resumed; and
        a line for each scan that is broken.

    Raises:
        InputError: before anything is written, if an input has other classes, or `check_output`
            raises it.
    """
    classes = request.classes
    scans = inputs.for_weights(request.weights, report, official=True)
    check_output(scans, output, request.settings if drive is None else None)
    drives = None
    if drive is not None:
        with progress("poses") as step:
            drives = find_poses(scans, drive.poses, drive.past_only, progress=step, report=report)
        table = None if classes is None else classes.table(request.weights.taxonomy)
        drives = replace(drives, table=table)
        request = replace(request, drive=drives.digest)
    segmenter = make_segmenter()
    pipeline = Pipeline(
        scans,
        segment_by(segmenter, classes, drives),
        output,
        batch=batch,
        at_once=segmenter.at_once,
        drives=drives,
    )
    with progress("segmenting") as step:
        return pipeline.run(request.settings, step)


def segment_by(
    segmenter: Segmenter, classes: ClassMap | None = None, drives: Drives | None = None
) -> Segment:
    """Return a function that segments scans, with labels in other classes and fused over drives."""
    table = None if classes is None else classes.table(segmenter.taxonomy)

    def segment(inputs: Sequence[ScanFile], scans: Sequence[Scan]) -> list[Segmentation]:
        yaws = None if drives is None else [drives.yaws[scan] for scan in inputs]
        results = segmenter.many(scans, yaws)
        if table is None:
            return results
        return [replace(result, labels=table[result.labels]) for result in results]

    return segment


def report_certainty(
    entries: Sequence[Entry], method: str, usual: float | None, report: Reporter
) -> None:
    """Report how sure the labels are, which recordings or scans have doubtful labels, and advice.

    A recording is named if all of its scans are doubtful or their sum is, and else those that are.
    The usual share of uncertain points is in [0, 1]; None if it is not known.
    """
    recordings: dict[str, list[Entry]] = {}
    for entry in entries:
        if entry.points:
            recordings.setdefault(entry.sensor, []).append(entry)
    if not recordings:
        return

    def judge(some: Iterable[Entry]) -> Verdict:
        counts = [(entry.uncertain, entry.points) for entry in some]
        uncertain, points = map(sum, zip(*counts, strict=True))
        return Verdict.of(method, uncertain / points, usual)

    doubtful: dict[str, Verdict] = {}
    for sensor, scans in recordings.items():
        bad = [entry for entry in scans if judge([entry]).is_doubtful]
        if 0 < len(bad) < len(scans):
            doubtful |= {str(Path(entry.scan).with_suffix("")): judge([entry]) for entry in bad}
        elif judge(scans).is_doubtful:
            doubtful[sensor] = judge(scans)

    verdict = judge(chain.from_iterable(recordings.values()))
    if not doubtful or (list(doubtful) == list(recordings) and len(recordings) == 1):
        report(f"warning: {verdict}; {ADVICE}" if doubtful else verdict.shares)
        return

    report(verdict.shares)
    for name in list(doubtful)[:SHOWN_RECORDINGS]:
        report(f"warning: {name}: {doubtful[name]}")
    others = len(doubtful) - SHOWN_RECORDINGS
    more = f"the same holds for {others} more; " if others > 0 else ""
    report(f"warning: {more}{ADVICE}")
