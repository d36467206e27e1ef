"""Segment the scans of a user's inputs into label files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from amvnet.data.class_maps import ClassMap
from amvnet.data.formats.bags import Bag
from amvnet.data.formats.detect import BY_ENDING_OR_FOLDER, ending_of
from amvnet.data.formats.rows import UNKNOWN
from amvnet.data.labels import label_bags
from amvnet.distributed import Processes
from amvnet.errors import InputError, SomeBroken
from amvnet.inference.certainty import UncertainCount, Verdict
from amvnet.inference.inputs import (
    DatasetScan,
    FileScan,
    InputScan,
    ScanOptions,
    adapter_for,
    open_inputs,
)
from amvnet.inference.pipeline import ExecutionOptions, OutputOptions, Pipeline
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import METHODS
from amvnet.progress import Progress, Say, no_progress, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter
from amvnet.written import WrittenFiles

# What to try if the labels are doubtful.
ADVICE = (
    "check what was assumed, and try --height, --axes, --rotate or --intensity-scale, "
    "weights of another sensor, or training for yours (docs/own_sensor.md)"
)


def predict(
    inputs: Sequence[str],
    segmenter: Segmenter,
    output: OutputOptions,
    options: ScanOptions = ScanOptions(),
    execution: ExecutionOptions = ExecutionOptions(),
    adapter: ScanAdapter | None = None,
    classes: ClassMap | None = None,
    progress: Progress = no_progress,
    say: Say = say_nothing,
) -> int:
    """Segment datasets, scan files, bags and folders of them.

    Args:
        inputs: each a dataset as `open_dataset` takes it, a scan file, a bag, or a folder of these.
        segmenter: labels the scans.
        output: what is written, and where.
        options: which scans of the inputs to segment.
        execution: how many scans at a time, and by which processes.
        adapter: adapts scan files to what the weights expect; None measures everything about the
            sensor and says nothing.
        classes: maps the classes of the weights to those that are written; None writes these.
        say: is told at the end how sure the labels are, if there are two networks.

    Returns:
        The number of label files of these scans, with those of the run that is resumed.

    Raises:
        InputError: before anything is written, if an input is missing, its folder is that of the
            output, a file of the user would be replaced, or the method has no uncertain points to
            write; at the end, if every scan is broken.
        SomeBroken: at the end, if some of several scans are broken.
    """
    if output.uncertain and not METHODS[segmenter.method].has_two_networks:
        raise InputError(
            f"expected a method of two networks for --uncertain, found {segmenter.method}; "
            "use amvnet"
        )

    adapter = adapter or adapter_for(segmenter.weights)
    opened = open_inputs(inputs, options, segmenter.taxonomy, adapter)
    scans = opened.scans
    taxonomy = segmenter.taxonomy
    if classes is not None:
        scans = [_with_classes(scan, classes) for scan in scans]
        taxonomy = classes.target

    if output.kind in label_bags.KINDS:
        _check_bags(opened.scans, output)

    execution = replace(execution, at_once=execution.at_once or segmenter.at_once)
    segment = NetworkSegmentation(segmenter, classes)
    pipeline = Pipeline(scans, segment, output, taxonomy, execution)
    settings = _settings(segmenter, output, adapter)
    if options.layout != UNKNOWN:
        settings["layout"] = repr(options.layout)
    if classes is not None:
        settings["classes"] = repr(classes)

    faults: SomeBroken | None = None
    try:
        written = pipeline.run(settings, progress)
    except SomeBroken as error:  # the others are written
        faults = error
    if output.kind in label_bags.KINDS and execution.processes.first:
        _write_bags(opened.scans, output)

    _report(segment, execution.processes, say)
    if faults is not None:
        raise faults
    return written


def _with_classes(scan: InputScan, classes: ClassMap) -> InputScan:
    """Return a scan whose labels are written as those of mapped classes."""
    if isinstance(scan, DatasetScan):
        return replace(scan, written=classes.target)
    return scan


def _check_bags(scans: Sequence[InputScan], output: OutputOptions) -> None:
    """Check that labels can become bags.

    Raises:
        InputError: if scans are in other files, or in these bags, or a bag of the user would be
            replaced.
    """
    label_bags.check_rosbags()
    bags = set()
    for scan in scans:
        if not isinstance(scan, FileScan):
            continue
        if BY_ENDING_OR_FOLDER[ending_of(scan.path)].open is not Bag:
            raise InputError(
                f"{scan.path}: expected a bag for --format {output.kind}, found another file; "
                "choose another format, such as ply"
            )
        bag = label_bags.bag_path(scan.name, output.kind)
        bags.add(bag)
        if (output.folder / bag).resolve() == scan.path.resolve():
            raise InputError(
                f"{scan.path}: expected another folder for the labels, found the bag's own; "
                "change --out"
            )

    if not output.overwrite:
        WrittenFiles(output.folder).check(sorted(bags))


def _write_bags(scans: Sequence[InputScan], output: OutputOptions) -> None:
    """Join the labels of the scans to bags."""
    names = [scan.name for scan in scans if isinstance(scan, FileScan)]
    written = WrittenFiles(output.folder)
    written.claim({label_bags.bag_path(name, output.kind) for name in names})
    written.finish(label_bags.join_parts(output.folder, names, output.kind))


class NetworkSegmentation:
    """Segments scans of the inputs; those that are adapted to the weights, by their rings.

    Args:
        segmenter: labels the scans.
        classes: maps the labels to other classes; None leaves them.
    """

    def __init__(self, segmenter: Segmenter, classes: ClassMap | None = None) -> None:
        self.segmenter = segmenter
        self._table = None if classes is None else classes.table(segmenter.taxonomy)
        self.by_ring = segmenter.by_ring()
        self.counted = UncertainCount()

    def __call__(self, inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        results: list[Segmentation] = []

        pairs = zip(inputs, scans, strict=True)
        for is_adapted, group in groupby(pairs, key=lambda pair: pair[0].is_adapted):
            segmenter = self.by_ring if is_adapted else self.segmenter
            results += segmenter.many([scan for _, scan in group])

        for result in results:
            self.counted.add(result.labels, result.uncertain)
        if self._table is None:
            return results
        return [replace(result, labels=self._table[result.labels]) for result in results]


def _report(segment: NetworkSegmentation, processes: Processes, say: Say) -> None:
    """Say how sure the labels of all processes are, and what to try if they are doubtful."""
    shares = processes.gather((segment.counted.points, segment.counted.uncertain))
    points = sum(points for points, _ in shares)
    uncertain = sum(uncertain for _, uncertain in shares)
    if not points or not METHODS[segment.segmenter.method].has_two_networks:
        return

    verdict = Verdict(uncertain / points, segment.segmenter.weights.usual_uncertain)
    say(f"warning: {verdict}; {ADVICE}" if verdict.is_doubtful else str(verdict))


def _settings(segmenter: Segmenter, output: OutputOptions, adapter: ScanAdapter) -> dict[str, Any]:
    """Return what the written files depend on, as JSON types."""
    weights = segmenter.weights
    settings: dict[str, Any] = {
        "weights": {part: weights.digest(part) for part in weights.parts},
        "method": segmenter.method,
        "sensor": repr(adapter.sensor),
        "scores": output.scores,
        "uncertain": output.uncertain,
        "format": output.kind,
    }

    if segmenter.precision != "float32":
        settings["precision"] = segmenter.precision
    if segmenter.tta is not None:
        settings["tta"] = segmenter.tta
    if segmenter.tau is not None:
        settings["tau"] = segmenter.tau
    return settings
