"""The verbs of the command line: what each asks the other modules to do, and what it says of it."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from amvnet.arguments import Positional
from amvnet.errors import InputError
from amvnet.terminal import console, on_terminal, progress, say

if TYPE_CHECKING:
    from amvnet.analysis import Swept
    from amvnet.data.labels import Taxonomy
    from amvnet.data.records import ScanRecord
    from amvnet.evaluation import Evaluation

MethodName = Literal["rv", "bev", "ensemble", "amvnet"]
WEIGHTS = "sim-hdl64e"
SHOWN = 20  # names of sequences in a line


def demo(out: Path = Path("demo"), seed: int | None = None, weights: str = WEIGHTS) -> None:
    """Simulate streets, segment them, score the result and draw it.

    Args:
        out: folder for the scans, predictions and pictures.
        seed: of the streets; by default one that the weights never saw.
        weights: a weights file, or the name of a built-in one.
    """
    from amvnet import jobs
    from amvnet.data.semantickitti import SemanticKitti
    from amvnet.segmenter import Segmenter
    from amvnet.simulation import simulate as write

    segmenter = Segmenter(weights)
    with progress("simulating") as step:
        seed = jobs.DEMO_SEED if seed is None else seed
        write(out / "data", sequences=jobs.DEMO_SEQUENCES, scans=jobs.DEMO_SCANS, seed=seed, progress=step)
    dataset = SemanticKitti(out / "data")
    records = jobs.choose_records(dataset, None, "all")
    with progress("segmenting") as step:
        jobs.predict([str(out / "data")], segmenter, out / "predictions", progress=step)
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


def train(
    recipe: Any,
    data: str,
    out: Path,
    stage: Literal["rv", "bev", "head", "all"] = "all",
    init: str | None = None,
    resume: bool = False,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    taxonomy: Path | None = None,
) -> None:
    """Train the two networks and the point head.

    Args:
        recipe: what to train; a built-in recipe's name or a YAML file.
        data: the data set: semantickitti:PATH, nuscenes:PATH, or a path whose layout says which.
        out: folder of the run.
        stage: which part to train; `all` trains one after the other.
        init: weights to begin with; parts that are not trained are taken from them.
        resume: go on where an earlier run in the folder stopped.
        train_sequences: sequences or scenes to train on, with commas; default: the official split.
        val_sequences: sequences or scenes to validate on, with commas; default: the official split.
        taxonomy: a semantic-kitti.yaml with other classes.
    """
    from amvnet import weights
    from amvnet.jobs import split_records
    from amvnet.runner import Run

    _calm_lightning()
    dataset = _open(data, taxonomy)
    learnt, val = split_records(dataset, _names(train_sequences), _names(val_sequences))
    say(f"training on {_listed(learnt)}; validating on {_listed(val)}")
    given = None if init is None else weights.load(init)
    path = Run(recipe, dataset, learnt, val, out, resume, say, on_terminal()).stages(stage, given)
    say(f"weights in {path}")


def predict(
    inputs: list[str],
    weights: str,
    out: Path,
    method: MethodName = "amvnet",
    sequences: str | None = None,
    scores: bool = False,
    device: str = "cpu",
) -> None:
    """Segment data sets, scans, or folders of scans.

    Args:
        inputs: data sets, scan files, or folders of scans.
        weights: a weights file, or the name of a built-in one.
        out: folder for the labels.
        method: the whole of AMVNet, or a part of it.
        sequences: of data sets, which sequences or scenes, with commas; default: all.
        scores: also write the probabilities of both networks.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet import jobs
    from amvnet.segmenter import Segmenter

    segmenter = Segmenter(weights, device, method)
    with progress("segmenting") as step:
        written = jobs.predict(inputs, segmenter, out, _names(sequences), scores, step)
    say(f"{len(written)} label files in {out}")


def evaluate(
    data: str,
    weights: str | None = None,
    predictions: Path | None = None,
    split: Literal["train", "val", "test", "all"] = "val",
    sequences: str | None = None,
    json: Path | None = None,
    pictures: Path | None = None,
    taxonomy: Path | None = None,
    device: str = "cpu",
) -> None:
    """Score weights, or predictions of any tool, by the benchmark's official formulas.

    Args:
        data: the data set.
        weights: a weights file, or the name of a built-in one: all methods are scored.
        predictions: a folder of predictions in the benchmark's layout, instead of weights.
        split: the official split to score.
        sequences: sequences or scenes to score instead, with commas.
        json: file for all figures.
        pictures: folder for drawings of some scans from above.
        taxonomy: a semantic-kitti.yaml with other classes.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet import jobs
    from amvnet.data.files import make_folder
    from amvnet.segmenter import Segmenter, widest_method
    from amvnet.weights import load

    if (weights is None) == (predictions is None):
        raise InputError("expected either --weights or --predictions, found both or neither; give one of them")
    given = None if weights is None else load(weights)
    dataset = _open(data, taxonomy, None if given is None else jobs.own_classes(given.taxonomy))
    records = jobs.choose_records(dataset, _names(sequences), split)
    if given is not None:
        label = jobs.by_weights(dataset, Segmenter(given, device, widest_method(given)))
    else:
        label = jobs.by_files(dataset, Path(str(predictions)))
    for path in (json, pictures):  # so that nothing is scored in vain
        if path is not None:
            make_folder(path.parent)
    with progress("scoring") as step:
        found = jobs.evaluate(dataset, records, label, pictures, step)
    show_evaluation(found, data, dataset.taxonomy, json)


def info(weights: str | None = None) -> None:
    """Say what a weights file is; without one, what is installed.

    Args:
        weights: a weights file, or the name of a built-in one.
    """
    from amvnet import report
    from amvnet import weights as weights_file

    if weights is not None:
        console.print(report.weights_table(weights_file.load(weights), weights))
        return
    console.print(report.installation_table())


def analyze(
    data: str,
    weights: str,
    out: Path,
    split: Literal["train", "val", "test", "all"] = "val",
    sequences: str | None = None,
    neighbours: str | None = None,
    recipe: str | None = None,
    train_sequences: str | None = None,
    device: str = "cpu",
) -> None:
    """Draw what the paper shows of the method: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the data set, with labels.
        weights: a weights file, or the name of a built-in one.
        out: folder for the figures (PNG), and the same figures as CSV and Markdown.
        split: the official split to score.
        sequences: sequences or scenes to score instead, with commas.
        neighbours: also train a head for each of these numbers of neighbours, with commas; needs a recipe.
        recipe: what says how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes that these heads learn from, with commas; default: the official split.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet import charts, jobs
    from amvnet.analysis import analyze as score
    from amvnet.analysis import sweep_neighbours
    from amvnet.data.files import make_folder
    from amvnet.recipes import load_recipe
    from amvnet.runner import Run
    from amvnet.segmenter import Segmenter
    from amvnet.weights import load

    if (neighbours is None) != (recipe is None):
        raise InputError("expected --neighbours and --recipe together, found one of them; give both or neither")
    given = load(weights)
    dataset = _open(data, None, jobs.own_classes(given.taxonomy))
    segmenter = Segmenter(given, device)
    jobs.by_weights(dataset, segmenter)
    records = jobs.choose_records(dataset, _names(sequences), split)
    heads: Iterable[Swept] = ()
    if recipe is not None:
        _calm_lightning()
        learnt = dataset.records(_names(train_sequences) or dataset.sequences("train"))
        chosen, counts = load_recipe(recipe), _counts(str(neighbours))
        Run(chosen, dataset, learnt, records, out)  # so that nothing is scored in vain
        heads = sweep_neighbours(chosen, given, dataset, learnt, records, counts, out, say, device)
    make_folder(out)
    with progress("scoring") as step:
        found = score(dataset, records, segmenter, step)
    written = charts.write_all(found, data, out)
    if swept := list(heads):
        used = given.model.point_head.neighbours
        written += charts.write_sweep(swept, "neighbours", used, data, out / "neighbours")
    say(f"{len(written)} files in {out}")


def ablate(
    recipe: Any,
    data: str,
    out: Path,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    device: str = "cpu",
) -> None:
    """Train the range-view network with and without GRU and class weights, and write the paper's Table 5.

    Args:
        recipe: what to train; a built-in recipe's name or a YAML file.
        data: the data set.
        out: folder for the four runs and the table; started again, it goes on.
        train_sequences: sequences or scenes to train on, with commas; default: the official split.
        val_sequences: sequences or scenes to score, with commas; default: the official split.
        device: where the trained networks are scored: cpu, cuda, cuda:1, ...
    """
    from amvnet import charts, jobs
    from amvnet.analysis import ablate as compare

    _calm_lightning()
    dataset = _open(data, None)
    learnt, val = jobs.split_records(dataset, _names(train_sequences), _names(val_sequences))
    say(f"training on {_listed(learnt)}; scoring on {_listed(val)}")
    rows = list(compare(recipe, dataset, learnt, val, out, say, on_terminal(), device))
    files = charts.write_ablation(rows, out / "ablation")
    say(files[-1].read_text().rstrip())


def bench(weights: str = WEIGHTS, scan: Path | None = None, runs: int = 10, device: str = "cpu") -> None:
    """Time the stages from a scan's file to its labels on this machine.

    Args:
        weights: a weights file, or the name of a built-in one.
        scan: the scan to time with; by default a simulated one.
        runs: how often; the medians are shown.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet.bench import time_stages
    from amvnet.data.files import read_scan
    from amvnet.report import timing_table
    from amvnet.segmenter import Segmenter
    from amvnet.simulation import simulate as write

    segmenter = Segmenter(weights, device)
    with TemporaryDirectory() as folder:
        if scan is None:
            write(Path(folder), scans=1)
        path = scan or Path(folder) / "sequences/00/velodyne/000000.bin"
        console.print(timing_table(time_stages(segmenter, lambda: read_scan(path), runs)))


def show_evaluation(evaluation: Evaluation, dataset: str, taxonomy: Taxonomy, path: Path | None) -> None:
    """Print the table, and write the same figures as JSON."""
    from amvnet.data.files import whole_file
    from amvnet.report import evaluation_table

    figures = evaluation.report(dataset)
    console.print(evaluation_table(figures, taxonomy))
    if path is not None:
        with whole_file(path) as part:
            part.write_text(json.dumps(figures, indent=1))


def _open(data: str, taxonomy: Path | None, otherwise: Taxonomy | None = None) -> Any:
    from amvnet.data.catalog import open_dataset
    from amvnet.data.labels import taxonomy_from_yaml

    return open_dataset(data, otherwise if taxonomy is None else taxonomy_from_yaml(taxonomy))


def _listed(records: Sequence[ScanRecord]) -> str:
    names = sorted({record.sequence for record in records})
    shown = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    return f"{len(records)} scans of {shown}"


def _names(text: str | None) -> list[str] | None:
    names = None if text is None else [name.strip() for name in text.split(",") if name.strip()]
    if names == []:
        raise InputError(f"expected names of sequences with commas, found {text!r}; name some, or leave the option out")
    return names


def _counts(text: str) -> list[int]:
    names = _names(text) or []
    if not all(name.isdecimal() and int(name) for name in names):
        raise InputError(f"expected numbers of neighbours with commas, found {text!r}; say 5,10,15")
    return sorted({int(name) for name in names})


def _calm_lightning() -> None:
    for name in ("lightning.pytorch", "lightning.fabric"):  # which set their levels when they are imported
        logging.getLogger(name).setLevel(logging.ERROR)


VERBS: dict[str, tuple[Callable[..., None], Positional]] = {
    "demo": (demo, {}),
    "simulate": (simulate, {"out": {"metavar": "OUT", "type": Path}}),
    "train": (train, {"recipe": {"metavar": "RECIPE"}}),
    "predict": (predict, {"inputs": {"metavar": "INPUT", "nargs": "+"}}),
    "evaluate": (evaluate, {"data": {"metavar": "DATA"}}),
    "analyze": (analyze, {"data": {"metavar": "DATA"}}),
    "ablate": (ablate, {"recipe": {"metavar": "RECIPE"}}),
    "bench": (bench, {}),
    "info": (info, {"weights": {"metavar": "W", "nargs": "?"}}),
}
