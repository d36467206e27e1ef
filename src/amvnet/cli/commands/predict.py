"""The verbs that use weights: what each asks the other modules to do, and what it says of it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import console, progress, say
from amvnet.cli.options import meet, methods_in, names_in, open_data
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.evaluation.metrics import Evaluation

MethodName = Literal["rv", "bev", "arithmetic", "maximum", "ensemble", "amvnet"]
EngineName = Literal["auto", "torch", "compile", "onnx"]
FormatName = Literal["label", "npy", "ply", "pcd", "las"]
PrecisionName = Literal["float32", "bfloat16", "float16"]
WEIGHTS = "sim-hdl64e"


def demo(out: Path = Path("demo"), seed: int | None = None, weights: str = WEIGHTS) -> None:
    """Simulate streets, segment them, score the result and draw it.

    Args:
        out: folder for the scans, predictions and pictures.
        seed: of the streets; by default one that the weights never saw.
        weights: a weights file, or the name of a built-in one.
    """
    from amvnet.data.datasets.semantickitti import SemanticKitti
    from amvnet.evaluation import scoring as jobs
    from amvnet.inference.predict import predict as segment
    from amvnet.inference.segmenter import Segmenter
    from amvnet.simulation import simulate as write

    segmenter = Segmenter(weights)
    with progress("simulating") as step:
        seed = jobs.DEMO_SEED if seed is None else seed
        write(out / "data", sequences=jobs.DEMO_SEQUENCES, scans=jobs.DEMO_SCANS, seed=seed, progress=step)
    dataset = SemanticKitti(out / "data")
    records = jobs.choose_records(dataset, None, "all")
    with progress("segmenting") as step:
        segment([str(out / "data")], segmenter, out / "predictions", progress=step)
    with progress("scoring") as step:
        label = jobs.by_weights(dataset, segmenter)
        found = jobs.evaluate(dataset, records, label, out / "pictures", step)
    show_evaluation(found, f"simulated streets, seed {seed}", dataset.taxonomy, out / "metrics.json")
    say(f"labels in {out / 'predictions'}, pictures in {out / 'pictures'}, figures in {out / 'metrics.json'}")


def simulate(
    out: Path,
    sensor: str = "hdl64e",
    sequences: int = 1,
    scans: int = 10,
    seed: int = 0,
    first_sequence: int = 0,
    processes: int | None = None,
) -> None:
    """Write labelled scans of simulated streets; what an earlier call has written stays, and it goes on from there.

    Args:
        out: folder to write to.
        sensor: the LiDAR: hdl64e writes SemanticKITTI's layout, hdl32e that of nuScenes-lidarseg.
        sequences: number of sequences; each is another street.
        scans: number of scans in each sequence.
        seed: of all randomness; the same seed gives the same bytes.
        first_sequence: number of the first sequence.
        processes: sequences that are simulated side by side; by default, one a processor.
    """
    from amvnet.simulation import simulate as write

    with progress("simulating") as step:
        write(
            out,
            sensor=sensor,
            sequences=sequences,
            scans=scans,
            seed=seed,
            first_sequence=first_sequence,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=step,
        )
    say(f"{sequences * scans} scans in {out}")


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
    from amvnet.export.engines import engage
    from amvnet.inference.predict import predict as segment
    from amvnet.inference.segmenter import Segmenter
    from amvnet.sensors.adapt import Fitting
    from amvnet.sensors.lidars import describe

    processes = meet()
    options = {"height": height, "intensity_scale": intensity_scale, "axes": axes, "rotate": rotate, "offset": offset}
    given = describe(sensor, **options)
    segmenter = Segmenter(weights, processes.device(device), method, precision)
    engage(segmenter, engine)
    fitting, chosen = Fitting(segmenter.weights, given, say), names_in(sequences)
    with progress("segmenting") as step:
        written = segment(
            inputs, segmenter, out, chosen, scores, step, split, topic, fitting, resume, processes, format, uncertain,
            batch, at_once,
        )  # fmt: skip
    say(f"{written} label files in {out}")


def evaluate(
    data: str,
    weights: str | None = None,
    predictions: Path | None = None,
    split: Literal["train", "val", "test", "all"] = "val",
    sequences: str | None = None,
    methods: str = "rv,bev,ensemble,amvnet",
    json: Path | None = None,
    pictures: Path | None = None,
    taxonomy: Path | None = None,
    device: str = "cpu",
    precision: PrecisionName = "float32",
) -> None:
    """Score weights, or predictions of any tool, by the benchmark's official formulas.

    Args:
        data: the data set.
        weights: a weights file, or the name of a built-in one: all methods are scored.
        predictions: a folder of predictions in the benchmark's layout, instead of weights.
        split: the official split to score.
        sequences: sequences or scenes to score instead, with commas.
        methods: what to score of weights, with commas; arithmetic and maximum are the other ensembles.
        json: file for all figures.
        pictures: folder for drawings of some scans from above.
        taxonomy: a semantic-kitti.yaml with other classes.
        device: cpu, cuda, cuda:1, ...
        precision: of the networks; float16 on a GPU only.
    """
    from amvnet.data.scan_files import make_folder
    from amvnet.evaluation import scoring as jobs
    from amvnet.inference.segmenter import Segmenter, widest_method
    from amvnet.weights.file import load

    if (weights is None) == (predictions is None):
        raise InputError("expected either --weights or --predictions, found both or neither; give one of them")
    processes = meet()
    given = None if weights is None else load(weights)
    dataset = open_data(data, taxonomy, None if given is None else jobs.own_classes(given.taxonomy))
    records = jobs.choose_records(dataset, names_in(sequences), split)
    if given is not None:
        segmenter = Segmenter(given, processes.device(device), widest_method(given), precision)
        label = jobs.by_weights(dataset, segmenter, methods_in(methods))
    else:
        label = jobs.by_files(dataset, Path(str(predictions)))
    for path in (json, pictures):  # so that nothing is scored in vain
        if path is not None:
            make_folder(path.parent)
    with progress("scoring") as step:
        found = jobs.evaluate(dataset, records, label, pictures, step, processes)
    if processes.first:
        show_evaluation(found, data, dataset.taxonomy, json)


def submit(
    data: str,
    predictions: Path | None = None,
    out: Path | None = None,
    check: Path | None = None,
    split: Literal["train", "val", "test"] = "test",
    sequences: str | None = None,
    use_camera: bool = False,
    use_lidar: bool = True,
    use_radar: bool = False,
    use_map: bool = False,
    use_external: bool = False,
) -> None:
    """Pack predictions for the benchmark's server after checking them, or check an archive of any tool.

    Args:
        data: the data set, whose scans are the reference.
        predictions: a folder of predictions in the benchmark's layout.
        out: the archive to write, NAME.zip.
        check: an archive to check instead.
        split: the official split; the servers score test, the others are for trials.
        sequences: sequences or scenes instead, with commas, for trials.
        use_camera: nuScenes: the method was given images.
        use_lidar: nuScenes: the method was given LiDAR scans.
        use_radar: nuScenes: the method was given radar.
        use_map: nuScenes: the method was given the semantic map.
        use_external: nuScenes: the method was given data that are not of nuScenes.
    """
    from amvnet.submission import pack as submission
    from amvnet.submission.rules import Sources, rules_for

    sources = Sources(use_camera, use_lidar, use_radar, use_map, use_external)
    rules = rules_for(open_data(data, None), split, names_in(sequences))
    if sources != Sources() and (check is not None or rules.meta is None):
        raise InputError("expected no --use-... but to write an archive for nuScenes, found one; leave it out")
    if check is not None and predictions is None and out is None:
        with progress("checking") as step:
            found = submission.check(rules, check, step)
    elif predictions is not None and out is not None and check is None:
        with progress("packing") as step:
            found = submission.write(rules, predictions, out, sources, step)
    else:
        raise InputError("expected either --predictions and --out, or --check, found others; give one or the other")
    say(f"{check or out}: {found.predictions} predictions of {rules.what} keep to the rules of {rules.taxonomy.name}")
    for note in found.notes:
        say(f"note: {note}")


def info(weights: str | None = None) -> None:
    """Say what a weights file is; without one, what is installed.

    Args:
        weights: a weights file, or the name of a built-in one: its model card, in Markdown.
    """
    from amvnet.cli.tables import installation_table
    from amvnet.weights.card import OURS, model_card
    from amvnet.weights.file import built_in, load

    if weights is not None:
        say(model_card(load(weights), weights, OURS if weights in built_in() else None).rstrip())
        return
    console.print(installation_table())


def show_evaluation(evaluation: Evaluation, dataset: str, taxonomy: Taxonomy, path: Path | None) -> None:
    """Print the table, and write the same figures as JSON."""
    from amvnet.cli.tables import evaluation_table
    from amvnet.data.scan_files import whole_file

    figures = evaluation.report(dataset)
    console.print(evaluation_table(figures, taxonomy))
    if path is not None:
        with whole_file(path) as part:
            part.write_text(json.dumps(figures, indent=1))
