"""The verbs that use weights: what each asks the other modules to do, and what it says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import join_processes, parse_names

MethodName = Literal["rv", "bev", "arithmetic", "maximum", "ensemble", "amvnet"]
EngineName = Literal["auto", "torch", "compile", "onnx"]
FormatName = Literal["label", "npy", "ply", "pcd", "las"]
PrecisionName = Literal["float32", "bfloat16", "float16"]
WEIGHTS = "sim-hdl64e"


def predict(
    inputs: list[str],
    weights: str,
    out: Path,
    method: MethodName = "amvnet",
    split: Literal["train", "val", "test", "all"] = "all",
    sequences: str | None = None,
    scores: bool = False,
    resume: bool = False,
    format: FormatName = "label",
    uncertain: bool = False,
    device: str = "cpu",
    engine: EngineName = "auto",
    precision: PrecisionName = "float32",
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
    """Segment data sets, scans, bags, or folders of scans.

    Args:
        inputs: data sets, scan files, bags, or folders of these.
        weights: a weights file, or the name of a built-in one.
        out: folder for the labels.
        method: the whole of AMVNet, or a part of it.
        split: of data sets, the official split.
        sequences: of data sets, which sequences or scenes instead, with commas.
        scores: also write the probabilities of both networks.
        resume: go on where an interrupted run into the folder stopped.
        format: of lone scans' labels: raw ids alone (label, npy), or coloured points (ply, pcd, las).
        uncertain: also write which points the two networks disagree on, as NAME.uncertain.npy.
        device: cpu, cuda, cuda:1, ...
        engine: what runs the networks: torch, compile (a slow start), onnx (ONNX Runtime), or auto, the fastest here.
        precision: of the networks; float16 on a GPU only.
        batch: scans that go through the networks at a time; more than one suits a GPU.
        at_once: scans that are segmented side by side on a CPU; default: as many as there are threads, 4 at most.
        topic: of bags, the topic of the scans; default: the only one with PointCloud2.
        sensor: of lone scans, a LiDAR's name (vlp16, os1-64, ...) or a YAML file; default: measured.
        height: of lone scans, the sensor's metres over the ground; default: measured.
        intensity_scale: of lone scans, the largest intensity there can be; default: 1, 255 or 65535 by the values.
        axes: of lone scans, x-forward (y left), y-forward (x right), z-forward (y down) or z-down (y right).
        rotate: of lone scans, yaw,pitch,roll in degrees that turn them level.
        offset: of lone scans, metres to add to x,y,z after that.
    """
    from amvnet.export.engines import use_engine
    from amvnet.inference.predict import predict as segment
    from amvnet.inference.segmenter import Segmenter
    from amvnet.sensors.adapt import ScanAdapter
    from amvnet.sensors.lidars import make_sensor

    processes = join_processes()
    options = {
        "height": height,
        "intensity_scale": intensity_scale,
        "axes": axes,
        "rotate": rotate,
        "offset": offset,
    }
    given = make_sensor(sensor, **options)
    segmenter = Segmenter(weights, processes.device(device), method, precision)
    use_engine(segmenter, engine)
    fitting, chosen = ScanAdapter(segmenter.weights, given, say), parse_names(sequences)
    with progress("segmenting") as step:
        written = segment(
            inputs, segmenter, out, chosen, scores, step, split, topic, fitting, resume, processes, format, uncertain,
            batch, at_once,
        )  # fmt: skip
    say(f"{written} label files in {out}")
