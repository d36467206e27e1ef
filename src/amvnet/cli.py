"""The command line: the only place that prints or exits."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from amvnet import __version__
from amvnet.arguments import Parser, Positional, parser_of
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.config import Recipe
    from amvnet.data.labels import Taxonomy
    from amvnet.data.records import ScanRecord
    from amvnet.evaluation import Evaluation

DONE, FAILED, WRONG_INPUT = 0, 1, 2
MethodName = Literal["rv", "bev", "ensemble", "amvnet"]
WEIGHTS = "sim-hdl64e"
SHOWN = 20  # names of sequences in a line

console = Console(highlight=False)


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

    for name in ("lightning.pytorch", "lightning.fabric"):  # which set their levels when they are imported
        logging.getLogger(name).setLevel(logging.ERROR)
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


def say(line: str) -> None:
    """A line, left as long as it is: paths are copied from it."""
    console.print(line, markup=False, soft_wrap=True)


def on_terminal() -> bool:
    return console.is_terminal


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, a line every tenth elsewhere; yields what is told (done, in all)."""
    if not on_terminal():
        yield lambda done, total: _tenth(title, done, total)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _tenth(title: str, done: int, total: int) -> None:
    if done and done * 10 // total != (done - 1) * 10 // total:
        say(f"{title}: {done} of {total}")


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


VERBS: dict[str, tuple[Callable[..., None], Positional]] = {
    "demo": (demo, {}),
    "simulate": (simulate, {"out": {"metavar": "OUT", "type": Path}}),
    "train": (train, {"recipe": {"metavar": "RECIPE"}}),
    "predict": (predict, {"inputs": {"metavar": "INPUT", "nargs": "+"}}),
    "evaluate": (evaluate, {"data": {"metavar": "DATA"}}),
    "bench": (bench, {}),
    "info": (info, {"weights": {"metavar": "W", "nargs": "?"}}),
}


def _parser(verb: str, recipe: Recipe | None = None) -> Parser:
    return parser_of(verb, *VERBS[verb], recipe)


def _train_arguments(arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments of `train`: read once to find the recipe, and once more with its values as defaults."""
    from amvnet.config import Recipe
    from amvnet.recipes import load_recipe

    if {"-h", "--help"} & set(arguments):
        recipe = Recipe() if arguments[0].startswith("-") else load_recipe(arguments[0])
    else:
        recipe = load_recipe(_parser("train", Recipe()).parse_args(list(arguments)).recipe)
    parser = _parser("train", recipe)
    made = vars(parser.instantiate(parser.parse_args(list(arguments))))
    return made | {"recipe": dataclasses.replace(recipe, model=made.pop("model"), training=made.pop("training"))}


USAGE = f"""usage: amvnet VERB ...

  demo       simulate, segment, score, draw: the first thing to run
  simulate   write labelled scans of simulated streets
  train      train the networks and the point head
  predict    segment scans
  evaluate   score weights or predictions by the official formulas
  bench      time per stage on this machine
  info       what a weights file is, or what is installed

`amvnet VERB --help` says more. Version {__version__}."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code: 0 done, 2 the input is wrong, 1 anything else."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        say(USAGE)
        return DONE if arguments else WRONG_INPUT
    if arguments[0] == "--version":
        say(__version__)
        return DONE
    try:
        run(arguments[0], arguments[1:])
    except InputError as error:
        print(f"amvnet: {error}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("amvnet: interrupted", file=sys.stderr)
        return FAILED
    return DONE


def run(verb: str, arguments: Sequence[str]) -> None:
    """Run one verb.

    Raises:
        InputError: where the verb, its arguments or what they name cannot be used.
    """
    if verb not in VERBS:
        raise InputError(f"expected a verb of {', '.join(VERBS)}, found {verb!r}; see amvnet --help")
    _quiet()
    call = _train_arguments(arguments) if verb == "train" else vars(_parser(verb).parse_args(list(arguments)))
    VERBS[verb][0](**call)


def _quiet() -> None:
    """Keep the notes that libraries have for their developers from our users."""
    warnings.filterwarnings("ignore", module="lightning")
    warnings.filterwarnings("ignore", module="torch")


if __name__ == "__main__":
    sys.exit(main())
