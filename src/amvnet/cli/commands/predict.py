"""The verb `predict`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, say
from amvnet.cli.options import LabelChoice, ScanChoice, SensorChoice, load_segmenter
from amvnet.config.bounds import Count
from amvnet.errors import InputError, import_optional
from amvnet.models.methods import Compute
from amvnet.progress import counted

if TYPE_CHECKING:
    from amvnet.data.formats.rows import RowLayout


def predict(
    inputs: list[str],
    /,
    weights: str,
    out: str,
    choice: ScanChoice,
    known: SensorChoice,
    compute: Compute,
    labels: LabelChoice,
    batch: Count = 1,
    resume: bool = False,
    overwrite: bool = False,
    ray: str | bool = False,
    workers: Count | None = None,
) -> None:
    """Segment datasets, scans, bags, or folders of scans.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin';
            with --ray, scan files, folders of these, or manifests (.parquet, .csv), also as URLs.
        weights: a weights file, or the name of a built-in one.
        out: folder for the labels; with --ray also a URL.
        choice: which scans of the inputs.
        known: what is known of the sensor of scan files.
        compute: where and how the networks are computed.
        labels: how points are labelled, and which files are written.
        batch: scans that go through the networks at a time; more than one suits a GPU.
        resume: continue an earlier run into the folder: segment only the scans that are new or were
            not done, with the same weights and options.
        overwrite: replace files that exist.
        ray: share the scans among the workers of a Ray cluster, and write a table of results;
            without an address, Ray starts on this machine.
        workers: of --ray, their number; default: one for each GPU, or for each 4 cores.
    """
    from amvnet.weights.file import load

    if ray:
        from amvnet.data.class_maps import class_map

        cluster = import_optional("amvnet.fleet.cluster", "fleet")
        labelling = cluster.Labelling(
            load(weights),
            out,
            kind=labels.format,
            scores=labels.scores,
            uncertain=labels.uncertain,
            method=labels.method,
            tau=labels.tau,
            compute=compute,
            batch=batch,
            sensor=known.parse(),
            layout=_layout(choice),
            classes=None if labels.classes is None else class_map(labels.classes),
        )
        with progress("segmenting") as step:
            written = cluster.label_fleet(
                inputs,
                labelling,
                address=None if ray is True else ray,
                most=workers,
                resume=resume,
                overwrite=overwrite,
                progress=step,
                say=say,
            )
        say(f"{counted(written, 'label file')} in {out}; the table of results is in {out}/results")
        return

    from amvnet.inference.predict import predict as predict_inputs

    for text in (*inputs, out):
        if "://" in text:
            raise InputError(f"{text}: expected a path, found a URL; say --ray to use it")
    request = labels.parse(load(weights), choice, known, compute)
    segmenter = load_segmenter(request.weights, request.method, compute, request.tau)

    with progress("segmenting") as step:
        written = predict_inputs(
            inputs,
            request,
            segmenter,
            Path(out),
            sequences=choice.sequences,
            split=choice.split,
            batch=batch,
            overwrite=overwrite,
            resume=resume,
            also_read=(*inputs, weights, labels.classes, known.sensor),
            progress=step,
            say=say,
        )
    say(f"{counted(written, 'label file')} in {out}")


def _layout(choice: ScanChoice) -> RowLayout:
    """Return the layout of rows; raise InputError for options of datasets."""
    options = choice.parse()
    if choice != ScanChoice(columns=choice.columns, dtype=choice.dtype):
        raise InputError(
            "expected scan files for --ray, found --split, --sequences or --topic, which are of "
            "datasets and bags; leave one out"
        )
    return options.layout
