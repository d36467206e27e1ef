"""The verbs that train, or show what training gave: train, analyze, ablate."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from amvnet.cli.console import on_terminal, progress, say
from amvnet.cli.options import listed, meet, names_in, numbers_in, open_data, scores_in
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.evaluation.analysis import Swept


def train(
    recipe: Any,
    data: str,
    out: Path,
    stage: Literal["rv", "bev", "head", "all"] = "all",
    init: str | None = None,
    resume: bool = False,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    with_val: bool = False,
    dry_run: bool = False,
    taxonomy: Path | None = None,
    scores_a: Path | None = None,
    scores_b: Path | None = None,
    key_a: str | None = None,
    key_b: str | None = None,
    logits: Literal["a", "b", "both"] | None = None,
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
        with_val: learn from these too, as for an entry to a benchmark; then nothing is validated.
        dry_run: only take two steps of each network, and say what they cost and the whole training would.
        taxonomy: a semantic-kitti.yaml with other classes.
        scores_a: with --stage head: a folder of another model's scores, to train a head for it and --scores-b.
        scores_b: a folder of the other model's scores.
        key_a: which array of each .npz in --scores-a.
        key_b: which array of each .npz in --scores-b.
        logits: which of the two are scores before softmax.
    """
    from amvnet.distributed import device_of
    from amvnet.evaluation.scoring import split_records
    from amvnet.training.run import Run
    from amvnet.weights import file as weights

    _calm_lightning()
    processes = meet(device_of(recipe.training.accelerator) == "cuda")
    dataset = open_data(data, taxonomy)
    learnt, val = split_records(dataset, names_in(train_sequences), names_in(val_sequences), with_val)
    say(f"training on {listed(learnt)}; validating on {listed(val)}")
    given = None if init is None else weights.load(init)
    pair = scores_in(scores_a, scores_b, key_a, key_b, logits)
    run = Run(recipe, dataset, learnt, val, out, resume, say, on_terminal(), processes, pair)
    if dry_run:
        for trial in run.trials(stage):
            say(trial)
        return
    say(f"weights in {run.stages(stage, given)}")


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
    from amvnet.config.recipes import load_recipe
    from amvnet.data.scan_files import make_folder
    from amvnet.evaluation import charts
    from amvnet.evaluation import scoring as jobs
    from amvnet.evaluation.analysis import analyze as score
    from amvnet.evaluation.analysis import sweep_neighbours
    from amvnet.inference.segmenter import Segmenter
    from amvnet.training.run import Run
    from amvnet.weights.file import load

    if (neighbours is None) != (recipe is None):
        raise InputError("expected --neighbours and --recipe together, found one of them; give both or neither")
    given = load(weights)
    dataset = open_data(data, None, jobs.own_classes(given.taxonomy))
    segmenter = Segmenter(given, device)
    jobs.check_classes(dataset, given.taxonomy)
    records = jobs.choose_records(dataset, names_in(sequences), split)
    heads: Iterable[Swept] = ()
    if recipe is not None:
        _calm_lightning()
        learnt = dataset.records(names_in(train_sequences) or dataset.sequences("train"))
        chosen, counts = load_recipe(recipe), numbers_in(str(neighbours))
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
    from amvnet.distributed import device_of
    from amvnet.evaluation import charts
    from amvnet.evaluation import scoring as jobs
    from amvnet.evaluation.analysis import ablate as compare

    _calm_lightning()
    processes = meet(device_of(recipe.training.accelerator) == "cuda")
    dataset = open_data(data, None)
    learnt, val = jobs.split_records(dataset, names_in(train_sequences), names_in(val_sequences))
    say(f"training on {listed(learnt)}; scoring on {listed(val)}")
    rows = list(compare(recipe, dataset, learnt, val, out, say, on_terminal(), device, processes))
    if processes.first:
        files = charts.write_ablation(rows, out / "ablation")
        say(files[-1].read_text().rstrip())


def _calm_lightning() -> None:
    for name in ("lightning.pytorch", "lightning.fabric"):  # which set their levels when they are imported
        logging.getLogger(name).setLevel(logging.ERROR)
