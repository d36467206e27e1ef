"""The verb `predict`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import ScanChoice, SensorChoice
from amvnet.config.bounds import Count, Share
from amvnet.errors import InputError, import_optional
from amvnet.models.methods import Compute, MethodName
from amvnet.progress import counted

if TYPE_CHECKING:
    from amvnet.data.formats.rows import RowLayout

FormatName = Literal["label", "npy", "ply"]


def predict(
    inputs: list[str],
    /,
    weights: str,
    out: str,
    choice: ScanChoice,
    known: SensorChoice,
    compute: Compute,
    method: MethodName = "amvnet",
    tau: Share | None = None,
    scores: bool = False,
    resume: bool = False,
    format: FormatName = "label",
    uncertain: bool = False,
    classes: str | None = None,
    batch: Count = 1,
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
        method: the whole of AMVNet, or a part of it.
        tau: points whose probabilities by the two networks have a cosine similarity of at most this
            go to the head, in [0, 1]; fewer points take less time; default: that of the weights.
        scores: also write the probabilities of both networks.
        resume: continue an earlier run into the folder: segment only the scans that are new or were
            not done, with the same weights and options.
        format: of scan files' labels: raw ids alone (label, npy), or coloured points (ply).
        uncertain: also write which points the two networks disagree on, as NAME.uncertain.npy.
        classes: write the ids of these classes, to which those of the weights are mapped: coarse,
            or a YAML file.
        batch: scans that go through the networks at a time; more than one suits a GPU.
        overwrite: replace files that exist.
        ray: share the scans among the workers of a Ray cluster, and write a table of results;
            without an address, Ray starts on this machine.
        workers: of --ray, their number; default: one for each GPU, or for each 4 cores.
    """
    from amvnet.data.class_maps import class_map
    from amvnet.weights.file import load

    mapping = None if classes is None else class_map(classes)
    if ray:
        cluster = import_optional("amvnet.fleet.cluster", "fleet")
        labelling = cluster.Labelling(
            load(weights),
            out,
            kind=format,
            scores=scores,
            uncertain=uncertain,
            method=method,
            tau=tau,
            compute=compute,
            batch=batch,
            sensor=known.parse(),
            layout=_layout(choice),
            classes=mapping,
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

    from amvnet.export.engines import make_segmenter
    from amvnet.inference.pipeline import OutputOptions
    from amvnet.inference.predict import predict as predict_inputs

    for text in (*inputs, out):
        if "://" in text:
            raise InputError(f"{text}: expected a path, found a URL; say --ray to use it")
    sensor = known.parse()
    segmenter = make_segmenter(load(weights), method, compute, tau, say)

    with progress("segmenting") as step:
        written = predict_inputs(
            inputs,
            segmenter,
            OutputOptions(
                Path(out),
                format,
                scores=scores,
                uncertain=uncertain,
                overwrite=overwrite,
                resume=resume,
            ),
            options=choice.parse(),
            batch=batch,
            sensor=sensor,
            classes=mapping,
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
