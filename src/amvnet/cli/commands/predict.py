"""The command `predict`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli import options
from amvnet.cli.console import progress, report, show
from amvnet.config.bounds import Count
from amvnet.engines.compute import Compute, resolved
from amvnet.errors import InputError, counted
from amvnet.sensors.lidars import AUTO

if TYPE_CHECKING:
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.inference.journal import Entry
    from amvnet.inference.segmenter import Segmenter


def predict(
    inputs: list[str],
    /,
    choice: options.ScanChoice,
    sensor_choice: options.SensorChoice,
    compute: Compute,
    labels: options.LabelChoice,
    drive_choice: options.DriveChoice,
    weights: str = AUTO,
    out: str = "labels",
    batch: Count = 1,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Segment datasets, scans, bags, or folders of scans.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin'.
        choice: which scans of the inputs to segment.
        sensor_choice: what is known about the sensor of scan files.
        compute: where and how the networks are computed.
        labels: how points are labelled, and which files are written.
        drive_choice: whether the scores of drives are fused over time.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers.
        out: folder for the labels.
        batch: number of scans that go through the networks together; more than one suits a GPU.
        resume: continue an earlier run in the folder, with the same weights and options; segment
            only scans that are new or were not finished.
        overwrite: replace files that exist.
    """
    from amvnet.cli.tables import labelled_table
    from amvnet.inference.journal import JOURNAL
    from amvnet.inference.pipeline import check_faults
    from amvnet.inference.predict import predict as predict_inputs
    from amvnet.inference.predict import report_certainty

    for text in (*inputs, out):
        if "://" in text:
            raise InputError(f"{text}: expected a path, found a URL; use amvnet fleet")
    compute = resolved(compute)  # the labels depend on what "auto" is
    drive = drive_choice.parse()
    where = f"; labels go to {out}"
    found, weights, loaded = options.open_inputs(inputs, choice, sensor_choice, weights, where)
    request = labels.parse(loaded, found.reading, compute, *found.taxonomies)
    is_new = not (Path(out) / JOURNAL).exists()
    also_read = (*inputs, weights, labels.classes, sensor_choice.sensor, drive_choice.poses)

    def make_segmenter() -> Segmenter:
        return options.load_segmenter(request.weights, request.method, compute, request.tau)

    entries, faults = predict_inputs(
        found,
        request,
        make_segmenter,
        request.output(Path(out), overwrite, resume, also_read),
        progress=progress,
        drive=drive,
        batch=batch,
        report=report,
    )

    if entries:
        show(labelled_table(entries, request.taxonomy))
    if sum(entry.counts[0] for entry in entries if entry.counts):
        others = ", or their class is none of --classes" if request.classes else ""
        report(f"unlabelled points are lost returns: they have no place, or lie at 0, 0, 0{others}")
    usual = request.weights.usual_uncertain_at(request.tau)
    report_certainty(entries, request.method, usual, report)
    if request.weights.weakness:
        report(f"warning: {request.weights.weakness}")
    check_faults(faults, len(entries) + len(faults))
    report(f"{counted(len(entries), 'label file')} in {out}")
    if is_new:  # else the user has seen these lines
        given = [*options.given_options(choice), *options.given_options(sensor_choice)]
        look = _words_to_look(inputs, given, weights, out, labels, request.taxonomy, entries)
        report(f"look at them: {shlex.join(['amvnet', 'view', *look])}")
        _report_training(inputs, weights)


def _words_to_look(
    inputs: list[str],
    given: list[str],
    weights: str,
    out: str,
    labels: options.LabelChoice,
    written: Taxonomy,
    entries: list[Entry],
) -> list[str]:
    """Return the arguments of `view` that show the labels of `written` classes."""
    from amvnet.data.datasets.open import is_dataset
    from amvnet.data.formats.registry import COMMENT_READERS
    from amvnet.data.taxonomy import TAXONOMIES

    if f".{labels.format}" in COMMENT_READERS and entries and not any(map(is_dataset, inputs)):
        name = entries[0].scan.removesuffix(".npz")
        return [str(Path(out) / f"{name}.{labels.format}")]  # it names its classes
    if labels.classes is not None:
        return [*inputs, *given, "--labels", out, "--classes", labels.classes]
    if TAXONOMIES.get(written.name) == written:
        return [*inputs, *given, "--labels", out, "--taxonomy", written.name]
    return [*inputs, *given, "--weights", weights]  # `view` knows no other classes of label files


def _report_training(inputs: list[str], weights: str) -> None:
    """Report the command that trains further."""
    from amvnet.data.datasets.open import is_dataset

    datasets = [text for text in inputs if is_dataset(text)]
    data = datasets[0] if datasets else "YOURS.yaml"
    source = "" if datasets else " that YOURS.yaml describes (docs/own_data.md)"

    command = ["amvnet", "train", "finetune", "--init", weights, "--data", data]
    report(f"train on your labels{source}: {shlex.join([*command, '--out', 'runs/finetuned'])}")
