"""The verb `predict`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import (
    Split,
    join_processes,
    make_segmenter,
    parse_names,
    refuse_other_formats,
)
from amvnet.models.methods import EngineName, MethodName, Precision

FormatName = Literal["label", "npy", "ply", "pcd", "las"]


def predict(
    inputs: list[str],
    weights: str,
    out: Path,
    method: MethodName = "amvnet",
    split: Split = "all",
    sequences: str | None = None,
    scores: bool = False,
    resume: bool = False,
    format: FormatName = "label",
    uncertain: bool = False,
    device: str = "cpu",
    engine: EngineName = "auto",
    precision: Precision = "float32",
    batch: int = 1,
    at_once: int | None = None,
    topic: str | None = None,
    sensor: str | None = None,
    height: float | None = None,
    intensity_scale: float | None = None,
    axes: str | None = None,
    rotate: str | None = None,
    offset: str | None = None,
) -> None:
    """Segment datasets, scans, bags, or folders of scans.

    Args:
        inputs: datasets, scan files, bags, or folders of these.
        weights: a weights file, or the name of a built-in one.
        out: folder for the labels.
        method: the whole of AMVNet, or a part of it.
        split: of datasets, the official split.
        sequences: of datasets, these sequences or scenes instead, separated by commas.
        scores: also write the probabilities of both networks.
        resume: continue an interrupted run into the folder.
        format: of scan files' labels: raw ids alone (label, npy), or coloured points (ply, pcd,
            las).
        uncertain: also write which points the two networks disagree on, as NAME.uncertain.npy.
        device: cpu, cuda, cuda:1, ...
        engine: what runs the networks: torch, compile (starts slowly), onnx (ONNX Runtime), or
            auto, the fastest here.
        precision: of the networks; float16 on a GPU only.
        batch: scans that go through the networks at a time; more than one suits a GPU.
        at_once: scans that are segmented at the same time on a CPU; default: one per thread, at
            most 4.
        topic: of bags, the topic of the scans; default: the only one with PointCloud2.
        sensor: of scan files, a LiDAR's name (vlp16, os1-64, ...) or a YAML file; default:
            measured.
        height: of scan files, the sensor's height over the ground in metres; default: measured.
        intensity_scale: of scan files, the largest possible intensity; default: 1, 255 or 65535,
            as the values suggest.
        axes: of scan files, x-forward (y left), y-forward (x right), z-forward (y down) or z-down
            (y right).
        rotate: of scan files, the rotation that levels them: yaw,pitch,roll in degrees.
        offset: of scan files, what to add to x,y,z after the rotation, in metres.
    """
    refuse_other_formats(inputs)
    from amvnet.inference.inputs import ScanOptions, adapter_for
    from amvnet.inference.pipeline import ExecutionOptions, OutputOptions
    from amvnet.inference.predict import predict as predict_inputs
    from amvnet.sensors.lidars import make_sensor
    from amvnet.weights.file import load

    processes = join_processes()
    given_sensor = make_sensor(
        sensor,
        height=height,
        intensity_scale=intensity_scale,
        axes=axes,
        rotate=rotate,
        offset=offset,
    )
    segmenter = make_segmenter(
        load(weights), processes.device(device), engine, precision, at_once, method=method
    )

    with progress("segmenting") as step:
        written = predict_inputs(
            inputs,
            segmenter,
            OutputOptions(out, format, scores, uncertain),
            options=ScanOptions(parse_names(sequences), split, topic),
            execution=ExecutionOptions(batch, at_once, resume, processes),
            adapter=adapter_for(segmenter.weights, given_sensor, say),
            progress=step,
        )
    say(f"{written} label files in {out}")
