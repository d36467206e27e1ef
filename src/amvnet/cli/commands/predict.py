"""The verb `predict`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import (
    ComputeChoice,
    ScanChoice,
    SensorChoice,
    join_processes,
    parse_classes,
)
from amvnet.models.methods import MethodName
from amvnet.progress import counted

FormatName = Literal["label", "npy", "ply", "pcd", "las", "bag", "mcap"]


def predict(
    inputs: list[str],
    weights: str,
    out: Path,
    choice: ScanChoice,
    known: SensorChoice,
    compute: ComputeChoice,
    method: MethodName = "amvnet",
    tau: float | None = None,
    scores: bool = False,
    resume: bool = False,
    format: FormatName = "label",
    uncertain: bool = False,
    classes: str | None = None,
    batch: int = 1,
    overwrite: bool = False,
) -> None:
    """Segment datasets, scans, bags, or folders of scans.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin'.
        weights: a weights file, or the name of a built-in one.
        out: folder for the labels.
        choice: which scans of the inputs.
        known: what is known of the sensor of scan files.
        compute: where and how the networks are computed.
        method: the whole of AMVNet, or a part of it.
        tau: points whose probabilities by the two networks have a cosine similarity of at most this
            go to the head, in [0, 1]; fewer points take less time; default: that of the weights.
        scores: also write the probabilities of both networks.
        resume: continue an earlier run into the folder: segment only the scans that are new or were
            not done, with the same weights and options.
        format: of scan files' labels: raw ids alone (label, npy), coloured points (ply, pcd, las),
            or, of bags, a bag of coloured points with the stamps of the scans (bag, mcap).
        uncertain: also write which points the two networks disagree on, as NAME.uncertain.npy.
        classes: write the ids of these classes, to which those of the weights are mapped: coarse,
            or a YAML file.
        batch: scans that go through the networks at a time; more than one suits a GPU.
        overwrite: replace files in the folder that amvnet did not write, too.
    """
    from amvnet.inference.pipeline import ExecutionOptions, OutputOptions
    from amvnet.inference.predict import predict as predict_inputs
    from amvnet.weights.file import load

    class_map = parse_classes(classes)
    processes = join_processes()
    sensor = known.parse()
    segmenter = compute.segmenter(load(weights), method, tau, processes)

    with progress("segmenting") as step:
        written = predict_inputs(
            inputs,
            segmenter,
            OutputOptions(out, format, scores, uncertain, overwrite),
            options=choice.parse(),
            execution=ExecutionOptions(batch, compute.at_once, resume, processes),
            sensor=sensor,
            classes=class_map,
            progress=step,
            say=say,
        )
    say(f"{counted(written, 'label file')} in {out}")
